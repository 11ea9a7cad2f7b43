"""What a command says beside its results: progress, warnings, rows."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

FLAGS = ("--quiet", "--verbose", "--traceback")
"""What every command takes; `simtest --help` names them."""


@dataclass
class Manners:
    """How much is said; of this process."""

    quiet: bool = False
    """Neither progress nor warnings: results and errors alone."""

    verbose: bool = False
    """Every step of the work and every row of a table."""


MANNERS = Manners()


def take_flags(words: Sequence[str]) -> tuple[list[str], bool]:
    """Take the flags of all commands out of a command line and set `MANNERS` by them.

    Parameters
    ----------
    words : sequence of str
        Arguments without the program's name; behind ``--`` nothing is a flag.

    Returns
    -------
    words : list of str
        The others.
    traceback : bool
        Whether errors are to be shown with where they came up.
    """
    end = list(words).index("--") if "--" in words else len(words)
    flags = set(words[:end]).intersection(FLAGS)
    MANNERS.quiet, MANNERS.verbose = "--quiet" in flags, "--verbose" in flags
    return [word for i, word in enumerate(words) if i >= end or word not in FLAGS], "--traceback" in flags


def meant_flag(word: str, options: Iterable[str]) -> str | None:
    """Return the message for an unknown option that is a flag of all commands, mistyped or with a value.

    Parameters
    ----------
    word : str
        The option as it was given, such as ``--verbse`` or ``--quiet=1``.
    options : iterable of str
        Of the command; one that is as close as a flag comes first.

    Returns
    -------
    str, optional
        None where no flag is meant.
    """
    from simtest.runtime.boundary import close_names

    name = word.partition("=")[0]
    if name in FLAGS:
        return f"{name}: takes no value"
    close = close_names(name, [*options, *FLAGS])
    return f'Unknown option: "{word!s:.60}". Did you mean "{close[0]}"?' if set(close) & set(FLAGS) else None
