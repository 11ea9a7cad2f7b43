"""The relief on the normal alone against a really displaced patch: the study's own geometry, and its statements."""

import numpy as np
import pytest

from simtest.geometry.vectors import angle_deg
from simtest.rendering import backend
from studies.displaced_relief import EDGE_MM, WAVELENGTH_MM, TracedPatch, glints, make_patch

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("radius", [np.inf, 15.0, -40.0])
def test_displaced_normals_are_those_of_the_displaced_triangles(radius):
    patch = make_patch(radius, 6.0, 0)
    mesh, _ = patch.mesh()
    first, second = np.split(mesh.faces, 2)
    # The normal of a cell, across its diagonals, against the mean of its corners.
    corners = [first[:, 0], first[:, 1], first[:, 2], second[:, 2]]
    A, B, C, D = (mesh.vertices[i] for i in corners)
    flat = np.cross(C - A, D - B)
    mean = np.sum([mesh.normals[i] for i in corners], axis=0)
    flat, mean = (n / np.linalg.norm(n, axis=1, keepdims=True) for n in (flat, mean))
    # Both are means over a cell; along an edge e they differ by (1/8 - 1/24) e^2 of the slope's second derivative,
    # k^2 times the slope of 6 deg per axis.
    typical = np.sqrt(2) * 6.0 * (2 * np.pi * EDGE_MM / WAVELENGTH_MM) ** 2 / 12
    assert np.median(angle_deg(flat, mean)) < typical
    assert angle_deg(flat, mean).max() < 5 * typical


def test_seen_straight_on_only_the_base_curvature_turns_normals():
    mi = backend.load()
    assert TracedPatch(mi, make_patch(np.inf, 6.0, 0)).judge(0)[0].max() < 0.15
    patch = make_patch(15.0, 6.0, 0)
    feet = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    off = angle_deg(patch.displaced(feet)[1], patch.turned(feet)[1])
    # slope x height x curvature
    position, _, t = patch.base(feet)
    jets = patch.field.jets(position)
    expected = np.degrees(np.abs(np.sum(t * jets.gradient, axis=1) * jets.value) / 15)
    assert np.allclose(off, expected, rtol=0.1, atol=1e-3)
    assert off.max() < 0.5


def test_aslant_views_see_other_normals_and_hidden_parts():
    patch = TracedPatch(backend.load(), make_patch(np.inf, 6.0, 0))
    straight, aslant = patch.judge(30), patch.judge(80)
    assert straight[1] == straight[2] == 0
    assert aslant[1] > 0.01
    assert aslant[2] > 0.003
    assert np.median(aslant[0]) > 3 * np.median(straight[0])


def test_glints_hardly_move():
    moved, turned, lost = glints(make_patch(np.inf, 6.0, 1), 6.0)
    assert len(moved) > 20
    assert not lost.any()
    assert np.median(moved) < 0.2
    assert np.median(turned) < 0.03
    # But they do.
    assert np.median(moved) > 0.01
