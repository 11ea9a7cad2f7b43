"""Writing a mesh as PLY, OBJ or STL."""

from collections.abc import Mapping
from pathlib import Path

from simtest.errors import InputError
from simtest.runtime.files import write_atomically
from simtest.runtime.resources import shown
from simtest.surfaces.model import Array, TriangleMesh

WRITTEN_SUFFIXES = (".ply", ".obj", ".stl")


def check_target(path: Path) -> None:
    """Raise `InputError` where a mesh cannot be written to a path: before any work is done."""
    if path.suffix.lower() not in WRITTEN_SUFFIXES:
        raise InputError(f"--out {shown(path)}: suffix {path.suffix!r}; allowed: {', '.join(WRITTEN_SUFFIXES)}")
    if path.is_dir():
        raise InputError(f"--out {shown(path)}: is a folder; must be a file")
    if not path.parent.is_dir():
        raise InputError(f"--out {shown(path)}: no such folder {shown(path.parent)}")


def write_mesh(path: Path, mesh: TriangleMesh, attributes: Mapping[str, Array] | None = None) -> None:
    """Write a mesh; single precision in PLY and STL, the same bytes for the same mesh.

    Parameters
    ----------
    path : Path
        The suffix says the format: PLY holds vertex normals and attributes, OBJ vertex normals, STL neither.
    mesh : TriangleMesh
        mm.
    attributes : mapping, optional
        Numbers at the vertices by name, each of shape (V,), for PLY.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    import trimesh  # slow to import

    check_target(path)
    built = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        for name, values in (attributes or {}).items():
            built.vertex_attributes[name] = values.astype("f4")
        data = built.export(file_type="ply", vertex_normal=True)
    elif suffix == ".obj":
        # Eight digits: single precision, like the others.
        data = built.export(file_type="obj", include_normals=True, digits=8, header=None).encode()
    else:
        data = built.export(file_type="stl")
    try:
        write_atomically(path, lambda part: part.write_bytes(data))
    except OSError as error:
        raise InputError(f"--out {shown(path)}: cannot be written ({error.strerror})") from error
