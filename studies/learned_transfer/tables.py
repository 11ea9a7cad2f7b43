"""The study's figures: what is answered, how far off, and the paired difference of tissue from smooth, over scenes."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from studies.learned_transfer.answers import OK, Answer
from studies.learned_transfer.real import Agreement
from studies.resampling import interval_of_mean

NONE, ALL = "none", "all"


@dataclass(frozen=True)
class Paired:
    """Mean difference of two estimators over the detections that both answer.

    Parameters
    ----------
    pairs, scenes : int
        How many there are.
    difference : float
        First minus second, deg; NaN without a pair.
    interval : tuple of float, optional
        Its 95 % interval by bootstrap over scenes; None with fewer than two of them.
    medians : tuple of float
        Of each, deg.
    """

    pairs: int
    scenes: int
    difference: float
    interval: tuple[float, float] | None
    medians: tuple[float, float]


def paired(answers: Sequence[Answer], first: str, second: str) -> Paired:
    """Compare the errors against the base of two estimators where both answer the same detection."""
    of: dict[str, dict[tuple[str, int, int], float]] = {first: {}, second: {}}
    for each in answers:
        if each.estimator in of and each.status == OK and np.isfinite(each.base_deg):
            of[each.estimator][each.row, each.scene, each.spot] = each.base_deg
    both = [key for key in of[first] if key in of[second]]
    if not both:
        return Paired(0, 0, float("nan"), None, (float("nan"), float("nan")))
    errors = np.array([[of[name][key] for name in (first, second)] for key in both])
    scenes, off = np.array([key[1] for key in both]), errors[:, 0] - errors[:, 1]
    medians = np.median(errors, axis=0)
    several = len(set(scenes.tolist())) > 1
    interval = interval_of_mean(off, scenes, 1000, from_integer(1)) if several else None
    return Paired(
        len(both), len(set(scenes.tolist())), float(off.mean()), interval,
        (float(medians[0]), float(medians[1])),
    )  # fmt: skip


def summary(answers: Sequence[Answer], rows: Mapping[str, Sequence[str]], names: Sequence[str]) -> Iterator[str]:
    """Yield the table of each group of rows and estimator."""
    heads = ("rows", "estimator", "detections", "answered", "refused", "base: median, deg", "95 % below",
             "reported deviation, median", "inside 95 % (n)")  # fmt: skip
    yield from head(heads)
    for group, members in rows.items():
        for name in names:
            own = [each for each in answers if each.estimator == name and each.row in members]
            ok = [each for each in own if each.status == OK]
            if not own:
                continue
            base, stated, inside = (
                _known(ok, lambda each, key=key: getattr(each, key)) for key in ("base_deg", "stated_deg", "inside")
            )
            held = f"{100 * inside.mean():.1f} ({len(inside)})" if len(inside) else NONE
            yield _line(
                group, name, len(own), len(ok), _reasons(own), _figure(base, np.median),
                _figure(base, lambda v: np.percentile(v, 95)), _figure(stated, np.median), held,
            )  # fmt: skip


def pairs(
    answers: Sequence[Answer], rows: Mapping[str, Sequence[str]], compared: Sequence[tuple[str, str]]
) -> Iterator[str]:
    """Yield the table of paired differences for each group of rows."""
    yield from head(("rows", "pair", "n", "scenes", "mean difference, deg", "95 % interval", "medians of both"))
    for group, members in rows.items():
        own = [each for each in answers if each.row in members]
        for first, second in compared:
            made = paired(own, first, second)
            if not made.pairs:
                yield _line(group, f"{first} - {second}", 0, 0, NONE, NONE, NONE)
                continue
            interval = NONE if made.interval is None else f"{made.interval[0]:+.2f} to {made.interval[1]:+.2f}"
            medians = " and ".join(f"{value:.2f}" for value in made.medians)
            yield _line(
                group, f"{first} - {second}", made.pairs, made.scenes, f"{made.difference:+.2f}", interval, medians
            )


def agreement(agreed: Sequence[Agreement], frames: Sequence[str]) -> Iterator[str]:
    """Yield the table of agreement on each real frame, and on all."""
    yield from head(("frame", "pair", "n", "angle: median, deg", "95 % below", "regions overlap"))
    for frame in (*frames, ALL):
        for pair in dict.fromkeys((each.estimator, each.other) for each in agreed):
            own = [
                each for each in agreed if frame in (ALL, each.frame) and (each.estimator, each.other) == pair
            ]  # fmt: skip
            if not own:
                continue
            off, stated = np.array([each.off_deg for each in own]), [e.overlaps for e in own if e.overlaps is not None]
            share = f"{sum(stated)} of {len(stated)}" if stated else NONE
            cells = (len(own), _figure(off, np.median), _figure(off, lambda v: np.percentile(v, 95)), share)
            yield _line(frame, " - ".join(pair), *cells)


def head(heads: Sequence[str]) -> Iterator[str]:
    """Yield the two lines that begin a table."""
    yield _line(*heads)
    yield "|" + "---|" * len(heads)


def _line(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _reasons(own: Sequence[Answer]) -> str:
    """Return how many detections were refused, and for which reasons."""
    count = Counter(each.status for each in own if each.status != OK)
    return "; ".join(f"{number} {reason}" for reason, number in count.most_common()) or "0"


def _known(answers: Sequence[Answer], value: Callable[[Answer], float]) -> Array:
    values = np.array([value(each) for each in answers], dtype=float)
    return values[np.isfinite(values)]


def _figure(values: Array, of: Callable[[Array], object]) -> str:
    return f"{of(values):.2f}" if len(values) else NONE
