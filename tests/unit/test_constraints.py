"""constraints.npz: the region of each normal holds the surface's normal where the entry says that it stands."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, Response, exactly
from simtest.calibration.priors import NO_FLOORS
from simtest.detection import Detection, Region
from simtest.detection.view import View
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.geometry import Camera
from simtest.reconstruction.motion import NEEDED, TrackedHighlight
from simtest.reconstruction.options import Choices, Options
from simtest.reconstruction.outputs import constraints_arrays
from simtest.reconstruction.pipeline import reconstruct_values
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime import chi_squared
from simtest.runtime.files import write_json
from simtest.validation.columns import WHOLE

CAMERA = Camera(160, 120, 400.0, 400.0, 80.0, 60.0)
AXIS = CAMERA.unproject(np.array([87.0, 64.0]))
DISTANCE = 20.0
SPOT_RAD = 0.025
QUANTILE = chi_squared.quantile(0.95, 2)
DRAWS = 60


def normals_at(rays, dk):
    """Return the normals of a ball of radius d / dk where rays meet it; its brightest point lies along `AXIS`."""
    radius = DISTANCE / dk
    centre = (DISTANCE + radius) * AXIS
    along = rays @ centre
    # Beside the ball: where the ray comes nearest to it.
    reach = along - np.sqrt(np.maximum(along**2 - centre @ centre + radius**2, 0))
    return (reach[..., None] * rays - centre) / radius


@cache
def stored(dk):
    """Return the constraints of pictures with 2 % noise of a ball that is lit from the camera."""
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    facing = -np.sum(normals_at(rays, dk) * rays, axis=-1)
    # A Phong lobe of exponent c / 4 over twice the normal's angle, so that the spot is as large at each curvature.
    curvature = ((1 + dk) * SPOT_RAD) ** -2
    lobe = np.maximum(2 * np.maximum(facing, 0) ** 2 - 1, 0) ** (curvature / 4)
    priors = type(LIGHT_AT_CAMERA)(
        lights_mm=((0.0, 0.0, 0.0),),
        distance_mm=exactly(DISTANCE),
        lobe_curvature=exactly(curvature),
        falloff_power=None,
        floors=NO_FLOORS,
    )
    calibration = Calibration(CAMERA, Response(), priors=priors)
    options = Options(fov_deg=60.0, estimators=("curved",), roi=(40, 20, 94, 88))
    made = []
    for seed in range(DRAWS):
        drawn = np.random.default_rng(seed).normal(0, 0.02, lobe.shape)
        record = reconstruct_values("ball", (0.1 + 0.8 * lobe + drawn).astype(np.float32), calibration, options)
        made.append(constraints_arrays(record))
    return made


def held(made, truths, key):
    """Return the share of the regions of covariances that hold true normals."""
    inside = []
    for each, truth in zip(made, truths, strict=True):
        (miss,) = each["basis"] @ (truth - each["normal"][0])
        inside.append(miss @ np.linalg.solve(each[key][0], miss) <= QUANTILE)
    return np.mean(inside)


def found(spots, view=WHOLE):
    """Return specularities of a frame of `CAMERA`."""
    calibration = Calibration(CAMERA)
    frame = Frame(np.zeros((120, 160), np.float32), calibration, 2.0)
    return Specularities(spots, Detection((), frame, view=view), Choices(calibration, "peaks", 2.0, ()))


def alone_at(i, name, estimate):
    nowhere = Failure(Reason.NO_PEAK, "no region was detected here")
    return Specularity(Region((30, 20, 1, 1), (30, 20), None), nowhere, {name: estimate}, id=i)


def test_an_answer_without_a_patch_is_a_constraint_too():
    """What a frame's estimator finds by itself, such as a cloud: the other files hold it."""
    normal, look = np.array([0.0, 0.0, -1.0]), np.array([30.0, 20.0])
    alone = Estimate(normal, normal[None], look, covariance=np.diag([1e-4, 4e-4]), target="base")
    beyond = replace(alone, look_px=np.array([np.nan, np.nan]))
    made = constraints_arrays(found([alone_at(4, "own", alone), alone_at(5, "own", beyond)]))
    # An answer that looks along no ray has no sightline to stand on.
    assert (made["id"].tolist(), made["target"].tolist()) == ([4], ["base"])
    np.testing.assert_array_equal(made["pixel"], [look])
    np.testing.assert_allclose(made["sightline"], [CAMERA.unproject(look)])
    np.testing.assert_array_equal(made["covariance"][0], alone.covariance)


def test_an_estimate_is_read_back_with_the_spread_of_its_axis_ratio(tmp_path):
    normal = np.array([0.0, 0.0, -1.0])
    given = Estimate(normal, normal[None], np.array([30.0, 20.0]), axis_ratio=0.5, axis_ratio_deviation=0.1)
    write_json(tmp_path / "spot.json", alone_at(0, NEEDED, given).to_json() | {"track": 7})
    read = TrackedHighlight.from_json(3, json.loads((tmp_path / "spot.json").read_text()))
    assert (read.frame, read.track) == (3, 7)
    assert read.judging.axis_ratio_deviation == 0.1


def test_the_outline_of_the_view_is_that_of_its_largest_part():
    y, x = np.mgrid[:120, :160]
    seen = (x < 110) | ((x - 140) ** 2 + (y - 60) ** 2 < 15**2)
    outline = np.array(found([], View(seen)).to_json()["view"]["outline"])
    assert (outline.min(axis=0).tolist(), outline.max(axis=0).tolist()) == ([0.5, 0.5], [109.5, 119.5])


@pytest.mark.parametrize("dk", [1.0, 3.0, 6.0])
def test_the_region_at_the_pixel_holds_the_normal_on_its_sightline(dk):
    made = stored(dk)
    at_pixel = [normals_at(each["sightline"], dk)[0] for each in made]
    assert held(made, at_pixel, "covariance_at_pixel") >= 0.9
    # The plain covariance is that at the brightest point, and no more.
    assert held(made, [-AXIS] * DRAWS, "covariance") >= 0.9
    if dk > 1:
        assert held(made, at_pixel, "covariance") < 0.6
    # Neither is much too wide.
    for key, truths in (("covariance_at_pixel", at_pixel), ("covariance", [-AXIS] * DRAWS)):
        misses = [np.linalg.norm(truth - each["normal"][0]) for truth, each in zip(truths, made, strict=True)]
        stated = [np.sqrt(np.trace(each[key][0])) for each in made]
        assert np.median(stated) < 2 * np.sqrt(np.mean(np.square(misses)))
