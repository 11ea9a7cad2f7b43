"""Stops and broken surroundings: signals at any moment, readers that have gone, full disks, deleted folders."""

import errno
import importlib
import os
import signal
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import numpy as np
import pytest

from simtest.cli.main import INTERRUPTED, TERMINATED, Termination, main
from simtest.cli.progress import stop_between_steps
from simtest.errors import InputError, SimtestError
from simtest.runtime.boundary import plain
from simtest.runtime.files import make_folder
from simtest.runtime.stops import breakable
from simtest.simulation import views
from simtest.spec.sensor import Sensor
from tests.refusals import refused

MAIN = "from simtest.cli.main import main; main()"


def script(code, *arguments, **options):
    return subprocess.run([sys.executable, "-c", textwrap.dedent(code), *arguments], capture_output=True, text=True,
                          timeout=60, check=False, **options)  # fmt: skip


def shell(line, folder=None):
    environment = {**os.environ, "SIMTEST": f"{sys.executable} -m simtest"}
    return subprocess.run(
        ["/bin/bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=60, check=False, env=environment
    )


# Signals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("number", "came"), [("SIGTERM", True), ("SIGINT", False)])
def test_a_stop_within_an_import_waits_for_its_end(tmp_path, number, came):
    (tmp_path / "broken_off.py").write_text(
        f"import signal\ntry:\n    signal.raise_signal(signal.{number})\n    x = sum(range(10**5))\n"
        "except KeyboardInterrupt:\n    print('swallowed')\nprint('imported')\n"
    )
    done = script(f"""
        import signal, sys, time
        from simtest.cli.main import Termination
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.path.insert(0, {str(tmp_path)!r})
        try:
            with Termination() as stop:
                import broken_off
                time.sleep(5)
                print("not stopped")
        except KeyboardInterrupt:
            print("stopped", stop.came)
    """)
    assert (done.stdout.split(), done.stderr) == (["imported", "stopped", str(came)], "")


def test_a_stop_while_the_command_is_loaded_is_one_line():
    process = subprocess.Popen([sys.executable, "-X", "importtime", "-c", MAIN, "schema"], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)  # fmt: skip
    told = []
    # The module that answers signals; nothing heavy is loaded yet.
    for line in process.stderr:
        told.append(line)
        if line.rstrip().endswith("| simtest.cli.main"):
            process.send_signal(signal.SIGTERM)
            break
    output, rest = process.communicate(timeout=60)
    # Before main() begins nobody answers, and the system ends the process.
    assert process.returncode in (TERMINATED, -signal.SIGTERM)
    assert output == ""
    lines = [line for line in (*told, *rest.splitlines()) if not line.startswith("import time:")]
    assert [line.partition(";")[0] for line in lines] in ([], ["simtest: terminated"])


# The output ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [pytest.param("schema scene", marks=pytest.mark.ci), "list", "doctor --help"])
def test_a_reader_that_has_gone_is_no_error(command):
    done = shell(f"$SIMTEST {command} | true; echo ${{PIPESTATUS[0]}}")
    assert (done.stdout, done.stderr) == ("0\n", "")


def test_a_reader_of_a_table_that_has_gone_is_no_error(tmp_path):
    (tmp_path / "table.py").write_text(
        "import sys\nfrom simtest.cli import common, main, scenes\ncommon.MOST_ROWS = 10**6\n"
        "scenes.names_of = lambda _: common.Table(('a',), [['x']] * 5000).print() or {}\n"
        "sys.argv = ['simtest', 'list']\nmain.main()\n"
    )
    done = shell(f"{sys.executable} {tmp_path}/table.py | true; echo ${{PIPESTATUS[0]}}")
    assert (done.stdout, done.stderr) == ("0\n", "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("command", [pytest.param("schema scene", marks=pytest.mark.ci), "list scenes"])
def test_an_output_that_is_full_is_told(command):
    done = shell(f"$SIMTEST {command} >/dev/full")
    assert done.returncode == 1
    assert done.stderr == "simtest: the output cannot be written (No space left on device)\n"


# Folders and disks -----------------------------------------------------------------------------------------------


def test_a_link_that_leads_nowhere_is_told(tmp_path):
    out = tmp_path / "out"
    out.symlink_to(tmp_path / "nothing")
    refused(lambda: make_folder(out), f"--out {out}: is a link to {tmp_path / 'nothing'}, which does not exist")
    (tmp_path / "nothing").mkdir()
    make_folder(out)


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG])
def test_what_the_disk_cannot_do_is_told_from_what_the_user_may_change(number):
    error = plain(OSError(number, os.strerror(number), "x.png"))
    assert type(error) is SimtestError
    assert str(error).startswith(f"x.png: {os.strerror(number)}")
    assert isinstance(plain(OSError(errno.EACCES, "Permission denied", "x.png")), InputError)


def saved_calibration(path):
    from simtest import Calibration, Camera, save_calibration

    save_calibration(Calibration(Camera.from_fov(60.0, 64, 48)), path)


def saved_camera(path):
    from simtest import Camera, save_camera

    save_camera(Camera.from_fov(60.0, 64, 48), path)


@pytest.mark.parametrize("save", [saved_calibration, saved_camera])
def test_files_that_are_saved_tell_a_full_disk(tmp_path, monkeypatch, save):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for write in ("write_text", "write_bytes"):
        monkeypatch.setattr(f"pathlib.Path.{write}", full)
    with pytest.raises(SimtestError, match=r"c\.toml: No space left on device; ") as caught:
        save(tmp_path / "c.toml")
    assert not isinstance(caught.value, InputError)


def test_a_wrong_variable_is_bad_input(monkeypatch, capfd, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SIMTEST_VARIANT", "lvm")
    for line in ("render plane --out x", "doctor", "validate overview --out x"):
        monkeypatch.setattr(sys, "argv", ["simtest", *line.split()])
        with pytest.raises(SystemExit) as stop:
            main()
        errors = capfd.readouterr().err
        assert stop.value.code == 2, line
        assert "SIMTEST_VARIANT 'lvm': cannot be used; allowed: llvm, cuda, " in errors
        assert "(did you mean llvm?)" in errors
    assert list(tmp_path.iterdir()) == []


def test_standard_input_is_a_pipe(tmp_path):
    for command in ("reconstruct /dev/stdin --fov 60", "render /dev/stdin", "realism /dev/stdin --against plane"):
        done = shell(f"cat /dev/null | $SIMTEST {command} --out {tmp_path}/x")
        assert done.returncode == 2
        assert done.stderr.startswith("simtest: /dev/stdin: is no plain file but a pipe or a device (write it")
        assert done.stderr.count("/dev/stdin") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_stopped_film_leaves_no_half_of_it(tmp_path, monkeypatch):
    """The list of an earlier call's views goes too, since their pictures have gone."""

    def stopped(scene, count, viewpoints, variant, progress, rate, write):
        view = SimpleNamespace(
            scene=SimpleNamespace(sensor=Sensor()), frame=lambda seed: np.zeros((48, 64, 3), np.float32)
        )
        write(None, view)
        assert {path.suffix for path in tmp_path.iterdir()} == {".avi", ".png"}
        raise KeyboardInterrupt

    monkeypatch.setattr(views, "sample_views", stopped)
    (tmp_path / "views.json").write_text("{}")
    with pytest.raises(KeyboardInterrupt):
        views.sample_into(tmp_path, None, 3, [0.1], None, None, sequence=True)
    assert [path.name for path in tmp_path.iterdir()] == ["view_0000.png"]


def test_a_stop_breaks_into_a_wait_and_else_waits_for_the_end_of_a_step():
    """One that came within a step is raised by the next wait, as by the next check."""
    with stop_between_steps() as check:
        signal.raise_signal(signal.SIGINT)
        for waits in (check, lambda: breakable().__enter__()):
            with pytest.raises(KeyboardInterrupt):
                waits()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    with stop_between_steps() as check:
        check()
        with pytest.raises(KeyboardInterrupt), breakable():
            signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("line", "module", "name", "goes_on"),
    [
        ("twin none.png --fov 60 --out x", "simtest.advice.twin.run", "twin_picture", False),
        ("validate overview --out x", "simtest.api", "validate", True),
    ],
)
def test_a_stop_says_whether_the_same_command_goes_on(here, monkeypatch, tmp_path, line, module, name, goes_on):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(importlib.import_module(module), name, stopped)
    code, output, errors = here(*line.split())
    assert (code, output) == (INTERRUPTED, "")
    told = "goes on from there" if goes_on else "begins anew"
    assert errors[-1] == f"simtest: stopped; what is finished is kept, and the same command {told}"
    assert not list(tmp_path.iterdir())


def test_a_stop_does_not_wait_for_the_end_of_a_long_step(monkeypatch):
    """Making an anatomy took 25 s, and who stops a container kills it after 10."""
    monkeypatch.setattr("simtest.cli.progress.PATIENCE_S", 0.01)
    with Termination(), stop_between_steps():
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.pause()
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
