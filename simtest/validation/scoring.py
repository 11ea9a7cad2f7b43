"""How answers are measured: detections are matched with true highlights, each estimate gives a row of results.

Detections come from the frame alone; each estimator has a row at each detected or missed highlight.
"""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, replace

import numpy as np

from simtest.conventions import HIGHLIGHT_ISOVALUE, ON_INSTRUMENT, PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators import AnyEstimator, Estimate
from simtest.estimators.budget import deviations
from simtest.estimators.protocol import CloudEstimator, Law
from simtest.geometry import Patch
from simtest.geometry.patch import encloses
from simtest.geometry.vectors import angle_deg, tangent_coordinates
from simtest.reconstruction.records import Specularity
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array
from simtest.simulation.frame import RenderedView
from simtest.simulation.highlights import CloudRegions, TrueHighlight
from simtest.spec.scene import Scene
from simtest.validation import laws
from simtest.validation.columns import Row
from simtest.validation.glints import RoughTruth
from simtest.validation.predicted import EQUAL_KD, axis_ratio_seen, base_law_deg, law_deg, look_law_deg


def match(specularities: Sequence[Specularity], points_px: Sequence[Array]) -> dict[int, int]:
    """Match each detection to the nearest true point, px, inside its isophote at t = 0.5 (theory.md section 6).

    The points are the BPs of true highlights, or the peaks of visible ones.

    Returns
    -------
    dict
        Index of the point by index of the detection; a point is matched to the nearest of its detections only.
    """
    points = np.asarray(points_px, dtype=float).reshape(-1, 2)
    # Candidates: points that an isophote encloses, with their distance from its peak.
    pairs = []
    for i, specularity in enumerate(specularities):
        for j in _enclosed(specularity, points):
            distance = float(np.hypot(*(points[j] - peak_px(specularity))))
            pairs.append((_is_undetected(specularity), distance, i, j))
    # Detections before what a frame estimator alone saw, the nearest pair first; each detection and each point once.
    matched: dict[int, int] = {}
    for _, _, i, j in sorted(pairs):
        if i not in matched and j not in matched.values():
            matched[i] = j
    return matched


def on_instruments(
    specularities: Sequence[Specularity], matched: Mapping[int, int], view: RenderedView
) -> list[bool] | None:
    """Return which detections that match no true highlight have their peak on an instrument; None where none is listed.

    What shines there is the instrument: it is no answer about the tissue, and no false detection.
    """
    if not view.scene.instruments:
        return None
    if view.instruments is None:
        return [False] * len(specularities)
    height, width = view.instruments.shape
    pixels = [peak_px(specularity).astype(int) for specularity in specularities]
    peaks = [(min(max(row, 0), height - 1), min(max(column, 0), width - 1)) for column, row in pixels]
    return [i not in matched and bool(view.instruments[peak]) for i, peak in enumerate(peaks)]


def match_cloud(regions: CloudRegions, view: RenderedView, estimate: Estimate) -> list[int]:
    """Return the indices in `view.clouds`, whose `regions` are given, of those that an estimate is of, one a light.

    Of each light it is the one that most of the estimate's spots belong to; of several, the nearest to where the
    estimate looks. That of most spots comes first. Empty where they belong to none that is in view. A point that an
    instrument covers or shades counts too, since the spots around it still belong to it.
    """
    if estimate.cloud is None or not view.clouds:
        return []
    points, centres = estimate.cloud.points_px, list(view.clouds)
    votes: dict[int, int] = {}
    for light in sorted({centre.light for centre in centres}):
        owners = regions.assign(np.full(len(points), light), points)
        counts = Counter(n for n in owners if n is not None)
        if counts:
            best = [n for n, count in counts.items() if count == max(counts.values())]
            nearest = min(best, key=lambda n: float(np.hypot(*(centres[n].bp_px - estimate.look_px))))
            votes[nearest] = counts[nearest]
    return sorted(votes, key=lambda n: -votes[n])


def _is_undetected(specularity: Specularity) -> bool:
    """Return whether no detector found it: it has neither a patch nor a contrast."""
    return isinstance(specularity.patch, Failure) and specularity.region.contrast is None


def peak_px(specularity: Specularity) -> np.ndarray:
    """Return a detection's peak, px: sub-pixel where there is a patch."""
    if isinstance(specularity.patch, Failure):
        return np.array(specularity.region.peak) + PIXEL_CENTRE
    return specularity.patch.peak_px


def _enclosed(specularity: Specularity, points: Array) -> list[int]:
    """Return the indices of the points, shape (N, 2), px, that a detection's isophote encloses.

    Where the isophote does not close, the detection's region decides.
    """
    x, y, width, height = specularity.region.box
    # The isophote lies in the region. A frame on a relief has hundreds of regions and of points, far apart.
    inside = ((points >= [x, y]) & (points <= [x + width, y + height])).all(axis=1)
    near, patch = np.flatnonzero(inside).tolist(), specularity.patch
    if not near or isinstance(patch, Failure):
        return near
    if patch.area_px(HIGHLIGHT_ISOVALUE) is None:
        return near
    # The border passes between pixel centres: where the four around a point agree, it need not be traced.
    sides = np.pad(patch.inside(HIGHLIGHT_ISOVALUE), 1)

    def holds(point: Array) -> bool:
        column, row = np.floor(point - PIXEL_CENTRE - patch.origin_px).astype(int) + 1
        around = sides[max(row, 0) : row + 2, max(column, 0) : column + 2]
        if around.all() == around.any():
            return bool(around.all())
        contour = patch.isophote(HIGHLIGHT_ISOVALUE)
        return not isinstance(contour, Failure) and encloses(contour, point)

    return [j for j in near if holds(points[j])]


MISSED = "missed"

LEAST_VISIBLE = 15
"""A cloud that is wholly in view and has so many visible highlights is missed where no estimate is of it."""


def rows(
    session: Session,
    common: Row,
    specularities: Sequence[Specularity],
    truths: Sequence[TrueHighlight],
    matched: Mapping[int, int],
    estimators: Mapping[str, Collection[Law]],
    unfound: str = MISSED,
    rough: RoughTruth | None = None,
    on_instrument: Sequence[bool] | None = None,
) -> list[Row]:
    """Make the rows of one realisation: of each detection, and of each truth that no detection found.

    Parameters
    ----------
    session : Session
        At the scene; casts exact rays.
    common : dict
        What all rows share: experiment, setting, realisation, seed, swept parameters.
    specularities, truths : sequence
        Detections with their estimates, and the highlights that count as true.
    matched : mapping
        Index of the truth by index of the detection.
    estimators : mapping
        Laws that each estimator declares (`simtest.estimators.protocol.laws_of`), by name.
    unfound : str
        Status for the rows of truths that no detection found.
    rough : RoughTruth, optional
        What stands beside the true highlights on a surface with relief.
    on_instrument : sequence of bool, optional
        Of a scene with instruments, for each detection: see `on_instruments`.
    """
    rough = rough or RoughTruth()
    made = []
    scene, look_normals = session.scene, _look_normals(session, specularities, matched)
    # Detections: matched, or false.
    for i, specularity in enumerate(specularities):
        true_id = matched.get(i)
        truth = None if true_id is None else truths[true_id]
        row = common | scene_columns(scene, truth) | {"specularity": i, "true_id": true_id}
        row |= rough.columns(i, true_id, truth)
        if on_instrument is not None:
            row[ON_INSTRUMENT] = on_instrument[i]
        if not isinstance(patch := specularity.patch, Failure):
            bp_x, bp_y = patch.peak_px.tolist()
            row |= {"bp_x_px": bp_x, "bp_y_px": bp_y, "saturated_share": patch.saturated_share(HIGHLIGHT_ISOVALUE)}
        for name, result in specularity.estimates.items():
            if isinstance(result, Failure):
                made.append(row | {"estimator": name, "status": str(result.reason), "flags": result.detail})
                continue
            answered = row | {"estimator": name} | estimate_columns(result)
            if truth is not None:
                look_normal = look_normals.get((i, name))
                answered |= _error_columns(scene, estimators[name], patch, result, truth, look_normal)
            made.append(answered)
    # Truths without a row of some estimator: no detection found them, or one of a frame estimator alone.
    held = {(row["true_id"], row["estimator"]) for row in made}
    for j, truth in enumerate(truths):
        if missing := [name for name in estimators if (j, name) not in held]:
            row = common | scene_columns(scene, truth) | {"true_id": j, "status": unfound}
            row |= rough.columns(None, j, truth)
            made += [row | {"estimator": name} for name in missing]
    return made


def scene_columns(scene: Scene, truth: HighlightPoint | None) -> Row:
    """Describe the scene and, unless the detection is false, the true highlight or the centre of the true cloud."""
    row: Row = {
        # What was not answered would have been of the fine surface.
        "target": "fine",
        "surface": scene.surface.label,
        "reflectance": scene.reflectance.type,
        "noise_sigma": scene.sensor.noise_sigma,
        "path_depth": scene.render.path_depth,
        "n_lights": len(scene.rig.lights),
    }
    if truth is None:
        return row
    # The light that made the highlight, at its true position.
    light = scene.rig.true_mm()[truth.light]
    truth_x, truth_y, truth_z = truth.normal.tolist()
    return row | {
        "distance_mm": truth.distance,
        "kd_min": truth.kd_min,
        "kd_max": truth.kd_max,
        "kd_min_base": truth.kd_min_base,
        "kd_max_base": truth.kd_max_base,
        "eps_over_d": float(np.linalg.norm(light)) / truth.distance,
        "peak_snr": truth.peak_snr if isinstance(truth, TrueHighlight) and np.isfinite(truth.peak_snr) else None,
        "axis_ratio_law": float(laws.axis_ratio(truth.kd_min, truth.kd_max)),
        "bp_true_x_px": float(truth.bp_px[0]),
        "bp_true_y_px": float(truth.bp_px[1]),
        "truth_x": truth_x,
        "truth_y": truth_y,
        "truth_z": truth_z,
    }


def estimate_columns(estimate: Estimate) -> Row:
    """Describe an estimate."""
    isovalues = [isophote.isovalue for isophote in estimate.isophotes]
    normal_x, normal_y, normal_z = estimate.normal.tolist()
    covariance = estimate.covariance
    gains = None if estimate.curvature is None else estimate.curvature.gains
    return {
        "status": "ok",
        "flags": ",".join(estimate.flags),
        "n_candidates": len(estimate.candidates),
        "choice_margin": estimate.choice_margin,
        "look_x_px": float(estimate.look_px[0]),
        "look_y_px": float(estimate.look_px[1]),
        "isovalue": isovalues[0] if len(isovalues) == 1 else None,
        "isovalues": ",".join(f"{t:g}" for t in isovalues) or None,
        "axis_ratio": estimate.axis_ratio,
        "normal_x": normal_x,
        "normal_y": normal_y,
        "normal_z": normal_z,
        "cov_11": None if covariance is None else covariance[0, 0],
        "cov_12": None if covariance is None else covariance[0, 1],
        "cov_22": None if covariance is None else covariance[1, 1],
        "target": estimate.target,
        **{f"budget_{name}_deg": float(np.degrees(sd)) for name, sd in deviations(estimate.budget or {}).items()},
        "gain_1": None if gains is None else float(gains[0]),
        "gain_2": None if gains is None else float(gains[1]),
        **({} if estimate.calibrated is None else asdict(estimate.calibrated)),
    }


def _look_normals(
    session: Session, specularities: Sequence[Specularity], matched: Mapping[int, int]
) -> dict[tuple[int, str], Array]:
    """Return the true normals where the estimates at matched detections look, by detection and estimator.

    Those that look beside the surface are left out. All rays are cast at once: a call costs as much as many rays.
    """
    looks = {
        (i, name): result.look_px
        for i in matched
        for name, result in specularities[i].estimates.items()
        if not isinstance(result, Failure) and np.isfinite(result.look_px).all()
    }
    if not looks:
        return {}
    found = session.exact_points(np.stack(list(looks.values())))
    return {key: found.normal[n] for n, key in enumerate(looks) if found.valid[n]}


def _error_columns(
    scene: Scene,
    declared: Collection[Law],
    patch: Patch | Failure,
    estimate: Estimate,
    truth: TrueHighlight,
    look_normal: Array | None,
) -> Row:
    """Compute an estimate's errors, and what the laws predict for them.

    `look_normal` is the true normal where the estimate looks, None where there is no surface.
    """
    # The headline errors are those against the surface whose normal is stated.
    stated = truth.normal if estimate.target == "fine" else truth.normal_base
    smoothing_px = 0.0 if isinstance(patch, Failure) else patch.smoothing_px
    # Samples of datasets hold the columns in this order.
    return {
        "axis_ratio_seen_law": axis_ratio_seen(scene, declared, estimate, truth, smoothing_px),
        **dict.fromkeys(("error_deg", "error_fine_deg", "error_base_deg", "error_oracle_deg", "error_look_deg")),
        "error_law_deg": law_deg(scene, declared, estimate, truth),
        "error_look_law_deg": look_law_deg(scene, declared, estimate, truth),
        "error_base_law_deg": base_law_deg(scene),
        **scored(estimate, stated, look_normal),
        "error_fine_deg": float(angle_deg(estimate.normal, truth.normal)),
        "error_base_deg": float(angle_deg(estimate.normal, truth.normal_base)),
        **curvature_errors(estimate, truth),
    }


def scored(estimate: Estimate, truth: Array, look_normal: Array | None) -> Row:
    """Compute an estimate's errors against the true normal of what it states, unit, shape (3,).

    `look_normal` is that where the estimate looks; None where there is no surface.
    """
    errors = angle_deg(estimate.candidates, truth)
    return {
        "error_deg": float(errors[0]),
        "error_oracle_deg": float(errors.min()),
        "error_look_deg": None if look_normal is None else float(angle_deg(estimate.normal, look_normal)),
        "rank_correct": int(errors.argmin()),
        "mahalanobis2": mahalanobis2(estimate, truth),
    }


def curvature_errors(estimate: Estimate, true: HighlightPoint) -> Row:
    """Compute the errors of an estimate's curvature at a true highlight; what it does not state is left out.

    Of the gains it is the larger relative error of 1 + d k, of the proposed hypothesis and of the best one. The
    direction is that of the smaller abs(1 + d k), in [0, 90] deg; left out where the true curvatures are equal.
    """
    stated, errors = estimate.curvature, Row()
    if stated is None:
        return errors
    # True gains and their first direction, the smaller gain first as in the estimate.
    gains, first = np.array([1 + true.kd_min, 1 + true.kd_max]), true.direction_min
    if abs(gains[0]) > abs(gains[1]):
        gains, first = gains[::-1], np.cross(true.normal, true.direction_min)
    if stated.hypotheses is not None and np.all(gains != 0):
        off = np.abs(stated.hypotheses / gains - 1).max(axis=1)
        errors |= {"gain_error": float(off[0]), "gain_oracle_error": float(off.min())}
    if abs(true.kd_max - true.kd_min) > EQUAL_KD:
        angle = float(angle_deg(stated.directions[0], first))
        errors["direction_error_deg"] = min(angle, 180 - angle)
    return errors


def mahalanobis2(estimate: Estimate, truth: Array) -> float | None:
    """Compute the squared Mahalanobis distance of the true normal, unit, shape (3,), by the region or the covariance.

    Both are chi-squared with two degrees of freedom where the estimate's uncertainty is right; None without either.
    """
    if estimate.region is not None:
        return float(estimate.region.statistic(truth))
    if estimate.covariance is None:
        return None
    # The three numbers that the table of results states: rounding may have left a covariance not quite symmetric.
    (first, mixed), (_, second) = estimate.covariance
    covariance = np.array([[first, mixed], [mixed, second]])
    if np.linalg.eigvalsh(covariance)[0] <= 0:
        return None
    miss = tangent_coordinates(estimate.normal, truth)
    return float(miss @ np.linalg.solve(covariance, miss))


def of_clouds(estimators: Mapping[str, AnyEstimator]) -> list[str]:
    """Return the names of the estimators that state the normals of clouds."""
    return [name for name, estimator in estimators.items() if isinstance(estimator, CloudEstimator)]


def apart(
    specularities: Sequence[Specularity], names: Sequence[str]
) -> tuple[list[Specularity], dict[str, list[tuple[int, Estimate]]], dict[str, Failure]]:
    """Part the results of cloud estimators from those of single highlights.

    Returns
    -------
    singles : list of Specularity
        Those of single highlights, without the cloud estimators' results; they come first in `specularities`.
    clouds : dict
        Number of the specularity and estimate, by estimator.
    failures : dict
        Why an estimator found no cloud, if it failed.
    """
    clouds: dict[str, list[tuple[int, Estimate]]] = {name: [] for name in names}
    failures: dict[str, Failure] = {}
    singles = []
    for i, specularity in enumerate(specularities):
        own = {name: result for name, result in specularity.estimates.items() if name in clouds}
        for name, result in own.items():
            if isinstance(result, Failure):
                failures[name] = result
            else:
                clouds[name].append((i, result))
        if not any(isinstance(result, Estimate) for result in own.values()):
            others = {name: result for name, result in specularity.estimates.items() if name not in clouds}
            singles.append(replace(specularity, estimates=others))
    return singles, clouds, failures


def cloud_rows(
    session: Session, view: RenderedView, common: Row, found: Mapping[str, Sequence[tuple[int, Estimate]]],
    failures: Mapping[str, Failure], whole: Mapping[int, Row],
) -> list[Row]:  # fmt: skip
    """Make the rows of cloud estimators: of each estimate, and of each whole cloud that none is of.

    `found` and `failures` are those of `apart`, `whole` the columns of the clouds that are wholly in view. The column
    ``true_id`` is the index of the base's highlight point, as ``cloud``; ``error_base_deg`` is against the base's
    normal there, the other errors are where the estimate looks.
    """
    made, regions = [], CloudRegions.of(session, view.clouds) if any(found.values()) else None
    for name, estimates in found.items():
        taken: set[int] = set()
        for i, estimate in estimates:
            assert regions is not None
            numbers = match_cloud(regions, view, estimate)
            taken.update(numbers)
            row = _cloud_row(session, common, view, whole, numbers[0] if numbers else None)
            row |= estimate_columns(estimate) | {"estimator": name, "specularity": i}
            made.append(row | _cloud_errors(session, estimate, [view.clouds[n] for n in numbers]))
        status = MISSED if name not in failures else str(failures[name].reason)
        detail = None if name not in failures else failures[name].detail
        for number, columns in whole.items():
            visible = columns["cloud_visible"]
            is_clear = isinstance(visible, int) and visible >= LEAST_VISIBLE
            if number not in taken and is_clear and view.clouds[number].lit:
                row = _cloud_row(session, common, view, whole, number)
                made.append(row | {"estimator": name, "status": status, "flags": detail})
    return made


def _cloud_row(session: Session, common: Row, view: RenderedView, whole: Mapping[int, Row], number: int | None) -> Row:
    """Return the row of a cloud before its estimate: scene, and the base's highlight point by number, if any."""
    centre = None if number is None else view.clouds[number]
    row = common | scene_columns(session.scene, centre) | {"true_id": number, "cloud": number, "target": "base"}
    return row if number is None else row | whole.get(number, {})


def _cloud_errors(session: Session, estimate: Estimate, centres: Sequence[HighlightPoint]) -> Row:
    """Compute the errors against the base's normal where the estimate looks, and at its highlight point, if any.

    Lights that are not told apart make one cloud: its truth is the mean of the normals at their points.
    """
    mean = np.sum([centre.normal_base for centre in centres], axis=0) if centres else None
    point = None if mean is None else np.asarray(mean / np.linalg.norm(mean))
    look = session.exact_points(estimate.look_px[None], fine=False)
    truth = look.normal_base[0] if look.valid[0] else point
    if truth is None:
        return {}
    truth_x, truth_y, truth_z = truth.tolist()
    return {
        **scored(estimate, truth, truth if look.valid[0] else None),
        "error_base_deg": None if point is None else float(angle_deg(estimate.normal, point)),
        "truth_x": truth_x, "truth_y": truth_y, "truth_z": truth_z,
    }  # fmt: skip
