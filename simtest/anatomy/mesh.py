"""A user's mesh as a surface: made smooth by Loop subdivision, its normals and curvatures estimated at the vertices."""

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b
from pathlib import Path

import igl
import numpy as np

from simtest.anatomy.base import (
    Array,
    IntArray,
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    pack_points,
)
from simtest.anatomy.mesh_file import MESH_SUFFIXES, read_mesh
from simtest.anatomy.viewpoints import MeshProbe, lumen_pose, organ_pose
from simtest.errors import InputError
from simtest.resources import find
from simtest.spec.surface import AnatomySurface

__all__ = ["LUMEN_QUOTIENT", "MeshSurface", "PreparedMesh", "isoperimetric_quotient", "prepare", "read_mesh"]

LUMEN_QUOTIENT = 0.1
"""Below this isoperimetric quotient a mesh is taken for a lumen.

The quotient is 1 for a sphere and falls as a body gets long or folded. A tube of length-to-radius ratio q has about
4.5 / q: below 0.1 from 45 radii on, less with folds. A colon from CT has 0.03, a liver 0.3, so 0.1 parts them widely.
A short piece of gut is taken for an organ, and a shallow open patch for a lumen: the scene's ``kind`` says it then.
"""

MAX_SUBDIVIDED_FACES = 1_600_000

CURVATURE_RINGS = 2
"""Rings of neighbours to which the quadric is fitted for the curvature.

Few, so that the curvature is that of the normals which make the highlights: compared with the change of the vertex
normals along the edges of a colon from CT, subdivided once, 2 rings give 0.85 of the curvature, 5 give 0.55.
"""


@dataclass(frozen=True)
class PreparedMesh:
    """A mesh ready for rendering and for the truth.

    Parameters
    ----------
    mesh : TriangleMesh
        mm; normals and winding on the camera's side.
    shape_operators : ndarray, shape (V, 3, 3)
        S at the vertices, 1/mm, for those normals; NaN where the fit failed.
    lumen : bool
        Whether the camera belongs inside.
    subdivisions : int
        How often the mesh was subdivided.
    key : str
        Identity of the file and the settings.
    """

    mesh: TriangleMesh
    shape_operators: Array
    lumen: bool
    subdivisions: int
    key: str

    @cached_property
    def probe(self) -> MeshProbe:
        """Distances and rays for the choice of a pose."""
        return MeshProbe(self.mesh)


def isoperimetric_quotient(vertices: Array, faces: IntArray) -> float:
    """Give 36 pi V^2 / A^3 of a mesh with outward faces: 1 for a sphere, small for a long or folded body.

    Parameters
    ----------
    vertices : ndarray, shape (V, 3)
        mm.
    faces : ndarray of int, shape (F, 3)
        An open mesh counts as closed by cones from its centroid.

    Returns
    -------
    float
    """
    corners = (vertices - vertices.mean(axis=0))[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1).sum() / 2
    volume = np.einsum("ni,ni->n", corners[:, 0], cross).sum() / 6
    return float(36 * np.pi * volume**2 / area**3)


def prepare(path: str | Path, subdivisions: int = 1, kind: str = "auto") -> PreparedMesh:
    """Read a mesh and make it ready; the last few are kept as long as their file does not change.

    Parameters
    ----------
    path : str or Path
        A mesh file (see `read_mesh`).
    subdivisions : int
        Loop subdivisions; fewer, with a warning, where they would exceed `MAX_SUBDIVIDED_FACES`.
    kind : {"auto", "lumen", "organ"}
        "auto": a lumen if the isoperimetric quotient is below `LUMEN_QUOTIENT`.

    Returns
    -------
    PreparedMesh

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    path = Path(path).expanduser().resolve()
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return _prepare(str(path), state.st_mtime_ns, state.st_size, subdivisions, kind)


@lru_cache(maxsize=4)
def _prepare(path: str, mtime_ns: int, size: int, subdivisions: int, kind: str) -> PreparedMesh:
    loaded = read_mesh(path)
    vertices = np.ascontiguousarray(loaded.vertices, dtype=np.float64)
    faces = _outward(vertices, np.ascontiguousarray(loaded.faces, dtype=np.int64))
    lumen = kind == "lumen" or (kind == "auto" and isoperimetric_quotient(vertices, faces) < LUMEN_QUOTIENT)
    times = _allowed_subdivisions(path, faces, subdivisions)
    if times:
        vertices, faces = igl.loop(vertices, faces, times)
    normals = _vertex_normals(vertices, faces)
    # libigl counts a surface convex towards its normals positive, as we do (checked on a sphere by the tests).
    first, second, k1, k2, *_ = igl.principal_curvature(vertices, faces, CURVATURE_RINGS, True)
    operators = k1[:, None, None] * first[:, :, None] * first[:, None, :]
    operators += k2[:, None, None] * second[:, :, None] * second[:, None, :]
    if lumen:
        faces, normals, operators = np.ascontiguousarray(faces[:, ::-1]), -normals, -operators
    digest = blake2b(repr((path, mtime_ns, size, times, lumen)).encode(), digest_size=12).hexdigest()
    return PreparedMesh(TriangleMesh(vertices, faces, normals), operators, lumen, times, f"mesh-{digest}")


def _outward(vertices: Array, faces: IntArray) -> IntArray:
    """Make the winding consistent within each connected piece, and each piece's normals point outward."""
    faces, piece = igl.bfs_orient(faces)
    piece = np.asarray(piece).ravel()
    count = int(piece.max()) + 1
    corners = vertices[faces]
    # About each piece's own centroid, so that an open piece has a meaningful sign.
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, c, count) for c in corners.mean(axis=1).T], axis=1) / size[:, None]
    a, b, c = (corners[:, i] - middle[piece] for i in range(3))
    volume = np.bincount(piece, np.einsum("ni,ni->n", a, np.cross(b, c)), count)
    return np.ascontiguousarray(np.where((volume[piece] < 0)[:, None], faces[:, ::-1], faces), dtype=np.int64)


def _allowed_subdivisions(path: str, faces: IntArray, wanted: int) -> int:
    allowed = wanted
    while allowed and len(faces) * 4**allowed > MAX_SUBDIVIDED_FACES:
        allowed -= 1
    if allowed < wanted:
        warnings.warn(
            f"{path}: {wanted} subdivisions of {len(faces)} faces would exceed {MAX_SUBDIVIDED_FACES}; using {allowed}",
            stacklevel=4,
        )
    if allowed:
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        uses = np.unique(edges[:, 0] * (faces.max() + 1) + edges[:, 1], return_counts=True)[1]
        if (bad := int((uses > 2).sum())) > 0:
            warnings.warn(
                f"{path}: {bad} edges belong to more than two faces; Loop subdivision needs a manifold, using 0",
                stacklevel=4,
            )
            return 0
    return allowed


def _vertex_normals(vertices: Array, faces: IntArray) -> Array:
    normals = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


class MeshSurface(SurfaceModel):
    """A user's mesh with a camera inside its lumen or outside the organ.

    Parameters
    ----------
    spec : AnatomySurface
        Path, kind, viewpoint and subdivisions.

    Raises
    ------
    InputError
        If the file is missing or malformed, or no camera can be placed.
    """

    def __init__(self, spec: AnatomySurface) -> None:
        self._prepared = prepare(find(spec.path, "meshes", suffixes=MESH_SUFFIXES), spec.subdivisions, spec.kind)
        probe = self._prepared.probe
        if self._prepared.lumen:
            pose = lumen_pose(spec.label, spec.viewpoint, probe.sites, probe.clearance, probe.cast)
        else:
            pose = organ_pose(spec.label, spec.viewpoint, probe.targets, probe.clearance, probe.cast)
        self.solid = not self._prepared.lumen
        self.model_from_camera = pose

    @property
    def prepared(self) -> PreparedMesh:
        """The mesh with its normals and shape operators."""
        return self._prepared

    def shape(self) -> Shape:
        """Give the subdivided mesh; winding and normals on the camera's side."""
        return Shape("mesh", False, {}, self._prepared.mesh, self._prepared.key)

    def vertex_shape_operators(self) -> Array:
        """Give the fitted S at the vertices (see `SurfaceModel.vertex_shape_operators`)."""
        return self._prepared.shape_operators

    def clearance(self, points: Array) -> Array:
        """Give the signed distance of points, shape (N, 3), to the mesh, mm; positive on the camera's side."""
        return self._prepared.probe.clearance(points)

    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Give what the mesh says where rays meet it (see `SurfaceModel.points`).

        The position is the hit itself. The normal is the normalised barycentric mean of the vertex normals, the shape
        operator that of the vertices' tensors, projected on the plane perpendicular to that normal.
        """
        mesh, hit = self._prepared.mesh, np.flatnonzero(np.isfinite(hits.distance))
        second, third = hits.barycentric[hit].T
        weights, corners = np.stack([1 - second - third, second, third], axis=1), mesh.faces[hits.face[hit]]
        normal = np.einsum("nc,nci->ni", weights, mesh.normals[corners])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        operator = np.einsum("nc,ncij->nij", weights, self._prepared.shape_operators[corners])
        projector = np.eye(3) - normal[:, :, None] * normal[:, None, :]
        normals, operators = np.full((len(origins), 3), np.nan), np.full((len(origins), 3, 3), np.nan)
        normals[hit], operators[hit] = normal, projector @ operator @ projector
        return pack_points(origins, directions, hits.distance, normals, operators)
