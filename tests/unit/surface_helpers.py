"""Differences, rays on meshes and angles, as tests of surfaces and renderers share them."""

import numpy as np

from simtest.surfaces import RayHits

STENCIL = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))
"""Central differences of 4th order, times the step."""

SECOND_STENCIL = ((-2, -1 / 12), (-1, 16 / 12), (0, -30 / 12), (1, 16 / 12), (2, -1 / 12))
"""Second differences, times the squared step."""


RELIEF = {
    "bands": [
        {"slope_deg": 4, "wavelength_mm": 1.5},
        {"slope_deg": 2, "wavelength_mm": 0.9, "kind": "ridged", "anisotropy": 2, "direction": [1, 2, 0]},
        {"slope_deg": 1.5, "wavelength_mm": 2.2, "kind": "pits"},
    ],
    "seed": 3,
}
"""Three bands, one of each kind."""


def derivative(f, step, stencil=STENCIL, order=1):
    """Differentiate f: R -> (N, ...) at 0."""
    return sum(weight * f(k * step) for k, weight in stencil) / step**order


def gradient(f, points, step):
    """Differentiate a function of points, shape (N, 3), along each axis, on the last axis of the result."""
    return np.stack([derivative(lambda h, e=axis: f(points + h * e), step) for axis in np.eye(3)], axis=-1)


def angle(a, b):
    """Return the angles between vectors, rad."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def hits_on(mesh, count, height, spread, seed=0):
    """Rays that start about `height` above random points of random faces, as a ray tracer reports their hits.

    Returns origins, directions, hits and the normal at one corner of each face.
    """
    rng = np.random.default_rng(seed)
    face, (b, c) = rng.integers(len(mesh.faces), size=count), np.sort(rng.random((2, count)), axis=0)
    b, c = b, c - b
    points = np.einsum("cn,nci->ni", np.stack([1 - b - c, b, c]), mesh.vertices[mesh.faces[face]])
    facing = mesh.normals[mesh.faces[face, 0]]
    origins = points + height * facing + spread * rng.normal(size=(count, 3))
    distance = np.linalg.norm(points - origins, axis=1)
    return origins, (points - origins) / distance[:, None], RayHits(distance, face, np.stack([b, c], axis=1)), facing


def interpolated_normals(mesh, count=100_000):
    """Return faces, weights and the interpolated unit normals of random points of a mesh, even by area."""
    rng, corners = np.random.default_rng(0), mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face, weights = rng.choice(len(area), count, p=area / area.sum()), rng.dirichlet([1, 1, 1], count)
    shown = np.einsum("nc,nci->ni", weights, mesh.normals[mesh.faces[face]])
    return face, weights, shown / np.linalg.norm(shown, axis=1, keepdims=True)


def normals(J, dh, away):
    """Return base and fine normals, against the vectors `away`, of tangents J = dX/dx, (N, 3, 2), and dh/dx, (N, 2)."""
    base = np.cross(J[:, :, 0], J[:, :, 1])
    base *= -np.sign(np.sum(base * away, axis=1, keepdims=True)) / np.linalg.norm(base, axis=1, keepdims=True)
    inverse = np.linalg.inv(np.einsum("nij,nik->njk", J, J))
    normal = base - np.einsum("nij,njk,nk->ni", J, inverse, dh)
    return base, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def curvatures(J, normal, dn):
    """Return the principal curvatures, (N, 2), of fine normals with derivatives dn/dx, (N, 3, 2)."""
    inverse = np.linalg.inv(np.einsum("nij,nik->njk", J, J))
    # A tangent f of the fine surface stands over the base's tangent f - N (N.f) = J a.
    first = np.cross(normal, np.roll(normal, 1, axis=1))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    tangents = np.stack([first, np.cross(normal, first)], axis=2)
    a = np.einsum("njk,nij,nit->nkt", inverse, J, tangents)
    form = np.einsum("nif,nik,nkt->nft", tangents, dn, a)
    return np.linalg.eigvalsh((form + np.swapaxes(form, 1, 2)) / 2)


def relative(found, curvature):
    """Return the error of both curvatures over the larger one's size, at least that of a radius of 1 m.

    In pools on a plane both vanish, and differences know nothing relative to that.
    """
    return np.abs(found - curvature).max(axis=1) / np.maximum(np.abs(curvature).max(axis=1), 1e-3)
