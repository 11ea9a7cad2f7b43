"""Malformed cameras, frames and arguments give one line; ill-posed data gives a value."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Response
from simtest.errors import Failure, Reason
from simtest.geometry import Camera, Patch
from simtest.reconstruction.options import DEFAULT_ESTIMATORS
from simtest.reconstruction.pipeline import reconstruct
from tests.refusals import refused

# Cameras ---------------------------------------------------------------------------------------------------------

K = [[40.0, 0.0, 16.0], [0.0, 40.0, 12.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize("fov", [0, 0.04, 179.1, -60, float("nan"), float("inf")])
def test_fields_of_view(fov):
    refused(lambda: Camera.from_fov(fov, 32, 24), f"fov = {fov}: must be 0.05 to 179 deg")


# Frames ----------------------------------------------------------------------------------------------------------

WIDTH, HEIGHT = 32, 24
EYE = Camera.from_matrix(K, WIDTH, HEIGHT)
_ROWS, _COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
SPOT = np.exp(-((_COLUMNS - 16) ** 2 + (_ROWS - 12) ** 2) / 30)


def with_value(value):
    frame = SPOT.copy()
    frame[3, 5] = value
    return frame


FRAMES = {
    "NaN": (with_value(np.nan), "frame holds 1 values that are NaN, infinite"),
    "infinities of both signs": (np.stack([SPOT + np.inf, SPOT - np.inf], 2), "frame holds 768 values"),
    "beyond float32": (with_value(1e300), "frame holds 1 values", "beyond 3e38: all must be finite"),
    "none above 0": (np.where(SPOT > 0.5, 0.0, -1.0), "frame holds values from -1 to 0: some must be above 0"),
    "turned": (SPOT.T, "frame is 24 x 32 px: must be 32 x 24, the size of the camera's calibration"),
    "one number": (1.0, "frame has shape (): must be (H, W) or (H, W, C)"),
    "four dimensions": (SPOT[None, None], "frame has shape (1, 1, 24, 32): must be (H, W) or (H, W, C)"),
    "no channels": (np.empty((HEIGHT, WIDTH, 0)), "frame has shape (24, 32, 0)"),
    "a file that is not there": ("frame.png", "frame.png: no such file"),
    "numbers in quotes": ([["1", "2"], ["3", "4"]], "frame holds values of type <U1"),
    "ragged": ([[1, 2], [3]], "frame: must be an array of numbers; its rows differ in length"),
    "complex": (SPOT * 1j, "frame holds values of type complex128: must be an array of real numbers"),
    "integers of no range": (np.zeros((HEIGHT, WIDTH), int), "integers of type int64, whose range is not known"),
    "a picture of two channels": (np.zeros((HEIGHT, WIDTH, 2), np.uint8), "frame: has 2 channels; must have 1, 3 or 4"),
}  # fmt: skip


@pytest.mark.parametrize("name", FRAMES)
def test_frames(name):
    frame, *fragments = FRAMES[name]
    refused(lambda: reconstruct(frame, EYE), *fragments)


@pytest.mark.parametrize("peak", [(4, 8), (8, 4), (14, 8), (8, 14), (-1, 8)])
def test_a_peak_outside_its_region(peak):
    """An index below 0 took the value of the pixel that is counted from the far end."""
    refused(lambda: Patch.cut(SPOT, (5, 5, 9, 9), peak), f"peak = {peak[0]},{peak[1]}: must lie inside its region")


ARGUMENTS = {
    "roi outside": ({"roi": (0, 0, 33, 24)}, "roi = 0,0,33,24: must be x,y,w,h inside the 32 x 24 frame"),
    "roi beyond the corner": ({"roi": (31, 23, 2, 2)}, "roi = 31,23,2,2: must be x,y,w,h inside"),
    "roi of negative size": ({"roi": (9, 9, 5, -5)}, "roi = 9,9,5,-5: must be x,y,w,h inside"),
    "roi fractional": ({"roi": (1.5, 0, 4, 4)}, "roi = (1.5, 0, 4, 4): must be x, y, width, height: four integers"),
    "roi text": ({"roi": "1,2,3,4"}, "roi = '1,2,3,4': must be x, y, width, height: four integers, px"),
    "smoothing huge": ({"smoothing_px": 1e9}, "smoothing_px = 1000000000.0: must be a number in [0, 50]"),
    "smoothing NaN": ({"smoothing_px": float("nan")}, "smoothing_px = nan: must be a number in [0, 50]"),
    "smoothing true": ({"smoothing_px": True}, "smoothing_px = True: must be a number in [0, 50]"),
    "unknown estimator": ({"estimators": ["magic"]}, "estimator 'magic': not installed; allowed: "),
    "estimator twice": ({"estimators": ["cone_axis"] * 2}, "estimator 'cone_axis': given twice"),
    "estimators one name": ({"estimators": "cone_axis"}, "estimators = 'cone_axis': must be a list of names"),
    "encoding unknown": ({"encoding": "rec709"}, "encoding = 'rec709': must be one of srgb, linear, or None"),
    "encoding of large values": ({"encoding": "srgb", "frame": 255 * SPOT}, "encoded real values must lie in [0, 1]"),
    "encoding told twice": (
        {"encoding": "srgb", "camera": Calibration(EYE, Response("gamma", 2.2))},
        "encoding = 'srgb': the calibration states the response; give one of them",
    ),
    "detector unknown": ({"detector": "magic"}, "allowed: colour, peaks; auto chooses among those of simtest"),
    "detector of a region": ({"detector": "colour", "roi": (0, 0, 9, 9)}, "the region of interest is named"),
    "detector of grey": ({"detector": "colour"}, "detector colour: the picture is grey; must be peaks"),
    "field of view out of range": ({"camera": 200.0}, "200"),
    "field of view of no image": ({"camera": 60.0, "frame": [1.0, 2.0]}, "where the camera is a field of view"),
    "camera a truth": ({"camera": True}, "camera is a bool: must be a simtest.Camera"),
    "camera a matrix": ({"camera": np.eye(3)}, "camera is a ndarray: must be a simtest.Camera"),
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_of_reconstruct(name):
    given, fragment = ARGUMENTS[name]
    refused(lambda: reconstruct(**{"frame": SPOT, "camera": EYE, **given}), fragment)


NOTHING_TO_SEE = {
    "black": np.zeros((HEIGHT, WIDTH)),
    "grey": np.full((HEIGHT, WIDTH), 0.5),
    "all saturated": np.ones((HEIGHT, WIDTH)),
    "all 255": np.full((HEIGHT, WIDTH, 3), 255, np.uint8),
    "chequered": (_ROWS + _COLUMNS) % 2.0,
    "ramp": _COLUMNS / WIDTH,
    "noise": np.random.default_rng(0).random((HEIGHT, WIDTH)),
}


@pytest.mark.parametrize("name", NOTHING_TO_SEE)
def test_frames_without_a_highlight_give_an_empty_list(name):
    assert reconstruct(NOTHING_TO_SEE[name], EYE) == []


@pytest.mark.parametrize("name", ["black", "grey", "all saturated"])
def test_a_region_without_a_peak_is_a_failure(name):
    (found,) = reconstruct(NOTHING_TO_SEE[name], EYE, roi=(4, 4, 20, 16))
    assert len(found.estimates) == len(DEFAULT_ESTIMATORS)
    assert all(isinstance(e, Failure) and e.reason == Reason.NO_PEAK for e in found.estimates.values())


@pytest.mark.parametrize("size", [(1, 1), (1, 32), (24, 2), (3, 3)])
def test_tiny_frames(size):
    frame = SPOT[12 : 12 + size[0], : size[1]] if size[0] < 24 else SPOT[:, 16:18]
    camera = Camera.from_matrix(K, size[1], size[0])
    assert reconstruct(frame, camera) == []
    (found,) = reconstruct(frame, camera, roi=(0, 0, size[1], size[0]), smoothing_px=0)
    assert isinstance(found.estimates["circle_pose"], Failure)
    assert isinstance(found.estimates["cone_axis"], Failure)
    assert found.estimates["circle_pose"].reason in {
        Reason.NO_PEAK,
        Reason.NO_CLOSED_ISOPHOTE,
        Reason.TOO_FEW_POINTS,
    }


@pytest.mark.parametrize("scale", [1e-40, 1e38])
def test_the_scale_of_a_frame_does_not_matter(scale):
    (found,) = reconstruct(SPOT * scale, EYE)
    assert all(not isinstance(estimate, Failure) for estimate in found.estimates.values())


def test_an_estimator_that_fails_is_a_value():
    class Broken:
        def estimate(self, patch, camera, priors):
            raise ZeroDivisionError("float division by zero")

    class Silent:
        def estimate(self, patch, camera, priors):
            return None

    (found,) = reconstruct(SPOT, EYE, {"broken": Broken(), "silent": Silent()})
    details = {name: result.detail for name, result in found.estimates.items()}
    assert {result.reason for result in found.estimates.values()} == {Reason.ESTIMATOR_ERROR}
    assert details["broken"].startswith("ZeroDivisionError: float division by zero (test_bad_pictures.py:")
    assert details["silent"] == "gave a NoneType; must be an Estimate or a Failure"
    refused(
        lambda: reconstruct(SPOT, EYE, {"number": 5}),
        "estimator 'number'",
        "has neither estimate(patch, camera, priors)",
    )


@pytest.mark.parametrize("focal", [1e-300, 1e300])
def test_an_absurd_camera_gives_failures_not_errors(focal):
    (found,) = reconstruct(SPOT, Camera(WIDTH, HEIGHT, focal, focal, 16, 12))
    assert isinstance(found.estimates["circle_pose"], Failure)
    assert isinstance(found.estimates["cone_axis"], Failure)
