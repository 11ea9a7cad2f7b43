"""Limits of inputs: refused at once, with what is allowed and how to allow more."""

import os
import signal
import struct
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from simtest.api import sample_views
from simtest.cli.data import fit
from simtest.dataset.manifest import ManifestError, read_manifest
from simtest.dataset.scoring.frames import read_record
from simtest.errors import InputError, SimtestError
from simtest.realism.frames import open_generated
from simtest.reconstruction.images import _tiff_size, read_picture
from simtest.runtime.files import DEFAULTS, VARIABLE, check_limit, limit, require_plain
from simtest.runtime.processes import call_apart, check_workers
from simtest.spec import load_experiment, load_scene
from simtest.spec.toml_files import apply_settings, parse_settings
from simtest.surfaces import mesh_file
from simtest.surfaces.mesh_file import check_ply, read_mesh, read_vtk
from simtest.validation import run_folder
from simtest.validation.cases import check_effort
from simtest.validation.depth_maps import read_depth
from studies.bad_inputs import files
from tests.refusals import refused
from tests.unit.engine_tasks import prints, swallows_memory


@pytest.fixture(autouse=True)
def no_limits_of_ones_own(monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)


def test_the_variable_replaces_limits_by_name(monkeypatch):
    assert limit("mesh_faces") == DEFAULTS["mesh_faces"]
    monkeypatch.setenv(VARIABLE, " mesh_faces = 2e4, picture_pixels=1e9 ,")
    found = (limit("mesh_faces"), limit("picture_pixels"), limit("text_bytes"))
    assert found == (20_000, 10**9, DEFAULTS["text_bytes"])
    check_limit("mesh_faces", 20_000, "x", "faces")
    refused(lambda: check_limit("mesh_faces", 20_001, "x", "faces"), "x: 20001 faces; at most 20000 are allowed (")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("speed=3", "speed: unknown limit; allowed: text_bytes, "),
        ("mesh_faces", "mesh_faces = '': must be a number from 1 on"),
        ("mesh_faces=nan", "mesh_faces = nan: must be a number"),
        ("mesh_faces=1e300", "mesh_faces = 1e300: must be a number"),
    ],
)
def test_a_malformed_variable_is_refused(monkeypatch, text, said):
    monkeypatch.setenv(VARIABLE, text)
    refused(lambda: limit("text_bytes"), f"{VARIABLE}: {said}")


def test_what_is_no_plain_file_is_refused_without_opening_it(tmp_path):
    for name, make, said in (
        ("pipe", files.fifo, "is no plain file"), ("device", files.endless, "is no plain file"),
        ("folder", files.folder, "is a folder"), ("loop", files.loop, "symbolic links"),
        ("nothing", files.dangling, "no such file"), ("sparse", files.sparse(), "bytes; at most 1000000 are allowed"),
    ):  # fmt: skip
        make(tmp_path / name)
        refused(
            lambda path=tmp_path / name: require_plain(path, "text_bytes", "a TOML file"), f"{tmp_path / name}: ", said
        )
    refused(lambda: require_plain(tmp_path / ("n" * 300), "text_bytes", "a TOML file"), "File name too long")


@pytest.mark.parametrize(("width", "height"), [(10_001, 10_000), (65_500, 1)])
def test_large_pictures_are_refused_by_their_header(tmp_path, width, height):
    path = tmp_path / "x.png"
    path.write_bytes(files.png(width, height, b""))
    refused(lambda: read_picture(path), f"x.png: {width} x {height} px: ", " are allowed (SIMTEST_LIMITS=picture_")


def test_tiff_of_pixels_that_pillow_does_not_know_is_refused_by_its_header(tmp_path, monkeypatch):
    path = tmp_path / "x.tif"
    # Three channels of floats: OpenCV reads them, Pillow does not.
    path.write_bytes(files.encoded(".tif", np.zeros((48, 64, 3), np.float32)))
    monkeypatch.setenv(VARIABLE, "picture_pixels=3000")
    refused(lambda: read_picture(path), "x.tif: 64 x 48 px: 3072 px; at most 3000 are allowed")
    monkeypatch.setenv(VARIABLE, "picture_pixels=5000")
    path.write_bytes(files.encoded(".tif", np.zeros((48, 64, 3), np.float64)))
    refused(lambda: read_picture(path), "x.tif: 192 bits a pixel: 6144 times 96 bits; at most 5000 are allowed (")


@pytest.mark.parametrize("order", ["<", ">"])
def test_big_tiff_is_refused_by_its_header(tmp_path, monkeypatch, order):
    # Width, height and three channels of 32 bits: their values stand in the entries, the bits' as 16-bit numbers.
    tags = [(256, 4, 1, struct.pack(order + "L4x", 64)), (257, 4, 1, struct.pack(order + "L4x", 48)),
            (258, 3, 3, struct.pack(order + "3H2x", 32, 32, 32))]  # fmt: skip
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HHHQQ", 43, 8, 0, 16, len(tags))
    path = tmp_path / "x.tif"
    path.write_bytes(head + b"".join(struct.pack(order + "HHQ8s", *tag) for tag in tags) + bytes(8))
    assert _tiff_size(path) == (64, 48, 96)
    monkeypatch.setenv(VARIABLE, "picture_pixels=3000")
    refused(lambda: read_picture(path), "x.tif: 64 x 48 px: 3072 px; at most 3000 are allowed")
    head = struct.pack("<2sHL", b"II", 42, 8)
    path.write_bytes(head + struct.pack("<HHHLHHHHLHHL", 2, 256, 3, 1, 64, 0, 257, 3, 1, 48, 0, 0))
    assert _tiff_size(path) == (64, 48, 1)


def test_a_picture_of_49_megapixels_passes_the_limits_and_one_of_99_does_not(tmp_path):
    path = tmp_path / "x.png"
    path.write_bytes(files.png(7_000, 7_000, b""))
    # What is wrong with it are its missing pixels.
    refused(lambda: read_picture(path), "x.png: no picture (")
    path.write_bytes(files.png(10_000, 9_999, b""))
    refused(lambda: read_picture(path), "picture_pixels")
    sizes = {"mesh_bytes": 248 * 5_000_000, "picture_pixels": 48_000_000}
    for name, size in sizes.items():
        check_limit(name, size, "x", "units")


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: check_workers(257), "workers = 257: must be 1 to 256"),
        (lambda: check_workers(2.0), "workers = 2.0: must be 1 to 256"),
        (lambda: sample_views("anatomy", "out", 1001), "count = 1001: must be 1 to 1000"),
        (
            lambda: fit([Path("a.png")], recipe="tiny", out=Path("x.toml"), size=10_001),
            "--size 10001: must be 1 to 10000",
        ),
        (lambda: open_generated("plane", 0), "--count 0: must be 1 to 10000"),
    ],
)
def test_counts_of_work_are_refused_before_anything_is_written(tmp_path, monkeypatch, call, said):
    monkeypatch.chdir(tmp_path)
    refused(call, said)
    assert list(tmp_path.iterdir()) == []


def test_large_records_are_refused_with_the_limit_s_name(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, "manifest_bytes=3,record_bytes=3")
    for name in ("manifest.json", "export.json"):
        (tmp_path / name).write_text("{   }")
    with pytest.raises(ManifestError, match=rf"manifest.json: 5 bytes; .* \({VARIABLE}=manifest_bytes=N sets another"):
        read_manifest(tmp_path)
    refused(lambda: read_record(tmp_path), f"export.json: 5 bytes; at most 3 are allowed ({VARIABLE}=manifest_bytes=N")
    told = f"manifest.json: 5 bytes; at most 3 are allowed ({VARIABLE}=record_bytes=N sets another limit)"
    refused(lambda: require_plain(tmp_path / "manifest.json", "record_bytes"), told)


@pytest.mark.parametrize(("kind", "suffix"), [("PNG", "png"), ("TIFF", "tif"), ("GIF", "gif")])
def test_of_several_pictures_the_first_is_used_and_it_is_said(tmp_path, kind, suffix):
    path = tmp_path / f"x.{suffix}"
    path.write_bytes(files.animated(kind))
    with pytest.warns(UserWarning, match=rf"x\.{suffix}: holds several pictures; the first is used"):
        read = read_picture(path)
    # The second and third are shifted by 5 and 10 px; coding and a palette change values a little.
    assert np.abs(read * 255 - files.picture()).mean() < 3
    assert np.abs(read * 255 - np.roll(files.picture(), 5, axis=1)).mean() > 5


def test_experiments_of_too_many_settings_are_refused_before_they_are_expanded(tmp_path):
    numbers = ", ".join(map(str, range(1, 434)))
    path = tmp_path / "x.toml"
    keys = ("surface.tilt_deg", "surface.distance_mm", "reflectance.exponent")
    tables = ", ".join(f'{{ "{key}" = [{numbers}] }}' for key in keys)
    path.write_text(f'[[groups]]\nscene = "plane"\nsweep = [{tables}]\n')
    begun = time.process_time()
    refused(lambda: check_effort(load_experiment(path)), "groups.0: 81182737 settings", "at most 10000 are allowed")
    assert time.process_time() - begun < 2
    path.write_text(
        f'[[groups]]\nscene = "plane"\nsweep = [{{ "surface.tilt_deg" = [{", ".join(["1"] * 90_000)}] }}]\n'
    )
    refused(lambda: check_effort(load_experiment(path)), "groups.0.sweep: surface.tilt_deg: 90000 values")
    path.write_text("realisations = 1000000\n" + '[[groups]]\nscene = "plane"\n' * 11)
    refused(lambda: check_effort(load_experiment(path)), "groups.10: 11000000 realisations, up to this group")


def test_frames_of_too_many_pixels_or_rays_are_refused():
    large = {"camera.width": 16_384, "camera.height": 16_384, "camera.fx": 9000.0, "camera.fy": 9000.0}
    refused(lambda: load_scene("plane", large), "camera.height = 16384: 268435456 px; at most 20000000 are allowed")
    long = {"camera.width": 4000, "camera.height": 4000, "camera.fx": 4000.0, "camera.fy": 4000.0,
            "render.samples_per_pixel": 4096}  # fmt: skip
    refused(lambda: load_scene("plane", long), "65536000000 rays a frame; at most 4000000000 are allowed")


def test_what_is_nested_deeply_is_refused():
    deep = ".".join("a" * 33)
    refused(lambda: apply_settings({}, {deep: 1}, "x.toml"), "x.toml: a.a.a", "33 parts; a key path has 32 at most")
    # As a value it is no TOML that is read, and stays text.
    assert isinstance(parse_settings(["x=" + "{a=" * 40 + "1" + "}" * 40])["x"], str)


PLY = files.ply()
MESHES = {
    "9e9 faces": (PLY.replace("face 4", "face 9000000000"), "9000000000 faces; at most 5000000 are allowed: decimate"),
    "faces missing": (PLY[:-20], "holds 4 vertices and 1 faces, but its header announces 4 and 4: it is cut short"),
    "cut short": (PLY.replace("face 4", "face 400"), "bytes follow the header; 4 vertex elements and 400 face"),
    "no x": (PLY.replace("float x", "float q"), "its vertices have no property x"),
    "unknown type": (PLY.replace("float x", "text x"), "header line 'property text x'"),
    "words": (PLY.replace("element vertex 4", "element vertex four"), "must be element NAME COUNT"),
}


@pytest.mark.parametrize("name", MESHES)
def test_ply_files_are_checked_by_their_header(tmp_path, name):
    text, said = MESHES[name]
    path = tmp_path / "m.ply"
    path.write_text(text)
    refused(lambda: read_mesh(path), f"{path}: ", said)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("m.obj", "v 0 0 0\nv 9 0 0\nv 0 9 0\nv 0 0 9\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"),
        ("m.stl", "solid x\n" + "facet normal 0 0 1\nouter loop\nendloop\nENDFACET\n" * 4 + "endsolid x\n"),
    ],
)
def test_large_meshes_of_text_are_searched_for_faces_before_they_are_read(tmp_path, monkeypatch, name, text):
    monkeypatch.setattr(mesh_file, "LARGE_BYTES", 10)
    path = tmp_path / name
    path.write_text(text)
    assert mesh_file._check_file(path, path.suffix) == (0, 0)
    path.write_text(text + "# rubbish\n" * 1000)
    refused(lambda: read_mesh(path), f"{path}: 4 faces in 1", " bytes; must be 2000 bytes a face at most")
    # The words that are counted stand across the pieces too.
    monkeypatch.setenv(VARIABLE, "mesh_faces=299999")
    path.write_text((text.splitlines()[4] + "\n" + "\nf" if name == "m.obj" else "endfacet ") * 300_000)
    refused(lambda: read_mesh(path), "faces; at most 299999 are allowed: decimate the mesh")


def test_lines_of_a_ply_header_end_at_line_feeds_alone(tmp_path):
    path = tmp_path / "m.ply"
    odd = "comment by \u00c5sa\x0b,\x0c,\x1c,\x1d,\x1e,\x85, \u2028\nelement vertex"
    path.write_bytes(PLY.replace("element vertex", odd, 1).encode())
    assert read_mesh(path)[1].shape == (4, 3)
    # Lines of Windows end with a carriage return too.
    path.write_bytes(PLY.replace("\n", "\r\n").encode())
    assert check_ply(path, path.stat().st_size) == (4, 4)


def test_a_vtk_file_that_breaks_vtk_down_is_refused(tmp_path):
    path = tmp_path / "m.vtk"
    path.write_text(files.vtk())
    assert read_vtk(path)[1].shape == (4, 3)
    path.write_text(files.vtk().replace("\n3 0 2 1", "\n999999999 0 2 1"))
    refused(lambda: read_mesh(path), f"{path}: damaged: VTK breaks down")
    path.write_text(files.vtk().replace("POINTS 4", "POINTS 9000000000"))
    refused(lambda: read_mesh(path), "POINTS 9000000000: the file has", "too few for them")


def test_what_the_machine_lacks_is_no_damage_of_a_vtk_file(tmp_path, monkeypatch):
    path = tmp_path / "m.vtk"
    path.write_text(files.vtk())

    def ended(code, said=b""):
        monkeypatch.setattr(subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, code, said))
        with pytest.raises(SimtestError) as error:
            read_mesh(path)
        return error

    killed = ended(-signal.SIGKILL)
    assert str(killed.value) == f"{path}: the reader of a VTK mesh was killed, mostly for want of memory"
    assert killed.type is SimtestError
    assert ended(-signal.SIGSEGV).type is InputError


def test_what_a_process_of_its_own_makes_of_a_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("content")
    assert call_apart(prints, path, 1e9, "text", "damaged") == "content"
    with pytest.raises(SimtestError, match=r"a\.txt: not enough memory") as error:
        call_apart(swallows_memory, path, 1e9, "text", "damaged")
    assert error.type is SimtestError
    refused(lambda: call_apart(prints, tmp_path / "none", 1e9, "text", "damaged"), "none: not a readable text (")


def test_the_first_bytes_of_a_film_tell_its_container(tmp_path):
    from simtest.reconstruction.images import open_source

    path = tmp_path / "x.mp4"
    # FFmpeg would read the list, and whatever it names.
    path.write_text(f"ffconcat version 1.0\nfile {os.devnull}\n")
    refused(lambda: open_source(path), "x.mp4: no video that can be read", "of no known container")


def test_a_fingerprint_that_cannot_be_one_is_not_read(tmp_path):
    record = tmp_path / "parts" / "fingerprint.json"
    record.parent.mkdir()
    files.sparse('"digest"')(record)
    run_folder.prepare(tmp_path, "digest")
    assert record.read_text().strip() == '"digest"'


@pytest.mark.render
def test_an_exr_image_whose_channel_is_called_depth_is_read(tmp_path):
    path = tmp_path / "z.exr"
    path.write_bytes(files.exr(files.depth()))
    np.testing.assert_array_equal(read_depth(path), files.depth().astype(float))
    data = bytearray(path.read_bytes())
    at = data.index(b"dataWindow") + 29
    data[at : at + 8] = b"\xff\xff\xff\x7f" * 2
    path.write_bytes(data)
    refused(
        lambda: read_depth(path), "z.exr: 2147483648 x 2147483648 px: ", "px along a side; at most 16384 are allowed"
    )
