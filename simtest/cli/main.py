"""The `simtest` command: its sub-commands, and errors of one line.

Sub-commands are imported when they are called, so that `simtest --help` answers at once.
"""

import io
import os
import sys
import warnings

from cyclopts import App, CycloptsError

from simtest.cli.stopping import Termination
from simtest.errors import InputError, SimtestError
from simtest.runtime.machine_errors import machine_problem
from simtest.runtime.resources import shown

NARROWEST = 20
"""Columns of a terminal; tables and help cannot be laid out in fewer."""

LONGEST = 900
"""Characters of a line; a longer one is cut."""

APP = App(
    name="simtest",
    help="Simulation testbed for 3D reconstruction from specular highlights in endoscopy.",
    version_flags=["--version"],
    version=lambda: _version(),
    # `main` reports what is kept.
    suppress_keyboard_interrupt=False,
)
# Stated here, since a sub-command's own text is loaded with its module.
_COMMANDS = {
    "doctor": "Check the rendering backend.",
    "schema": "Print the JSON schema of a scene, experiment, dataset, camera, calibration or profile file.",
    "render": "Render a scene with its ground truth.",
    "views": "Pick viewpoints of an anatomy that show isolated highlights.",
    "view": "Show a scene in 3D: curvature, camera, lights, true and estimated normals.",
    "export": "Write a scene as files that Mitsuba itself loads.",
    "reconstruct": "Reconstruct the normals at the specularities of a picture, a folder or a video.",
    "realism": "Measure how far generated frames are from real ones.",
    "fit": "Fit the ranges of a dataset recipe to real frames.",
    "validate": "Run an experiment and write its report.",
    "nightly": "Run the fixed experiments, compare with the baseline, write the page.",
    "dataset": "Make a labelled dataset for learning, check it, look at it.",
    "mesh": "Check a mesh of yours, or make a colon or liver from its recipe.",
}
for _name, _help in _COMMANDS.items():
    APP.command(f"simtest.cli.{_name}:{_name}", help=_help)

INTERRUPTED = 130
TERMINATED = 143
BAD_USE = 2


def _version() -> str:
    from simtest.runtime.provenance import version

    return version()


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    print(f"simtest: warning: {shown(message, LONGEST)}", file=sys.stderr)


def main() -> None:
    """Run the command line.

    Exit codes: 0 done, 1 could not render, a full disk, or a command's own verdict, 2 bad input, 130 Ctrl-C, 143
    SIGTERM. Of `nightly`, whose 1 is a regression or an unexplained change, whatever else went wrong is 2.
    """
    failed = BAD_USE if sys.argv[1:2] == ["nightly"] else 1
    _mend_terminal()
    stop = Termination()
    if "--traceback" in sys.argv:
        sys.argv.remove("--traceback")
        sys.exit(APP())
    warnings.showwarning = _warn
    try:
        with stop:
            # A command's result is its exit code.
            code = APP(exit_on_error=False, print_error=False, result_action="return_value")
        # Output may wait in a buffer whose reader has gone.
        if sys.stdout is not None:
            sys.stdout.flush()
    except (CycloptsError, InputError) as error:
        sys.exit(_report(str(error), BAD_USE))
    except SimtestError as error:
        sys.exit(_report(str(error), failed))
    except KeyboardInterrupt as stopped:
        kept = "what is finished is kept, and the same command goes on from there"
        how = "terminated" if stop.came else "stopped"
        sys.exit(_report(f"{how}; {str(stopped) or kept}", TERMINATED if stop.came else INTERRUPTED))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        what = machine_problem(error) or (
            f"internal error, please report it ({type(error).__name__}: {error}); --traceback shows where"
        )
        sys.exit(_report(what, failed))
    sys.exit(code if isinstance(code, int) else 0)


def _mend_terminal() -> None:
    """Let output never fail: characters that a terminal lacks are replaced, and one of no width gets the usual one."""
    for stream in (sys.stdout, sys.stderr):
        # None where it is closed.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"]) < NARROWEST:
        del os.environ["COLUMNS"]


def _report(text: str, code: int) -> int:
    """Print an error as one line and return the exit code."""
    line = " ".join(text.split())
    print(f"simtest: {shown(line, LONGEST)}", file=sys.stderr)
    return code
