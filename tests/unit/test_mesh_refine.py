"""Refinement of a user's mesh: normals and curvatures of known shapes, stability, fair smoothing, edge lengths."""

import numpy as np
import pytest
import trimesh

from simtest.spec.surfaces import AnatomySurface
from simtest.surfaces.mesh_file import read_mesh
from simtest.surfaces.mesh_surface import fair, halvings, prepare, refine, shape_operators, vertex_normals
from simtest.surfaces.model import principal_curvatures
from simtest.surfaces.triangles import edge_lengths, edge_uses


def plane_lattice(side, reach):
    """Vertices in the plane and faces of a jittered grid; the rim's vertices keep their place."""
    x = np.linspace(-reach, reach, side)
    points = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    inner = (np.abs(points) < reach - 1e-9).all(axis=1)
    points[inner] += np.random.default_rng(0).uniform(-0.25, 0.25, size=(inner.sum(), 2)) * (x[1] - x[0])
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    a, b, c, d = corner, corner + side, corner + side + 1, corner + 1
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def sphere():
    mesh = trimesh.creation.icosphere(5, radius=10.0)
    vertices = np.array(mesh.vertices)
    k = np.full(len(vertices), 0.1)
    return vertices, np.array(mesh.faces), vertices / 10, k, k, np.ones(len(k), dtype=bool)


def torus():
    big, small = 20.0, 6.0
    mesh = trimesh.creation.torus(big, small, major_sections=240, minor_sections=96)
    vertices = np.array(mesh.vertices)
    ring = np.hypot(vertices[:, 0], vertices[:, 1])
    centre = vertices * [1, 1, 0] * (big / ring)[:, None]
    k = (ring - big) / small / ring
    return vertices, np.array(mesh.faces), (vertices - centre) / small, k, np.full(len(k), 1 / small), ring > 0


def saddle():
    k1, k2 = -0.05, 0.08
    plane, faces = plane_lattice(121, 10.0)
    x, y = plane.T
    vertices = np.stack([x, y, -(k1 * x**2 + k2 * y**2) / 2], axis=1)
    gradient = np.stack([k1 * x, k2 * y, np.ones_like(x)], axis=1)
    length = np.linalg.norm(gradient, axis=1)
    normal = gradient / length[:, None]
    projector = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    low, high = principal_curvatures(projector @ np.diag([k1, k2, 0.0]) @ projector / length[:, None, None])
    return vertices, faces, normal, low, high, (np.abs(plane) < 9.0).all(axis=1)


@pytest.mark.parametrize("shape", [sphere, torus, saddle])
def test_normals_and_curvatures_of_known_shapes(shape):
    vertices, faces, normal, low, high, inner = shape()
    found = vertex_normals(vertices, faces)
    angle = np.degrees(np.arccos(np.einsum("ni,ni->n", found, normal).clip(-1, 1)))[inner]
    assert np.median(angle) < 0.1
    k_min, k_max = principal_curvatures(shape_operators(vertices, faces))
    largest = np.maximum(np.abs(low), np.abs(high))
    for measured, exact in ((k_min, low), (k_max, high)):
        assert np.median((np.abs(measured - exact) / largest)[inner]) < 0.02


def test_principal_curvatures_are_the_eigenvalues_in_the_tangent_plane():
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(50, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    projector = np.eye(3) - normal[:, :, None] * normal[:, None, :]
    symmetric = rng.normal(size=(50, 3, 3))
    S = projector @ (symmetric + symmetric.transpose(0, 2, 1)) @ projector
    values = np.linalg.eigvalsh(S + 1e3 * normal[:, :, None] * normal[:, None, :])
    np.testing.assert_allclose(np.stack(principal_curvatures(S), axis=1), values[:, :2], atol=1e-10)


def test_fair_smoothing_halves_the_wave_of_its_length_and_keeps_long_ones():
    plane, faces = plane_lattice(121, 40.0)
    inner = (np.abs(plane) < 25).all(axis=1)
    for length, kept in ((8.0, 0.5), (32.0, 1 / (1 + 0.25**4)), (4.0, 1 / 17)):
        wave = 0.05 * np.cos(2 * np.pi / length * plane[:, 0])
        smooth = fair(np.column_stack([plane, wave]), faces, 8.0)
        share = (smooth[inner, 2] @ wave[inner]) / (wave[inner] @ wave[inner])
        assert share == pytest.approx(kept, abs=0.03)


def test_an_open_flat_mesh_stays_as_it_is():
    plane, faces = plane_lattice(21, 10.0)
    vertices = np.column_stack([plane, np.zeros(len(plane))])
    np.testing.assert_allclose(fair(vertices, faces, 6.0)[:, 2], 0, atol=1e-12)
    rim = np.unique(edge_uses(faces)[0][edge_uses(faces)[1] == 1])
    np.testing.assert_allclose(fair(vertices, faces, 2.0)[rim], vertices[rim], atol=0.2)


def test_edges_are_halved_until_they_are_short_enough():
    ball = trimesh.creation.icosphere(3, radius=10.0)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    longest = np.quantile(edge_lengths(vertices, faces), 0.95)
    assert [halvings(longest, longest * share) for share in (2.0, 1.0, 0.9, 0.5, 0.49)] == [0, 0, 1, 1, 2]
    fine, _ = refine(vertices, faces, 2, 0.0)
    assert len(fine) == 10 * 4**5 + 2


def test_a_scene_may_ask_for_an_edge_length(tmp_path, monkeypatch):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(3, radius=15.0).export(path)
    prepared = prepare(path, edge_mm=1.5)
    assert prepared.subdivisions == 1
    radius = np.linalg.norm(prepared.mesh.vertices, axis=1)
    assert radius.mean() == pytest.approx(15, rel=0.01)  # fair smoothing hardly shrinks
    monkeypatch.setattr("simtest.surfaces.mesh_surface.AUTO_CONCENTRATION", 40.0)  # a wide lobe: fewer faces
    automatic = prepare(path, edge_mm="auto")
    assert automatic.subdivisions == 2  # 40 mm sqrt(2 ln 2 / 40) / (1 + 40/15) / 2 = 1.0 mm
    assert automatic.key != prepared.key
    with pytest.raises(ValueError, match=r"subdivisions = 2 and edge_mm = 0\.5: only one of them"):
        AnatomySurface(path="x.ply", subdivisions=2, edge_mm=0.5)
    with pytest.raises(ValueError, match="edge_mm"):
        AnatomySurface(path="x.ply", edge_mm="fine")


def test_a_surface_of_an_edge_length_is_read_back_from_its_dump():
    surface = AnatomySurface(path="x.ply", edge_mm=3.0)
    assert AnatomySurface.model_validate(surface.model_dump(mode="json")) == surface


def test_smoothing_is_left_out_with_a_warning_where_it_cannot_be(tmp_path, monkeypatch):
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(3, radius=15.0).export(path)
    monkeypatch.setattr("simtest.surfaces.mesh_surface.MAX_SMOOTHED_FACES", 1000)
    with pytest.warns(UserWarning, match="1280 faces, at most 1000 can be smoothed; using smoothing_mm = 0"):
        prepare(path, 0, smoothing_mm=3.0)


@pytest.mark.slow
def test_curvature_of_a_colon_from_ct_is_stable_when_the_edges_are_halved(shared_data):
    """Median over the surface of the larger change of the two curvatures, relative to the larger of them."""
    vertices, faces, _ = read_mesh(shared_data / "meshes" / "colon_edingca_00090.ply")
    smoothing = 2 * float(np.median(edge_lengths(vertices, faces)))
    coarse, coarse_faces = refine(vertices, faces, 1, smoothing)
    fine, fine_faces = refine(vertices, faces, 2, smoothing)
    before = np.stack(principal_curvatures(shape_operators(coarse, coarse_faces)))
    # Loop's scheme numbers the old vertices first.
    after = np.stack(principal_curvatures(shape_operators(fine, fine_faces)))[:, : len(coarse)]
    change = np.abs(after - before).max(axis=0) / np.abs(after).max(axis=0)
    assert np.median(change) < 0.10
