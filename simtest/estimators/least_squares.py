"""Least-squares fit of a highlight's model to its pixels, with analytic derivatives and clipped pixels censored."""

from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar

import numpy as np

from simtest.geometry import Array, Mask

MAX_STEPS = 30
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-7, 1e6
CONVERGED = 1e-8
"""A fit has converged when the sum of squares falls by less than this share."""

EXACT = 1e-24
"""Share of the observed power that rounding alone leaves as residual."""


class LobeModel(Protocol):
    """A highlight's model at some values of its parameters."""

    def evaluate(self) -> tuple[Array, Array]:
        """Return the pixels' intensities, shape (m,), and their derivatives, shape (m, p)."""

    def moved(self, step: Array) -> Self:
        """Return the model at parameters that differ by a step, shape (p,)."""


Model = TypeVar("Model", bound=LobeModel)


@dataclass(frozen=True)
class LobeFit(Generic[Model]):
    """A fitted model.

    Parameters
    ----------
    model : LobeModel
        At the minimum.
    covariance : ndarray, shape (p, p)
        Of its parameters, from the residual's variance.
    sigma : float
        Standard deviation of the residual.
    chi2 : float
        Sum of squared residuals.
    """

    model: Model
    covariance: Array
    sigma: float
    chi2: float


def fit_lobe(
    start: Model, observed: Array, clipped: Mask | None = None, rounding: float = 0.0
) -> LobeFit[Model] | None:
    """Fit a model by Levenberg and Marquardt's method: maximum likelihood under white noise.

    The start must be near the minimum. None where the fit does not converge, or the pixels do not determine a
    parameter.

    Parameters
    ----------
    observed : ndarray, shape (m,)
        Intensities of the model's pixels.
    clipped : ndarray of bool, shape (m,), optional
        Censored pixels: the intensity is at least what was observed, so a model above it leaves no residual.
    rounding : float
        Relative error of the sum of squares by the model's rounding: a change by no more than that ends the fit.
    """
    # A step too far overflows, and is then not taken.
    with np.errstate(all="ignore"):
        return _descend(start, observed, clipped, rounding)


def _descend(start: Model, observed: Array, clipped: Mask | None, rounding: float) -> LobeFit[Model] | None:
    """Run the damped Gauss-Newton steps."""
    model, damping, power = start, FIRST_DAMPING, float(observed @ observed)
    residual, J = _residual(model, observed, clipped)
    chi2 = float(residual @ residual)
    if not np.isfinite(chi2):
        return None
    for _ in range(MAX_STEPS):
        # trial step
        normal, gradient = J.T @ J, J.T @ residual
        try:
            damped = normal + damping * np.diag(np.diag(normal))
            step = np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        trial = model.moved(step)
        next_residual, next_J = _residual(trial, observed, clipped)
        next_chi2 = float(next_residual @ next_residual)
        if abs(next_chi2 - chi2) < rounding * chi2:
            break
        # reject: more damping
        if not (next_chi2 < chi2 and np.isfinite(next_J).all()):
            if damping > MOST_DAMPING:
                # No downhill step is left: the minimum, to rounding.
                break
            damping *= 10
            continue
        # accept: less damping
        fall = (chi2 - next_chi2) / chi2
        model, residual, J, chi2 = trial, next_residual, next_J, next_chi2
        damping = max(damping / 10, LEAST_DAMPING)
        if fall < CONVERGED or chi2 < EXACT * power:
            break
    else:
        return None
    return _with_covariance(model, J, chi2)


def _residual(model: LobeModel, observed: Array, clipped: Mask | None) -> tuple[Array, Array]:
    """Return the residual and the model's derivatives, both 0 at censored pixels that the model exceeds."""
    intensity, J = model.evaluate()
    residual = observed - intensity
    if clipped is not None:
        silent = clipped & (residual < 0)
        residual[silent] = 0.0
        J[silent] = 0.0
    return residual, J


def _with_covariance(model: Model, J: Array, chi2: float) -> LobeFit[Model] | None:
    """Add the Gauss-Newton covariance; None where a parameter is not determined."""
    count, parameters = J.shape
    if count <= parameters:
        return None
    variance = chi2 / (count - parameters)
    # scaled to a diagonal of 1, so that the condition does not depend on units
    scale = np.sqrt(np.sum(J * J, axis=0))
    if not (scale > 0).all():
        return None
    information = (J / scale).T @ (J / scale)
    if np.linalg.cond(information) > 1e14:
        return None
    covariance = variance * np.linalg.inv(information) / np.outer(scale, scale)
    return LobeFit(model, covariance, float(np.sqrt(variance)), chi2)
