"""Negative log-likelihoods that networks are trained with, of rotations and of numbers with stated uncertainty."""

import torch
from torch import Tensor

from simtest.estimators.spot_inputs import LOG_RANGE


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
