"""Least squares by Levenberg and Marquardt's method: many fits at once, or one model of a highlight's pixels."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from simtest.geometry import Array, Index, Mask
from simtest.runtime.arrays import AnyArray


class Descent(NamedTuple):
    """How a minimum is sought: the damping and its bounds, the most steps, and the fall of the sum that ends it."""

    first: float
    least: float
    most: float
    steps: int
    converged: float  # a fit has converged when its sum of squares falls by less than this share
    ridge: tuple[float, float] = (0.0, 0.0)  # added to the equations' diagonal: a share of it, and a constant


OF_LOBES = Descent(1e-3, 1e-7, 5e7, 30, 1e-8)

EXACT = 1e-24  # share of the observed power that rounding alone leaves as residual

Equations = tuple[Array, Array, Array, Mask]
"""Of n fits: sums of squares, (n,), normal equations, (n, p, p) and (n, p), and whether the states may be taken."""


def minimise(
    states: AnyArray,
    equations: Callable[[AnyArray, Index], Equations],
    move: Callable[[AnyArray, Array], AnyArray],
    descent: Descent,
    exact: float,
    rounding: float = 0.0,
) -> tuple[AnyArray, Array, Array, Mask]:
    """Minimise N sums of squares at once, by Levenberg and Marquardt's method.

    Returns the states, sums of squares and normal matrices, and which fits have ended. A sum below `exact` is 0; one
    that changes by no more than the share `rounding` ends its fit. `equations` are asked for some of the fits by index.
    """
    squares, normal, gradient, _ = equations(states, np.arange(len(states)))
    damping, active = np.full(len(states), descent.first), np.ones(len(states), dtype=bool)
    share, constant = descent.ridge
    for _ in range(descent.steps):
        if not len(at := np.flatnonzero(active)):
            break
        # trial step of all that have not ended
        diagonal = np.diagonal(normal[at], axis1=1, axis2=2)
        ridge = (damping[at, None] + share) * diagonal + constant
        damped = normal[at] + np.eye(normal.shape[1]) * ridge[:, None, :]
        step = np.asarray(np.linalg.solve(damped, gradient[at][:, :, None])[:, :, 0], dtype=float)
        trial = move(states[at], step)
        new_squares, new_normal, new_gradient, is_sound = equations(trial, at)
        is_same = np.abs(new_squares - squares[at]) < rounding * squares[at]
        accepted = (new_squares < squares[at]) & is_sound & ~is_same
        # rejected: more damping, until no downhill step is left; accepted: less
        fall = np.where(accepted, (squares[at] - new_squares) / squares[at], 1.0)
        damping[at] = np.where(accepted, np.maximum(damping[at] / 10, descent.least), damping[at] * 10)
        taken = at[accepted]
        states[taken], squares[taken] = trial[accepted], new_squares[accepted]
        normal[taken], gradient[taken] = new_normal[accepted], new_gradient[accepted]
        has_ended = (fall < descent.converged) | (squares[at] < exact) | (damping[at] > descent.most)
        active[at] = ~(has_ended | is_same)
    return states, squares, normal, ~active


class LobeModel(Protocol):
    """A highlight's model at some values of its parameters."""

    def evaluate(self) -> tuple[Array, Array]:
        """Return the pixels' intensities, shape (m,), and their derivatives, shape (m, p)."""

    def moved(self, step: Array) -> Self:
        """Return the model at parameters that differ by a step, shape (p,)."""


Model = TypeVar("Model", bound=LobeModel)


@dataclass(frozen=True)
class LobeFit(Generic[Model]):
    """A fitted model."""

    model: Model  # at the minimum
    covariance: Array  # (p, p): of its parameters, from the residual's variance
    sigma: float  # standard deviation of the residual
    chi2: float  # sum of squared residuals


def fit_lobe(
    start: Model, observed: Array, clipped: Mask | None = None, rounding: float = 0.0
) -> LobeFit[Model] | None:
    """Fit a model by Levenberg and Marquardt's method: maximum likelihood under white noise.

    The start must be near the minimum. None where the fit does not converge, or the pixels do not determine a
    parameter.

    `observed`, (m,): intensities of the model's pixels; `clipped`, (m,), optional: censored pixels: the intensity is at
    least what was observed, so a model above it leaves no residual; `rounding`: relative error of the sum of squares by
    the model's rounding: a change by no more than that ends the fit.
    """

    def equations(states: AnyArray, _: Index) -> Equations:
        state: _State = states[0]
        residual, state.J = _residual(state.model, observed, clipped)
        J, is_sound = state.J, np.isfinite(state.J).all()
        return np.array([residual @ residual]), (J.T @ J)[None], (J.T @ residual)[None], np.array([is_sound])

    def move(states: AnyArray, steps: Array) -> AnyArray:
        return _only(_State(states[0].model.moved(steps[0])))

    # A step too far overflows, and is then not taken.
    with np.errstate(all="ignore"):
        try:
            exact = EXACT * float(observed @ observed)
            (state,), (chi2,), _, (has_ended,) = minimise(
                _only(_State(start)), equations, move, OF_LOBES, exact, rounding
            )
        except np.linalg.LinAlgError:
            return None
        return _with_covariance(state.model, state.J, float(chi2)) if has_ended and np.isfinite(chi2) else None


@dataclass
class _State:
    """A model on the way to its minimum, and its derivatives once they are known."""

    model: Any
    J: Array = field(default_factory=lambda: np.empty(0))


def _only(state: _State) -> AnyArray:
    """Return one state as an array."""
    states = np.empty(1, dtype=object)
    states[0] = state
    return states


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
