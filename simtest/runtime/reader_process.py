"""Files whose reader may crash or take all memory, read in a process of its own under a memory limit.

A module calls `serve` in its `main`, and is run as ``python -m MODULE FILE OUT``; `read_apart` starts it.
"""

import json
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from simtest.errors import InputError, SimtestError
from simtest.runtime.machine_errors import disk_problem, machine_problem
from simtest.runtime.resources import shown

TIMEOUT_S = 300
REFUSED = 3
"""Exit code of a file that is refused; the last line of the output says why."""
FAILED = 4
"""Exit code where the machine lacks memory or room on its disk; the last line of the output says which."""

T = TypeVar("T")


def read_apart(path: Path, module: str, load: Callable[[Path], T], program: str, breakdown: str) -> T:
    """Read a file in a process of its own.

    Parameters
    ----------
    path : Path
        The file; its name begins every message.
    module : str
        What the process runs; its `main` calls `serve`.
    load : callable
        Reads what the process has stored.
    program : str
        The reader's name in messages, such as "VTK".
    breakdown : str
        What is said of a file over which the reader breaks down.

    Raises
    ------
    InputError
        If the file is refused, takes more than `TIMEOUT_S`, or the reader breaks down over it.
    SimtestError
        If memory, or the disk of temporary files, does not hold it.
    """
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "made"
        # -P: no file of the current folder may stand in for a package.
        command = [sys.executable, "-P", "-m", module, str(path.absolute()), str(made)]
        try:
            child = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise InputError(f"{shown(path)}: not read within {TIMEOUT_S} s; must be a smaller file") from None
        if child.returncode == 0:
            return load(made)
    # What the machine did is no damage of the file.
    if child.returncode == -signal.SIGKILL:
        raise SimtestError(f"{shown(path)}: {program} was killed while it read the file, mostly for want of memory")
    told = _told(child.stdout) if child.returncode in (REFUSED, FAILED) else ""
    if child.returncode == FAILED:
        raise SimtestError(f"{shown(path)}: {told or 'not read'}")
    raise InputError(f"{shown(path)}: {told or breakdown}")


def _told(output: str) -> str:
    """Return the text that `serve` printed last; nothing where it printed none."""
    try:
        return str(json.loads(output.strip().splitlines()[-1]))
    except (IndexError, ValueError):
        return ""


def serve(read: Callable[[str], T], store: Callable[[T, str], None], kind: str, content: str) -> int:
    """Read the file that the command line names, and store it; print why that cannot be.

    Parameters
    ----------
    read : callable
        Reads the file. It raises `InputError` where the content is not what it must be, without the file's name.
    store : callable
        Writes what was read under a name.
    kind : str
        What the file must be, for messages, such as "VTK mesh".
    content : str
        What is stored, for messages.

    Returns
    -------
    code : int
        Exit code.
    """
    try:
        made = read(sys.argv[1])
    except InputError as error:
        return _ended(str(error), REFUSED)
    except MemoryError as error:
        return _ended(str(machine_problem(error)), FAILED)
    except Exception as error:
        # The reader raises whatever it runs into; the file is at fault.
        return _ended(f"not a readable {kind} ({' '.join(str(error).split())[:160] or type(error).__name__})", REFUSED)
    try:
        store(made, sys.argv[2])
    except OSError as error:
        return _ended(f"{content} cannot be stored ({disk_problem(error, Path(sys.argv[2])) or error})", FAILED)
    return 0


def _ended(text: str, code: int) -> int:
    # JSON is ASCII on one line, whatever the encoding of the output.
    print(json.dumps(text))
    return code


def limit_memory(most: float) -> None:
    """Let this process allocate at most so many bytes beside what it holds now; beyond, allocations fail.

    Systems without such limits (Windows) are left as they are.
    """
    try:
        import resource
    except ImportError:
        return
    try:
        held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
    except (OSError, ValueError, IndexError):
        held = 0
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    wanted = held + int(most)
    try:
        resource.setrlimit(
            resource.RLIMIT_DATA, (wanted if hard == resource.RLIM_INFINITY else min(wanted, hard), hard)
        )
    except (OSError, ValueError):
        return
