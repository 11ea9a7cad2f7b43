"""Laws of results: statistics, counts and columns against numbers by hand, laws against measured ones."""

import math
from dataclasses import replace

import numpy as np

from simtest.detection.peaks import detect, half_height_component
from simtest.estimators import Estimate, load_estimators
from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import Examined, verdicts
from simtest.spec import Experiment
from simtest.spec.recipes import PaperSetting
from simtest.validation import laws
from simtest.validation.cases import expand
from simtest.validation.columns import Row, table
from simtest.validation.paper.rows import paper_rows
from simtest.validation.realisation import Realisation, realise
from simtest.validation.scoring import curvature_errors, mahalanobis2, match, rows, scene_columns
from simtest.validation.statistics import figures
from tests.laws import by_hand
from tests.laws.law import Law, law
from tests.laws.rendered import AZIMUTH_DEG, DISTANCE_MM, LIGHT_MM, PLANE, TILT_DEG, described

ERRORS = (0.2, 0.4, 0.5, 0.9, 1.1, 1.6, 2.0, 3.1, 4.2, 9.0)
"""Ten errors, deg, whose mean, median and quantiles all differ."""

SIGMA = 0.02


def statistics() -> list[Law]:
    """Compare the figures of thirteen rows with numbers worked out apart from this package."""
    count = len(ERRORS)
    made = [
        dict(status="ok", realisation=i, true_id=0, error_deg=e, error_oracle_deg=e / 2, error_base_deg=2 * e,
                  mahalanobis2=m)
        for i, (e, m) in enumerate(zip(ERRORS, (0.1, 0.5, 1.0, 1.4, 2.0, 3.0, 4.0, 5.5, 5.9, 6.1), strict=True))
    ]  # fmt: skip
    made += [dict(status="missed", true_id=1), dict(status="no_peak", true_id=2), dict(status="ok")]
    found = figures(table(made, {}))
    # Student's 97.5 % point of 9 degrees of freedom is 2.262157, chi-squared's 95 % point of 2 is 5.991465.
    wanted = {
        "n": (found.n, 12), "n_ok": (found.n_ok, 10), "n_missed": (found.n_missed, 1), "n_false": (found.n_false, 1),
        "n_failed": (sum(found.n_failed_by_reason.values()), 1), "mean": (found.mean_deg, 2.3),
        "median": (found.median_deg, 1.35), "rms": (found.rms_deg, 3.4246168), "std": (found.std_deg, 2.6745716),
        "p95": (found.p95_deg, 6.84), "max": (found.max_deg, 9.0), "oracle": (found.mean_oracle_deg, 1.15),
        "base": (found.mean_base_deg, 4.6), "penalised": (found.mean_penalised_deg, 203.0 / 12),
        "coverage95": (found.coverage95, 0.9), "interval_low": (found.ci95_deg[0], 0.3867267),
    }  # fmt: skip
    about = "ten answers, a miss, a failure and a false detection; worked out by hand"
    return [
        law(
            "statistics",
            f"{name}_off",
            "",
            math.nan if value is None else abs(value - right),
            1e-6,
            n=count,
            about=about,
        )
        for name, (value, right) in wanted.items()
    ]


def counts(session: Session) -> list[Law]:
    """Check that a miss has a row, and that a detection beside a highlight is not matched to it."""
    made = _realised(session, 0.0)
    own = [made.specularities[i] for i in made.matched]
    aside = [truth.bp_px + np.array([40.0, 0.0]) for truth in made.truths]
    missed = rows(session, {}, [], made.truths, {}, {"cone_axis": (), "curved": ()})
    states = [row["status"] for row in missed]
    return [
        law("counts", "matched", "", len(made.matched), 1, 1, about="the one highlight of a plane"),
        law("counts", "matched_aside", "", len(match(own, aside)), 0, about="to a point 40 px away"),
        law("counts", "missed", "", states.count("missed"), 2, 2, about="rows of two estimators without a detection"),
    ]


def columns(session: Session) -> list[Law]:
    """Compare the columns of a plane's rows under a light aside with the plane's own geometry."""
    made = _realised(session, SIGMA)
    wanted = [row for row in made.rows if row["estimator"] == "cone_axis" and row["status"] == "ok"]
    (row,) = wanted
    normal = by_hand.anchor_normal(TILT_DEG, AZIMUTH_DEG)
    light = np.array(LIGHT_MM)
    point = by_hand.highlight_of_plane(normal, DISTANCE_MM, light)
    far = math.sqrt(float(point @ point))
    c = by_hand.CAMERA
    pixel = c["fx"] * point[0] / point[2] + c["cx"], c["fy"] * point[1] / point[2] + c["cy"]
    half = float(by_hand.angle_deg(-point, light - point)) / 2
    stated = _vector(row, "normal")
    look = np.array(
        [(_value(row["look_x_px"]) - c["cx"]) / c["fx"], (_value(row["look_y_px"]) - c["cy"]) / c["fy"], 1.0]
    )
    error = float(by_hand.angle_deg(stated, normal))
    off = {
        "distance_off": (row["distance_mm"], far, 1e-4), "eps_over_d_off": (row["eps_over_d"], 1.0 / far, 1e-6),
        "kd_min_off": (row["kd_min"], 0.0, 1e-9), "kd_max_off": (row["kd_max"], 0.0, 1e-9),
        "axis_ratio_law_off": (row["axis_ratio_law"], 1.0, 1e-9), "bp_x_off": (row["bp_true_x_px"], pixel[0], 1e-3),
        "bp_y_off": (row["bp_true_y_px"], pixel[1], 1e-3), "peak_x_off": (row["bp_x_px"], pixel[0], 1.0),
        "peak_y_off": (row["bp_y_px"], pixel[1], 1.0), "noise_sigma_off": (row["noise_sigma"], SIGMA, 0),
        "n_lights_off": (row["n_lights"], 1, 0),
        "truth_off": (float(by_hand.angle_deg(_vector(row, "truth"), normal)), 0, 1e-6),
        "error_law_off": (row["error_law_deg"], half, 1e-4), "error_off": (row["error_deg"], error, 1e-6),
        "error_look_off": (row["error_look_deg"], error, 1e-6), "error_fine_off": (row["error_fine_deg"], error, 1e-6),
        "error_base_off": (row["error_base_deg"], error, 1e-6),
        "look_off_deg": (float(by_hand.angle_deg(look, -stated)), 0, 1e-6),
    }  # fmt: skip
    about = "cone_axis on a plane under a light 1 mm aside, its geometry by hand"
    figures_ = [
        law("columns", name, "", abs(_value(value) - right), close, about=about)
        for name, (value, right, close) in off.items()
    ]
    # The peak stands on black, a little lower for its smoothing.
    snr = _value(row["peak_snr"]) * SIGMA
    figures_.append(law("columns", "peak_snr", "x", snr, 1.02, 0.85, about="peak over the noise; smoothing lowers it"))
    # Of a bent surface: curvatures in their order, and the ratio of 1 + d k
    bent = scene_columns(made.view.scene, replace(made.truths[0], kd_min=-0.3, kd_max=0.8))
    gap = (
        abs(_value(bent["kd_min"]) + 0.3)
        + abs(_value(bent["kd_max"]) - 0.8)
        + abs(_value(bent["axis_ratio_law"]) - 0.7 / 1.8)
    )
    figures_.append(law("columns", "bent_off", "", gap, 1e-12, n=3, about="k d of -0.3 and 0.8, as they were put in"))
    return [*figures_, *_candidates(made), *_of_protocol(), *_curvature_errors(made), _distance(made)]


def thresholds(session: Session) -> list[Law]:
    """Detect spots of known height in known noise; cut one at half its height; judge points by their peaks."""
    x, y = np.meshgrid(np.arange(240) + 0.5, np.arange(60) + 0.5)
    heights = (6.0, 9.0, 9.7, 10.3, 11.0, 14.0)
    centres = [20.0 + 40 * i for i in range(len(heights))]
    spots = sum(
        h * np.exp(-((x - cx) ** 2 + (y - 30.0) ** 2) / (2 * 5.0**2)) for h, cx in zip(heights, centres, strict=True)
    )
    found = detect(np.asarray(spots, dtype=np.float32), 1.0)
    lowest = min((float(spots[r.peak[1], r.peak[0]]) for r in found), default=math.nan)
    part = half_height_component(np.asarray(spots[:, 200:], dtype=np.float32), 30, 20)
    area = math.nan if part is None else float(part.mask.sum()) / (2 * math.pi * math.log(2) * 5.0**2)
    # True highlights by their peak over the noise.
    session.update(described(PLANE))
    points = session.highlights()
    levels = [Examined((0, 0), 1.0, 10.5 * SIGMA, ""), Examined((0, 0), 1.0, 9.5 * SIGMA, "")]
    judged = verdicts([points[0]] * 2, levels, np.full(2, SIGMA))
    return [
        law("detection", "found", "", len(found), 3, 3, about="spots of 10.3 to 14 standard deviations, of six"),
        law("detection", "lowest", "sigma", lowest, 10.35, 10.0, about="the lowest one that counts stands at 10"),
        law("detection", "area", "x", area, 1.05, 0.95, n=1, about="2 pi ln 2 s^2 of a Gaussian; whole pixels"),
        law("detection", "isolated", "", float(judged[0].isolated) + 2 * float(judged[1].isolated), 1, 1,
               about="10.5 standard deviations count, 9.5 do not"),
    ]  # fmt: skip


MEASURED = ((1000.0, 2.4), (100.0, 8.0), (10.0, 24.6), (3.0, 41.3), (1.0, 59.9), (0.5, 70.4))
"""Radius over distance of a cylinder and circle pose's error, deg, that a prototype measured (docs/concepts/theory.md,
section 4): n = 50, t = 0.5, without noise."""


def law_values() -> list[Law]:
    """Compare the laws with figures that a program apart from this package measured, and with limits by hand."""
    kd = np.array([1 / r for r, _ in MEASURED])
    a, b = laws.isophote_half_axes(0.5, 200.0, np.zeros_like(kd), kd)
    found = np.degrees(laws.circle_pose_error(a, b))
    measured = np.array([error for _, error in MEASURED])
    pose = np.abs(found - measured) / np.maximum(0.3, 0.03 * measured)
    ratios = laws.axis_ratio(np.zeros(4), np.array([0.01, 0.1, 1.0, 2.0]))
    offsets = np.degrees(
        laws.bisector_angle(np.array([0.0, 0.0, 10.0]), np.array([[0.1, 0, 0], [0.5, 0, 0], [2.0, 0, 0]]))
    )
    halves = np.array([math.atan(x) / 2 / math.pi * 180 for x in (0.01, 0.05, 0.2)])
    shift = math.degrees(float(laws.vignetting_shift(math.radians(10.0), 4.0, 200.0)))
    look = laws.look_error(np.array([0.01, 0.02]), 1.0, -0.5)
    return [
        law("laws", "circle_pose_off", "", float(pose.max()), 1.0, n=len(MEASURED), about="over 0.3 deg or 3 %"),
        law("laws", "axis_ratio_off", "", float(np.abs(ratios - [1 / 1.01, 1 / 1.1, 0.5, 1 / 3]).max()), 1e-12, n=4,
               about="R/(R + d)"),
        law("laws", "offset_off", "deg", float(np.abs(offsets - halves).max()), 1e-9, n=3, about="atan(eps/d) / 2"),
        law("laws", "vignetting", "deg", shift, 0.203, 0.195, about="k tan(phi)/(4 n + 2), cos^4 at 10 deg: 0.20"),
        law("laws", "look_off", "", abs(float(look) - math.hypot(0.02, 0.01)), 1e-12, about="abs((I + dS) w)"),
    ]  # fmt: skip


def _candidates(made: Realisation) -> list[Law]:
    """Check error and better error of two candidates, one of which is the truth."""
    truth = made.truths[0]
    other = by_hand.anchor_normal(TILT_DEG + 5.0, AZIMUTH_DEG)
    own = next(iter(made.specularities[next(iter(made.matched))].estimates.values()))
    if not isinstance(own, Estimate):
        return [law("columns", "oracle_off", "deg", math.nan, 0, about="no estimate to change")]
    both = replace(own, normal=other, candidates=np.array([other, truth.normal]), budget=None, covariance=None)
    specularity = replace(made.specularities[next(iter(made.matched))], estimates={"both": both})
    session = _Still(made)
    (row, *_) = rows(session, {}, [specularity], [truth], {0: 0}, {"both": ()})  # type: ignore[arg-type]
    gap = max(
        abs(_value(row["error_deg"]) - 5.0), abs(_value(row["error_oracle_deg"])), abs(_value(row["rank_correct"]) - 1)
    )
    about = "the second of two candidates is the truth, the first 5 deg off"
    return [law("columns", "oracle_off", "deg", gap, 1e-6, about=about)]


class _Still:
    """Stands in for a session at its scene that casts no rays."""

    def __init__(self, made: Realisation) -> None:
        self.scene = made.view.scene

    def exact_points(self, points: Array) -> object:
        class Nothing:
            valid = np.zeros(len(points), dtype=bool)
            normal = np.full((len(points), 3), np.nan)

        return Nothing()


def _of_protocol() -> list[Law]:
    """Compare the published protocol's errors with the angles between its columns."""
    setting = PaperSetting(size=200, sigma=0.02, isovalue=0.5)
    made = table(paper_rows(setting, {}, range(2), [3, 4], ("circle_pose",)), {})
    stated = made.select("normal_x", "normal_y", "normal_z").to_numpy()
    slanted = np.array([0.0, math.sin(58 / 180 * math.pi), -math.cos(58 / 180 * math.pi)])
    gap = np.abs(by_hand.angle_deg(stated, slanted) - made["error_deg"].to_numpy()).max()
    true = by_hand.angle_deg(made.select("truth_x", "truth_y", "truth_z").to_numpy(), slanted).max()
    about = "angle between the stated normal and a plane slanted by 58 deg"
    return [
        law("columns", "protocol_error_off", "deg", float(gap), 1e-6, n=made.height, about=about),
        law("columns", "protocol_truth_off", "deg", float(true), 1e-6, n=made.height, about="the slanted plane"),
    ]


def _curvature_errors(made: Realisation) -> list[Law]:
    """Check gain errors and direction errors of an estimate that is 10 % and 30 deg off."""
    from simtest.estimators.protocol import EstimatedCurvature

    truth = replace(
        made.truths[0], kd_min=0.0, kd_max=1.0, direction_min=np.array([1.0, 0, 0]), normal=np.array([0, 0, -1.0])
    )
    turned = np.array([[math.cos(math.pi / 6), 0.5, 0.0], [-0.5, math.cos(math.pi / 6), 0.0]])
    listed = np.array([[1.1, 2.0], [1.0, 2.0]])
    estimate = Estimate(
        truth.normal, truth.normal[None], np.zeros(2), curvature=EstimatedCurvature(turned, 0.55, listed)
    )
    errors = curvature_errors(estimate, truth)
    gap = abs(_value(errors["gain_error"]) - 0.1) + abs(_value(errors["gain_oracle_error"]))
    gap += abs(_value(errors["direction_error_deg"]) - 30.0)
    return [law("columns", "curvature_errors_off", "", gap, 1e-9, about="10 %, 0 and 30 deg, by construction")]


def _distance(made: Realisation) -> Law:
    """Compare a Mahalanobis distance with that of a covariance along and across a tilt by hand."""
    normal = np.array([0.0, 0.0, -1.0])
    # About this normal the tangent basis is along x and y, up to sign: variances stay with their axes.
    estimate = Estimate(normal, normal[None], np.zeros(2), covariance=np.diag([0.04**2, 0.01**2]))
    truth = np.array([math.sin(0.02), 0.0, -math.cos(0.02)]), np.array([0.0, math.sin(0.02), -math.cos(0.02)])
    found = [mahalanobis2(estimate, each) for each in truth]
    gap = max(abs(_value(found[0]) - 0.25), abs(_value(found[1]) - 4.0))
    return law("coverage", "distance_off", "", gap, 1e-9, n=2, about="0.02 rad over 0.04, and over 0.01, squared")


def _realised(session: Session, sigma: float) -> Realisation:
    """Make one realisation of the plane under a light aside, which no estimator is told."""
    scene = described(PLANE, LIGHT_MM, sensor={"noise_sigma": sigma})
    experiment = Experiment(name="law", realisations=1, groups=[{"scene": "plane", "isolated": False}])
    (case,) = expand(experiment)
    names = ("cone_axis",)
    return realise(session, experiment, case, 0, render_view(session, scene), {}, load_estimators(names))


def _vector(row: Row, name: str) -> Array:
    return np.array([_value(row[f"{name}_{axis}"]) for axis in "xyz"])


def _value(value: float | None) -> float:
    return math.nan if value is None else float(value)
