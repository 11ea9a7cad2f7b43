"""`simtest doctor`."""

import json
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import Variant


def doctor(*, as_json: Annotated[bool, Parameter(name="--json", negative="")] = False, variant: Variant = None) -> int:
    """Check the rendering backend in a child process and say how to mend it; exit 1 if it cannot render.

    Parameters
    ----------
    as_json : bool
        Print JSON.
    variant : str, optional
        Mitsuba variant to check.
    """
    from simtest.rendering.backend_check import examine

    report = examine(variant)
    if as_json:
        print(json.dumps(report.to_json(), indent=2))
        return 0 if report.can_render else 1
    print(f"variant     {report.variant}")
    for candidate in report.candidates:
        print(f"libLLVM     {candidate.path}  ({candidate.origin}): {candidate.verdict}")
    if report.library:
        print(f"in use      {report.library}")
    for package, version in report.versions.items():
        print(f"{package:<11} {version}")
    print(f"rendering   {'works' if report.can_render else 'does not work'}")
    if report.problem:
        print(f"problem     {report.problem}")
    return 0 if report.can_render else 1
