"""Stops and odd surroundings: signals at any moment, workers, terminals, readers that have gone, disks, odd files."""

import errno
import importlib
import io
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import platformdirs
import pytest

from simtest.cli.common import named_path
from simtest.cli.main import INTERRUPTED, TERMINATED, Termination, _mend_terminal, main
from simtest.cli.progress import stop_between_steps
from simtest.errors import InputError, SimtestError
from simtest.geometry import Camera
from simtest.reconstruction import reconstruct
from simtest.reconstruction.images import is_coloured
from simtest.rendering import bitmap
from simtest.runtime.arrays import cache_folder
from simtest.runtime.files import make_folder, user_cache
from simtest.runtime.processes import make_engine
from simtest.runtime.stops import breakable
from simtest.simulation import views
from simtest.spec import load_calibration, load_scene
from simtest.spec.sensor import Sensor
from simtest.surfaces.mesh_file import read_mesh
from tests.refusals import refused
from tests.unit.engine_tasks import threads

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


def test_a_stop_within_the_building_of_a_model_waits_for_its_end():
    done = script("""
        import signal, time
        from pydantic import BaseModel, ConfigDict
        from pydantic_core import core_schema
        from simtest.cli.main import Termination

        class Slow:
            @classmethod
            def __get_pydantic_core_schema__(cls, *_):
                signal.raise_signal(signal.SIGTERM)
                return core_schema.any_schema()

        class Held(BaseModel):
            model_config = ConfigDict(defer_build=True)
            slow: Slow

        try:
            with Termination():
                Held(slow=1)
                time.sleep(5)
                print("not stopped")
        except KeyboardInterrupt:
            Held(slow=1)
            print("stopped")
    """)
    assert (done.stdout, done.stderr) == ("stopped\n", "")


@pytest.mark.parametrize("after", ["SIGALRM", "SIGTERM"])
def test_a_stop_as_soon_as_signals_are_answered_is_one_line(after):
    done = script(f"""
        import signal, sys
        from simtest.cli.main import main
        answer = signal.signal

        def answered_at_once(number, answerer):
            before = answer(number, answerer)
            if number == signal.{after}:
                signal.raise_signal(signal.SIGTERM)
            return before

        signal.signal, sys.argv = answered_at_once, ["simtest", "schema"]
        main()
    """)
    # Before SIGTERM is answered the system ends the process.
    ends = (-signal.SIGTERM, "") if after == "SIGALRM" else (TERMINATED, "simtest: terminated")
    assert (done.returncode, done.stderr.partition(";")[0]) == ends


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


@pytest.mark.parametrize("command", [pytest.param("schema scene", marks=pytest.mark.ci), "list"])
def test_a_reader_that_has_gone_is_no_error(command):
    done = shell(f"$SIMTEST {command} | true; echo ${{PIPESTATUS[0]}}")
    assert (done.stdout, done.stderr) == ("0\n", "")


def test_a_closed_output_is_no_error():
    done = shell("$SIMTEST schema scene >&-")
    assert (done.returncode, done.stderr) == (0, "")


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


ROOT = Path(__file__).resolve().parents[2]
BLOCKED = """
import signal
from simtest.runtime.processes import make_engine
from tests.unit.engine_tasks import blocked_signals

if __name__ == "__main__":
    made = dict(make_engine(workers=2).run(blocked_signals, [0, 1], lambda: None))
    print(all({signal.SIGINT, signal.SIGTERM} <= set(each) for each in made.values()), signal.SIGINT in
          signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""


def test_no_worker_is_broken_into_while_it_starts(tmp_path):
    # In a process of its own: the first worker of a process starts multiprocessing's tracker, which lifts masks.
    path = tmp_path / "blocked.py"
    path.write_text(f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{BLOCKED}")
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=120, check=True)
    # Blocked in the workers, and no longer here.
    assert done.stdout.split() == ["True", "False"], done.stderr


def test_each_worker_has_its_share_of_the_cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    ((_, told),) = make_engine(workers=2).run(threads, [0], lambda: None)
    # A single task has all of them.
    assert told == ("6", "6", 6)
    shares = dict(make_engine(workers=2).run(threads, [0, 1], lambda: None))
    assert set(shares.values()) == {("3", "3", 3)}


Y, X = np.mgrid[:120, :160]


def grey_sphere():
    """A grey picture with a highlight, its channels apart by up to two codes, as coded films have it."""
    grey = 0.3 + 0.6 * np.exp(-((X - 80) ** 2 + (Y - 60) ** 2) / 200)
    apart = np.random.default_rng(0).integers(-1, 2, (*grey.shape, 3))
    return (np.rint(255 * grey)[..., None] + apart).clip(0, 255).astype(np.float32) / 255


def test_a_terminal_without_the_characters_gets_others(monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    _mend_terminal()
    print("± deg", flush=True)
    assert written.getvalue() == b"? deg\n"


@pytest.mark.parametrize(("columns", "left"), [("1", None), ("20", "20"), ("wide", "wide")])
def test_a_terminal_too_narrow_for_tables_counts_as_one_of_no_stated_width(monkeypatch, columns, left):
    monkeypatch.setenv("COLUMNS", columns)
    _mend_terminal()
    assert os.environ.get("COLUMNS") == left


def test_a_name_that_is_no_utf8_is_refused():
    with pytest.raises(ValueError, match=r"is no UTF-8 name: 'o\\udcff'"):
        named_path(None, [SimpleNamespace(value="o\udcff")])


def test_a_user_without_a_home_keeps_nothing(monkeypatch):
    def homeless(_):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.setattr(platformdirs, "user_cache_dir", homeless)
    monkeypatch.delenv("SIMTEST_CACHE", raising=False)
    assert user_cache() is None
    assert cache_folder() is None


def test_coded_grey_is_grey():
    assert not is_coloured(grey_sphere())
    tissue = grey_sphere() * np.float32([1.0, 0.6, 0.5])
    assert is_coloured(tissue)


def test_grey_by_colour_warns_of_nothing():
    # Warnings are errors here.
    grey = np.repeat(grey_sphere()[..., :1], 3, axis=2)
    assert reconstruct(grey, Camera.from_fov(60.0, 160, 120), detector="colour", encoding="srgb") == []


def test_a_mark_of_the_encoding_is_read_over(tmp_path):
    for name, text in (
        ("scene.toml", 'surface.type = "plane"\n'),
        ("camera.toml", "[camera]\nwidth = 64\nheight = 48\n"),
    ):
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert load_scene(tmp_path / "scene.toml").surface.type == "plane"
    with pytest.raises(InputError, match=r"camera\.toml: fx: missing"):
        load_calibration(tmp_path / "camera.toml")


def test_a_mesh_most_of_whose_faces_have_no_area_is_damaged(tmp_path):
    corners = "v 0 0 0\nv 90 0 0\nv 0 90 0\nv 0 0 90\n"
    faces = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "m.obj").write_text(corners + faces + "f 1 1 1\n" * 5)
    with pytest.raises(InputError, match=r"m\.obj: 4 of 9 faces have an area: it is damaged or cut short"):
        read_mesh(tmp_path / "m.obj")


@pytest.mark.render
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EFBIG])
def test_an_image_that_cannot_be_written_whole_names_the_cause(tmp_path, monkeypatch, number):
    path = tmp_path / "o.exr"

    class Stream:
        def Bitmap(self, _):
            return self

        def write(self, name):
            raise RuntimeError(f'[FileStream] "{name}": I/O error while writing: {os.strerror(number)}')

    monkeypatch.setattr(bitmap, "mi", Stream())
    with pytest.raises(OSError, match=os.strerror(number)) as error:
        bitmap.write_exr(path, np.ones((4, 4), np.float32))
    assert (error.value.errno, error.value.filename) == (number, str(path))
