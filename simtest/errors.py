"""Two kinds of error: exceptions for malformed input, values for ill-posed data.

Malformed input (a file, a key, an argument) raises an `InputError` whose message is one line that names the file or
key, the value got and the values allowed. Ill-posed data (no closed isophote, a degenerate conic) is a normal outcome
of an experiment: it is returned as a `Failure`, counted and reported.
"""

from dataclasses import dataclass
from enum import StrEnum


class SimtestError(Exception):
    """Base of every error that simtest raises on purpose; its text is one line for the user."""


class InputError(SimtestError, ValueError):
    """Malformed input: the message names the file or key, the value got and what is allowed."""


class BackendError(SimtestError, RuntimeError):
    """The rendering backend cannot be used; the message says how to repair it."""


class Reason(StrEnum):
    """Why a reconstruction has no normal; the values are the `status` column of the results."""

    NO_LIGHT = "no_light"
    NO_PEAK = "no_peak"
    NO_CLOSED_ISOPHOTE = "no_closed_isophote"
    TOO_FEW_POINTS = "too_few_points"
    NOT_AN_ELLIPSE = "not_an_ellipse"
    DEGENERATE_CONIC = "degenerate_conic"
    NOT_FINITE = "not_finite"
    NOT_CONVERGED = "not_converged"
    STREAK = "streak"
    UNRESOLVED = "unresolved"
    NOT_KNOWN = "not_known"
    NO_ESTIMATE = "no_estimate"
    ESTIMATOR_ERROR = "estimator_error"


@dataclass(frozen=True, slots=True)
class Failure:
    """Ill-posed data, as a value.

    Parameters
    ----------
    reason : Reason
        The class of failure, counted in the reports.
    detail : str
        One line with the numbers of this case.
    """

    reason: Reason
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}" if self.detail else str(self.reason)
