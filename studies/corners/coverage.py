"""Answers against the truth: what their 95 % regions hold, and how many are wrong and sure."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.rendering import HighlightPoint
from simtest.runtime.arrays import Array
from simtest.validation.statistics import is_wrong_and_sure
from studies.corners import formulas
from studies.corners.case import Case
from studies.corners.scenes import FACTORS, SMOOTH

REACH_PX = 2.5
"""A detection is of the nearest highlight within this, or within `REACH` of its box's shorter side."""

REACH = 0.3

NOMINAL, LEAST, LOWEST = 0.95, 0.92, 0.90
"""What regions are to hold, and hold at least: where all answers are pooled, and at each level."""

LEAST_SCENES = 5

WRONG_SMOOTH, WRONG_TISSUE = 0.01, 0.03


class Answer(NamedTuple):
    """An answer of an estimator with its error, deg.

    `scene` numbers row and draw; `matched` says whether it is of an isolated highlight (else it is compared with the
    normal where it looks); `inside` is None where no region is reported, `reported_deg` where no deviation is.
    """

    scene: tuple[int, int]
    estimator: str
    matched: bool
    smooth: bool
    error_deg: float
    reported_deg: float | None
    inside: bool | None


def answers_of(case: Case) -> list[Answer]:
    """Compare all answers of a case with its truth; those on an instrument are left out."""
    rough = case.row["relief"] != "none"
    base = case.row["relief"] == "not_resolved"
    points: Sequence[HighlightPoint] = case.seen.clouds if base else [h for h in case.seen.highlights if h.lit]
    normals = np.array([p.normal_base if base else p.normal for p in points]).reshape(-1, 3)
    places = np.array([p.bp_px for p in points]).reshape(-1, 2)
    found = []
    for spot in case.answers:
        if isinstance(spot.patch, Failure):
            continue
        peak = spot.patch.peak_px
        if case.frame.labels.instrument[int(peak[1]), int(peak[0])]:
            continue
        gaps = np.linalg.norm(places - peak, axis=1)
        reach = max(REACH_PX, REACH * min(spot.region.box[2:]))
        near = int(gaps.argmin()) if len(gaps) and gaps.min() < reach else None
        # The package vouches for isolated highlights; on a relief not resolved each is that of the base.
        if near is not None and not base and not rough and not getattr(points[near], "isolated", True):
            near = None
        for name, result in spot.estimates.items():
            if isinstance(result, Failure):
                continue
            truth = normals[near] if near is not None else _at_look(case, result, base)
            if truth is not None and np.isfinite(truth).all():
                found.append(_answer(case, name, result, truth, near is not None, not rough))
    return found


def _at_look(case: Case, result: Estimate, base: bool) -> Array | None:
    """Return the true normal at the pixel where an answer looks; None outside the frame."""
    x, y = result.look_px
    if not (0 <= x < case.camera["width"] and 0 <= y < case.camera["height"]):
        return None
    return np.asarray((case.truth.normal_base if base else case.truth.normal)[int(y), int(x)])


def _answer(case: Case, name: str, result: Estimate, truth: Array, matched: bool, smooth: bool) -> Answer:
    inside, reported = None, None
    if result.covariance is not None:
        reported = math.degrees(math.sqrt(max(float(np.trace(result.covariance)), 0.0)))
        squared = formulas.squared_mahalanobis(result.normal, result.covariance, truth)
        inside = bool(squared <= formulas.CHI2_95)
    elif result.region is not None:
        inside = bool(result.region.contains(truth))
    organ = smooth and case.row["surface"] in SMOOTH
    error = float(formulas.angle_deg(result.normal, truth))
    return Answer((case.number, case.draw), name, matched, organ, error, reported, inside)


def share_by_scene(answers: Iterable[Answer]) -> tuple[int, int, float, float, float]:
    """Return answers with a region, scenes, the share inside, and its 95 % interval with the scene as the unit."""
    counts: dict[tuple[int, int], list[int]] = {}
    for each in answers:
        if each.inside is not None:
            of_scene = counts.setdefault(each.scene, [0, 0])
            of_scene[0] += each.inside
            of_scene[1] += 1
    inside, total = np.array(list(counts.values()), dtype=float).reshape(-1, 2).T
    if not len(total):
        return 0, 0, math.nan, 0.0, 1.0
    share = inside.sum() / total.sum()
    # A ratio of sums over scenes, by its residuals; never narrower than Wilson's of so many scenes.
    n = len(total)
    residual = (inside - share * total) / total.mean()
    half = 1.96 * math.sqrt(np.sum(residual**2) / max(n - 1, 1) / n)
    low, high = formulas.wilson(share * n, n)
    return int(total.sum()), n, float(share), min(max(share - half, 0.0), low), max(min(share + half, 1.0), high)


def table(answers: Sequence[Answer], rows: Sequence[dict[str, str]]) -> tuple[list[str], list[str]]:
    """Return the lines of the tables of coverage, and the faults."""
    matched = [each for each in answers if each.matched]
    lines = ["| feature | level | answers | scenes | inside | 95 % interval |", "|---|---|---|---|---|---|"]
    faults = []

    def add(feature: str, level: str, chosen: list[Answer], least: float) -> None:
        count, scenes, share, low, high = share_by_scene(chosen)
        if not count:
            return
        lines.append(f"| {feature} | {level} | {count} | {scenes} | {share:.1%} | {low:.0%} to {high:.0%} |")
        # Few scenes may lie below by chance.
        if share < least and high < NOMINAL and scenes >= LEAST_SCENES:
            faults.append(f"red: coverage of {feature} {level}: {share:.1%}, {low:.0%} to {high:.0%}")

    add("all", "", matched, LEAST)
    for name in dict.fromkeys(each.estimator for each in matched):
        add("estimator", name, [each for each in matched if each.estimator == name], LOWEST)
    for feature, levels in FACTORS.items():
        for level in levels:
            add(feature, level, [e for e in matched if rows[e.scene[0]][feature] == level], LOWEST)
    lines += ["", "| wrong and sure | answers | wrong and sure | of highlights | of others |", "|---|---|---|---|---|"]
    for smooth, limit in ((True, WRONG_SMOOTH), (False, WRONG_TISSUE)):
        chosen = [e for e in answers if e.smooth == smooth and e.reported_deg is not None]
        wrong = [e for e in chosen if is_wrong_and_sure(e.error_deg, e.reported_deg or 0.0)]
        of_highlights = sum(e.matched for e in wrong)
        share = len(wrong) / max(len(chosen), 1)
        kind = "smooth" if smooth else "tissue"
        lines.append(
            f"| {kind} | {len(chosen)} | {len(wrong)} ({share:.1%}) | {of_highlights} | {len(wrong) - of_highlights} |"
        )
        if share > limit:
            faults.append(f"red: wrong and sure, {kind}: {share:.1%}, must be at most {limit:.0%}")
    return lines, faults
