"""All checks by name; each takes a case and returns its faults, none where the case is right."""

from collections.abc import Callable, Sequence

from simtest.errors import SimtestError
from studies.corners.calibration_checks import calibration
from studies.corners.case import Case, Faults, NotAskedError
from studies.corners.geometry_checks import law, projection, search, surface
from studies.corners.label_checks import isolated, labels
from studies.corners.symmetry_checks import answers, mirror, turn

CHECKS: dict[str, Callable[[Case], Faults]] = {
    each.__name__: each
    for each in (
        law, projection, surface, search, mirror, turn, answers, isolated, labels, calibration,
    )
}  # fmt: skip


def run(check: str, case: Case) -> tuple[str, Sequence[str]]:
    """Run a check on a case; return its verdict (green, refused, not asked, red) and the reasons."""
    try:
        faults = CHECKS[check](case)
    except NotAskedError as reason:
        return "not asked", [str(reason)]
    except SimtestError as error:
        return "refused", [_first_line(error)]
    except Exception as error:
        return "red", [f"{type(error).__name__}: {_first_line(error)}"]
    return ("red" if faults else "green"), faults


def _first_line(error: Exception) -> str:
    """Return the first line of an exception's text."""
    return next(iter(str(error).splitlines()), "")
