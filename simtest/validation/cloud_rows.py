"""Rows of results for estimates of clouds: each against the base's highlight point that most of its spots belong to."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from simtest.errors import Failure
from simtest.estimators import AnyEstimator, Estimate
from simtest.estimators.protocol import CloudEstimator
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import Specularity
from simtest.rendering import HighlightPoint, Session
from simtest.simulation.frame import RenderedView
from simtest.simulation.highlights import CloudRegions
from simtest.validation.columns import Row
from simtest.validation.metrics import MISSED, estimate_columns, mahalanobis2, scene_columns
from simtest.validation.rough_truth import Cloud, cloud_columns

LEAST_VISIBLE = 15
"""A cloud that is wholly in view and has so many visible highlights is missed where no estimate is of it."""


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


def cloud_rows(
    session: Session, view: RenderedView, common: Row, found: Mapping[str, Sequence[tuple[int, Estimate]]],
    failures: Mapping[str, Failure], whole: Mapping[int, Cloud],
) -> list[Row]:  # fmt: skip
    """Make the rows of cloud estimators: of each estimate, and of each whole cloud that none is of.

    `found` and `failures` are those of `apart`, `whole` the clouds that are wholly in view. The column ``true_id`` is
    the index of the base's highlight point, as ``cloud``; the errors are against the base's normal there.
    """
    made, regions = [], CloudRegions.of(session, view.clouds) if any(found.values()) else None
    for name, estimates in found.items():
        taken: set[int] = set()
        for i, estimate in estimates:
            assert regions is not None
            numbers = match_cloud(regions, view, estimate)
            taken.update(numbers)
            row = _row(session, common, view, whole, numbers[0] if numbers else None)
            row |= estimate_columns(estimate) | {"estimator": name, "specularity": i}
            made.append(row | _errors(session, estimate, [view.clouds[n] for n in numbers]) if numbers else row)
        status = MISSED if name not in failures else str(failures[name].reason)
        detail = None if name not in failures else failures[name].detail
        for number, cloud in whole.items():
            if number not in taken and cloud.visible >= LEAST_VISIBLE and view.clouds[number].lit:
                row = _row(session, common, view, whole, number)
                made.append(row | {"estimator": name, "status": status, "flags": detail})
    return made


def _row(session: Session, common: Row, view: RenderedView, whole: Mapping[int, Cloud], number: int | None) -> Row:
    """Return the row of a cloud before its estimate: scene, and the base's highlight point by number, if any."""
    centre = None if number is None else view.clouds[number]
    row = common | scene_columns(session.scene, centre) | {"true_id": number, "cloud": number, "target": "base"}
    own = None if number is None else whole.get(number)
    return row if own is None else row | cloud_columns(own)


def _errors(session: Session, estimate: Estimate, centres: Sequence[HighlightPoint]) -> Row:
    """Compute the errors against the base's normal at its highlight point, and where the estimate looks.

    Lights that are not told apart make one cloud: the truth is the mean of the normals at their points.
    """
    mean = np.mean([centre.normal_base for centre in centres], axis=0)
    truth = mean / np.linalg.norm(mean)
    errors = angle_deg(estimate.candidates, truth)
    look = session.exact_points(estimate.look_px[None], fine=False)
    at_look = float(angle_deg(estimate.normal, look.normal_base[0])) if look.valid[0] else None
    return {
        "truth_x": float(truth[0]),
        "truth_y": float(truth[1]),
        "truth_z": float(truth[2]),
        "error_deg": float(errors[0]),
        "error_base_deg": float(errors[0]),
        "error_oracle_deg": float(errors.min()),
        "error_look_deg": at_look,
        "rank_correct": int(errors.argmin()),
        "mahalanobis2": mahalanobis2(estimate, truth),
    }
