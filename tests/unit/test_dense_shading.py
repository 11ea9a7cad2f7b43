"""The baseline `shading`: exact pictures of matt surfaces, highlights, darkness, and what it may not see."""

import inspect

import numpy as np
import pytest
from dense_frames import LENSES, hit, sphere_truth

from simtest.calibration import Calibration
from simtest.dataset.scoring.dense.maps import MapOptions, Shading
from simtest.dataset.scoring.dense.score import score_frames
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from tests.marked import marked

CAMERA = Camera(160, 120, 110.0, 110.0, 80.0, 60.0)


def matt(normal, distance, rays, albedo=0.7):
    """Return Lambert's cosine over the squared distance, a light at the camera."""
    cosine = -np.einsum("hwi,hwi->hw", normal, rays)
    return (albedo * np.maximum(cosine, 0) * (20.0 / distance) ** 2).astype(np.float32)


def plane(camera, normal, at_mm=25.0):
    rays = camera.unproject(camera.pixel_centres())
    normal = np.asarray(normal) / np.linalg.norm(normal)
    distance = at_mm * normal[2] / (rays @ normal)
    return np.broadcast_to(normal, rays.shape), distance, rays


@pytest.mark.parametrize("tilt", [[0.0, 0.0, -1.0], [0.4, 0.0, -1.0], [-0.3, 0.5, -1.0]])
def test_a_matt_plane_is_recovered_but_for_its_scale(tilt):
    normal, distance, rays = plane(CAMERA, tilt)
    found, relative = shading_maps(matt(normal, distance, rays), Calibration(CAMERA))
    assert np.median(angle_deg(found, normal)) < 1.5
    ratio = distance / relative
    assert np.std(ratio) / np.mean(ratio) < 0.02


@pytest.mark.parametrize("lens", marked(LENSES, ci=["pinhole", "brown_conrady"]))
def test_a_matt_hollow_is_recovered_through_any_lens(lens):
    camera = LENSES[lens]
    rays = camera.unproject(camera.pixel_centres())
    distance, normal, _ = hit(rays, np.array([10.0, 5.0, 12.0]), -30.0)
    found, _ = shading_maps(matt(normal, distance, rays), Calibration(camera))
    facing = np.median(angle_deg(-rays, normal))
    assert facing > 10
    assert np.median(angle_deg(found, normal)) < 0.15 * facing


def test_the_albedo_does_not_matter():
    normal, distance, rays = plane(CAMERA, [0.4, 0.2, -1.0])
    found = [shading_maps(matt(normal, distance, rays, albedo), Calibration(CAMERA))[0] for albedo in (0.05, 1.0)]
    assert angle_deg(*found).max() < 0.01


def test_a_highlight_is_left_out():
    normal, distance, rays = plane(CAMERA, [0.4, 0.0, -1.0])
    frame = matt(normal, distance, rays)
    y, x = np.mgrid[:120, :160]
    frame += (5 * np.exp(-((x - 60) ** 2 + (y - 70) ** 2) / 18)).astype(np.float32)
    found, _ = shading_maps(frame, Calibration(CAMERA))
    assert np.median(angle_deg(found, normal)) < 2


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_a_frame_without_light_has_no_answer(value):
    found, distance = shading_maps(np.full((120, 160), value, np.float32), Calibration(CAMERA))
    assert np.isnan(found).all()
    assert np.isnan(distance).all()


def test_it_takes_picture_and_calibration_alone():
    assert list(inspect.signature(shading_maps).parameters) == ["values", "calibration"]


@pytest.mark.ci  # meanwhile: test_dense_command scores maps; test_a_matt_hollow_is_recovered holds the method
def test_it_is_scored_as_maps_are():
    truth = sphere_truth()
    rays = truth.camera.unproject(truth.camera.pixel_centres())
    image = matt(truth.normal["fine"], truth.distance, rays)
    from dataclasses import replace

    shown = replace(truth, image=image, calibration=Calibration(truth.camera))
    score = score_frames([shown], Shading(), MapOptions())
    found, _ = shading_maps(image, Calibration(truth.camera))
    error = angle_deg(found, truth.normal["fine"])[truth.scored]
    assert score.cell("normal")["mean"] == pytest.approx(error.mean())
    assert score.cell("depth_scale", quantity="depth_percent")["median"] < 10
    assert score.name == "shading"
