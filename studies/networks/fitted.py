"""Losses of both networks, and what is fitted beside the weights: scales of covariances, and the range taught."""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.special import chdtri
from torch import Tensor

from simtest.estimators.learned import LOG_RANGE, CovarianceScale, TrainingRange
from simtest.runtime.arrays import AnyArray, Array

COVERAGE = 0.95
"""Share of the truths that a stated region holds."""

REFUSED = 0.005
"""Share of the validation split's examples whose features the network would refuse."""

USUAL = 0.5
"""Share of the validation split's examples whose features lie within the usual distance (`inflation`)."""

SHRUNK = 0.1
"""Weight of the mean variance in the features' covariance, which has more dimensions than the examples fill."""

LEAST_FOR_SCALE = 60
"""Examples from which one factor of the covariances is fitted; with fewer in all they stay as they are."""

MOST_FACTORS = 5


def fitted_range(names: Sequence[str], inputs: AnyArray, taught: AnyArray, judged: AnyArray) -> TrainingRange:
    """Return the range that a network was taught.

    `names`: names of the inputs that have a range; `inputs` (shape (N, M)): their values on the train split;
    `taught`, `judged`: features of the network on the train split, which give mean and covariance, and on the
    validation split, which gives the limit: a share `REFUSED` of its rows lies beyond.
    """
    taught = np.asarray(taught, dtype=float)
    mean, covariance = taught.mean(axis=0), np.atleast_2d(np.cov(taught.T))
    average = np.trace(covariance) / len(covariance)
    precision = np.linalg.inv((1 - SHRUNK) * covariance + SHRUNK * average * np.eye(len(covariance)))
    low, high = (
        dict(zip(names, each.tolist(), strict=True)) for each in (inputs.min(axis=0), inputs.max(axis=0))
    )  # fmt: skip
    unlimited = TrainingRange(low, high, mean, precision, np.inf)
    return TrainingRange(low, high, mean, precision, float(np.quantile(unlimited.distances(judged), 1 - REFUSED)))


def fitted_scale(
    distances: Array, deviations: Array, coverage: float = COVERAGE, dimensions: int = 2
) -> CovarianceScale:
    """Return the covariances' factors that put a share of the examples inside their regions of 95 %.

    The examples are sorted by the deviation that the network states and divided into groups, each with a factor of its
    own: a network may be too sure where it states to be sure, and right elsewhere. No group's factor is below that of
    all examples together, so that no group gains at another's cost.

    `distances` (shape (N,)): squared Mahalanobis distances of the truths; `deviations` (shape (N,)): mean
    logarithms of the stated deviations; `coverage`: the share; `dimensions`: of what is stated: 2 for a normal, 1
    for a distance.
    """
    limit = float(chdtri(dimensions, 1 - COVERAGE))
    groups = min(len(distances) // LEAST_FOR_SCALE, MOST_FACTORS)
    if groups == 0:
        return CovarianceScale((0.0,), (1.0,))
    parts = np.array_split(np.argsort(deviations, kind="stable"), groups)
    centres = [float(np.median(deviations[part])) for part in parts]
    least = _factor(distances, coverage, limit)
    if (np.diff(centres) <= 0).any():
        return CovarianceScale((centres[0],), (least,))
    factors = tuple(max(_factor(distances[part], coverage, limit), least) for part in parts)
    return CovarianceScale(tuple(centres), factors)


def _factor(distances: Array, coverage: float, limit: float) -> float:
    """Return the factor for N examples: the ceil((N + 1) coverage)-th smallest distance, which covers one more."""
    rank = min(int(np.ceil((len(distances) + 1) * coverage)), len(distances))
    return float(np.sort(distances)[rank - 1] / limit)


def squared_distance(made: Tensor, wanted: Tensor) -> Tensor:
    """Return the squared Mahalanobis distance of wanted pairs, shape (N, 2), from outputs, shape (N, 5 or more).

    The outputs are the pair, log L11, L21 and log L22, with L the Cholesky factor of its covariance.
    """
    off = wanted - made[:, :2]
    log_first, log_second = _logarithms(made)
    u = off[:, 0] * torch.exp(-log_first)
    v = (off[:, 1] - made[:, 3] * u) * torch.exp(-log_second)
    return u * u + v * v


def pair_loss(made: Tensor, wanted: Tensor) -> Tensor:
    """Return the negative log-likelihood of pairs under a normal distribution but for a constant, shape (N,)."""
    log_first, log_second = _logarithms(made)
    return 0.5 * squared_distance(made, wanted) + log_first + log_second


def number_loss(made: Tensor, log_deviation: Tensor, wanted: Tensor) -> Tensor:
    """Return the negative log-likelihood of numbers but for a constant, shape (N,); 0 where none is known."""
    log_deviation = log_deviation.clamp(*LOG_RANGE)
    off = torch.nan_to_num(wanted - made, nan=0.0) * torch.exp(-log_deviation)
    return torch.where(torch.isfinite(wanted), 0.5 * off * off + log_deviation, torch.zeros_like(off))


def _logarithms(made: Tensor) -> tuple[Tensor, Tensor]:
    return made[:, 2].clamp(*LOG_RANGE), made[:, 4].clamp(*LOG_RANGE)
