"""What tests share: the rendering backend's cache, where the reference meshes lie, and commands in this process."""

import gc
import os
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from tests.extras.needs import missing

# No test depends on wall time; all else is as hypothesis has it, in CI for one.
settings.register_profile("untimed", settings(), deadline=None)
settings.load_profile("untimed")

# Where each core has a worker, more threads of the renderer only wait for each other: a sixth of its processor time.
if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
    os.environ.setdefault("SIMTEST_THREADS", "1")

# One folder of kept arrays for all workers of a run, so that an anatomy is grown once. It ends with the run.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _KEPT = tempfile.TemporaryDirectory(prefix="simtest-tests-", ignore_cleanup_errors=True)
    os.environ["SIMTEST_CACHE"] = _KEPT.name
# Children run the checkout whose tests these are, not the package that happens to be installed.
ROOT = Path(__file__).resolve().parents[1]
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))


def _without_waiting(descriptor):
    """Stand in for `os.fsync`: refuse what is no open file, and do not wait for the disk.

    What a power cut leaves cannot be tested here, and a test of a full disk puts its own function in this place.
    """
    os.fstat(descriptor if isinstance(descriptor, int) else descriptor.fileno())


os.fsync = _without_waiting


def pytest_terminal_summary(terminalreporter):
    """Name the folders of tests/extras that were left out."""
    for line in missing().values():
        terminalreporter.write_line(line)


def pytest_collection_finish():
    """Take what all tests have imported out of the garbage collector's sight: it would look through it again and again.

    Each scene that a dataset lets go is followed by a full collection, which takes 0.3 s with all test files in memory.
    """
    gc.collect()
    gc.freeze()


def pytest_runtest_teardown():
    """Let no command that ran in this process say how much the next one tells."""
    if (command_line := sys.modules.get("simtest.cli.main")) is not None:
        command_line.MANNERS.quiet = command_line.MANNERS.verbose = False


def largest_first(files):
    """Return files by their size: how long a file of tests takes is near enough, on 2 to 8 cores."""
    return sorted(files, key=lambda file: -file.stat().st_size)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Put the longest files first: one that began last would leave workers idle."""
    files = largest_first(dict.fromkeys(item.path for item in items))
    order = {file: number for number, file in enumerate(files)}
    items.sort(key=lambda item: order[item.path])


SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real meshes and frames beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"no reference data at ../shared/data (looked beside {SHARED.parents[1].name})")
    return SHARED


@pytest.fixture
def here(monkeypatch, capfd, tmp_path):
    """Run a command in this process, in an empty folder; gives exit code, output and error lines."""
    from simtest.cli.main import main

    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["simtest", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        output, errors = capfd.readouterr()
        return stop.value.code, output, errors.splitlines()

    return run


@pytest.fixture
def matlab_here(monkeypatch):
    """Read .mat files in this process: a process of its own for each takes a third of a second."""
    import json

    from simtest.errors import InputError
    from simtest.spec.camera_formats import matlab

    def read(path):
        try:
            return json.loads(json.dumps(matlab.struct_of(str(path))))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    monkeypatch.setattr(matlab, "read_struct", read)
