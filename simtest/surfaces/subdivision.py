"""Refinement of a user's mesh: fair smoothing, Loop subdivision, normals and principal curvatures."""

import math
import warnings
from typing import Any

import igl
import numpy as np

from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces.mesh_geometry import edge_lengths, edge_uses

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


def halvings(vertices: Array, faces: IntArray, edge_mm: float) -> int:
    """Return how often edges must be halved for 95 % of them to be at most `edge_mm` long."""
    length = float(np.quantile(edge_lengths(vertices, faces), 0.95))
    # With a small tolerance, so that the mesh's own edge length needs no halving.
    return max(0, math.ceil(math.log2(length / edge_mm) - 1e-6))


def subdivisions_within_limit(faces: int, wanted: int) -> int:
    """Return how often a mesh of so many faces may be subdivided, at most `wanted` times."""
    allowed = wanted
    # Each subdivision makes four faces of one.
    while allowed and faces * 4**allowed > MAX_SUBDIVIDED_FACES:
        allowed -= 1
    return allowed


def allowed_subdivisions(path: str, faces: IntArray, wanted: int) -> int:
    """Return how often a mesh may be subdivided: `wanted`, or fewer with a warning that names the reason."""
    allowed = subdivisions_within_limit(len(faces), wanted)
    if allowed < wanted:
        # One subdivision more of a quarter of the limit's faces ends finer than what this mesh allows.
        fewer = MAX_SUBDIVIDED_FACES // 4 ** (allowed + 1)
        warnings.warn(
            f"{path}: {wanted} subdivisions of {len(faces)} faces would exceed {MAX_SUBDIVIDED_FACES}; using {allowed}"
            f". Decimated to {fewer} faces it would take {allowed + 1} and end finer",
            stacklevel=5,
        )
    if allowed and (bad := int((edge_uses(faces)[1] > 2).sum())) > 0:
        warnings.warn(
            f"{path}: {bad} edges belong to more than two faces; Loop subdivision needs a manifold, using 0",
            stacklevel=5,
        )
        return 0
    return allowed


def allowed_smoothing(path: str, faces: IntArray, wanted: float) -> float:
    """Return the wavelength that may be smoothed, mm: `wanted`, or 0 with a warning that names the reason."""
    problem = ""
    if len(faces) > MAX_SMOOTHED_FACES:
        problem = f"{len(faces)} faces, at most {MAX_SMOOTHED_FACES} can be smoothed"
    elif (bad := int((edge_uses(faces)[1] > 2).sum())) > 0:
        problem = f"{bad} edges belong to more than two faces, smoothing needs a manifold"
    if not wanted or not problem:
        return wanted
    warnings.warn(f"{path}: {problem}; using smoothing_mm = 0", stacklevel=5)
    return 0.0


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
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def shape_operators(vertices: Array, faces: IntArray) -> Array:
    """Return S at the vertices for outward normals, 1/mm, shape (V, 3, 3), from a quadric fitted to the neighbours.

    For libigl a surface convex towards its normals has positive curvature, as for us (the tests check it on a sphere).
    """
    fitted: Any = igl.principal_curvature(vertices, faces, CURVATURE_RINGS, True)
    first, second, k1, k2 = fitted[:4]
    # S = k1 d1 d1^T + k2 d2 d2^T
    operators = k1[:, None, None] * first[:, :, None] * first[:, None, :]
    operators += k2[:, None, None] * second[:, :, None] * second[:, None, :]
    return np.asarray(operators)
