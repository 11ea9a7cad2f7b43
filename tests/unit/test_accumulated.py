"""Highlights of many frames on the tissue: the base's normal from a process whose law is known."""

import numpy as np
import pytest

from simtest.errors import Failure
from simtest.estimators.accumulated import Plane, Sighting, base_normal, fine_map
from simtest.geometry.vectors import angle_deg, rotation

DISTANCE, RADIUS = 20.0, 7.0
LOOK = np.diag([1.0, -1.0, -1.0])
"""World from camera, of a camera that looks down on z = 0."""


def poses(count, reach=5.0, shift=(0.0, 0.0)):
    number = np.arange(count)
    r, angle = reach * np.sqrt((number + 0.5) / count), 2.4 * number
    made = np.tile(np.eye(4), (count, 1, 1))
    made[:, :3, :3] = LOOK
    made[:, 0, 3], made[:, 1, 3] = r * np.cos(angle) + shift[0], r * np.sin(angle) + shift[1]
    made[:, 2, 3] = DISTANCE
    return made


def sightings(rng, normal, slope_deg, where, facets=4000):
    """Facets at rest on the plane z = 0, with Gaussian slopes about the base's: each shines where it faces a camera.

    A facet counts as facing a camera within 1 deg, so the same facet shines in neighbouring frames, as relief does.
    """
    at = np.zeros((facets, 3))
    at[:, :2] = rng.uniform(-12, 12, (facets, 2))
    slopes = rng.normal(0, np.radians(slope_deg), (facets, 2))
    fine = normal + np.concatenate([slopes, np.zeros((facets, 1))], axis=1)
    fine /= np.linalg.norm(fine, axis=1, keepdims=True)
    found = []
    for pose in where:
        ray = at - pose[:3, 3]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        shining = np.einsum("ni,ni->n", fine, -ray) > np.cos(np.radians(1.0))
        found.append(Sighting(pose, ray[shining] @ pose[:3, :3]))
    return found


def tilted(degrees, azimuth=0.4):
    return rotation(np.radians(degrees) * np.array([np.sin(azimuth), np.cos(azimuth), 0.0])) @ np.array([0.0, 0, 1])


PLANE = Plane(np.zeros(3), np.array([0.0, 0.0, 1.0]))


def test_fine_map_lies_on_the_tissue_and_faces_the_cameras():
    pose = poses(1)[0]
    ray = np.array([[0.1, 0.2, 1.0], [0.0, 0.0, -1.0]])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    found = fine_map([Sighting(pose, ray)], PLANE)
    # The second ray leads away from the tissue.
    assert len(found.position) == 1
    assert found.position[0] == pytest.approx(pose[:3, 3] + np.array([2.0, -4.0, -20.0]))
    assert found.normal[0] == pytest.approx(-LOOK @ ray[0])


def test_the_mean_of_what_is_seen_is_biased_and_the_estimate_is_not():
    """Cameras that all stand to one side see normals of that side: the mean follows them, the fit does not."""
    rng, normal = np.random.default_rng(3), tilted(6.0)
    errors, means = [], []
    for _ in range(20):
        seen = sightings(rng, normal, 4.0, poses(20, shift=(-4.0, 1.0)))
        found = base_normal(seen, PLANE, RADIUS)
        mapped = fine_map(seen, PLANE)
        near = np.linalg.norm(mapped.position, axis=1) < RADIUS
        errors.append(found.normal[:2] - normal[:2])
        means.append(mapped.normal[near].mean(axis=0)[:2] - normal[:2])
    standard_error = np.std(errors, axis=0) / np.sqrt(len(errors))
    # alpha = 0.001 for two components.
    assert (np.abs(np.mean(errors, axis=0)) < 3.5 * standard_error).all()
    assert np.degrees(np.linalg.norm(np.mean(means, axis=0))) > 1.0


@pytest.mark.slow
def test_stated_regions_hold_the_truth():
    """95 % regions of 200 films hold 92 to 98 %: a binomial of 95 % lies outside with 3.3 %."""
    rng, inside = np.random.default_rng(101), []
    for _ in range(200):
        normal = tilted(rng.uniform(0, 15), rng.uniform(-3, 3))
        found = base_normal(sightings(rng, normal, 4.0, poses(10)), PLANE, RADIUS)
        inside.append(found.squared_mahalanobis(normal) < 5.991)
    assert 0.92 <= np.mean(inside) <= 0.98


def test_more_frames_and_slopes():
    rng, normal = np.random.default_rng(5), tilted(8.0)
    where = poses(30)
    seen = sightings(rng, normal, 4.0, where, facets=8000)
    few, many = (base_normal(seen[:count], PLANE, RADIUS) for count in (2, 30))
    assert np.trace(many.covariance) < 0.5 * np.trace(few.covariance)
    assert angle_deg(many.normal, normal) < 1.0
    # The facets' 1 deg lobe widens the slopes little.
    assert np.degrees(many.slope) == pytest.approx(4.0, rel=0.15)


def test_errors_of_poses_widen_the_region():
    rng, normal = np.random.default_rng(6), tilted(5.0)
    seen = sightings(rng, normal, 4.0, poses(3))
    sure, unsure = (base_normal(seen, PLANE, RADIUS, (0.0, angle)) for angle in (0.0, np.radians(2.0)))
    assert np.trace(unsure.covariance) > np.trace(sure.covariance) + np.radians(0.5) ** 2


def test_a_wrong_plane_does_not_drive_the_normal():
    """The plane places highlights; 5 deg of it may cost a fraction of a degree."""
    rng, normal = np.random.default_rng(7), tilted(5.0)
    seen = sightings(rng, normal, 4.0, poses(30), facets=8000)
    wrong = Plane(np.array([0.0, 0.0, 0.4]), tilted(5.0, azimuth=2.5))
    gap = angle_deg(base_normal(seen, PLANE, RADIUS).normal, base_normal(seen, wrong, RADIUS).normal)
    assert gap < 0.5


def test_no_answer_from_too_little():
    pose = poses(1)[0]
    one = base_normal([Sighting(pose, np.array([[0.0, 0.0, 1.0]]))], PLANE, RADIUS)
    assert isinstance(one, Failure)
    assert "1 cells" in one.detail
    assert isinstance(base_normal([], PLANE, RADIUS), Failure)


def test_highlights_that_get_no_rarer_state_no_normal():
    """Facets of all slopes alike: nothing says where the base faces."""
    rng, found = np.random.default_rng(8), []
    for pose in poses(10):
        at = np.zeros((200, 3))
        at[:, :2] = rng.uniform(-10, 10, (200, 2))
        ray = at - pose[:3, 3]
        found.append(Sighting(pose, ray / np.linalg.norm(ray, axis=1, keepdims=True) @ pose[:3, :3]))
    made = base_normal(found, PLANE, RADIUS)
    assert isinstance(made, Failure) or np.sqrt(np.trace(made.covariance)) > np.radians(3)
