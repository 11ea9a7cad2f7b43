"""The `simtest` command: runs the application, and reports errors in one line.

It loads little before signals are answered.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cyclopts import MissingArgumentError

INTERRUPTED = 130
TERMINATED = 143

NARROWEST = 20
"""Columns of a terminal; tables and help cannot be laid out in fewer."""

LATER_S = 0.01
"""After so long a stop that had to wait is tried again."""


class Termination:
    """Answers SIGTERM as Ctrl-C is answered, and remembers that it came.

    Within an import both wait for its end: an exception there can be swallowed, or break a library for good. So they do
    while pydantic builds a model, which makes another error of it.
    """

    def __init__(self) -> None:
        self.came = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> "Termination":
        """Answer the signals from now on; in a thread, which gets none, nothing is done."""
        if threading.current_thread() is threading.main_thread():
            # The alarm first, by which another waits.
            numbers = [signal.SIGALRM, signal.SIGTERM]
            # Ignored by nohup, and in the background of a script: then it stays so.
            if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
                numbers.append(signal.SIGINT)
            self._before = {number: signal.signal(number, self._stop) for number in numbers}
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the signals to whoever answered them before."""
        for number, before in self._before.items():
            signal.signal(number, before)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        self.came = self.came or number == signal.SIGTERM
        if _loading(frame):
            signal.setitimer(signal.ITIMER_REAL, LATER_S)
            return
        # A progress bar, which answers Ctrl-C itself, waits for the end of its step.
        answer = signal.getsignal(signal.SIGINT)
        if callable(answer) and answer != self._stop:
            answer(number, frame)
        else:
            raise KeyboardInterrupt


BUILDING = frozenset({"complete_model_class", "complete_dataclass", "_init_core_attrs"})
"""Functions of pydantic that build what validates."""


def _loading(frame: FrameType | None) -> bool:
    """Return whether a module is being imported, or a model built."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>" or frame.f_code.co_name in BUILDING:
            return True
        frame = frame.f_back
    return False


FLAGS = ("--quiet", "--verbose", "--traceback")
"""What every command takes; `simtest --help` names them."""

SHORT = {"-q": "--quiet", "-v": "--verbose"}


class Manners:
    """How much is said; of this process."""

    quiet = False
    """Neither progress nor warnings nor notes: results and errors alone."""

    verbose = False
    """Every step of the work, every row of a table, and the debug messages of the logger "simtest"."""


MANNERS = Manners()


def take_flags(words: Sequence[str]) -> tuple[list[str], bool]:
    """Set `MANNERS` by the flags of a command line; return its other words, and whether it has ``--traceback``."""
    # Behind -- nothing is a flag.
    end = list(words).index("--") if "--" in words else len(words)
    words = [*(SHORT.get(word, word) for word in words[:end]), *words[end:]]
    flags = set(words[:end]).intersection(FLAGS)
    MANNERS.quiet, MANNERS.verbose = "--quiet" in flags, "--verbose" in flags
    return [word for i, word in enumerate(words) if i >= end or word not in FLAGS], "--traceback" in flags


def meant_flag(word: str, options: Iterable[str]) -> str | None:
    """Return the message for an unknown word that is a mistyped flag or one with a value, unless an option is meant."""
    from simtest.runtime.boundary import close_names

    name = word.partition("=")[0]
    if name in FLAGS:
        return f"{name}: takes no value"
    close = close_names(name, [*options, *FLAGS])
    return f'Unknown option: "{word:.60}". Did you mean "{close[0]}"?' if set(close) & set(FLAGS) else None


BAD_USE = 2

GOING_ON = ("validate", "advise", "dataset", "nightly", "bench", "calibrate core")
"""Commands that take up what a stopped run has finished."""


def main() -> None:
    """Run the command line.

    Exit codes: 0 done, 1 could not render, a full disk, or a command's own verdict, 2 bad input, 130 Ctrl-C, 143
    SIGTERM. Of `nightly`, whose 1 is a regression or an unexplained change, whatever else went wrong is 2. A reader of
    the output that has gone is no error.
    """
    stop = Termination()
    # Around it: a signal may come as soon as the first is answered.
    try:
        with stop:
            _mend_terminal()
            code = _run()
    except KeyboardInterrupt as stopped:
        goes_on = " ".join(sys.argv[1:3]).startswith(GOING_ON)
        kept = f"what is finished is kept, and the same command {'goes on from there' if goes_on else 'begins anew'}"
        _report(f"{'terminated' if stop.came else 'stopped'}; {str(stopped) or kept}", 0)
        code = TERMINATED if stop.came else INTERRUPTED
    sys.exit(code)


def _run() -> int:
    """Run the command and return its exit code."""
    sys.argv[1:], wants_traceback = take_flags(sys.argv[1:])
    failed = BAD_USE if sys.argv[1:2] == ["nightly"] else 1
    with _messages(wants_traceback):
        return _answer(failed, wants_traceback)


def _answer(failed: int, wants_traceback: bool) -> int:
    """Run the command and return its exit code; `failed` is that of an error that is none of the input."""
    from cyclopts import CycloptsError, MissingArgumentError, UnknownOptionError

    from simtest.cli.commands import APP, GONE
    from simtest.cli.common import gather_settings
    from simtest.errors import InputError

    words = gather_settings(sys.argv[1:])
    if wants_traceback:
        return _code(APP(words, result_action="return_value"))
    try:
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
    except CycloptsError as error:
        return _report(str(error), BAD_USE)
    except BrokenPipeError:
        _discard_output()
        return 0
    except SystemExit as ended:
        # So ends the printer of help, whose own code for it is 1.
        if isinstance(ended.__context__, BrokenPipeError):
            return 0
        raise
    except Exception as error:
        return _told(error, failed)


def _missing(error: "MissingArgumentError") -> str:
    """Return which argument or option is missing, or has no value, and what it must be."""
    argument, command = error.argument, " ".join(["simtest", *(error.command_chain or ())])
    if argument is None:
        return str(error)
    what = " ".join(str(argument.parameter.help or "").split()).rstrip(".")
    lacks = "needs a value" if error.keyword or argument.tokens else "missing"
    return f"{error.keyword or argument.name}: {lacks}{f' ({what})' if what else ''}; {command} --help describes it"


def _told(error: Exception, failed: int) -> int:
    """Report an error of the input, of the output, of a file, of the machine, or of the program; return the code."""
    from simtest.errors import InputError, SimtestError
    from simtest.runtime.boundary import plain

    told = plain(error)
    # Only the output's stream has neither a name nor a reason of its own to fail.
    if isinstance(error, OSError) and error.filename is None and _output_fails():
        return _report(f"the output cannot be written ({told})", failed)
    if isinstance(told, SimtestError):
        return _report(str(told), BAD_USE if isinstance(told, InputError) else failed)
    internal = f"internal error, please report it ({type(error).__name__}: {error}); --traceback shows where"
    return _report(internal, failed)


def _output_fails() -> bool:
    """Return whether what is printed cannot be written; then it is given up, or Python would say so at its end."""
    try:
        # What failed once is lost from the buffers, so flushing them again tells nothing.
        os.write(sys.stdout.fileno(), b"\n")
    except (OSError, ValueError, AttributeError):
        _discard_output()
        return True
    return False


def _discard_output() -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _code(result: object) -> int:
    return result if isinstance(result, int) else 0


@contextmanager
def _messages(plain: bool) -> Iterator[None]:
    """Print warnings and messages of the logger "simtest" in one line each, but warnings as Python does if `plain`."""
    import logging
    import warnings

    from simtest.runtime.messages import LOGGER, log_warnings

    class Lines(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            from simtest.errors import one_line

            print(f"simtest: {record.levelname.lower()}: {one_line(record.getMessage())}", file=sys.stderr)

    before, level, handler = warnings.showwarning, LOGGER.level, Lines()
    LOGGER.addHandler(handler)
    LOGGER.setLevel(logging.ERROR if MANNERS.quiet else logging.DEBUG if MANNERS.verbose else logging.WARNING)
    if MANNERS.quiet or not plain:
        log_warnings()
    try:
        yield
    finally:
        LOGGER.removeHandler(handler)
        LOGGER.setLevel(level)
        warnings.showwarning = before


def _mend_terminal() -> None:
    """Let output never fail: characters that a terminal lacks are replaced, and one of no width gets the usual one."""
    import io

    for stream in (sys.stdout, sys.stderr):
        # None where it is closed.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    # Help is laid out without end, in ever more memory, where there is no room for a word.
    if os.environ.get("COLUMNS", "").isdecimal() and int(os.environ["COLUMNS"]) < NARROWEST:
        del os.environ["COLUMNS"]


def _report(text: str, code: int) -> int:
    """Print an error as one line and return the exit code."""
    from simtest.errors import one_line

    print(f"simtest: {one_line(' '.join(text.split()))}", file=sys.stderr)
    return code
