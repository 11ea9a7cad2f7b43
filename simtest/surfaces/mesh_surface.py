"""A user's mesh as a surface: made smooth by Loop subdivision, its normals and curvatures estimated at the vertices."""

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Literal

import numpy as np

from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec.surface import AnatomySurface
from simtest.surfaces.fineness import DEFAULT_EXPONENT, needed_edge, phong_concentration
from simtest.surfaces.mesh_file import MESH_SUFFIXES, other_unit, read_mesh
from simtest.surfaces.model import (
    Array,
    IntArray,
    RayHits,
    Shape,
    SurfaceModel,
    SurfacePoints,
    TriangleMesh,
    pack_points,
    principal_curvatures,
)
from simtest.surfaces.poses import AXIS_RANGE_MM, ORGAN_RANGE_MM, MeshProbe, lumen_pose, organ_pose
from simtest.surfaces.repair import examine
from simtest.surfaces.subdivision import (
    allowed_smoothing,
    allowed_subdivisions,
    edge_lengths,
    halvings,
    refine,
    shape_operators,
    vertex_normals,
)

__all__ = [
    "LUMEN_QUOTIENT",
    "MeshSurface",
    "PreparedMesh",
    "Refinement",
    "isoperimetric_quotient",
    "prepare",
    "read_mesh",
]

LUMEN_QUOTIENT = 0.1
"""Below this isoperimetric quotient a mesh is taken for a lumen.

The quotient is 1 for a sphere and falls as a body gets long or folded. A tube of length-to-radius ratio q has about
4.5 / q: below 0.1 from 45 radii on, less with folds. A colon from CT has 0.03, a liver 0.3, so 0.1 parts them widely.
A short piece of gut is taken for an organ, and a shallow open patch for a lumen: the scene's ``kind`` says it then.
"""

AUTO_CONCENTRATION = phong_concentration(DEFAULT_EXPONENT)
"""Lobe for which ``edge_mm = "auto"`` makes the mesh fine enough: that of the shipped anatomy scene."""

EDGE_QUANTILE = 0.05
"""``edge_mm = "auto"`` is what all but this share of the surface needs."""

SMOOTHING_EDGES = 2.0
"""With ``edge_mm``, relief shorter than this many median edges of the file is smoothed: it is the mesh's own."""

MAX_CROSSING_FACES = 250_000
"""Up to this many faces self-intersections are looked for before a mesh is used (about a second)."""


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


@dataclass(frozen=True)
class Refinement:
    """How a mesh is made smooth and fine; see `AnatomySurface` for the fields."""

    subdivisions: int = 1
    edge_mm: float | Literal["auto"] | None = None
    smoothing_mm: float | None = None


def prepare(path: str | Path, refinement: Refinement | int = 1, kind: str = "auto") -> PreparedMesh:
    """Read a mesh and make it ready; the last few are kept as long as their file does not change.

    Each repair is said in a warning, and so are self-intersections, since the truth around them is none.

    Parameters
    ----------
    path : str or Path
        A mesh file (see `read_mesh`).
    refinement : Refinement or int
        How to refine it; a number: so many Loop subdivisions. Fewer, with a warning, where the faces would exceed
        `MAX_SUBDIVIDED_FACES`.
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
    how = Refinement(refinement) if isinstance(refinement, int) else refinement
    return _prepare(str(path), state.st_mtime_ns, state.st_size, how, kind)


@lru_cache(maxsize=4)
def _prepare(path: str, mtime_ns: int, size: int, how: Refinement, kind: str) -> PreparedMesh:
    vertices, faces, repairs = read_mesh(path)
    lumen = is_lumen(vertices, faces, kind)
    _say(path, vertices, faces, list(repairs.sentences(lumen)))
    times, smoothing = _plan(path, vertices, faces, how, lumen)
    vertices, faces = refine(vertices, faces, times, smoothing)
    normals, operators = vertex_normals(vertices, faces), shape_operators(vertices, faces)
    if lumen:
        faces, normals, operators = np.ascontiguousarray(faces[:, ::-1]), -normals, -operators
    digest = blake2b(repr((path, mtime_ns, size, times, smoothing, lumen)).encode(), digest_size=12).hexdigest()
    return PreparedMesh(TriangleMesh(vertices, faces, normals), operators, lumen, times, f"mesh-{digest}")


def is_lumen(vertices: Array, faces: IntArray, kind: str) -> bool:
    """Say whether the camera belongs inside a mesh with outward faces; `kind` as in `prepare`."""
    return kind == "lumen" or (kind == "auto" and isoperimetric_quotient(vertices, faces) < LUMEN_QUOTIENT)


def _say(path: str, vertices: Array, faces: IntArray, repairs: list[str]) -> None:
    if repairs:
        warnings.warn(f"{path}: {'; '.join(repairs)}", stacklevel=4)
    if unit := other_unit(float(np.ptp(vertices, axis=0).max())):
        warnings.warn(f"{path}: lengths are taken as mm; by its extent the file may be in {unit}", stacklevel=4)
    if len(faces) <= MAX_CROSSING_FACES and (crossing := examine(vertices, faces).crossing_faces):
        warnings.warn(
            f"{path}: {crossing} faces cut through others; normals and curvatures around them mean nothing",
            stacklevel=4,
        )


def _plan(path: str, vertices: Array, faces: IntArray, how: Refinement, lumen: bool) -> tuple[int, float]:
    """Give how often to subdivide, and the wavelength to smooth, mm."""
    smoothing, wanted = how.smoothing_mm or 0.0, how.subdivisions
    if how.edge_mm is not None and how.smoothing_mm is None:
        smoothing = SMOOTHING_EDGES * float(np.median(edge_lengths(vertices, faces)))
    smoothing = allowed_smoothing(path, faces, smoothing)
    if how.edge_mm is not None:
        edge = automatic_edge(vertices, faces, lumen, smoothing) if how.edge_mm == "auto" else how.edge_mm
        wanted = halvings(vertices, faces, edge)
    return allowed_subdivisions(path, faces, wanted), smoothing


def automatic_edge(vertices: Array, faces: IntArray, lumen: bool, smoothing_mm: float) -> float:
    """Give the edge length, mm, for highlights of `AUTO_CONCENTRATION` seen from as near as a camera comes.

    Parameters
    ----------
    vertices : ndarray, shape (V, 3)
        mm.
    faces : ndarray of int, shape (F, 3)
        Outward.
    lumen : bool
        Whether the camera is inside.
    smoothing_mm : float
        Smoothing that the mesh will undergo; the curvatures are taken after it.

    Returns
    -------
    float
    """
    vertices, faces = refine(vertices, faces, 0, smoothing_mm)
    distance = (AXIS_RANGE_MM if lumen else ORGAN_RANGE_MM)[0]
    k_min, k_max = principal_curvatures(shape_operators(vertices, faces) * (-1.0 if lumen else 1.0))
    needed = needed_edge(distance, AUTO_CONCENTRATION, k_min, k_max)
    return area_quantile(needed, vertices, faces, EDGE_QUANTILE)


def area_quantile(values: Array, vertices: Array, faces: IntArray, share: float) -> float:
    """Give the value below which this share of the surface lies; values at the vertices, shape (V,), NaN ignored."""
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weight = np.bincount(faces.ravel(), np.repeat(area, 3), len(vertices))
    known = np.isfinite(values)
    order = np.argsort(values[known])
    filled = np.cumsum(weight[known][order])
    return float(values[known][order][np.searchsorted(filled, share * filled[-1])])


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
        how = Refinement(spec.subdivisions, spec.edge_mm, spec.smoothing_mm)
        self._prepared = prepare(find(spec.path, "meshes", suffixes=MESH_SUFFIXES), how, spec.kind)
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
