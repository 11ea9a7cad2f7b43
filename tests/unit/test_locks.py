"""Two runs on one folder, stops by a signal, and disks that are full: one line each, and nothing lost."""

import errno
import fcntl
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

import simtest
from simtest.cli.main import Termination
from simtest.errors import InputError, SimtestError
from simtest.runtime import processes
from simtest.runtime.boundary import explain, plain, plain_errors
from simtest.runtime.files import write_atomically, write_json
from simtest.runtime.locks import LOCK, exclusive_file, exclusive_folder, is_same, waiting_for
from simtest.surfaces.mesh_file import write_mesh
from simtest.surfaces.model import TriangleMesh
from simtest.validation import runner
from studies.bad_inputs import files
from tests.refusals import refused

pytestmark = pytest.mark.filterwarnings("ignore:Cyclopts application invoked without tokens")

MAIN = "from simtest.cli.main import main; main()"


def no_room(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


def entered(context):
    with context:
        pass


def is_held(lock):
    with lock.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_a_folder_in_use_is_refused_with_its_process(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["/bin/simtest", "validate", "my experiment"])
    folder = tmp_path / "a" / "out"
    with exclusive_folder(folder):
        assert is_held(folder / LOCK)
        told = f"--out {folder}: is in use by process {os.getpid()} (simtest validate 'my experiment', since 20"
        refused(lambda: entered(exclusive_folder(folder)), told, "; wait until it ends, or name another")
        (folder / "results").touch()
    assert [path.name for path in folder.iterdir()] == ["results"]
    entered(exclusive_folder(folder))


def test_what_stays_empty_is_removed(tmp_path):
    with pytest.raises(InputError, match="stop"), exclusive_folder(tmp_path / "a" / "b"):
        raise InputError("stop")
    assert list(tmp_path.iterdir()) == []
    # A folder that was there stays.
    (tmp_path / "c").mkdir()
    entered(exclusive_folder(tmp_path / "c"))
    assert [path.name for path in tmp_path.iterdir()] == ["c"]


@pytest.mark.parametrize("held", [b"", json.dumps({"process": 1, "machine": "x"}).encode(), b"\xff" * 9])
def test_a_lock_left_behind_locks_nothing(tmp_path, held):
    (tmp_path / LOCK).write_bytes(held)
    entered(exclusive_folder(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_a_lock_of_a_killed_process_is_stale(tmp_path):
    code = "import sys, time\nfrom pathlib import Path\nfrom simtest.runtime.locks import exclusive_folder\n"
    code += "with exclusive_folder(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
    child = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline() == "held\n"
    refused(lambda: entered(exclusive_folder(tmp_path)), f"is in use by process {child.pid} (-c ")
    child.kill()
    child.communicate()
    assert (tmp_path / LOCK).is_file()
    entered(exclusive_folder(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_a_lock_file_that_was_replaced_is_another_one(tmp_path):
    path = tmp_path / LOCK
    with path.open("wb") as file:
        assert is_same(path, file)
        path.rename(tmp_path / "old")
        assert not is_same(path, file)
        path.touch()
        assert not is_same(path, file)


def test_a_lock_of_another_machine_is_named(tmp_path, monkeypatch):
    with exclusive_file(tmp_path / "m.ply"):
        monkeypatch.setattr(socket, "gethostname", lambda: "elsewhere")
        refused(lambda: entered(exclusive_file(tmp_path / "m.ply")), f"process {os.getpid()} on ", "--out ")
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    (tmp_path / LOCK).symlink_to(tmp_path / "mine.txt")
    refused(lambda: plain_errors(entered)(exclusive_folder(tmp_path)), f"{tmp_path}: Too many levels of symbolic links")
    assert (tmp_path / "mine.txt").read_text() == "mine"
    (tmp_path / "b").mkdir()
    os.mkfifo(tmp_path / "b" / LOCK)
    refused(lambda: plain_errors(entered)(exclusive_folder(tmp_path / "b")), f"{tmp_path / 'b'}: ", "not seekable")


def permission_denied(monkeypatch, denied):
    """Let `os.open` deny what a function of its flags says: the superuser is denied nothing."""
    opened = os.open

    def checked(path, flags, *mode, **options):
        if str(path).endswith(LOCK) and denied(flags):
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, flags, *mode, **options)

    monkeypatch.setattr(os, "open", checked)


def test_a_lock_of_another_user_holds(tmp_path, monkeypatch):
    with exclusive_folder(tmp_path):
        permission_denied(monkeypatch, lambda flags: flags & os.O_RDWR)
        refused(lambda: entered(exclusive_folder(tmp_path)), f"is in use by process {os.getpid()} (")
        monkeypatch.undo()
    # One that was left behind is taken: it keeps others out, and its own text stays.
    (tmp_path / LOCK).write_bytes(b"left behind")
    permission_denied(monkeypatch, lambda flags: flags & os.O_RDWR)
    with exclusive_folder(tmp_path):
        assert is_held(tmp_path / LOCK)
        assert (tmp_path / LOCK).read_bytes() == b"left behind"
    assert list(tmp_path.iterdir()) == []


def test_a_lock_of_another_user_that_cannot_be_read_is_refused(tmp_path, monkeypatch):
    (tmp_path / LOCK).touch()
    permission_denied(monkeypatch, lambda flags: True)
    refused(lambda: plain_errors(entered)(exclusive_folder(tmp_path)), ".lock is another user's", "remove it")
    # Where nothing can be written nobody writes.
    monkeypatch.setattr(os, "access", lambda *_: False)
    entered(exclusive_folder(tmp_path))


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_refuses_nobody(tmp_path, monkeypatch, number):
    def without(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", without)
    entered(exclusive_folder(tmp_path / "a"))
    entered(exclusive_file(tmp_path / "m.ply"))
    assert list(tmp_path.iterdir()) == []
    number = errno.ENOTDIR
    refused(lambda: plain_errors(entered)(exclusive_folder(tmp_path)), "Not a directory")
    # A disk that fails is no bad input: exit 1 in place of 2.
    number = errno.EIO
    with pytest.raises(SimtestError, match="Input/output error") as caught:
        plain_errors(entered)(exclusive_folder(tmp_path))
    assert not isinstance(caught.value, InputError)


def test_a_file_in_place_of_a_folder_is_refused_with_its_option(tmp_path):
    (tmp_path / "bank").touch()
    refused(lambda: entered(exclusive_folder(tmp_path / "bank", "--bank")), f"--bank {tmp_path / 'bank'}: is a file")


# Signals ----------------------------------------------------------------------------------------------------------


def test_termination_is_answered_as_ctrl_c_is():
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT)
    presses = []
    try:
        with Termination() as stop:
            signal.signal(signal.SIGINT, lambda *_: presses.append("press"))
            signal.raise_signal(signal.SIGTERM)
            assert (presses, stop.came) == (["press"], True)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) == before[0]
    finally:
        signal.signal(signal.SIGINT, before[1])


def command(folder, *arguments, **options):
    return subprocess.Popen([sys.executable, "-c", MAIN, *arguments], cwd=folder, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, **options)  # fmt: skip


@pytest.mark.slow
@pytest.mark.render
def test_a_second_run_is_refused_and_sigterm_ends_the_first(tmp_path):
    given = ("dataset", "tiny", "--samples", "400", "--set", "samples_per_anatomy=10", "--workers", "2", "--out", "d")
    first = command(tmp_path, *given)
    while not list((tmp_path).glob("d/*.part")) and first.poll() is None:
        time.sleep(0.05)
    second = command(tmp_path, *given)
    _, errors = second.communicate(timeout=300)
    assert second.returncode == 2
    assert errors.startswith(f"simtest: --out d: is in use by process {first.pid} (")
    first.send_signal(signal.SIGTERM)
    _, errors = first.communicate(timeout=300)
    assert first.returncode == 143
    assert errors.splitlines()[-1].startswith("simtest: terminated; what is finished is kept")
    assert not (tmp_path / "d" / LOCK).exists()


# Disk and memory --------------------------------------------------------------------------------------------------


def test_a_disk_that_is_full_is_named_with_file_and_room(tmp_path):
    with pytest.raises(OSError, match="No space left") as error:
        write_atomically(tmp_path / "results.parquet", no_room)
    said = explain(error.value)
    assert said.startswith(f"{tmp_path / 'results.parquet'}: No space left on device; ")
    assert f"MB are free on the disk of {tmp_path}" in said
    assert list(tmp_path.iterdir()) == []


def test_a_limit_of_the_system_is_named(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with pytest.raises(OSError, match="File too large") as error:
            write_json(tmp_path / "x.json", ["x" * 2000])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert explain(error.value) == (
        f"{tmp_path / 'x.json'}: File too large; the system limits the size of a file (ulimit -f)"
    )


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("Unable to allocate 9 GiB"), "not enough memory (Unable to allocate 9 GiB); smaller frames"),
        (PermissionError(13, "Permission denied", "a.png"), "a.png: Permission denied"),
        (RecursionError("maximum recursion depth exceeded"), "a value is nested too deeply"),
        (RuntimeError("write failed: (os error 28)"), "write failed: (os error 28)"),
        (OSError(36, "File name too long", "n" * 500), "n: File name too long"),
        (ZeroDivisionError("division by zero"), None),
        (OSError("no number"), None),
    ],
)
def test_errors_of_the_machine_are_told_from_faults(error, said):
    found = explain(error)
    assert (found is None) == (said is None)
    assert said is None or said in found


# Each command -----------------------------------------------------------------------------------------------------

FOLDERS = {
    "render": ("render", "plane", "--out", "held"),
    "export": ("export", "plane", "--out", "held"),
    "views": ("views", "anatomy", "--count", "1", "--out", "held"),
    "validate": ("validate", "overview", "--out", "held"),
    "dataset": ("dataset", "tiny", "--out", "held"),
    "reconstruct": ("reconstruct", "a.png", "--fov", "60", "--out", "held"),
    "reconstruct a folder": ("reconstruct", "frames", "--fov", "60", "--out", "held"),
    "twin": ("twin", "a.png", "--fov", "60", "--out", "held"),
    "realism": ("realism", "a.png", "--against", "plane", "--out", "held"),
    "fit's bank": ("fit", "a.png", "--recipe", "tiny", "--scene", "plane", "--bank", "held", "--out", "x.toml"),
}
FILES = {
    "fit": ("fit", "a.png", "--recipe", "tiny", "--scene", "plane", "--out", "held.toml"),
    "mesh": ("mesh", "colon", "--out", "held.ply"),
    "view": ("view", "plane", "--screenshot", "held.png"),
    "camera": ("camera", "convert", "c.toml", "--out", "held.toml"),
    "preview": ("dataset", "preview", "nothing", "--out", "held.html"),
    "nightly": ("nightly", "--profile", "quick", "--reports", "."),
}


@pytest.fixture
def run_here(tmp_path, here):
    """Run commands in a folder with some pictures; return exit code and lines of the error stream."""
    (tmp_path / "frames").mkdir()
    for path in (tmp_path / "a.png", tmp_path / "frames" / "a.png"):
        path.write_bytes(files.encoded(".png"))
    return lambda *arguments: here(*arguments)[::2]


@pytest.mark.parametrize("name", [*FOLDERS, *FILES])
def test_each_command_is_refused_what_is_in_use(tmp_path, run_here, name):
    words = (FOLDERS | FILES)[name]
    held = {"nightly": "quick", "fit's bank": "held"}.get(name, words[-1])
    with (exclusive_folder if name in FOLDERS else exclusive_file)(tmp_path / held):
        code, lines = run_here(*words)
    assert (code, len(lines)) == (2, 1)
    assert name not in FOLDERS or lines[0].startswith(f"simtest: {'--bank' if 'bank' in name else '--out'} held: ")
    assert f" {held}: is in use by process {os.getpid()} (" in lines[0]
    assert {path.name for path in tmp_path.iterdir()} == {"frames", "a.png"}


@pytest.mark.parametrize("name", [name for name in FILES if name != "nightly"])
def test_each_command_refuses_a_file_in_a_missing_folder_in_the_same_words(tmp_path, run_here, name):
    *words, held = FILES[name]
    code, lines = run_here(*words, f"nowhere/{held}")
    assert (code, lines) == (2, [f"simtest: {words[-1]} nowhere/{held}: no such folder nowhere"])
    assert {path.name for path in tmp_path.iterdir()} == {"frames", "a.png"}


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EACCES])
def test_full_disks_end_every_command_alike(tmp_path, number):
    error = OSError(number, os.strerror(number), str(tmp_path / "out" / "x.png"))
    raised = plain(error, "what is written stays")
    # Another folder would do where a permission is missing; the exit codes are 2 and 1.
    assert type(raised) is (InputError if number == errno.EACCES else SimtestError)
    assert str(raised).startswith(f"{tmp_path / 'out' / 'x.png'}: {os.strerror(number)}")
    assert str(raised).endswith("; what is written stays")


def test_a_public_function_raises_one_line_and_hides_no_fault():
    @plain_errors
    def opened(path):
        """Open it."""
        return open(path) if path else 1 / 0

    assert opened.__doc__ == "Open it."
    with pytest.raises(InputError, match=r"^nowhere/a: No such file or directory$"):
        opened("nowhere/a")
    with pytest.raises(ZeroDivisionError):
        opened("")


def test_a_full_disk_beside_an_output_file_names_that_file(tmp_path, monkeypatch):
    def full(part, data):
        raise OSError(28, "No space left on device", str(part))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    mesh = TriangleMesh(np.eye(4, 3), np.array([[0, 1, 2], [0, 1, 3]]), np.eye(4, 3))
    with pytest.raises(OSError, match=r"No space left on device") as error:
        write_mesh(tmp_path / "x.stl", mesh)
    assert explain(error.value).startswith(f"{tmp_path / 'x.stl'}: No space left on device; ")


def test_errors_of_files_elsewhere_do_not_blame_the_folder(tmp_path, monkeypatch):
    def missing(*_):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "some-core")

    monkeypatch.setattr(runner, "run_experiment", missing)
    with pytest.raises(SimtestError) as error:
        simtest.validate("overview", tmp_path / "out")
    assert str(error.value).startswith("some-core: No such file or directory; ")
    assert "--out" not in str(error.value)


@pytest.mark.filterwarnings("ignore:no calibration")
def test_a_full_disk_is_exit_1(tmp_path, run_here, monkeypatch):
    monkeypatch.setattr("simtest.reconstruction.outputs.write_json", no_room)
    code, lines = run_here("reconstruct", "a.png", "--fov", "60", "--out", "out")
    assert code == 1
    assert lines[-1] == "simtest: No space left on device"


def test_a_full_disk_during_a_run_says_what_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "run_experiment", no_room)
    with pytest.raises(SimtestError) as error:
        simtest.validate("overview", tmp_path / "out")
    assert str(error.value).startswith(f"{tmp_path / 'out'}: No space left on device; ")
    assert "MB are free on the disk of" in str(error.value)
    assert "; what is finished is kept" in str(error.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("raised", "kind", "said"),
    [
        (OSError(28, "No space left on device"), OSError, "[Errno 28] No space left on device"),
        (MemoryError(), SimtestError, "not enough memory; "),
        (KeyError("x"), SimtestError, "a worker failed (KeyError"),
    ],
)
def test_a_worker_says_what_the_machine_lacks(raised, kind, said):
    def task(*_):
        raise raised

    state, error = processes._answer(None, task, None)
    assert state == "error"
    assert type(error) is kind
    assert str(error).startswith(said)


def test_another_user_s_lock_can_be_waited_for(tmp_path, monkeypatch):
    """It is opened to read alone; `touch` would be denied."""
    lock = tmp_path / LOCK
    lock.write_bytes(b"left behind")
    permission_denied(monkeypatch, lambda flags: flags & os.O_RDWR)
    with waiting_for(lock) as file:
        assert not file.writable()
        assert is_held(lock)
    assert not is_held(lock)
    monkeypatch.undo()
    with waiting_for(lock) as file:
        assert file.writable()


def test_where_there_are_no_locks_nobody_waits(tmp_path, monkeypatch):
    def without(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", without)
    with waiting_for(tmp_path / "x.part") as file:
        file.write(b"data")
