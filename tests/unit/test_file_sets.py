"""Files that belong together: no reader finds some of an earlier result beside some of a new one."""

import errno
import os

import pytest

from simtest import reconstruct, render
from simtest.reconstruction.outputs import write_outputs
from simtest.runtime.files import write_json, written_together
from simtest.spec import load_scene

NAMES = ("a.json", "b.json", "c.json")


def write(folder, value):
    with written_together(folder, NAMES) as new:
        for name in NAMES:
            write_json(new / name, value)


def held(folder):
    return {path.name: path.read_text().strip() for path in folder.iterdir()}


@pytest.fixture
def stops_at(monkeypatch):
    """Let the n-th call of one of the system's functions fail."""

    def arm(function, count, error):
        calls = iter(range(count + 1))
        real = getattr(os, function)

        def counted(*given, **more):
            if next(calls, None) == count:
                raise error
            return real(*given, **more)

        monkeypatch.setattr(os, function, counted)

    return arm


@pytest.mark.parametrize("file", range(3))
def test_a_full_disk_leaves_the_earlier_files(tmp_path, monkeypatch, file):
    write(tmp_path, 1)
    synced, real = iter(range(4)), os.fsync

    def full(descriptor):
        if next(synced) == file:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as caught:
        write(tmp_path, 2)
    assert caught.value.filename == str(tmp_path / NAMES[file])
    assert held(tmp_path) == dict.fromkeys(NAMES, "1")


@pytest.mark.parametrize("step", range(3, 6))
def test_a_kill_between_two_files_leaves_no_old_one(tmp_path, stops_at, step):
    """The first three renames are those of the files within their own folder."""
    write(tmp_path, 1)
    stops_at("replace", step, KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, 2)
    assert held(tmp_path) == dict.fromkeys(NAMES[: step - 3], "2")


def test_what_is_not_written_anew_goes(tmp_path):
    write(tmp_path, 1)
    with written_together(tmp_path, NAMES) as new:
        write_json(new / "b.json", 2)
    assert held(tmp_path) == {"b.json": "2"}


def test_frames_and_reconstructions_are_such_sets(tmp_path, stops_at):
    """What a frame's render or a reconstruction leaves when it ends at its first new file is no whole result."""
    frame = render(load_scene("plane", {"camera.width": 96, "camera.height": 72}))
    out = tmp_path / "out"
    frame.write(out)
    found = reconstruct(frame.image, frame.calibration)
    write_outputs(out, found, frame.image)
    for write_again, last in (
        (frame.write, "truth.npz"),
        (lambda out: write_outputs(out, found, frame.image), "index.html"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "replace", _after_the_first_move(os.replace, out))
            with pytest.raises(KeyboardInterrupt):
                write_again(out)
        assert not (out / last).exists()


def _after_the_first_move(real, out):
    moved = []

    def replace(source, target):
        if os.path.dirname(target) == str(out) and moved:
            raise KeyboardInterrupt
        moved.extend([target] if os.path.dirname(target) == str(out) else [])
        return real(source, target)

    return replace
