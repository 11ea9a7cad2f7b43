"""Odd surroundings: terminals, names, homes, and files as other programs write them."""

import errno
import io
import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import platformdirs
import pytest

from simtest.cli.common import named_path
from simtest.cli.main import _mend_terminal
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.reconstruction import reconstruct
from simtest.reconstruction.images import is_coloured
from simtest.rendering import bitmap
from simtest.runtime.arrays import cache_folder
from simtest.runtime.files import user_cache
from simtest.spec import load_calibration, load_scene
from simtest.surfaces.mesh_file import read_mesh

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


@pytest.mark.parametrize(("columns", "left"), [("0", None), ("1", None), ("20", "20"), ("wide", "wide")])
def test_a_terminal_too_narrow_for_tables_counts_as_one_of_no_stated_width(monkeypatch, columns, left):
    monkeypatch.setenv("COLUMNS", columns)
    _mend_terminal()
    import os

    assert os.environ.get("COLUMNS") == left


def test_a_closed_output_is_no_error():
    command = f"{sys.executable} -m simtest schema scene >&-"
    done = subprocess.run(["/bin/sh", "-c", command], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


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
    made = reconstruct(
        np.repeat(grey_sphere()[..., :1], 3, axis=2),
        Camera.from_fov(60.0, 160, 120),
        detector="colour",
        encoding="srgb",
    )
    assert made == []


def test_a_mark_of_the_encoding_is_read_over(tmp_path):
    for name, text in (
        ("scene.toml", 'surface.type = "plane"\n'),
        ("camera.toml", "[camera]\nwidth = 64\nheight = 48\n"),
    ):
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + text.encode())
    assert load_scene(tmp_path / "scene.toml").surface.type == "plane"
    with pytest.raises(InputError, match=r"camera\.toml: fx: missing"):
        load_calibration(tmp_path / "camera.toml")


def test_a_light_a_kilometre_away_is_refused(tmp_path):
    (tmp_path / "c.toml").write_text(
        "[camera]\nwidth = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 32.0\ncy = 24.0\n"
        "[rig]\nlights_mm = [[0, 0, 1e6]]\n"
    )
    with pytest.raises(InputError, match=r"rig\.lights_mm.*1000"):
        load_calibration(tmp_path / "c.toml")


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
