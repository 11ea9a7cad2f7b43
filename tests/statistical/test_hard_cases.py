"""Highlights that are clipped, cut, touching or drawn out: right, or flagged, or refused with a reason."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Priors, exactly
from simtest.detection import estimate_noise
from simtest.errors import Failure, Reason
from simtest.estimators.brightest_point import brightest_point
from simtest.estimators.budget import dominant
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import photometric
from simtest.geometry import Camera, ViewMask
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import load_scene, scene_from_dict
from simtest.validation.scoring import mahalanobis2, match
from tests.marked import marked

D = 10.0
AXES = {"cone_axis": cone_axis, "curved": curved}
ALL = {**AXES, "photometric": photometric, "brightest_point": brightest_point}
TWO_DEG = 2.0


def surface(kind, kd=0.0, **more):
    placed = {"type": kind, "distance_mm": D, "tilt_deg": 0.5, "azimuth_deg": 30.0, **more}
    if kd:
        placed |= {"radius_mm": D / abs(kd), **({"side": "inside"} if kd < 0 else {})}
    return placed | ({"spin_deg": 20.0} if kind == "cylinder" else {})


@pytest.fixture(scope="module")
def see():
    """Return a function from the tables of a scene to what is seen of it, rendered once."""
    kept, session = {}, Session(scene_from_dict({"surface": surface("plane")}))

    def made(**tables):
        key = str(tables)
        if key not in kept:
            kept[key] = render_view(session, scene_from_dict(tables))
        return kept[key]

    return made


def found(frame, calibration, estimators=AXES):
    """Return the estimates at the brightest peak, of whatever shape; None where no peak stands out."""
    spots = reconstruct(frame, calibration, estimators, isolated=False)
    return spots[0].estimates if spots else None


def error(estimate, truth):
    return float(angle_deg(estimate.normal, truth.normal))


# Saturation ----------------------------------------------------------------------------------------------------------

CLIPPED = {"noise_sigma": 0.05, "saturation": True, "bits": 8, "exposure": {"gain": 1.45}}
CLIPPED_SURFACES = {
    "plane": surface("plane"),
    "cylinder": surface("cylinder", 1.0),
    "inside": surface("cylinder", -0.5),
}


def clipped_estimates(see, name, count):
    seen = see(surface=CLIPPED_SURFACES[name], sensor=CLIPPED)
    truth, made = seen.highlights[0], []
    for number in range(count):
        (spot,) = reconstruct(seen.frame(number), seen.calibration, AXES, isolated=False)
        assert spot.patch.saturated_share(0.5) > 0.3
        made.append(spot.estimates)
    return made, truth


def check_clipped(made, truth):
    smaller, larger = 1 + truth.kd_min, 1 + truth.kd_max
    for key in AXES:
        estimates = [e[key] for e in made if not isinstance(e[key], Failure)]
        assert len(estimates) >= 0.95 * len(made)
        assert np.mean([error(e, truth) for e in estimates]) <= 0.1
        assert all("saturated" in e.flags for e in estimates)
    gains = np.mean([e["curved"].curvature.gains for e in made], axis=0)
    # With the clipped peak taken as the peak they would be a third too small.
    np.testing.assert_allclose(gains, [smaller, larger], rtol=0.03)


@pytest.mark.render
@pytest.mark.parametrize(
    ("name", "count"),
    [("plane", 6), ("cylinder", 6), *(pytest.param(name, 200, marks=pytest.mark.slow) for name in CLIPPED_SURFACES)],
)
def test_a_clipped_peak_is_done_without(see, name, count):
    made, truth = clipped_estimates(see, name, count)
    check_clipped(made, truth)
    if count >= 200:
        for key in AXES:
            assert 0.9 < np.mean([mahalanobis2(e[key], truth.normal) < 5.99 for e in made]) <= 1, key


def test_noise_is_that_of_pixels_away_from_clipped_ones():
    rng = np.random.default_rng(1)
    x = np.linspace(-2, 2, 200)
    frame = np.clip(1.3 * np.exp(-(x**2) - x[:, None] ** 2) + 0.05 * rng.standard_normal((200, 200)), 0, 1)
    clipped = (frame <= 0) | (frame >= 1)
    assert estimate_noise(frame, clipped=clipped) == pytest.approx(0.05, rel=0.05)
    # Negative control: on the dark ground half of the noise is cut off.
    assert estimate_noise(np.where(np.hypot(x, x[:, None]) > 1, frame, 0)) < 0.04


# Cut by the border ---------------------------------------------------------------------------------------------------

SIDES = 4


def cut_through_the_peak(seen, frame, side):
    """Cut frame and camera off at the column or row of the true BP, so that half of each isophote is outside."""
    camera, (column, row) = seen.calibration.camera, np.round(seen.highlights[0].bp_px).astype(int)
    height, width = frame.shape
    x0, x1 = {0: (0, column), 1: (column, width)}.get(side, (0, width))
    y0, y1 = {2: (0, row), 3: (row, height)}.get(side, (0, height))
    part = Camera(x1 - x0, y1 - y0, camera.fx, camera.fy, camera.cx - x0, camera.cy - y0)
    return np.ascontiguousarray(frame[y0:y1, x0:x1]), replace(seen.calibration, camera=part)


HALVES = {**AXES, "photometric": photometric}
SHAPES = [surface("plane"), surface("cylinder", 1.0), surface("cylinder", -0.5), surface("sphere", 3.0)]


@pytest.mark.render
@pytest.mark.parametrize(
    ("placed", "count"),
    [(SHAPES[1], 8), *(pytest.param(placed, 200, marks=pytest.mark.slow) for placed in SHAPES)],
    ids=str,
)
def test_half_a_highlight_is_enough(see, placed, count):
    seen = see(surface=placed, sensor={"noise_sigma": 0.05})
    truth, errors = seen.highlights[0], {key: [] for key in HALVES}
    for number in range(count):
        made = found(*cut_through_the_peak(seen, seen.frame(number), number % SIDES), HALVES) or {}
        for key, estimate in made.items():
            if not isinstance(estimate, Failure):
                errors[key].append(error(estimate, truth))
                assert "partial_arc" in estimate.flags
    for values in errors.values():
        assert len(values) >= 0.6 * count
        assert np.median(values) <= 0.5
        assert max(values) <= TWO_DEG


@pytest.mark.render
def test_what_the_view_mask_cuts_is_fitted_too(see):
    seen = see(surface=surface("plane"), sensor={"noise_sigma": 0.02})
    truth, camera = seen.highlights[0], seen.calibration.camera
    column = truth.bp_px[0]
    masked = replace(camera, view_mask=ViewMask(column - 150.0, camera.cy, 150.0))
    made = found(seen.frame(0), Calibration(masked))
    for estimate in made.values():
        assert "partial_arc" in estimate.flags
        assert error(estimate, truth) < 0.5


# Touching, drawn out, textured ---------------------------------------------------------------------------------------


@pytest.mark.render
@pytest.mark.parametrize("kd", marked([-0.95, -1.1, -0.9, -1.05], ci=[-1.1], slow=[-0.9, -1.05]))
def test_streaks_are_refused_or_flagged(see, kd):
    """Seen from near its axis a tube shows a streak: no estimate off by more than 2 deg goes without a flag."""
    seen = see(surface=surface("cylinder", kd), sensor={"noise_sigma": 0.02})
    truth, kept = seen.highlights[0], 0
    assert not reconstruct(seen.frame(0), seen.calibration, ALL)
    for number in range(1):
        made = found(seen.frame(number), seen.calibration, ALL)
        assert isinstance(made["curved"], Failure)
        for estimate in made.values():
            if isinstance(estimate, Failure):
                assert estimate.reason in (Reason.NO_CLOSED_ISOPHOTE, Reason.STREAK, Reason.DEGENERATE_CONIC,
                                           Reason.NOT_CONVERGED)  # fmt: skip
                assert estimate.detail
            else:
                kept += 1
                assert {"streak", "partial_arc"} & set(estimate.flags) or error(estimate, truth) < TWO_DEG
    # Next to -1 the streak crosses the frame, and no isophote is left to answer from.
    assert kept > 0 or abs(kd + 1) <= 0.05 + 1e-9


@pytest.mark.render
@pytest.mark.parametrize("apart_mm", [2.2, 3.0])
def test_touching_highlights_are_left_out_or_flagged(see, apart_mm):
    lights = [{"position_mm": [apart_mm / 2, 0, 0]}, {"position_mm": [-apart_mm / 2, 0, 0], "power": 0.8}]
    seen = see(surface=surface("plane"), rig={"lights": lights}, sensor={"noise_sigma": 0.02})
    frame, told = seen.frame(0), seen.calibration
    # They are not isolated.
    assert not reconstruct(frame, told, ALL)
    merged = found(frame, told, ALL)
    assert all("light_offset" in e.flags and e.covariance is None for e in merged.values())
    # With a light at the camera told, which is wrong, the fit of one lobe to two is found out.
    unknown = found(frame, replace(told, priors=LIGHT_AT_CAMERA), ALL)
    assert "misfit" in unknown["photometric"].flags
    if apart_mm > 2.5:
        assert "not_elliptic" in unknown["cone_axis"].flags


@pytest.mark.render
def test_a_diffuse_base_with_texture_does_little(see):
    """Texture of 20 % under a lobe on a base of 30 %: the axis stays within 0.2 deg, and photometric says misfit."""
    seen = see(surface=surface("cylinder", 1.0), reflectance={"type": "phong", "exponent": 50.0, "diffuse": 0.3},
               sensor={"noise_sigma": 0.01})  # fmt: skip
    truth, radiance = seen.highlights[0], seen.radiance
    y, x = np.mgrid[: radiance.specular.shape[0], : radiance.specular.shape[1]]
    base = radiance.diffuse * (1 + 0.2 * np.sin(x / 5.0) * np.cos(y / 7.0))
    light = radiance.specular + base
    light = light if light.ndim == 2 else light.mean(axis=2)
    noise = 0.01 * np.random.default_rng(0).standard_normal(light.shape)
    made = found((light / light.max() + noise).astype(np.float32), seen.calibration, HALVES)
    assert "misfit" in made["photometric"].flags
    for key, estimate in made.items():
        assert error(estimate, truth) < 0.2, key


# What the picture does not show ---------------------------------------------------------------------------------------


@pytest.mark.render
def test_a_light_beside_the_camera_is_told_by_the_rig_alone(see):
    """On a plane a light 1 mm aside leaves a lobe that fits as well as one at the camera, 2.8 deg off."""
    seen = see(surface=surface("plane", tilt_deg=10.0), sensor={"noise_sigma": 0.02},
               rig={"lights": [{"offset_mm": 1.0, "azimuth_deg": 45.0}]})  # fmt: skip
    truth, frame = seen.highlights[0], seen.frame(0)
    blind = found(frame, replace(seen.calibration, priors=LIGHT_AT_CAMERA), HALVES)
    near = found(frame, seen.calibration, HALVES)
    distance = replace(seen.calibration.priors, distance_mm=exactly(truth.distance))
    told = found(frame, replace(seen.calibration, priors=distance), HALVES)
    untold = found(frame, replace(seen.calibration, priors=Priors()), HALVES)
    for key in HALVES:
        assert not {"misfit", "not_elliptic", "light_offset"} & set(blind[key].flags)
        assert mahalanobis2(blind[key], truth.normal) > 100
        # A known error is no random one: with the light told, the reversed sightline states no uncertainty ...
        for estimate in (near[key], told[key]):
            assert estimate.covariance is None
            assert "light_offset" in estimate.flags
        # ... and without, the light lies somewhere beside the camera.
        assert mahalanobis2(untold[key], truth.normal) < 5.99
        assert dominant(untold[key].budget) == "light_offset"


@pytest.mark.render
def test_a_lobe_of_another_form_is_no_misfit_since_its_normal_is_right(see):
    for form in ("phong", "rough_plastic"):
        seen = see(surface=surface("cylinder", 1.0), reflectance={"type": form}, sensor={"noise_sigma": 0.02})
        made = [found(seen.frame(i), seen.calibration, {"photometric": photometric}) for i in range(4)]
        for each in made:
            assert "misfit" not in each["photometric"].flags
            assert error(each["photometric"], seen.highlights[0]) < 0.05


@pytest.mark.slow
@pytest.mark.render
def test_regions_cover_the_truth_on_a_generated_colon():
    """Different highlights, one realisation each: none that the covariances' factors were set on."""
    session, held = None, {key: [] for key in HALVES}
    for viewpoint in range(5000, 5060):
        scene = load_scene("anatomy", {"surface.path": "colon", "surface.viewpoint": viewpoint})
        session = session or Session(scene)
        seen = render_view(session, scene)
        truths = [truth for truth in seen.highlights if truth.isolated]
        spots = reconstruct(seen.frame(viewpoint), seen.calibration, HALVES)
        for i, j in match(spots, [truth.bp_px for truth in truths]).items():
            for key, estimate in spots[i].estimates.items():
                if not isinstance(estimate, Failure):
                    held[key].append(mahalanobis2(estimate, truths[j].normal) < 5.99)
    for key, values in held.items():
        assert len(values) > 35
        assert np.mean(values) >= binom.ppf(0.001, len(values), 0.93) / len(values), key
