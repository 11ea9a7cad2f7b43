"""`simtest mesh`: check a user's mesh, or make one from a recipe."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from simtest.cli.options import AsJson, named_path, replacing, seed_number

mesh = App(name="mesh", help="Check a mesh of yours, or make a colon or liver from its recipe.")

Seed = Annotated[int | None, Parameter(help="Seed of the shape; default the recipe's.", converter=seed_number)]


@mesh.command
def check(
    file: Path,
    /,
    *,
    distance: float = 30.0,
    exponent: float | None = None,
    roughness: float | None = None,
    kind: Literal["auto", "lumen", "organ"] = "auto",
    as_json: AsJson = False,
) -> int:
    """Check what is wrong with a mesh, what is mended when it is used, and whether it is fine enough for highlights.

    Exit 1 if it is too coarse or has a problem that cannot be mended, 2 if it is no mesh that can be used.

    Parameters
    ----------
    file : Path
        A PLY, OBJ, STL or VTK file; lengths in mm.
    distance : float
        Distance of camera and light from the surface, mm.
    exponent : float, optional
        Phong exponent of the highlights; default 200.
    roughness : float, optional
        GGX roughness alpha instead of an exponent.
    kind : str
        Which side the camera is on; auto goes by the shape.
    """
    from simtest.cli.printing import print_json
    from simtest.errors import InputError
    from simtest.surfaces.mesh_check import check_mesh
    from simtest.surfaces.mesh_surface import concentration

    if not 0.1 <= distance <= 1e4:
        raise InputError(f"--distance {distance:g}: must be 0.1 to 10000 mm")
    verdict = check_mesh(file, distance, concentration(exponent, roughness), kind)
    if as_json:
        print_json(verdict)
    else:
        print(*verdict.lines(), sep="\n")
    return 0 if verdict.usable else 1


@Parameter(name="*")
@dataclass(frozen=True)
class Recipe:
    """The options of an anatomy: its recipe, and where its mesh goes."""

    out: Annotated[Path, Parameter(help="File to write: .ply, .obj or .stl.", converter=named_path)]
    seed: Seed = None
    edge_mm: Annotated[float | None, Parameter(help="Edge length, mm; default that of the scenes.")] = None
    recipe: Annotated[
        Path | None, Parameter(help="Recipe file (TOML); default the shipped one.", converter=named_path)
    ] = None
    settings: Annotated[list[str] | None, replacing("length_mm=40")] = None
    curvature: Annotated[
        bool, Parameter(negative="", help="Write the principal curvatures k_min and k_max, 1/mm, into a PLY file.")
    ] = False
    as_json: AsJson = False


@mesh.command
def colon(*, options: Recipe) -> None:
    """Make a colon from its recipe: another one for each seed, the same bytes for the same."""
    _make("colon", options)


@mesh.command
def liver(*, options: Recipe) -> None:
    """Make a liver from its recipe: another one for each seed, the same bytes for the same."""
    _make("liver", options)


def _make(kind: Literal["colon", "liver"], given: Recipe) -> None:
    from simtest.cli.printing import print_json
    from simtest.errors import InputError
    from simtest.runtime.locks import exclusive_file
    from simtest.spec import parse_settings
    from simtest.surfaces.factory import make_mesh
    from simtest.surfaces.mesh_file import check_target, write_mesh
    from simtest.surfaces.recipe import load_anatomy

    check_target(given.out)
    if given.curvature and given.out.suffix.lower() != ".ply":
        raise InputError(f"--curvature: {given.out.suffix} files hold none; allowed: .ply")
    anatomy = load_anatomy(kind, given.recipe, given.seed, parse_settings(given.settings or []))
    with exclusive_file(given.out):
        made, k_min, k_max = make_mesh(anatomy, given.edge_mm)
        write_mesh(given.out, made, {"k_min": k_min, "k_max": k_max} if given.curvature else None)
    told = {"file": str(given.out), "vertices": len(made.vertices), "faces": len(made.faces)}
    if given.as_json:
        print_json(told)
    else:
        print("{file}: {vertices} vertices, {faces} faces".format_map(told))
