"""A user's mesh as a surface: smoothed by Loop subdivision, with normals and curvatures estimated at its vertices."""

import warnings
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Literal

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.resources import find
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.built_mesh import BuiltMesh, MeshedSurface
from simtest.surfaces.fineness import DEFAULT_EXPONENT, needed_edge, phong_concentration
from simtest.surfaces.mesh_file import MESH_SUFFIXES, other_unit, read_mesh
from simtest.surfaces.mesh_geometry import area_quantile, edge_lengths, isoperimetric_quotient
from simtest.surfaces.model import RayHits, SurfacePoints, TriangleMesh, principal_curvatures
from simtest.surfaces.poses import lumen_pose, nearest_mm, organ_pose
from simtest.surfaces.repair import examine
from simtest.surfaces.subdivision import (
    allowed_smoothing,
    allowed_subdivisions,
    halvings,
    refine,
    shape_operators,
    vertex_normals,
)  # fmt: skip

LUMEN_QUOTIENT = 0.1
"""Below this isoperimetric quotient a mesh is taken for a lumen.

The quotient is 1 for a sphere and falls as a body gets long or folded. A tube of length-to-radius ratio q has about
4.5 / q: below 0.1 from 45 radii on, less with folds. A colon from CT has 0.03, a liver 0.3, so 0.1 parts them widely.
A short piece of gut is taken for an organ, and a shallow open patch for a lumen: ``kind`` of the scene corrects that.
"""

AUTO_CONCENTRATION = phong_concentration(DEFAULT_EXPONENT)
"""Lobe for which ``edge_mm = "auto"`` makes the mesh fine enough: that of the shipped anatomy scene."""

EDGE_QUANTILE = 0.05
"""``edge_mm = "auto"`` is what all but this share of the surface needs."""

SMOOTHING_EDGES = 2.0
"""Median edges of the file in the shortest wave that it can hold. With ``edge_mm``, shorter ones are smoothed."""

SAME_HIT = 1e-4
"""A solution in double precision farther than this from the renderer's hit, as a share of the distance, is another."""

MAX_CROSSING_FACES = 250_000
"""A mesh of up to this many faces is checked for self-intersections before it is used (about a second)."""


@dataclass(frozen=True)
class PreparedMesh(BuiltMesh):
    """A mesh ready for rendering and for the truth.

    Parameters
    ----------
    operators : ndarray, shape (V, 3, 3)
        S at the vertices, 1/mm, for the mesh's normals; NaN where the fit failed.
    lumen : bool
        Whether the camera belongs inside.
    subdivisions : int
        How often the mesh was subdivided.
    shortest_mm : float
        Shortest wavelength that the mesh holds itself, mm: two of the file's median edges, or what smoothing left.
    """

    operators: Array
    lumen: bool
    subdivisions: int
    shortest_mm: float

    @property
    def shape_operators(self) -> Array:
        """The fitted S at the vertices, 1/mm, shape (V, 3, 3)."""
        return self.operators

    def clearance(self, points: Array) -> Array:
        """Return the signed distance to the mesh, mm (see `BuiltMesh.clearance`)."""
        return self.probe.clearance(points)

    def at_hits(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, Array, Array]:
        """Return what the mesh holds at the hits themselves (see `BuiltMesh.at_hits`).

        The normal is the normalised barycentric mean of the vertex normals; S is that of the vertices' tensors,
        projected on the plane perpendicular to that normal.
        """
        # The renderer's hits are single precision: too coarse for the derivatives of a fine relief.
        hits = on_triangles(origins, directions, hits, self.mesh)
        # Linear between the corners, as the renderer shades it
        corners = self.mesh.faces[hits.face]
        normal = np.einsum("nc,nci->ni", hits.weights, self.mesh.normals[corners])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        operator = np.einsum("nc,ncij->nij", hits.weights, self.operators[corners])
        projector = np.eye(3) - normal[:, :, None] * normal[:, None, :]
        return hits.distance, normal, projector @ operator @ projector

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Return the distances of the hits on the triangles, in double precision (see `BuiltMesh.distances`)."""
        return on_triangles(origins, directions, hits, self.mesh).distance

    def motion(self, points: SurfacePoints, hits: RayHits) -> tuple[Array, Array]:
        """Return how points and normals move within the hit triangles (see `SurfaceModel.motion`)."""
        faces = self.mesh.faces[hits.face]
        corner, second, third = np.moveaxis(self.mesh.vertices[faces], 1, 0)
        a, b, c = np.moveaxis(self.mesh.normals[faces], 1, 0)
        first_edge, second_edge = second - corner, third - corner
        plane = np.cross(first_edge, second_edge)
        # The mean of the corners' normals is linear: its gradient from those of the second and third weights.
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / np.einsum("ni,ni->n", plane, plane)[:, None]
        gradient = _outer(b - a, np.cross(second_edge, plane) * scale) + _outer(
            c - a, np.cross(plane, first_edge) * scale
        )
        mean = np.einsum("nc,nci->ni", hits.weights, self.mesh.normals[faces])
        # Turned as the points' normals are, which face the rays.
        length = np.linalg.norm(mean, axis=1) * np.sign(np.einsum("ni,ni->n", mean, points.normal_base))
        across = np.eye(3) - _outer(points.normal_base, points.normal_base)
        return plane, across @ gradient / length[:, None, None]


def _outer(a: Array, b: Array) -> Array:
    return np.asarray(a[:, :, None] * b[:, None, :])


def on_triangles(origins: Array, directions: Array, hits: RayHits, mesh: TriangleMesh) -> RayHits:
    """Solve hits again in double precision, on the planes of the hit triangles (Moeller and Trumbore 1997)."""
    corner, second, third = np.moveaxis(mesh.vertices[mesh.faces[hits.face]], 1, 0)
    first_edge, second_edge, start = second - corner, third - corner, origins - corner
    across, along = np.cross(directions, second_edge), np.cross(start, first_edge)
    determinant = np.einsum("ni,ni->n", first_edge, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, distance = (
            np.einsum("ni,ni->n", a, b) / determinant
            for a, b in ((start, across), (directions, along), (second_edge, along))
        )
        # A triangle seen edge on has no better solution.
        better = np.abs(distance - hits.distance) < SAME_HIT * hits.distance
    barycentric = np.where(better[:, None], np.stack([u, v], axis=1), hits.barycentric)
    return RayHits(np.where(better, distance, hits.distance), hits.face, barycentric)


@dataclass(frozen=True)
class Refinement:
    """How a mesh is made smooth and fine; see `AnatomySurface` for the fields."""

    subdivisions: int = 1
    edge_mm: float | Literal["auto"] | None = None
    smoothing_mm: float | None = None


def prepare(path: str | Path, refinement: Refinement | int = 1, kind: str = "auto") -> PreparedMesh:
    """Read a mesh and prepare it; the last few are cached until their file changes.

    Repairs are warned of, and so are self-intersections, around which the truth is meaningless.

    Parameters
    ----------
    path : str or Path
        A mesh file (see `read_mesh`).
    refinement : Refinement or int
        How to refine it; a number is that of Loop subdivisions. Fewer are made, with a warning, if the faces would
        exceed `MAX_SUBDIVIDED_FACES`.
    kind : {"auto", "lumen", "organ"}
        "auto": a lumen if the isoperimetric quotient is below `LUMEN_QUOTIENT`.

    Raises
    ------
    InputError
        If the file is missing or malformed.
    """
    path = Path(path).expanduser().resolve()
    state = path.stat()
    how = Refinement(refinement) if isinstance(refinement, int) else refinement
    return _prepare(str(path), state.st_mtime_ns, state.st_size, how, kind)


@lru_cache(maxsize=4)
def _prepare(path: str, mtime_ns: int, size: int, how: Refinement, kind: str) -> PreparedMesh:
    vertices, faces, repairs = read_mesh(path)
    # what is wrong with the file
    lumen = is_lumen(vertices, faces, kind)
    _warn(path, vertices, faces, list(repairs.sentences(lumen)))
    # smooth and fine
    times, smoothing = _plan(path, vertices, faces, how, lumen)
    shortest = max(smoothing, SMOOTHING_EDGES * float(np.median(edge_lengths(vertices, faces))))
    vertices, faces = refine(vertices, faces, times, smoothing)
    normals, operators = vertex_normals(vertices, faces), shape_operators(vertices, faces)
    if lumen:
        # Everything turned inward, to the camera's side
        faces, normals, operators = np.ascontiguousarray(faces[:, ::-1]), -normals, -operators
    digest = blake2b(repr((path, mtime_ns, size, times, smoothing, lumen)).encode(), digest_size=12).hexdigest()
    return PreparedMesh(TriangleMesh(vertices, faces, normals), f"mesh-{digest}", operators, lumen, times, shortest)


def is_lumen(vertices: Array, faces: IntArray, kind: str) -> bool:
    """Return whether the camera belongs inside a mesh with outward faces; `kind` as in `prepare`."""
    return kind == "lumen" or (kind == "auto" and isoperimetric_quotient(vertices, faces) < LUMEN_QUOTIENT)


def _warn(path: str, vertices: Array, faces: IntArray, repairs: list[str]) -> None:
    """Warn of what was repaired, of a doubtful unit, and of self-intersections."""
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
    """Return how often to subdivide, and the wavelength to smooth, mm."""
    smoothing, wanted = how.smoothing_mm or 0.0, how.subdivisions
    # smoothing, by default of what is the mesh's own
    if how.edge_mm is not None and how.smoothing_mm is None:
        smoothing = SMOOTHING_EDGES * float(np.median(edge_lengths(vertices, faces)))
    smoothing = allowed_smoothing(path, faces, smoothing)
    # subdivisions, as many as the edge length needs
    if how.edge_mm is not None:
        edge = automatic_edge(vertices, faces, lumen, smoothing) if how.edge_mm == "auto" else how.edge_mm
        wanted = halvings(vertices, faces, edge)
    return allowed_subdivisions(path, faces, wanted), smoothing


def automatic_edge(vertices: Array, faces: IntArray, lumen: bool, smoothing_mm: float) -> float:
    """Return the edge length, mm, that highlights of `AUTO_CONCENTRATION` need as near as a camera comes.

    The faces are outward. Curvatures are taken after smoothing by `smoothing_mm`.
    """
    vertices, faces = refine(vertices, faces, 0, smoothing_mm)
    # The nearest camera sees the narrowest highlights.
    distance = nearest_mm(lumen)
    k_min, k_max = principal_curvatures(shape_operators(vertices, faces) * (-1.0 if lumen else 1.0))
    needed = needed_edge(distance, AUTO_CONCENTRATION, k_min, k_max)
    return area_quantile(needed, vertices, faces, EDGE_QUANTILE)


class MeshSurface(MeshedSurface):
    """A user's mesh with a camera inside its lumen or outside the organ.

    Raises `InputError` if the file is missing or malformed, no camera can be placed, or the relief has waves as long as
    the mesh's own.
    """

    faceted = True

    def __init__(self, spec: AnatomySurface) -> None:
        how = Refinement(spec.subdivisions, spec.edge_mm, spec.smoothing_mm)
        self._build = self.prepared = prepare(find(spec.path, "meshes", suffixes=MESH_SUFFIXES), how, spec.kind)
        _check_relief(spec, self.prepared.shortest_mm)
        probe, lumen = self.prepared.probe, self.prepared.lumen
        if lumen:
            pose = lumen_pose(spec.label, spec.viewpoint, probe.sites, probe.clearance, probe.cast)
        else:
            pose = organ_pose(spec.label, spec.viewpoint, probe.targets, probe.clearance, probe.cast)
        self.solid = not lumen
        self.model_from_camera = pose

    def motion(self, points: SurfacePoints, hits: RayHits) -> tuple[Array, Array]:
        """Return how points and normals move within the hit triangles (see `SurfaceModel.motion`)."""
        return self.prepared.motion(points, hits)


def _check_relief(spec: AnatomySurface, shortest_mm: float) -> None:
    """Raise `InputError` for waves that the mesh holds itself: both would claim the same forms."""
    for i, band in enumerate(spec.relief.bands if spec.relief else ()):
        if band.wavelength_mm > shortest_mm:
            raise InputError(
                f"surface.relief.bands.{i}.wavelength_mm = {band.wavelength_mm:g}: {spec.path} holds waves from "
                f"{shortest_mm:.3g} mm on itself (two of its median edges, or smoothing_mm); the relief's must be "
                "shorter, or surface.smoothing_mm longer"
            )
