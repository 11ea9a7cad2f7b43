"""`curved`: the isophotes' centre carries the normal, their shape the curvature (theory.md section 3)."""

import itertools
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from simtest.calibration import Priors
from simtest.errors import Failure, Reason
from simtest.estimators.family import STREAK_RATIO, IsophoteFamily
from simtest.estimators.highlight import OfHighlight, along, of_spot
from simtest.estimators.protocol import Estimate, EstimatedCurvature, Law
from simtest.estimators.small_spots import HighlightAxis, SmallSpot
from simtest.geometry import Array

STREAK_GAIN = 0.1
"""A highlight with an abs(1 + d k) below this is a streak; where the lobe is not known `STREAK_RATIO` decides."""

ROUND_SHARE = 3.0  # squared difference of the moments over its noise: -ln 0.05, which 5 % of round highlights exceed


@dataclass(frozen=True)
class Curved(OfHighlight):
    """Normal and curvature of a surface lit from the camera's position (see `OfHighlight`).

    The normal is the cones' mean axis as in `cone_axis`, followed to t -> 1 where the axis drifts by more than the
    noise explains. The lobe's second moments at the peak, 1/H, give the rest: with m = 1 + d k and c the curvature of
    the lobe, H = c m^2 + 2 m along each principal direction. The directions are those of the isophotes' mean moments,
    which have a quarter of the noise. Where c is not known, m is known up to scale and the 2 m of the falloff is
    neglected: the axis ratio is then too large, by 1 % at 1 + d k = 1/3 for n = 50.

    The estimate has one candidate, and the flag ``round`` where noise hides the principal directions. Fails with
    ``degenerate_conic`` where the moments at the peak are not those of a lobe, and with ``streak`` where 1 + d k is
    near 0.
    """

    laws: ClassVar[tuple[Law, ...]] = ("sightline",)

    def of(self, highlight: HighlightAxis, priors: Priors) -> Estimate | Failure:
        """Estimate normal and curvature at a fitted highlight."""
        if isinstance(highlight, SmallSpot):
            return of_spot(highlight, priors)
        found = _curvature(highlight, None if priors.lobe_curvature is None else priors.lobe_curvature.mean)
        if isinstance(found, Failure):
            return found
        curvature, is_round = found
        axis, budget = highlight.axis, highlight.axis_budget
        if highlight.drift_is_real:
            axis, budget = highlight.peak_axis, highlight.peak_budget
        flags = (*highlight.flags, "round") if is_round else highlight.flags
        return along(highlight, axis, budget, priors, axis_ratio=curvature.axis_ratio, flags=flags, curvature=curvature)


curved = Curved()


def gain_of_stiffness(stiffness: Array, lobe_curvature: float) -> Array:
    """Solve H = c m^2 + 2 m for the positive m = 1 + d k; the negative solution is -2/c less it."""
    c = lobe_curvature
    return np.asarray(stiffness / (1 + np.sqrt(1 + c * stiffness)))


def _curvature(family: IsophoteFamily, lobe: float | None) -> tuple[EstimatedCurvature, bool] | Failure:
    """Return the curvature, and whether the highlight is round within the noise."""
    values = np.asarray(np.linalg.eigvalsh(family.moments), dtype=np.float64)
    if values[0] <= 0:
        return Failure(Reason.DEGENERATE_CONIC, f"moments at the peak {values[0]:.3g}, {values[1]:.3g} rad^2")
    shrunk, is_round = _without_noise(values, family.moments_covariance)
    # The longer axis lies along the smaller gain. Following the moments to t -> 1 would turn it by noise alone.
    stiffness = 1 / shrunk[::-1]
    vectors = np.linalg.eigh(family.mean_moments)[1]
    directions = vectors.T[::-1] @ family.basis
    if lobe is None:
        ratio = float(np.sqrt(stiffness[0] / stiffness[1]))
        hypotheses, smallest, least = None, ratio, STREAK_RATIO
    else:
        hypotheses = sign_hypotheses(stiffness, lobe)
        smallest, larger = np.sort(np.abs(hypotheses[0]))
        ratio, least = float(smallest / larger), STREAK_GAIN
    if smallest < least:
        of = "axis ratio" if lobe is None else "abs(1 + d k)"
        return Failure(Reason.STREAK, f"{of} {smallest:.3g}, below {least:g}")
    return EstimatedCurvature(directions, ratio, hypotheses), is_round


def _without_noise(values: Array, covariance: Array | None) -> tuple[Array, bool]:
    """Shrink the difference of two second moments by its noise; return both, rising, and whether they are equal.

    Noise splits equal eigenvalues: for a round highlight the squared difference has the mean of its variance, v. The
    difference D becomes D - v / D, or 0 where it is below its noise, so that round highlights stay round. Far above its
    noise this subtracts v / D where noise has added v / (4 D) on average: 3 % too much at D = 5 sqrt(v).
    """
    if covariance is None:
        return values, False
    (aa, _, ac), (_, bb, _), (_, _, cc) = covariance
    noise = float(aa + cc - 2 * ac + 4 * bb)
    mean, difference = float(values.mean()), float(values[1] - values[0])
    kept = max(difference - noise / difference, 0.0) if difference > 0 else 0.0
    return np.array([mean - kept / 2, mean + kept / 2]), difference**2 < ROUND_SHARE * noise


def sign_hypotheses(stiffness: Array, lobe: float) -> Array:
    """List (1 + d k) along both directions for all signs, the least curved surface first, shape (4, 2)."""
    positive = gain_of_stiffness(stiffness, lobe)
    pairs = [(m, -2 / lobe - m) for m in positive]  # both roots of H = c m^2 + 2 m
    listed = np.array(list(itertools.product(*pairs)))
    return listed[np.argsort(np.sum((listed - 1) ** 2, axis=1), kind="stable")]
