"""A user's mesh as a surface: smoothed by Loop subdivision, with normals and curvatures estimated at its vertices."""

import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import igl
import numpy as np

from simtest.conventions import EDGES_PER_HALF_WIDTH
from simtest.errors import InputError
from simtest.geometry.vectors import dot, projector, unit
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.resources import find
from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.mesh_file import MESH_SUFFIXES, Repairs, examine, other_unit, read_mesh
from simtest.surfaces.model import RayHits, SurfacePoints, TriangleMesh, outer, principal_curvatures, remembered
from simtest.surfaces.poses import at_viewpoint, nearest_mm
from simtest.surfaces.triangles import (
    MeshedSurface,
    area_quantile,
    edge_lengths,
    edge_uses,
    isoperimetric_quotient,
)

DEFAULT_EXPONENT = 200.0
"""Phong exponent of the shipped anatomy scene."""

ISOVALUE = 0.5
"""Level at which half-widths are taken: the middle of the default isovalues."""

LEAST_STRETCH = 0.25
"""Below this |1 + d k| there is no isolated highlight (docs/concepts/theory.md, section 6)."""


def concentration(exponent: float | None = None, alpha: float | None = None) -> float:
    """Return c = -(log f)''(0) of a lobe over the angle between normal and view, with the light at the camera.

    Phong's lobe of an exponent n, by default `DEFAULT_EXPONENT`, has 4 n. Of a GGX lobe of roughness alpha the half
    vector is the view direction, so that f ~ (alpha^2 + (1 - alpha^2) sin^2)^-2 and c = 4 (1/alpha^2 - 1); masking and
    Fresnel reflection add a term of order 1. Raises `InputError` if a value is out of range.
    """
    if exponent is not None and alpha is not None:
        raise InputError("--exponent and --roughness: only one of them may be given")
    if alpha is not None:
        if not 0 < alpha < 1:
            raise InputError(f"--roughness {alpha:g}: must be between 0 and 1")
        return 4.0 * (1.0 / alpha**2 - 1.0)
    exponent = DEFAULT_EXPONENT if exponent is None else exponent
    if not 0 < exponent <= 1e5:
        raise InputError(f"--exponent {exponent:g}: must be greater than 0 and at most 100000")
    return 4.0 * exponent


def half_width(distance_mm: float, concentration: float, curvature: Array | float) -> Array:
    """Return the half-width at `ISOVALUE`, mm, of a highlight of a lobe of c: d sqrt(-2 ln t / c) / |1 + d k|."""
    angle = math.sqrt(-2.0 * math.log(ISOVALUE) / concentration)
    return distance_mm * angle / np.maximum(np.abs(1.0 + distance_mm * curvature), LEAST_STRETCH)


def curvature_and_edge(
    vertices: Array, faces: IntArray, lumen: bool, distance_mm: float, concentration: float
) -> tuple[Array, Array]:
    """Return the larger absolute curvature, 1/mm, and the edge length that a highlight needs, mm, at the vertices."""
    # The operators are for outward normals; in a lumen the camera sees the other side.
    k_min, k_max = principal_curvatures(shape_operators(vertices, faces) * (-1.0 if lumen else 1.0))
    narrow = np.minimum(*(half_width(distance_mm, concentration, k) for k in (k_min, k_max)))
    return np.maximum(np.abs(k_min), np.abs(k_max)), narrow / EDGES_PER_HALF_WIDTH


MAX_SUBDIVIDED_FACES = 1_600_000

CURVATURE_RINGS = 2
"""Rings of neighbours to which the quadric is fitted for the curvature.

Few, so that the curvature agrees with the normals that make the highlights: compared with the change of the vertex
normals along the edges of a colon from CT, subdivided once, 2 rings give 0.85 of the curvature, 5 give 0.55.
"""

MAX_SMOOTHED_FACES = 400_000
"""Meshes of up to this many faces are smoothed: 7 s and 1 GB at the limit."""


def fair(vertices: Array, faces: IntArray, wavelength_mm: float) -> Array:
    """Smooth a manifold: a wave of this length keeps half of its height, a longer one nearly all, a shorter one little.

    Minimises sum m |x - x0|^2 + s sum |L x|^2 / m, with L the cotangent Laplacian, m the Voronoi areas and s =
    (wavelength / 2 pi)^4, which damps a wave of wave number q by 1 / (1 + s q^4). At a rim the Laplacian is left out,
    so that an open mesh does not shrink.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    # Laplacian, areas, and 0 at the vertices of a rim
    laplacian = igl.cotmatrix(vertices, faces)
    mass = np.asarray(igl.massmatrix(vertices, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal())
    edges, uses = edge_uses(faces)
    inner = np.ones(len(vertices))
    inner[edges[uses == 1].ravel()] = 0.0
    strength = (wavelength_mm / (2 * math.pi)) ** 4
    system = (diags(mass) + strength * (laplacian.T @ diags(inner / mass) @ laplacian)).tocsc()
    # Symmetric and positive definite. Thin triangles make it so stiff that conjugate gradients take thousands of steps.
    options = {"SymmetricMode": True}
    solver = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    # About the centroid, so that rounding is relative to the size, not to the distance from the origin.
    middle = vertices.mean(axis=0)
    return np.ascontiguousarray(solver.solve(mass[:, None] * (vertices - middle)) + middle)


def halvings(length_mm: float, edge_mm: float) -> int:
    """Return how often edges of a length must be halved to be at most `edge_mm` long."""
    # With a small tolerance, so that the mesh's own edge length needs no halving.
    return max(0, math.ceil(math.log2(length_mm / edge_mm) - 1e-6))


def subdivisions_within_limit(faces: int, wanted: int) -> int:
    """Return how often a mesh of so many faces may be subdivided, at most `wanted` times."""
    # Each subdivision makes four faces of one.
    return next(times for times in range(wanted, -1, -1) if not times or faces * 4**times <= MAX_SUBDIVIDED_FACES)


def refine(vertices: Array, faces: IntArray, times: int, smoothing_mm: float) -> tuple[Array, IntArray]:
    """Subdivide by Loop's scheme, `times` times, and smooth fairly unless `smoothing_mm` (see `fair`) is 0.

    The smoothing comes after the first subdivision, where it also evens out what Loop's scheme leaves around vertices
    of other than six neighbours; before it if there would be more than `MAX_SMOOTHED_FACES`.
    """
    if smoothing_mm:
        if times and 4 * len(faces) <= MAX_SMOOTHED_FACES:
            vertices, faces = igl.loop(vertices, faces, 1)
            times -= 1
        vertices = fair(vertices, faces, smoothing_mm)
    return igl.loop(vertices, faces, times) if times else (vertices, faces)


def vertex_normals(vertices: Array, faces: IntArray) -> Array:
    """Return unit vertex normals, shape (V, 3): the faces' normals weighted by their angles at the vertex."""
    normals = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE)
    return unit(normals)


def shape_operators(vertices: Array, faces: IntArray) -> Array:
    """Return S at the vertices for outward normals, 1/mm, (V, 3, 3), by a quadric fitted to the neighbours."""
    fitted: Any = igl.principal_curvature(vertices, faces, CURVATURE_RINGS, True)
    first, second, k1, k2 = fitted[:4]
    # S = k1 d1 d1^T + k2 d2 d2^T
    return np.asarray(outer(k1[:, None] * first, first) + outer(k2[:, None] * second, second))


LUMEN_QUOTIENT = 0.1
"""Below this isoperimetric quotient a mesh is taken for a lumen.

The quotient is 1 for a sphere and falls as a body gets long or folded. A tube of length-to-radius ratio q has about
4.5 / q: below 0.1 from 45 radii on, less with folds. A colon from CT has 0.03, a liver 0.3, so 0.1 parts them widely.
A short piece of gut is taken for an organ, and a shallow open patch for a lumen: ``kind`` of the scene corrects that.
"""

AUTO_CONCENTRATION = concentration()
"""Lobe for which ``edge_mm = "auto"`` makes the mesh fine enough: that of the shipped anatomy scene."""

EDGE_QUANTILE = 0.05
"""``edge_mm = "auto"`` is what all but this share of the surface needs."""

SMOOTHING_EDGES = 2.0
"""Median edges of the file in the shortest wave that it can hold. With ``edge_mm``, shorter ones are smoothed."""

SAME_HIT = 1e-4
"""A solution in double precision farther than this from the renderer's hit, as a share of the distance, is another."""

MAX_CROSSING_FACES = 250_000
"""A mesh of up to this many faces is checked for self-intersections before it is used (about a second)."""


class MeshSurface(MeshedSurface):
    """A user's mesh with a camera inside its lumen or outside the organ."""

    faceted = True

    def __init__(
        self, mesh: TriangleMesh, key: str, operators: Array, lumen: bool, subdivisions: int, shortest_mm: float
    ) -> None:
        super().__init__(mesh, "mesh", key)
        self._operators = operators  # (V, 3, 3): S at the vertices, 1/mm, for the mesh's normals; NaN: the fit failed
        self.lumen, self.solid = lumen, not lumen
        self.subdivisions = subdivisions  # How often the mesh was subdivided
        # Shortest wavelength that the mesh holds itself, mm: two of the file's median edges, or what smoothing left
        self.shortest_mm = shortest_mm

    def vertex_shape_operators(self) -> Array:
        """Return the fitted S (see `SurfaceModel.vertex_shape_operators`)."""
        return self._operators

    def clearance(self, points: Array) -> Array:
        """Return the signed distance to the mesh (see `SurfaceModel.clearance`)."""
        return self.probe.clearance(points)

    def solved(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Array, IntArray, Array]:
        """Return the hits themselves, with the vertices and weights of their triangles' corners."""
        # The renderer's hits are single precision: too coarse for the derivatives of a fine relief.
        hits = on_triangles(origins, directions, hits, self.mesh)
        return hits.distance, self.mesh.faces[hits.face], hits.weights

    def form(self, corners: IntArray, weights: Array) -> tuple[Array, Array]:
        """Return what the mesh holds between its vertices, linear as the renderer shades it, S across the normal."""
        normal = unit(np.einsum("nc,nci->ni", weights, self.mesh.normals[corners]))
        across = projector(normal)
        return normal, across @ np.einsum("nc,ncij->nij", weights, self._operators[corners]) @ across

    def motion(self, points: SurfacePoints, hits: RayHits) -> tuple[Array, Array]:
        """Return how points and normals move within the hit triangles (see `SurfaceModel.motion`)."""
        mesh = self.mesh
        faces = mesh.faces[hits.face]
        corner, second, third = np.moveaxis(mesh.vertices[faces], 1, 0)
        a, b, c = np.moveaxis(mesh.normals[faces], 1, 0)
        first_edge, second_edge = second - corner, third - corner
        plane = np.cross(first_edge, second_edge)
        # The mean of the corners' normals is linear: its gradient from those of the second and third weights.
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / dot(plane, plane)[:, None]
        gradient = outer(b - a, np.cross(second_edge, plane) * scale)
        gradient += outer(c - a, np.cross(plane, first_edge) * scale)
        mean = np.einsum("nc,nci->ni", hits.weights, mesh.normals[faces])
        # Turned as the points' normals are, which face the rays.
        length = np.linalg.norm(mean, axis=1) * np.sign(dot(mean, points.normal_base))
        across = projector(points.normal_base)
        return plane, across @ gradient / length[:, None, None]


def on_triangles(origins: Array, directions: Array, hits: RayHits, mesh: TriangleMesh) -> RayHits:
    """Solve hits again in double precision, on the planes of the hit triangles (Moeller and Trumbore 1997)."""
    corner, second, third = np.moveaxis(mesh.vertices[mesh.faces[hits.face]], 1, 0)
    first_edge, second_edge, start = second - corner, third - corner, origins - corner
    across, along = np.cross(directions, second_edge), np.cross(start, first_edge)
    determinant = dot(first_edge, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, distance = (
            dot(a, b) / determinant for a, b in ((start, across), (directions, along), (second_edge, along))
        )
        # A triangle seen edge on has no better solution.
        better = np.abs(distance - hits.distance) < SAME_HIT * hits.distance
    barycentric = np.where(better[:, None], np.stack([u, v], axis=1), hits.barycentric)
    return RayHits(np.where(better, distance, hits.distance), hits.face, barycentric)


def prepare(
    path: str | Path,
    subdivisions: int = 1,
    edge_mm: float | Literal["auto"] | None = None,
    smoothing_mm: float | None = None,
    kind: str = "auto",
) -> MeshSurface:
    """Read a mesh and make it smooth and fine, as `AnatomySurface` says; the last few are cached until a file changes.

    There are fewer subdivisions, with a warning, if the faces would exceed `MAX_SUBDIVIDED_FACES`. Of `kind` "auto" it
    is a lumen if the isoperimetric quotient is below `LUMEN_QUOTIENT`. Repairs are warned of, and self-intersections,
    around which the truth is meaningless. Raises `InputError` if the file is missing or malformed.
    """
    path = Path(path).expanduser().resolve()
    state = path.stat()
    return _prepare((str(path), state.st_mtime_ns, state.st_size), subdivisions, edge_mm, smoothing_mm, kind)


@remembered
def _prepare(
    file: tuple[str, int, int],
    subdivisions: int,
    edge_mm: float | Literal["auto"] | None,
    smoothing_mm: float | None,
    kind: str,
) -> MeshSurface:
    vertices, faces, repairs = read_mesh(file[0])
    lumen = is_lumen(vertices, faces, kind)
    own_wave = SMOOTHING_EDGES * float(np.median(edge_lengths(vertices, faces)))
    # smooth, by default of what is the mesh's own, and fine
    smoothing = smoothing_mm or (own_wave if edge_mm is not None and smoothing_mm is None else 0.0)
    branching = int((edge_uses(faces)[1] > 2).sum())
    problems = [*_doubts(vertices, faces, repairs, lumen)]
    cannot = ""
    if len(faces) > MAX_SMOOTHED_FACES:
        cannot = f"{len(faces)} faces, at most {MAX_SMOOTHED_FACES} can be smoothed"
    elif branching:
        cannot = f"{branching} edges belong to more than two faces, smoothing needs a manifold"
    if smoothing and cannot:
        problems.append(f"{cannot}; using smoothing_mm = 0")
        smoothing = 0.0
    if edge_mm is not None:
        # as many subdivisions as the edge length needs
        edge = _automatic_edge(vertices, faces, lumen, smoothing) if edge_mm == "auto" else edge_mm
        subdivisions = halvings(float(np.quantile(edge_lengths(vertices, faces), 0.95)), edge)
    times = subdivisions_within_limit(len(faces), subdivisions)
    if times < subdivisions:
        # One subdivision more of a quarter of the limit's faces ends finer than what this mesh allows.
        fewer = MAX_SUBDIVIDED_FACES // 4 ** (times + 1)
        problems.append(
            f"{subdivisions} subdivisions of {len(faces)} faces would exceed {MAX_SUBDIVIDED_FACES}; using {times}"
            f". Decimated to {fewer} faces it would take {times + 1} and end finer"
        )
    if times and branching:
        problems.append(f"{branching} edges belong to more than two faces; Loop subdivision needs a manifold, using 0")
        times = 0
    for problem in problems:
        warnings.warn(f"{file[0]}: {problem}", stacklevel=3)
    vertices, faces = refine(vertices, faces, times, smoothing)
    normals, operators = vertex_normals(vertices, faces), shape_operators(vertices, faces)
    if lumen:
        # Everything turned inward, to the camera's side
        faces, normals, operators = np.ascontiguousarray(faces[:, ::-1]), -normals, -operators
    mesh, key = TriangleMesh(vertices, faces, normals), repr((*file, times, smoothing, lumen))
    return MeshSurface(mesh, key, operators, lumen, times, max(smoothing, own_wave))


def is_lumen(vertices: Array, faces: IntArray, kind: str) -> bool:
    """Return whether the camera belongs inside a mesh with outward faces; `kind` as in `prepare`."""
    return kind == "lumen" or (kind == "auto" and isoperimetric_quotient(vertices, faces) < LUMEN_QUOTIENT)


def _doubts(vertices: Array, faces: IntArray, repairs: Repairs, lumen: bool) -> Iterator[str]:
    """Yield what was repaired, a doubtful unit, and self-intersections."""
    if sentences := list(repairs.sentences(lumen)):
        yield "; ".join(sentences)
    if unit := other_unit(float(np.ptp(vertices, axis=0).max())):
        yield f"lengths are taken as mm; by its extent the file may be in {unit}"
    if len(faces) <= MAX_CROSSING_FACES and (crossing := examine(vertices, faces).crossing_faces):
        yield f"{crossing} faces cut through others; normals and curvatures around them mean nothing"


def _automatic_edge(vertices: Array, faces: IntArray, lumen: bool, smoothing_mm: float) -> float:
    """Return the edge length, mm, that `AUTO_CONCENTRATION` needs on outward faces as near as a camera comes."""
    vertices, faces = refine(vertices, faces, 0, smoothing_mm)
    # The nearest camera sees the narrowest highlights.
    needed = curvature_and_edge(vertices, faces, lumen, nearest_mm(lumen), AUTO_CONCENTRATION)[1]
    return area_quantile(needed, vertices, faces, EDGE_QUANTILE)


def make_mesh_surface(spec: AnatomySurface) -> MeshSurface:
    """Return a user's mesh with a camera at the pose numbered by the description's viewpoint."""
    path = find(spec.path, "meshes", suffixes=MESH_SUFFIXES)
    surface = prepare(path, spec.subdivisions, spec.edge_mm, spec.smoothing_mm, spec.kind)
    _check_relief(spec, surface.shortest_mm)
    return at_viewpoint(surface, spec.label, spec.viewpoint)


def _check_relief(spec: AnatomySurface, shortest_mm: float) -> None:
    """Raise `InputError` for waves that the mesh holds itself: both would claim the same forms."""
    for i, band in enumerate(spec.relief.bands if spec.relief else ()):
        if band.wavelength_mm > shortest_mm:
            raise InputError(
                f"surface.relief.bands.{i}.wavelength_mm = {band.wavelength_mm:g}: {spec.path} holds waves from "
                f"{shortest_mm:.3g} mm on itself (two of its median edges, or smoothing_mm); the relief's must be "
                "shorter, or surface.smoothing_mm longer"
            )
