"""Weighs the highlights of a bank by their likeness to a real one, and measures error and coverage of those alike.

A real highlight's twins are the bank's highlights weighted by a Gaussian kernel over their features (`FEATURES`), over
the number of highlights in their frame: a frame is one draw of distance, lights and relief, and what its number of
highlights tells is among the features. The kernel is as narrow as leaves `TWINS` effective ones: the weights' squared
sum over the sum of their squares.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from simtest.advice.twin.scoring import FEATURES, ScoredSpot, Spot
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.statistics import mean_interval, weighted_quantile

TWINS = 40.0
"""Effective number of twins of a highlight."""

SCALES = dict(zip(FEATURES, (0.15, 0.15, 0.4, 0.3, 0.3, 0.4, 0.03, 0.3, 0.15, 0.25), strict=True))
"""How much of each feature is one unit of unlikeness."""

OTHER_ESTIMATOR = 4.0
"""Squared unlikeness of a spot whose best estimate is another estimator's."""

UNKNOWN = 1.0
"""Squared unlikeness by a feature that only one of two spots shows."""

WIDEST = 64.0
"""The kernel's width ends here; beyond it nothing in the bank is like the spot."""

UNLIKE = 2.0
"""Unlikeness of twins above which they are called so: outside of what the bank covers."""


@dataclass(frozen=True)
class Twins:
    """What the twins of one highlight measure.

    Parameters
    ----------
    rms_deg, interval_deg : float, tuple of float
        Root mean square error against the fine normal, with its 95 % interval over the bank's frames.
    base_rms_deg, base_interval_deg : float, tuple of float
        The same against the base's normal.
    coverage : float or None
        Share of the twins whose stated 95 % region holds the truth; None where none states one.
    near_misses, false : float
        Share of near misses among the twins that are highlights, and of false detections among all (`ScoredSpot`). All
        other figures are of the twins that are highlights.
    glint_rms_deg, near_rms_deg : float
        RMS error of the twins that are glints, and of near misses; NaN where there are none.
    p95_deg : float
        95 % of the twins' errors against the fine normal lie below.
    distance_mm : tuple of float
        Distances below which 10, 50 and 90 % of the twins stand, mm: what the picture's look says of it, and what was
        told. The error from a light beside the lens goes with its inverse.
    effective : float
        Effective number of twins.
    unlikeness : float
        Root mean square over twins and features of how far they are from the highlight, in units of `SCALES`.
    best : ndarray of int
        The likest in the bank, the first first.
    """

    rms_deg: float
    interval_deg: tuple[float, float]
    base_rms_deg: float
    base_interval_deg: tuple[float, float]
    coverage: float | None
    near_misses: float
    false: float
    glint_rms_deg: float
    near_rms_deg: float
    p95_deg: float
    distance_mm: tuple[float, float, float]
    effective: float
    unlikeness: float
    best: IntArray

    @property
    def is_covered(self) -> bool:
        """Whether the bank holds highlights like this one."""
        return self.unlikeness <= UNLIKE


class Matcher:
    """Finds twins in a bank.

    Parameters
    ----------
    spots : sequence of (int, ScoredSpot)
        The bank's highlights, with the number of the frame that each is in; at least one.
    """

    def __init__(self, spots: Sequence[tuple[int, ScoredSpot]]) -> None:
        self._frames = np.array([frame for frame, _ in spots])
        # Each frame is one draw of what was not told, however many highlights it shows.
        self._shares = 1 / np.bincount(self._frames)[self._frames]
        held = [spot.held for _, spot in spots]
        self._features = np.array([spot.spot.features for _, spot in spots])
        self._estimators = np.array([spot.spot.estimator for _, spot in spots])
        self._errors = np.array([spot.error_deg for _, spot in spots])
        self._base_errors = np.array([spot.base_error_deg for _, spot in spots])
        self._distances = np.array([spot.distance_mm for _, spot in spots])
        self._near = np.array([spot.kind == "near_miss" for _, spot in spots])
        self._real = np.array([spot.kind != "false" for _, spot in spots])
        self._stated = np.array([each is not None for each in held])
        self._held = np.array([bool(each) for each in held])

    def find(self, spot: Spot) -> Twins:
        """Measure the twins of a highlight."""
        squared = self._unlikeness(spot)
        whole = _weights(squared, self._shares, TWINS)
        # A false detection has no normal that is its own.
        weights = _weights(np.where(self._real, squared, np.inf), self._shares, TWINS)
        near, glint = weights * self._near, weights * ~self._near
        nearest, middle, farthest = (weighted_quantile(self._distances, weights, share) for share in (0.1, 0.5, 0.9))
        stated = weights * self._stated
        return Twins(
            rms_deg=_rms(weights, self._errors),
            interval_deg=self._interval(weights, self._errors),
            base_rms_deg=_rms(weights, self._base_errors),
            base_interval_deg=self._interval(weights, self._base_errors),
            coverage=float(stated @ self._held / stated.sum()) if stated.sum() > 0 else None,
            near_misses=float(near.sum() / weights.sum()),
            false=float(whole @ ~self._real / whole.sum()),
            glint_rms_deg=_rms(glint, self._errors),
            near_rms_deg=_rms(near, self._errors),
            p95_deg=weighted_quantile(self._errors, weights, 0.95),
            distance_mm=(nearest, middle, farthest),
            effective=float(weights.sum() ** 2 / np.square(weights).sum()),
            unlikeness=float(np.sqrt(weights @ np.where(self._real, squared, 0.0) / weights.sum() / len(FEATURES))),
            best=np.argsort(np.where(self._real, squared, np.inf), kind="stable")[:12],
        )

    def _unlikeness(self, spot: Spot) -> Array:
        """Return the squared unlikeness of the bank's highlights, shape (N,)."""
        apart = (self._features - spot.features) / np.array([SCALES[name] for name in FEATURES])
        squares = np.square(apart)
        # Neither shows it: no difference.
        one_sided = np.isnan(self._features) ^ np.isnan(spot.features)
        squares = np.where(one_sided, UNKNOWN, np.nan_to_num(squares))
        return np.asarray(squares.sum(axis=1) + OTHER_ESTIMATOR * (self._estimators != spot.estimator))

    def _interval(self, weights: Array, errors: Array) -> tuple[float, float]:
        """Return the 95 % interval of an RMS error over the frames: their highlights share a light."""
        low, high = mean_interval(weights * np.square(errors), self._frames, counts=weights)
        return (
            (np.nan, np.nan) if low is None or high is None else (float(np.sqrt(max(low, 0.0))), float(np.sqrt(high)))
        )


def _weights(squared: Array, shares: Array, wanted: float) -> Array:
    """Return shares times Gaussian weights of squared distances, shape (N,), as narrow as leave an effective number."""
    low, high = 1e-3, WIDEST
    shifted = squared - squared.min()
    # Bisection in the logarithm of the width: a wider kernel holds more.
    for _ in range(50):
        width = float(np.sqrt(low * high))
        weights = shares * np.exp(-shifted / (2 * width**2))
        if weights.sum() ** 2 / np.square(weights).sum() < wanted:
            low = width
        else:
            high = width
    return np.asarray(shares * np.exp(-shifted / (2 * high**2)))


def _rms(weights: Array, errors: Array) -> float:
    """Return a weighted root mean square; NaN without weight."""
    total = float(weights.sum())
    return float(np.sqrt(weights @ np.square(errors) / total)) if total > 0 else float("nan")
