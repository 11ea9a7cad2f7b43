"""Holm's correction with weights; ours, since scipy has no Holm correction and that of statsmodels has no weights."""

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array


def holm(p: npt.ArrayLike, weights: npt.ArrayLike | None = None) -> Array:
    """Correct p-values for the size of their family by Holm's step-down procedure [H79], section 2 and 4.

    Rejecting those of at most alpha keeps the chance of any false rejection at alpha, under arbitrary dependence.

    Parameters
    ----------
    p : array_like, shape (N,)
        p-values in [0, 1].
    weights : array_like, shape (N,), optional
        Share of alpha of each test, positive; only their ratios count. Default equal ones.

    Returns
    -------
    ndarray, shape (N,)
        Corrected p-values in [0, 1].
    """
    own = np.asarray(p, dtype=float)
    share = np.ones_like(own) if weights is None else np.asarray(weights, dtype=float)
    order = np.argsort(own / share, kind="stable")
    # Weight that is left at each step: the test's own and that of all less significant ones.
    left = np.cumsum(share[order][::-1])[::-1]
    stepped = np.maximum.accumulate(own[order] * left / share[order])
    corrected = np.empty_like(own)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected
