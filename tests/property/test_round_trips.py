"""Transforms against SciPy's and closed forms, there and back, each with a rotation about no axis of the frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from simtest.dataset.scoring.dense.maps import ALL, matrix, to_camera
from simtest.geometry import ellipse_of_conic
from simtest.geometry.vectors import angle_deg, bisect, rotation, tangent_basis, tangent_coordinates
from simtest.runtime.seeds import from_integer
from simtest.spec import LightSpec
from simtest.spec.camera import Moved, Views
from simtest.surfaces.analytic import placement
from simtest.validation.motion import told_pose

ANGLES = st.floats(-3.0, 3.0)
TURNS = st.tuples(ANGLES, ANGLES, ANGLES)


@given(TURNS)
def test_a_rotation_is_scipys(vector):
    np.testing.assert_allclose(rotation(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation(vector) @ rotation(np.negative(vector)), np.eye(3), atol=1e-12)


@pytest.mark.parametrize("degrees", [1e-6, 0.5, 30.0, 90.0, 150.0, 180.0])
def test_angles_are_degrees(degrees):
    x, z = np.array([1.0, 0.0, 0.0]), np.radians(degrees)
    assert angle_deg(x, np.array([np.cos(z), np.sin(z), 0.0])) == pytest.approx(degrees, rel=1e-9)


@given(TURNS, st.floats(0.01, 3.0))
def test_tangent_coordinates_lead_to_the_other_normal(vector, angle):
    normal = rotation(vector)[2]
    first, second = (basis[0] for basis in tangent_basis(normal[None]))
    np.testing.assert_allclose(np.cross(first, second), normal, atol=1e-12)
    axis = np.cos(1.0) * first + np.sin(1.0) * second
    other = rotation(angle * axis) @ normal
    found = tangent_coordinates(normal, other)
    turned = np.cross(normal, found[0] * first + found[1] * second)
    np.testing.assert_allclose(rotation(turned) @ normal, other, atol=1e-9)


@given(TURNS)
def test_a_bisector_turns_with_camera_and_light(vector):
    position, light = np.array([2.0, -1.0, 20.0]), np.array([3.0, 4.0, 1.0])
    to_light, to_camera = light - position, -position
    wanted = to_light / np.linalg.norm(to_light) + to_camera / np.linalg.norm(to_camera)
    found = bisect(position, light)
    np.testing.assert_allclose(found, wanted / np.linalg.norm(wanted), atol=1e-12)
    turn = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(bisect(turn @ position, turn @ light), turn @ found, atol=1e-12)


@given(TURNS)
def test_a_moved_camera_and_its_told_pose(vector):
    degrees = tuple(np.degrees(vector).tolist())
    moved = Moved(translation_mm=(1.0, -2.0, 0.5), rotation_deg=degrees)
    assert np.allclose(moved.pose()[:3, :3], Rotation.from_rotvec(vector).as_matrix(), atol=1e-12)
    assert np.allclose(moved.pose()[:3, 3], [1.0, -2.0, 0.5])
    exact = told_pose(Views(length_mm=2.0), moved, from_integer(0))
    assert np.allclose(exact @ moved.pose(), np.eye(4), atol=1e-12)


@pytest.mark.parametrize(("tilt", "azimuth", "spin"), [(0.0, 0.0, 35.0), (20.0, 130.0, 0.0), (40.0, -70.0, 25.0)])
def test_a_surface_is_placed_as_its_angles_say(tilt, azimuth, spin):
    camera_from_model = np.linalg.inv(placement(10.0, tilt, azimuth, spin))
    lean, towards = np.radians([tilt, azimuth])
    normal = [np.sin(lean) * np.cos(towards), np.sin(lean) * np.sin(towards), -np.cos(lean)]
    np.testing.assert_allclose(camera_from_model[:3, 2], normal, atol=1e-12)
    np.testing.assert_allclose(camera_from_model[:3, 3], [0.0, 0.0, 10.0], atol=1e-12)
    assert np.linalg.det(camera_from_model[:3, :3]) == pytest.approx(1.0)
    # Without the lean x points where the spin says.
    upright = rotation(-lean * np.cross([0.0, 0.0, -1.0], [np.cos(towards), np.sin(towards), 0.0]))
    x = upright @ camera_from_model[:3, 0]
    np.testing.assert_allclose(x, [np.cos(np.radians(spin)), np.sin(np.radians(spin)), 0.0], atol=1e-12)


def test_a_light_stands_where_offset_and_azimuth_say():
    light = LightSpec.model_validate({"offset_mm": 2.0, "azimuth_deg": 30.0})
    np.testing.assert_allclose(light.nominal_mm, [2 * np.cos(np.pi / 6), 1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("angle_deg_of", [0.0, 25.0, 110.0])
def test_an_ellipse_is_that_of_its_conic(angle_deg_of):
    turn = rotation(np.array([0.0, 0.0, np.radians(angle_deg_of)]))[:2, :2]
    centre, axes = np.array([12.0, -7.0]), np.array([5.0, 2.0])
    form = turn @ np.diag(axes**-2.0) @ turn.T
    conic = np.empty((3, 3))
    conic[:2, :2], conic[:2, 2] = form, -form @ centre
    conic[2, :2], conic[2, 2] = conic[:2, 2], centre @ form @ centre - 1
    found = ellipse_of_conic(conic)
    np.testing.assert_allclose(found.centre, centre, atol=1e-9)
    np.testing.assert_allclose([found.semi_major, found.semi_minor], axes, atol=1e-9)
    assert np.degrees(found.angle) % 180 == pytest.approx(angle_deg_of % 180, abs=1e-6)


def test_axes_of_normal_maps_are_their_names():
    vectors = np.random.default_rng(0).normal(size=(5, 3))
    for axes in ALL:
        # A map's channels are what the inverse makes of the camera frame.
        np.testing.assert_allclose(to_camera(vectors @ np.linalg.inv(matrix(axes)).T, axes), vectors, atol=1e-12)
