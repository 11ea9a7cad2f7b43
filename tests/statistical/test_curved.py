"""Statistics over noise at sigma 5 %: `curved`, `bisector`, the choice of circle pose, and stated uncertainties."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Priors, exactly
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.detection import detect
from simtest.estimators.bisector import bisector
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import ColocatedQuadric, photometric
from simtest.geometry import smooth
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, from_integer, generator
from simtest.spec import scene_from_dict
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.rows import pipeline_with
from simtest.validation.scoring import curvature_errors, mahalanobis2

ALPHA = 0.01
"""Level of each family of tests, shared evenly by its members."""

D, SIGMA = 10.0, 0.05
EXPONENT = 50.0
LOBE = replace(LIGHT_AT_CAMERA, lobe_curvature=exactly(4 * EXPONENT))
OFFSET = {"offset_mm": 1.0, "azimuth_deg": 45.0}


def tube(kd, spin=20.0):
    side = {} if kd > 0 else {"side": "inside"}
    return {"type": "cylinder", "radius_mm": D / abs(kd), "spin_deg": spin, **side}


def ball(kd):
    return {**tube(kd), "type": "sphere"}


def saddle(first, second):
    return {"type": "quadric", "k1_per_mm": first / D, "k2_per_mm": second / D, "spin_deg": 30.0}


DRIFTING = 0.99
"""Most that `bisector` may cover. A light beside the camera makes the isophotes' axis drift, even on a plane. A share
of the drift's square stands in the budget, for what a straight line to the peak misses, which is nothing here."""

AROUND_PX = 24
"""Margin of a crop around the region of interest: more than smoothing and noise's estimate reach."""


def cropped(image, camera):
    """Cut a frame and its camera to the surroundings of its one highlight: noise elsewhere is drawn for nothing."""
    (region,) = detect(smooth(image, DEFAULT_SMOOTHING_PX), 0.0, isolated=False)
    x, y, width, height = region.box
    left, top = max(x - AROUND_PX, 0), max(y - AROUND_PX, 0)
    part = image[top : y + height + AROUND_PX, left : x + width + AROUND_PX]
    moved = replace(camera, width=part.shape[1], height=part.shape[0], cx=camera.cx - left, cy=camera.cy - top)
    return np.ascontiguousarray(part), moved


class Bench:
    """Renders each surface once and puts noise on it."""

    def __init__(self):
        self.session = None
        self.kept = {}

    def view(self, surface, lights):
        key = str((surface, lights))
        if key not in self.kept:
            placed = {"tilt_deg": 0.5, "azimuth_deg": 30.0, "distance_mm": D, **surface}
            scene = scene_from_dict({"surface": placed, "rig": {"lights": lights}})
            self.session = self.session or Session(scene)
            self.session.update(scene)
            radiance = self.session.radiance()
            (highlight,) = self.session.highlights(radiance)
            image, camera = cropped(np.asarray(radiance.total / radiance.total.max()), self.session.camera)
            self.kept[key] = image, camera, highlight
        return self.kept[key]

    def estimates(self, surface, estimators, priors=LOBE, count=15, lights=({},)):
        image, camera, highlight = self.view(surface, list(lights))
        made = []
        for number in range(count):
            rng = generator(11, "curved", str(surface), number, Stage.SENSOR)
            frame = image + SIGMA * rng.standard_normal(image.shape, dtype=np.float32)
            told = priors(number, highlight) if callable(priors) else priors
            calibration = Calibration(camera, priors=told)
            # Every peak: this is about estimators, not about which peaks are looked at.
            (specularity,) = reconstruct(frame.astype(np.float32), calibration, estimators, isolated=False)
            # Without the contours, of which thousands would fill the memory.
            made.append({key: replace(e, isophotes=()) for key, e in specularity.estimates.items()})
        return made, highlight


@pytest.fixture(scope="module")
def bench():
    return Bench()


def below(values, limit, members=1):
    """One-sided t test: the mean is below the limit."""
    return stats.ttest_1samp(values, limit, alternative="less").pvalue < ALPHA / members


SHAPES = [tube(-0.7), tube(-0.5), tube(1.0), tube(3.0), ball(-0.5), ball(3.0), saddle(0.7, -0.7), saddle(0.5, -0.5)]
SHAPES += [tube(0.12)]

QUICK = (tube(-0.5), tube(0.12), ball(3.0), saddle(0.5, -0.5))
MARKED_SHAPES = [shape if shape in QUICK else pytest.param(shape, marks=pytest.mark.slow) for shape in SHAPES]


def name(shape):
    numbers = [f"{value:g}" for key, value in shape.items() if key in ("radius_mm", "k1_per_mm", "k2_per_mm")]
    return f"{shape['type']} {shape.get('side', '')} {' '.join(numbers)}"


@pytest.mark.render
@pytest.mark.parametrize("shape", MARKED_SHAPES, ids=name)
def test_curvature_from_the_shape_of_the_isophotes(bench, shape):
    made, true = bench.estimates(shape, {"curved": curved, "cone_axis": cone_axis})
    errors = {key: [float(angle_deg(e[key].normal, true.normal)) for e in made] for key in made[0]}
    # Each mean, with two standard errors of its own: the limits hold for the mean over all noise.
    for key, values in errors.items():
        assert np.mean(values) - 2 * stats.sem(values) <= 0.02, (key, values)
    estimates = [e["curved"] for e in made]
    smaller, larger = np.sort(np.abs([1 + true.kd_min, 1 + true.kd_max]))
    ratios = np.array([e.axis_ratio for e in estimates])
    limit = 0.03 if min(true.kd_min, true.kd_max) < -0.6 else 0.01
    assert abs(ratios.mean() / (smaller / larger) - 1) <= limit
    gains = np.array([e.curvature.gains for e in estimates]).mean(axis=0)
    np.testing.assert_allclose(gains, [smaller, larger], rtol=0.02)
    judged = [curvature_errors(e, true) for e in estimates]
    if smaller / larger < 0.9:
        assert np.mean([e["direction_error_deg"] for e in judged]) <= 1
        assert not any("round" in e.flags for e in estimates)
    else:
        assert all("direction_error_deg" not in e for e in judged)


@pytest.mark.render
def test_without_its_corrections_the_axis_ratio_is_noticeably_off(bench):
    """Negative control: raw ratios are 1 to 4 % too large where the law asks for 1 %."""
    made, true = bench.estimates(tube(3.0), {"cone_axis": cone_axis})
    raw = np.array([e["cone_axis"].axis_ratio for e in made]) * (1 + true.kd_max) / (1 + true.kd_min)
    assert stats.ttest_1samp(raw, 1.01, alternative="greater").pvalue < ALPHA


def direction_bound_deg(camera, kd, spin_deg=20.0):
    """Cramer-Rao bound of a cylinder's principal direction from all pixels of its lobe, n known, standard deviation."""
    rays = camera.unproject(camera.pixel_centres().reshape(-1, 2))
    along = np.radians(spin_deg)
    cos, sin = np.cos(along), np.sin(along)
    K = kd * np.array([cos * cos, cos * sin, sin * sin])
    intensity, J = ColocatedQuadric(rays, np.eye(3), K, 0.0, EXPONENT).evaluate()
    covariance = np.linalg.inv(J.T @ J) * (SIGMA * intensity.max()) ** 2
    difference, twice = K[0] - K[2], 2 * K[1]
    # The direction is atan(2 K12 / (K11 - K22)) / 2.
    slope = np.array([0, 0, -twice, 2 * difference, twice, 0]) / (2 * (difference**2 + twice**2))
    return float(np.degrees(np.sqrt(slope @ covariance @ slope)))


@pytest.mark.render
def test_principal_directions_come_near_their_bound(bench):
    """Squared errors over the bound's square are chi-squared for the best estimator; this one may have 2.5 times it."""
    count, kd = 40, 0.12
    made, true = bench.estimates(tube(kd), {"curved": curved}, count=count)
    errors = np.array([curvature_errors(e["curved"], true)["direction_error_deg"] for e in made])
    bound = direction_bound_deg(bench.view(tube(kd), [{}])[1], kd)
    assert 0.4 < bound < 0.6
    share = float(np.sum((errors / bound) ** 2))
    assert share >= stats.chi2.ppf(ALPHA, count)
    assert share <= 2.5 * stats.chi2.ppf(1 - ALPHA, count)


@pytest.mark.render
def test_signs_that_the_picture_cannot_tell_are_listed(bench):
    """Inside a cylinder beyond its axis, d k = -1.5: the gain is negative, and its hypothesis is not the first."""
    shape = {"type": "quadric", "k1_per_mm": -0.15, "k2_per_mm": 0.0}
    made, true = bench.estimates(shape, {"curved": curved}, count=4)
    for each in made:
        errors = curvature_errors(each["curved"], true)
        assert errors["gain_error"] > 1
        # Beyond the centre the terms of fourth order are larger than elsewhere.
        assert errors["gain_oracle_error"] < 0.1
        assert each["curved"].curvature.hypotheses.shape == (4, 2)


# Light offset --------------------------------------------------------------------------------------------------------

RIG = ((float(np.cos(np.pi / 4)), float(np.sin(np.pi / 4)), 0.0),)


def told(share):
    return lambda number, true: Priors(
        RIG, exactly(true.distance * (share if share else _uniform(number))), falloff_power=None
    )


def _uniform(number):
    # Stratified over the realisations: their mean has less noise than that of independent draws.
    return 0.8 + 0.4 * (number + 0.5) / 20


@pytest.mark.render
@pytest.mark.parametrize(
    "shape", [{"type": "plane", "tilt_deg": 10.0}, pytest.param(tube(-0.5), marks=pytest.mark.slow)], ids=name
)
def test_bisector_removes_the_error_of_a_known_light(bench, shape):
    def errors(share, count):
        made, true = bench.estimates(shape, {"bisector": bisector}, told(share), count, [OFFSET])
        return [float(angle_deg(e["bisector"].normal, true.normal)) for e in made]

    assert below(errors(1.0, 8), 0.1, 3)
    far = errors(0.8, 6)
    assert np.mean(far) - 2 * stats.sem(far) <= 0.75
    assert np.mean(errors(None, 20)) <= 0.35
    # Negative control: the axis alone is off by half the light's angle.
    made, true = bench.estimates(shape, {"cone_axis": cone_axis}, count=3, lights=[OFFSET])
    assert min(float(angle_deg(e["cone_axis"].normal, true.normal)) for e in made) > 2.5


# Uncertainty ---------------------------------------------------------------------------------------------------------


def covered(made, true, key):
    return np.array([mahalanobis2(e[key], true.normal) for e in made]) <= stats.chi2.ppf(0.95, 2)


QUICK_COUNT = 60
BINOMIAL = stats.binom.ppf([ALPHA / 12, 1 - ALPHA / 12], QUICK_COUNT, 0.95) / QUICK_COUNT


@pytest.mark.render
@pytest.mark.parametrize(
    ("shape", "count", "bounds"),
    [
        pytest.param(tube(1.0), QUICK_COUNT, BINOMIAL, id="60"),
        *(pytest.param(s, 5000, (0.93, 0.97), marks=pytest.mark.slow) for s in ({"type": "plane"}, tube(1.0))),
    ],
)
def test_stated_regions_cover_the_truth(bench, shape, count, bounds):
    low, high = bounds
    exact = lambda number, true: Priors(RIG, exactly(true.distance), falloff_power=None)  # noqa: E731
    told = {"cone_axis": cone_axis, "curved": curved, "photometric": photometric}
    made, true = bench.estimates(shape, told, count=count)
    beside, true_beside = bench.estimates(shape, {"bisector": bisector}, exact, count, [OFFSET])
    for each, truth in ((made, true), (beside, true_beside)):
        for key in each[0]:
            share = covered(each, truth, key).mean()
            most = max(high, DRIFTING) if key == "bisector" else high
            assert low <= share <= most, (key, share)
            rms = np.sqrt(np.mean([float(angle_deg(e[key].normal, truth.normal)) ** 2 for e in each]))
            # The RMS angle is that of two components.
            semi = [np.degrees(np.sqrt(np.linalg.eigvalsh(e[key].covariance))) for e in each]
            assert np.median(np.max(semi, axis=1)) <= 1.5 * rms / np.sqrt(2), key


# The choice of circle pose ------------------------------------------------------------------------------------------

CHOICES = [{}, {"isovalue": 0.5}, {"isovalue": 0.8}, {"theta_deg": 30.0}, {"theta_deg": 30.0, "isovalue": 0.5}]
CHOICES += [{"exponent": 120.0}, {"sigma": 0.1}]


@pytest.mark.parametrize("values", CHOICES, ids=str)
def test_the_published_protocol_chooses_right(values):
    setting, count = PaperSetting(**values), 150
    made = pipeline_with(setting, ("circle_pose",)).realise(from_integer(i) for i in range(count))["circle_pose"]
    gaps = np.array([angle_deg(e.candidates, setting.normal) for e in made])
    wrong = int(np.count_nonzero(gaps[:, 0] > gaps[:, 1]))
    assert wrong <= stats.binom.ppf(1 - ALPHA / len(CHOICES), count, 0.01)
    assert all(e.choice_margin > 0 for e in made)


def test_without_slant_the_choice_is_called_ambiguous():
    """Negative control: at slant 0 there is nothing to choose."""
    setting = PaperSetting(theta_deg=0.0)
    made = pipeline_with(setting, ("circle_pose",)).realise(from_integer(i) for i in range(40))["circle_pose"]
    assert all({"ambiguous", "near_degenerate"} <= set(e.flags) for e in made)


@pytest.mark.render
@pytest.mark.parametrize("shape", [{"type": "plane"}, tube(1.0), tube(0.1)], ids=name)
def test_a_light_at_the_camera_is_called_near_degenerate(bench, shape):
    from simtest.estimators.circle_pose import circle_pose

    made, _ = bench.estimates(shape, {"circle_pose": circle_pose}, count=10)
    assert sum("near_degenerate" in e["circle_pose"].flags for e in made) >= 9
