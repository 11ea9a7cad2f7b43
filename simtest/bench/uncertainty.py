"""Scores of a stated uncertainty: coverage with its interval, a test of it, sharpness, and the energy score."""

import math
from dataclasses import dataclass

import numpy as np
import polars as pl

from simtest.geometry import chi_squared
from simtest.geometry.vectors import tangent_coordinates
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject
from simtest.runtime.statistics import deviation_of_mean, share_interval, summed

LEVEL = 0.95
"""Of the regions whose coverage is tested."""

ALPHA = 0.01
"""Risk of each one-sided test that a right uncertainty is marked."""

LEAST_STATED = 50
"""With fewer uncertainties no verdict is given."""

DIRECTIONS = 64
"""Over which the energy score is averaged."""

_Z_TEST = 2.3263478740408408
"""Quantile of the normal distribution at 1 - ALPHA."""

SCALED, WELL, NARROW = "underconfident", "calibrated", "overconfident"
UNTESTED = "too few"


@dataclass(frozen=True)
class UncertaintyScore:
    """How good a stated uncertainty is.

    Parameters
    ----------
    n : int
        Answers that state an uncertainty, of highlights that are true ones.
    coverage : float or None
        Share of them whose 95 % region holds the true normal.
    interval : tuple of float or None
        95 % interval of the coverage, over scenes.
    verdict : str
        overconfident or underconfident where a test of the coverage says so, calibrated where not, else too few.
    inflation : float or None
        Factor on the covariances with which 95 % of the regions would hold the true normal; None where no factor
        would do, since too many covariances are singular.
    semi_axis_deg : float or None
        Sharpness: median of the regions' mean semi-axis (the square root of both semi-axes' product), deg.
    energy_deg : float or None
        Mean energy score, deg: a proper score; smaller is better, and only the right covariance has the smallest.
    """

    n: int
    coverage: float | None
    interval: tuple[float, float] | None
    verdict: str
    inflation: float | None
    semi_axis_deg: float | None
    energy_deg: float | None

    def to_json(self) -> JsonObject:
        """Return the score as a JSON object."""
        return {**vars(self), "interval": None if self.interval is None else list(self.interval)}


def score_uncertainty(answered: pl.DataFrame, scenes: IntArray, cases: IntArray | None = None) -> UncertaintyScore:
    """Score the uncertainties of answers.

    Parameters
    ----------
    answered : polars.DataFrame
        Rows of results with status "ok" and a true highlight. A stated covariance without a finite Mahalanobis
        distance is singular.
    scenes : ndarray of int, shape (N,)
        Which scene each row is of: rows of one scene are not independent.
    cases : ndarray of int, shape (N,), optional
        Which case each row is of: they are frozen, and not drawn.
    """
    distances = answered["mahalanobis2"].cast(pl.Float64).fill_null(float("nan")).to_numpy()
    covariances = answered.select("cov_11", "cov_12", "cov_22").cast(pl.Float64).to_numpy().astype(float)
    # A singular region holds no true normal: it is one that was stated and missed, not one that was left open.
    squared: Array = np.where(np.isnan(distances) & ~np.isnan(covariances).any(axis=1), np.inf, distances)
    stated = ~np.isnan(squared)
    n, limit = int(stated.sum()), chi_squared.quantile(LEVEL, 2)
    if n == 0:
        return UncertaintyScore(0, None, None, UNTESTED, None, None, None)
    inside = (squared[stated] <= limit).astype(float)
    share, groups = float(np.mean(inside)), (scenes[stated], None if cases is None else cases[stated])
    error, interval = coverage_error(inside, *groups), share_interval(inside, *groups)
    coordinates, covariances = _misses(answered)
    semi_axis = energy = None
    if len(covariances):
        with np.errstate(all="ignore"):
            areas = np.sqrt(np.maximum(np.linalg.det(covariances), 0.0))
            semi_axis = finite(np.degrees(np.median(np.sqrt(limit * areas))))
            energy = finite(np.degrees(np.mean(energy_scores(coordinates, covariances))))
    with np.errstate(invalid="ignore"):
        inflation = finite(np.quantile(squared[stated], LEVEL) / limit)
    return UncertaintyScore(n, share, interval, verdict_of(share, error, n), inflation, semi_axis, energy)


def finite(value: float | np.floating) -> float | None:
    """Return a figure as a certificate holds it; None in place of what is not finite."""
    return float(value) if np.isfinite(value) else None


def coverage_error(inside: Array, scenes: IntArray, cases: IntArray | None = None) -> float:
    """Return the standard error that a coverage of 95 % has with rows that are grouped in scenes.

    By how much the variance over the scenes of each case exceeds that of independent rows, at least 1, is the design
    effect; it enlarges the variance at 95 %. The variance at the observed share would be small where that happens to be
    large, and mark right uncertainties as underconfident.
    """
    n, share = len(inside), float(np.mean(inside))
    independent = math.sqrt(LEVEL * (1 - LEVEL) / n)
    totals, counts, kinds = summed(inside, scenes, cases, None)
    if len(counts) < 2 or share in (0.0, 1.0):
        return independent
    grouped = deviation_of_mean(totals, counts, kinds) ** 2
    return independent * math.sqrt(max(1.0, grouped / (share * (1 - share) / n)))


def verdict_of(share: float, error: float, n: int) -> str:
    """Return what two one-sided tests of the coverage against 95 %, each of risk `ALPHA`, say of `n` regions.

    Each asks two things: the normal test with the coverage's error, which scenes enlarge, and the exact binomial test.
    The normal test alone would mark up to 3 % of the right ones where there are few regions: shares near 1 are skew.
    """
    from scipy.special import bdtr, bdtrc

    if n < LEAST_STATED:
        return UNTESTED
    hits = round(share * n)
    if share < LEVEL - _Z_TEST * error and bdtr(hits, n, LEVEL) <= ALPHA:
        return NARROW
    return SCALED if share > LEVEL + _Z_TEST * error and bdtrc(hits - 1, n, LEVEL) <= ALPHA else WELL


def energy_scores(misses: Array, covariances: Array) -> Array:
    """Compute the energy score of normal distributions in the plane, E|X - y| - E|X - X'| / 2.

    The length of a vector is pi/2 times the mean of its parts along all directions, so the score is pi/2 times the
    mean over directions of the continuous ranked probability score of a normal distribution on a line, which has a
    closed form (Gneiting and Raftery 2007, J. Am. Stat. Assoc. 102, equation 21).

    Parameters
    ----------
    misses : ndarray, shape (N, 2)
        True values less the distributions' means.
    covariances : ndarray, shape (N, 2, 2)
        Of the distributions.

    Returns
    -------
    ndarray, shape (N,)
        Scores, in the unit of `misses`.
    """
    from scipy.special import ndtr

    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    value = misses @ along.T
    variance = np.einsum("kj,nji,ki->nk", along, covariances, along)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    z = value / sd
    density = np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)
    ranked = sd * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi))
    return np.asarray(np.pi / 2 * ranked.mean(axis=1))


def _misses(answered: pl.DataFrame) -> tuple[Array, Array]:
    """Return the true normals' coordinates about the proposed ones, rad, and the covariances, where one is stated."""
    columns = ["normal_x", "normal_y", "normal_z", "error_deg", "cov_11", "cov_12", "cov_22"]
    names = ["truth_x", "truth_y", "truth_z"]
    held = answered.select(columns + names).drop_nulls()
    values = held.select(columns).to_numpy().astype(float)
    truths = held.select(names).to_numpy().astype(float)
    misses, covariances = [], []
    for row, truth in zip(values, truths, strict=True):
        normal, (c11, c12, c22) = row[:3], row[4:7]
        across = tangent_coordinates(normal, truth)
        length = float(np.hypot(*across))
        # The length is the error that is scored: a base's normal may be the one that is stated.
        misses.append(across * (math.radians(row[3]) / length) if length > 0 else across)
        covariances.append([[c11, c12], [c12, c22]])
    return np.array(misses).reshape(-1, 2), np.array(covariances).reshape(-1, 2, 2)
