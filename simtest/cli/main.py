"""The `simtest` command: runs the application, and reports errors in one line.

It loads nothing before signals are answered, so that a stop in the first moments is a silent one.
"""

import sys
from typing import TYPE_CHECKING

from simtest.cli.stopping import INTERRUPTED, TERMINATED, Termination

if TYPE_CHECKING:
    from cyclopts import MissingArgumentError

NARROWEST = 20
"""Columns of a terminal; tables and help cannot be laid out in fewer."""

LONGEST = 900
"""Characters of a line; a longer one is cut."""

BAD_USE = 2

GOING_ON = ("validate", "advise", "dataset", "nightly", "bench")
"""Commands that take up what a stopped run has finished."""


def main() -> None:
    """Run the command line.

    Exit codes: 0 done, 1 could not render, a full disk, or a command's own verdict, 2 bad input, 130 Ctrl-C, 143
    SIGTERM. Of `nightly`, whose 1 is a regression or an unexplained change, whatever else went wrong is 2. A reader of
    the output that has gone is no error.
    """
    with Termination() as stop:
        _mend_terminal()
        sys.exit(_run(stop))


def _run(stop: Termination) -> int:  # noqa: C901 - a branch for each way in which a command may end
    """Run the command and return its exit code."""
    from simtest.cli.manners import MANNERS, meant_flag, take_flags

    sys.argv[1:], wants_traceback = take_flags(sys.argv[1:])
    failed = BAD_USE if sys.argv[1:2] == ["nightly"] else 1
    _answer_warnings(MANNERS.quiet, wants_traceback)

    from cyclopts import CycloptsError, MissingArgumentError, UnknownOptionError

    from simtest.cli.commands import APP, GONE
    from simtest.cli.options import gather_settings
    from simtest.errors import InputError, SimtestError

    words = gather_settings(sys.argv[1:])

    if wants_traceback:
        with stop.working():
            return _code(APP(words, result_action="return_value"))
    try:
        with stop.working():
            _require_folder()
            if words and words[0] in GONE:
                raise InputError(f"{words[0]}: is gone; {GONE[words[0]]}")
            if MANNERS.quiet and MANNERS.verbose:
                raise InputError("--quiet and --verbose exclude each other; give one of them")
            # A command's result is its exit code.
            code = _code(APP(words, exit_on_error=False, print_error=False, result_action="return_value"))
        # Output may wait in a buffer whose reader has gone, or whose disk is full.
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except UnknownOptionError as error:
        # Cyclopts knows the command's own options alone.
        known = [name for argument in error.argument_collection for name in argument.names]
        word = error.token.keyword or error.token.value
        return _report(meant_flag(word, known) or str(error), BAD_USE)
    except MissingArgumentError as error:
        return _report(_missing(error), BAD_USE)
    except (CycloptsError, InputError) as error:
        return _report(str(error), BAD_USE)
    except SimtestError as error:
        return _report(str(error), failed)
    except KeyboardInterrupt as stopped:
        goes_on = sys.argv[1:2] and sys.argv[1] in GOING_ON
        kept = "what is finished is kept, and the same command " + ("goes on from there" if goes_on else "begins anew")
        how = "terminated" if stop.came else "stopped"
        return _report(f"{how}; {str(stopped) or kept}", TERMINATED if stop.came else INTERRUPTED)
    except BrokenPipeError:
        _discard_output()
        return 0
    except SystemExit as ended:
        # So ends the printer of help, whose own code for it is 1.
        if isinstance(ended.__context__, BrokenPipeError):
            return 0
        raise
    except Exception as error:
        return _report(_problem(error), failed)


def _missing(error: "MissingArgumentError") -> str:
    """Return which argument or option is missing, or has no value, and what it must be."""
    argument, command = error.argument, " ".join(["simtest", *(error.command_chain or ())])
    if argument is None:
        return str(error)
    what = " ".join(str(argument.parameter.help or "").split()).rstrip(".")
    lacks = "needs a value" if error.keyword or argument.tokens else "missing"
    return f"{error.keyword or argument.name}: {lacks}{f' ({what})' if what else ''}; {command} --help describes it"


def _problem(error: Exception) -> str:
    """Return an error that no command foresaw as text: of the output, of the machine, or of the program."""
    from simtest.runtime.machine_errors import machine_problem

    # Only the output's stream has neither a name nor a reason of its own to fail.
    what = machine_problem(error) or _damaged_bytecode(error)
    if what is not None and isinstance(error, OSError) and error.filename is None and _output_fails():
        return f"the output cannot be written ({what})"
    return what or f"internal error, please report it ({type(error).__name__}: {error}); --traceback shows where"


def _damaged_bytecode(error: Exception) -> str | None:
    """Return which compiled file of Python is cut short, as a full disk leaves it; None for any other error."""
    if not isinstance(error, EOFError | ValueError) or "marshal data" not in str(error):
        return None
    import traceback

    for frame, _ in traceback.walk_tb(error.__traceback__):
        if path := frame.f_locals.get("bytecode_path"):
            return f"{path}: a compiled file of Python that is cut short, perhaps by a full disk; delete it"
    return None


def _output_fails() -> bool:
    """Return whether what is printed cannot be written; then it is given up, or Python would say so at its end."""
    import os

    try:
        # What failed once is lost from the buffers, so flushing them again tells nothing.
        os.write(sys.stdout.fileno(), b"\n")
    except (OSError, ValueError, AttributeError):
        _discard_output()
        return True
    return False


def _discard_output() -> None:
    import os

    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _code(result: object) -> int:
    return result if isinstance(result, int) else 0


def _require_folder() -> None:
    """Raise `InputError` where the working folder was deleted: libraries and child processes end without one."""
    import os

    from simtest.errors import InputError

    try:
        os.getcwd()
    except FileNotFoundError:
        if not {"--help", "-h", "--version"} & set(sys.argv):
            raise InputError("the working folder was deleted; change to another one") from None


def _answer_warnings(quiet: bool, plain: bool) -> None:
    """Have warnings printed in one line, or not at all where `quiet`, or as Python does where `plain`."""
    import warnings

    if quiet:
        warnings.showwarning = lambda *_, **__: None
    elif not plain:
        warnings.showwarning = _warn


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    from simtest.runtime.resources import shown

    print(f"simtest: warning: {shown(message, LONGEST)}", file=sys.stderr)


def _mend_terminal() -> None:
    """Let output never fail: characters that a terminal lacks are replaced, and one of no width gets the usual one."""
    import io
    import os

    for stream in (sys.stdout, sys.stderr):
        # None where it is closed.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"]) < NARROWEST:
        del os.environ["COLUMNS"]


def _report(text: str, code: int) -> int:
    """Print an error as one line and return the exit code."""
    from simtest.runtime.resources import shown

    line = " ".join(text.split())
    print(f"simtest: {shown(line, LONGEST)}", file=sys.stderr)
    return code
