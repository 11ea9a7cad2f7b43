"""`simtest doctor`."""

from simtest.cli.options import AsJson, Variant


def doctor(*, as_json: AsJson = False, variant: Variant = None) -> int:
    """Check the rendering backend in a child process and say how to mend it; exit 1 if it cannot render."""
    from simtest.cli.printing import print_json
    from simtest.rendering.backend import examine

    report = examine(variant)
    if as_json:
        print_json(report)
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
