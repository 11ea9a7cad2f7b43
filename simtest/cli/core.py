"""`simtest core`: check a reconstruction core that runs as a command of its own."""

from cyclopts import App

from simtest.cli.options import AsJson

core = App(name="core", help="Check a reconstruction core that runs as a command of its own.")


@core.command
def check(command: str, /, *, as_json: AsJson = False) -> int:
    """Check a core against the process protocol, step by step; exit 1 if a step is wrong.

    The core is started, asked about highlights whose normals are known by formula, and ended. Each step has a line:
    ok, or what is wrong and what is expected.

    Parameters
    ----------
    command : str
        The command in quotes, such as "python core.py", or the TOML file of a core.
    """
    from simtest.cli.printing import print_json
    from simtest.validation.core_check import check_core

    report = check_core(command)
    if as_json:
        print_json(report.to_json())
    else:
        for line in report.lines():
            print(line)
    return 0 if report.is_ok else 1
