"""What tests share: the rendering backend's cache, where the reference meshes lie, and commands in this process."""

import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from tests.slow_cases import SLOW

# No test depends on wall time; all else is as hypothesis has it, in CI for one.
settings.register_profile("untimed", settings(), deadline=None)
settings.load_profile("untimed")

# Where each core has a worker, more threads of the renderer only wait for each other: a sixth of its processor time.
if int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1")) > 1:
    os.environ.setdefault("SIMTEST_THREADS", "1")

# Children run the checkout whose tests these are, not the package that happens to be installed.
ROOT = Path(__file__).resolve().parents[1]
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))

# Tests change constants and functions that the key of a kept array does not know of.
os.environ["SIMTEST_CACHE"] = "off"


def _without_waiting(descriptor):
    """Stand in for `os.fsync`: refuse what is no open file, and do not wait for the disk.

    What a power cut leaves cannot be tested here, and a test of a full disk puts its own function in this place.
    """
    os.fstat(descriptor if isinstance(descriptor, int) else descriptor.fileno())


os.fsync = _without_waiting


def pytest_collection_finish():
    """Take what all tests have imported out of the garbage collector's sight: it would look through it again and again.

    Each scene that a dataset lets go is followed by a full collection, which takes 0.3 s with all test files in memory.
    """
    gc.collect()
    gc.freeze()


LONGEST = (
    "test_examples", "test_relief", "test_gate_edits", "test_gate", "test_dataset", "test_nightly_run",
    "test_process_runs", "test_cli", "test_colon", "test_core_check", "test_deformed_render", "test_tissue_colour",
    "test_canaries", "test_photometric", "test_page_up_to_date", "test_dense_shading", "test_fit",
    "test_nightly_page", "test_inverse_rendering", "test_reuse", "test_learn", "test_sensor_scenes", "test_export",
    "test_dense_command", "test_mesh_surface", "test_motion_sequence", "test_gate_signs", "test_tracks",
    "test_motion_evidence", "test_circle_pose", "test_process_faults", "test_nightly_browser", "test_dense_depths",
    "test_curved", "test_stopping", "test_camera_path", "test_deforming_sequence", "test_anatomies", "test_glints",
    "test_pages_browser",
)  # fmt: skip
"""Files of 4 s of processor time and more, the longest first."""


COLLECTED: dict[str, dict[str, bool]] = {}
"""Whether a test is slow, by name and file, of all that were collected; those that are not chosen too."""


def matches(listed, name):
    """Return whether a name of `SLOW` stands for a test."""
    return name == listed or (listed[-1] == "*" and name.startswith(listed[:-1]))


def is_slow(stem, name):
    """Return whether `SLOW` names a test of a file."""
    return any(matches(listed, name) for names in SLOW.get(stem, {}).values() for listed in names)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark the cases that are slow, and put the longest files first: one that began last would leave workers idle.

    What is chosen by marks is chosen afterwards. `make test-ci` runs these cases too.
    """
    for item in items:
        if is_slow(item.path.stem, item.name):
            item.add_marker("slow")
            item.add_marker("extra")
        own = COLLECTED.setdefault(item.path.stem, {})
        own[item.name] = item.get_closest_marker("slow") is not None
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


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
    from simtest.spec.camera_formats.matlab_struct import struct_of

    def read(path):
        try:
            return json.loads(json.dumps(struct_of(str(path))))
        except InputError as error:
            raise InputError(f"{path}: {error}") from error

    monkeypatch.setattr(matlab, "read_struct", read)


@pytest.fixture(scope="module")
def one_torch_thread() -> Iterator[None]:
    """Run PyTorch on one thread: several take turns at small networks, and wait for each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
