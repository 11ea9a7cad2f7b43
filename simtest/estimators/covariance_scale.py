"""Factor by which a learned core multiplies the covariances that its network states."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from simtest.estimators.training_range import rounded
from simtest.geometry import Array
from simtest.runtime.files import JsonObject


@dataclass(frozen=True)
class CovarianceScale:
    """Factor of a covariance, as it hangs on how sure the network states to be.

    Parameters
    ----------
    log_deviation : tuple of float
        Mean logarithm of the two stated deviations, ascending; constant beyond the ends.
    factor : tuple of float
        Factor of the covariance there; its logarithm is interpolated.
    """

    log_deviation: tuple[float, ...]
    factor: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.log_deviation) == len(self.factor) >= 1:
            raise ValueError("scales need as many factors as deviations, 1 or more")
        if not np.isfinite(self.log_deviation).all() or (np.diff(self.log_deviation) <= 0).any():
            raise ValueError("deviations of scales must ascend")
        if not np.isfinite(self.factor).all() or min(self.factor) <= 0:
            raise ValueError("scales must be above 0")

    @staticmethod
    def read(content: Mapping[str, Sequence[float]]) -> "CovarianceScale":
        """Return the scale in a network's metadata; raise KeyError, TypeError or ValueError if it is malformed."""
        return CovarianceScale(*(tuple(float(v) for v in content[key]) for key in ("log_deviation", "factor")))

    def written(self) -> JsonObject:
        """Return the scale as it stands in the metadata."""
        return {key: rounded(values) for key, values in asdict(self).items()}

    def at(self, log_deviation: Array | float) -> Array:
        """Return the factors at stated deviations."""
        return np.asarray(np.exp(np.interp(log_deviation, self.log_deviation, np.log(self.factor))))
