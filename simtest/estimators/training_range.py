"""The range that a network was taught, from its metadata: a learned core refuses what lies outside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.errors import Failure, Reason
from simtest.runtime.arrays import AnyArray, Array
from simtest.runtime.files import JsonObject

MARGIN = 0.05
"""Share of a range, and absolute part, by which an input may leave it."""


@dataclass(frozen=True)
class TrainingRange:
    """Ranges of named inputs on the train split, and the distribution of the network's inner features there.

    Parameters
    ----------
    low, high : dict of str to float
        Smallest and largest value of each input.
    mean : ndarray, shape (F,)
        Mean of the features.
    precision : ndarray, shape (F, F)
        Inverse of their covariance.
    limit : float
        Squared Mahalanobis distance of features beyond which the network refuses.
    """

    low: dict[str, float]
    high: dict[str, float]
    mean: Array
    precision: Array
    limit: float

    @staticmethod
    def read(content: JsonObject, names: Sequence[str]) -> "TrainingRange":
        """Return the range in a network's metadata (`written`).

        Raises
        ------
        KeyError, TypeError, ValueError
            If it is malformed, or a name is missing.
        """
        low, high = ({name: float(content[key][name]) for name in names} for key in ("low", "high"))
        mean = np.array(content["feature_mean"], dtype=float)
        precision = _symmetric(np.array(content["feature_precision"], dtype=float), len(mean))
        limit = float(content["feature_limit"])
        if not np.isfinite([*low.values(), *high.values(), *mean, *precision.ravel(), limit]).all():
            raise ValueError("its range holds values that are not finite")
        return TrainingRange(low, high, mean, precision, limit)

    def written(self) -> JsonObject:
        """Return the range as it stands in the metadata, features with `DIGITS` digits."""
        upper = self.precision[np.triu_indices(len(self.precision))]
        return {
            "low": self.low, "high": self.high, "feature_mean": rounded(self.mean),
            "feature_precision": rounded(upper), "feature_limit": float(self.limit),
        }  # fmt: skip

    def refusal(self, values: Mapping[str, float]) -> Failure | None:
        """Return why inputs are refused, or None: the first that leaves its range by more than `MARGIN` of it."""
        for name, value in values.items():
            low, high = self.low[name], self.high[name]
            margin = MARGIN * (1 + high - low)
            if not low - margin <= value <= high + margin:
                told = f"outside the network's training: {name} is {value:.3g}, was {low:.3g} to {high:.3g}"
                return Failure(Reason.NO_ESTIMATE, told)
        return None

    def distances(self, features: AnyArray) -> Array:
        """Return the squared Mahalanobis distances of features, shape (N, F), from those of the train split."""
        off = np.asarray(features, dtype=float) - self.mean
        return np.asarray(np.einsum("ni,ij,nj->n", off, self.precision, off))

    def refusals(self, features: AnyArray) -> list[Failure | None]:
        """Return for each row of features why it is refused, or None."""
        return [self._refusal(distance) for distance in self.distances(features)]

    def _refusal(self, distance: float) -> Failure | None:
        if distance <= self.limit:
            return None
        told = f"unlike the network's training: features at {distance:.3g}, limit {self.limit:.3g}"
        return Failure(Reason.NO_ESTIMATE, told)


def read_usual(content: JsonObject) -> float:
    """Return the usual squared distance of a network's metadata (`inflation`).

    Raises
    ------
    KeyError, TypeError, ValueError
        If it is missing or not a number above 0.
    """
    usual = float(content["feature_usual"])
    if not 0 < usual < np.inf:
        raise ValueError(f"feature_usual = {usual}: must be above 0")
    return usual


def inflation(distances: Array, usual: float) -> Array:
    """Return factors of covariances for features at squared distances from those of the train split.

    They are 1 up to the usual distance and proportional to the squared distance beyond: where the features say that a
    highlight or frame differs from those taught, the network is less sure than it states.
    """
    return np.maximum(1.0, distances / usual)


DIGITS = 7
"""Of the numbers of the metadata: those of the weights have no more."""


def rounded(values: AnyArray | Sequence[float]) -> list[float]:
    """Return values with `DIGITS` digits."""
    return [float(f"{value:.{DIGITS}g}") for value in values]


def _symmetric(upper: Array, size: int) -> Array:
    """Return a symmetric matrix from its upper triangle, row by row; raise `ValueError` for another length."""
    if upper.shape != (size * (size + 1) // 2,):
        raise ValueError("feature_precision does not fit feature_mean")
    whole = np.zeros((size, size))
    rows, columns = np.triu_indices(size)
    whole[rows, columns] = whole[columns, rows] = upper
    return whole
