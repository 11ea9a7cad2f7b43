"""Two kinds of error: exceptions for malformed input, values for ill-posed data.

Malformed input (a file, a key, an argument) raises an `InputError` whose message is one line that names the file or
key, the value got and the values allowed. Ill-posed data (no closed isophote, a degenerate conic) is a normal outcome
of an experiment: it is returned as a `Failure`, counted and reported.
"""

import re
from dataclasses import dataclass
from enum import StrEnum

LONGEST = 900
"""Characters of a message; of a longer one, as of a long word, the middle is left out."""


def one_line(text: object) -> str:
    """Return a text as one line of printable characters, since it may quote what a user or a file gave."""
    line = re.sub(r"\S{300,}", lambda word: f"{word[0][:120]}...{word[0][-60:]}", str(text))
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)
    half = LONGEST // 2 - 3
    return line if len(line) <= LONGEST else f"{line[:half]} ... {line[-half:]}"


class SimtestError(Exception):
    """Base of every error that simtest raises on purpose; its text is one line for the user.

    Examples
    --------
    >>> import simtest
    >>> try:
    ...     simtest.load_scene("cilinder")
    ... except simtest.SimtestError as error:
    ...     print(type(error).__name__)
    InputError
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class InputError(SimtestError, ValueError):
    """Malformed input: the message names the file or key, the value got and what is allowed.

    Examples
    --------
    >>> import simtest
    >>> try:
    ...     simtest.load_scene("cylinder", {"surface.radius_mm": -1.0})
    ... except simtest.InputError as error:
    ...     print("surface.radius_mm" in str(error))
    True
    """


class BackendError(SimtestError, RuntimeError):
    """The rendering backend cannot be used; the message says how to repair it.

    Examples
    --------
    >>> import simtest
    >>> issubclass(simtest.BackendError, simtest.SimtestError)
    True
    """


class Reason(StrEnum):
    """Why a reconstruction has no normal; the values are the `status` column of the results.

    Examples
    --------
    >>> import simtest
    >>> simtest.Reason.STREAK.value, simtest.Reason.STREAK.meaning
    ('streak', 'the spot is so long that its centre along it is not determined')
    """

    NO_LIGHT = "no_light"
    NO_PEAK = "no_peak"
    CLUSTER = "cluster"
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
    UNDECIDED = "undecided"
    REFUSED = "refused"
    ESTIMATOR_ERROR = "estimator_error"
    CORE_DIED = "core_died"
    CORE_TIMEOUT = "core_timeout"
    CORE_PROTOCOL = "core_protocol"

    @property
    def meaning(self) -> str:
        """The reason in words."""
        return _MEANINGS[self]


_MEANINGS = {
    Reason.NO_LIGHT: "no light reached the sensor",
    Reason.NO_PEAK: "the region has no value above the others",
    Reason.CLUSTER: "several highlights touch, so that none has isophotes of its own",
    Reason.NO_CLOSED_ISOPHOTE: "no isophote at the isovalue closes around the peak",
    Reason.TOO_FEW_POINTS: "the isophote has too few points for an ellipse",
    Reason.NOT_AN_ELLIPSE: "no ellipse fits the isophote",
    Reason.DEGENERATE_CONIC: "the fitted ellipse is nearly a line",
    Reason.NOT_FINITE: "the estimator gave values that are not finite",
    Reason.NOT_CONVERGED: "the fit did not converge",
    Reason.STREAK: "the spot is so long that its centre along it is not determined",
    Reason.UNRESOLVED: "the spot is too small to have a shape",
    Reason.NOT_KNOWN: "the estimator needs what the calibration does not tell, such as the lights' positions",
    Reason.UNDECIDED: "the pictures do not tell the signs of the curvatures apart",
    Reason.REFUSED: "the core's calibration finds its errors too large here, or the frame unlike its own",
    Reason.NO_ESTIMATE: "the estimator found nothing that it could answer for",
    Reason.ESTIMATOR_ERROR: "the estimator stopped with an error",
    Reason.CORE_DIED: "the core's process ended before it answered",
    Reason.CORE_TIMEOUT: "the core gave no answer within its time limit",
    Reason.CORE_PROTOCOL: "the core wrote what the process protocol does not allow",
}

FAULTS = (Reason.ESTIMATOR_ERROR, Reason.CORE_DIED, Reason.CORE_TIMEOUT, Reason.CORE_PROTOCOL)
"""Reasons that tell of a mistake in an estimator or of the end of its process, not of the data."""


@dataclass(frozen=True, slots=True)
class Failure:
    """Ill-posed data, as a value.

    Parameters
    ----------
    reason : Reason
        The class of failure, counted in the reports.
    detail : str
        One line with the numbers of this case.

    Examples
    --------
    >>> import simtest
    >>> print(simtest.Failure(simtest.Reason.TOO_FEW_POINTS, "4 points"))
    too_few_points: 4 points
    """

    reason: Reason
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}" if self.detail else str(self.reason)

    def __repr__(self) -> str:
        # The detail may quote a whole message of an estimator.
        detail = self.detail if len(self.detail) <= 200 else self.detail[:197] + "..."
        return f"Failure({str(self.reason)!r}, {detail!r})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the reason, its meaning and the numbers of this case."""
        from html import escape

        meaning = self.reason.meaning if isinstance(self.reason, Reason) else ""
        return f"<div><b>No normal: {escape(str(self.reason))}</b><br>{escape(meaning)}<br>{escape(self.detail)}</div>"
