"""Tests of many hypotheses at once, for renderers and samplers."""

import numpy as np
from scipy import stats

ALPHA = 0.01

LEAST_EXPECTED = 10
"""Bins that are expected less often are pooled: the chi-square law needs so many."""


def chi_square(observed, expected):
    """Return the p-value; the rarest bins are pooled until each pool is expected often enough."""
    order = np.argsort(expected)
    observed, expected = observed[order], expected[order]
    few = np.searchsorted(np.cumsum(expected), LEAST_EXPECTED) + 1
    observed = np.append(observed[few:], observed[:few].sum())
    expected = np.append(expected[few:], expected[:few].sum())
    while len(expected) > 1 and (rare := expected < LEAST_EXPECTED).any():
        first = int(np.flatnonzero(rare)[0])
        other = first - 1 if first else 1
        observed[other] += observed[first]
        expected[other] += expected[first]
        observed, expected = np.delete(observed, first), np.delete(expected, first)
    statistic = float(((observed - expected) ** 2 / expected).sum())
    return float(stats.chi2.sf(statistic, len(expected) - 1))


def rejected(p_values, alpha=ALPHA):
    """Return which hypotheses Holm's procedure rejects."""
    p = np.asarray(p_values)
    order = np.argsort(p)
    passes = np.logical_and.accumulate(p[order] <= alpha / np.arange(len(p), 0, -1))
    out = np.zeros(len(p), dtype=bool)
    out[order[passes]] = True
    return out
