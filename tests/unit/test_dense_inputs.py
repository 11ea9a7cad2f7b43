"""What a dense network sees of a frame: mirrored with the picture, placed on the grid, the truth at its own pixels."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, Priors, Response
from simtest.dataset.shard import Sample
from simtest.estimators.learned_dense import (
    CAMERA,
    CELLS,
    GRID,
    PLANES,
    Layout,
    camera_values,
    dense_inputs,
    output_centres,
)
from simtest.geometry import Camera, ViewMask

WIDTH, HEIGHT = 160, 120
LIGHTS = ((3.0, 1.0, 0.0), (-2.0, 1.5, 0.5))


def camera(width=WIDTH, height=HEIGHT, **more):
    return Camera(width, height, 100.0, 100.0, width / 2, height / 2, **more)


def frame(picture, seen_by=None, lights=LIGHTS, response=None):
    known = Calibration(seen_by or camera(*picture.shape[1::-1]), response, priors=Priors(lights_mm=lights))
    return Frame(picture, known, 1.0)


@pytest.fixture
def picture():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    light = 0.3 + 0.4 * np.exp(-((x - 100) ** 2 + (y - 40) ** 2) / 60)
    return (light[..., None] * [1.0, 0.6, 0.4] + rng.uniform(0, 0.1, (HEIGHT, WIDTH, 3))).astype(np.float32)


def test_a_plane_holds_the_logarithm_of_the_light(picture):
    even = np.broadcast_to(np.float32([0.5, 0.25, 0.125]), picture.shape).copy()
    even[:, :80] *= 0.5
    planes = dense_inputs(frame(even, response=Response("linear")))
    assert planes.shape == (len(PLANES), *GRID)
    assert np.isfinite(planes).all()
    light = np.where(np.arange(GRID[1]) < 64, 2 / 3, 4 / 3) * 1.0  # the median lies between both halves
    assert np.allclose(planes[0], np.log(light + 0.02), atol=1e-3)
    # Even cells have no spread, and colours are relative to the frame's own.
    assert np.allclose(planes[1:4], 0, atol=0.02)
    assert (planes[4] == 1).all()


def test_a_dark_background_does_not_change_what_the_tissue_looks_like(picture):
    # A small organ before black, as a liver: more than half of the view is dark.
    dark = np.zeros((HEIGHT, WIDTH, 1), bool)
    dark[:, 60:] = True
    before, after = (
        dense_inputs(frame(np.where(mask, np.float32(0), picture))) for mask in (np.zeros_like(dark), dark)
    )
    column = GRID[1] * 50 // WIDTH
    assert np.allclose(before[:4, :, :column], after[:4, :, :column], atol=0.25)
    assert np.abs(after[:4]).max() < 5


def test_a_frame_of_another_aspect_lies_in_the_middle():
    assert Layout.of(1280, 720) == Layout(128, 72, 0, 12)
    assert Layout.of(480, 480) == Layout(96, 96, 16, 0)
    wide = frame(np.full((72, 160, 3), 0.5, dtype=np.float32))
    planes = dense_inputs(wide)
    rows = Layout.of(160, 72)
    seen = np.zeros(GRID, dtype=bool)
    seen[rows.top : rows.top + rows.rows] = True
    assert ((planes[4] == 1) == seen).all()
    assert (planes[:4, ~seen] == 0).all()
    # Where a point stands on the grid, and back.
    layout = Layout.of(160, 72)
    points = np.random.default_rng(0).uniform(0, 70, (9, 2))
    assert np.allclose(layout.to_pixels(layout.to_cells(points, wide.camera), wide.camera), points)
    assert np.allclose(output_centres(camera(480, 360))[0, 0], 3.75)


def test_what_is_out_of_view_is_empty(picture):
    masked = camera(view_mask=ViewMask(80.0, 60.0, 55.0))
    planes = dense_inputs(frame(picture, masked))
    assert planes[4, 0, 0] == 0
    assert planes[4, 48, 64] == 1
    assert (planes[:4, planes[4] == 0] == 0).all()
    # What stands outside the view changes nothing.
    other = np.where(masked.seen[..., None], picture, np.float32(1))
    assert np.array_equal(dense_inputs(frame(other, masked)), planes)


def test_truth_is_missing_off_the_tissue():
    from studies.networks.examples import truth_at

    seen = camera(view_mask=ViewMask(80.0, 60.0, 70.0))
    depth = np.full((HEIGHT, WIDTH), 30.0)
    depth[60, 90] = np.nan
    instrument = np.zeros((HEIGHT, WIDTH), np.uint8)
    instrument[60, 100] = 3
    normal = np.broadcast_to([0.0, 0.0, -1.0], (HEIGHT, WIDTH, 3))
    points = np.array([[80.5, 60.5], [90.5, 60.5], [100.5, 60.5], [0.5, 0.5], [-3.0, 60.0], [80.0, 500.0]])
    sample = Sample({}, {"depth": depth, "normal_base": normal, "instrument": instrument})
    rotation, distance = truth_at(sample, seen, points)
    assert np.isfinite(distance).tolist() == [True, False, False, False, False, False]
    assert (np.isfinite(rotation).all(axis=0) == np.isfinite(distance)).all()
    assert rotation.shape == (2, 6)
    # The plane faces along the axis, so the rotation is the angle of the sightline.
    ray = seen.unproject(points[0])
    assert np.linalg.norm(rotation[:, 0]) == pytest.approx(np.arccos(ray[2]), abs=1e-9)


def test_the_camera_s_values_hang_on_field_of_view_not_on_size():
    one = camera_values(frame(np.full((120, 160, 3), 0.5, np.float32), Camera(160, 120, 100, 100, 80, 60)))
    other = camera_values(frame(np.full((240, 320, 3), 0.5, np.float32), Camera(320, 240, 200, 200, 160, 120)))
    assert np.allclose(one, other)
    assert one.shape == (len(CAMERA),)
    assert np.allclose(one[:2], np.log(100 / 160))
    assert np.allclose(one[4:7], np.mean(LIGHTS, axis=0) / 5)


def test_outputs_have_rows_and_columns_of_half_the_grid():
    assert tuple(count // 2 for count in GRID) == CELLS
    assert output_centres(camera()).shape == (*CELLS, 2)
