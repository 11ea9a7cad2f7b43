"""Bad files for every command that reads one, and command lines that make no sense.

What a key of a model may hold is tested from the models' schemas (tests/unit/test_model_inputs.py). Here is what that
cannot reach: things that are no plain file, damaged bytes, input that asks for too much, folders that cannot be.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from studies.bad_inputs import files
from studies.bad_inputs.files import Content
from studies.bad_inputs.run import Case, Wanted

PICTURE = files.encoded(".png")
SUFFIXES = (".png", ".jpg", ".tif", ".webp", ".bmp")


@dataclass(frozen=True)
class Reader:
    """A command that reads a file.

    `command`: arguments, one of them the file's name or a folder of it; `file`: the file's name, below the folder
    of the case; `good`: A good file; `beside`: other files that it needs; `wanted`: what comes of the good file;
    `REFUSED` where that takes too long or is a verdict of its own; `damaged`: how many damaged copies are tried,
    each as bytes and, of a text, as words. A damaged file may still be good, and is then worked on: those of
    commands that take long are broken at their end; `slow`: whether a good file takes long.
    """

    command: str
    file: str
    good: bytes | str
    beside: Mapping[str, Content] = field(default_factory=dict)
    wanted: Wanted = Wanted.REFUSED
    damaged: int = 6
    slow: bool = False

    def line(self, name: str | None = None) -> tuple[str, ...]:
        """Return the command's words, with another name of the file."""
        return tuple(name if name is not None and word == self.file else word for word in self.command.split(" "))

    def held(self, content: Content) -> dict[str, Content]:
        """Return the files of a case in which the file has other content."""
        return {**self.beside, self.file: content}


def _reconstruct(option: str, file: str, good: bytes | str, wanted: Wanted = Wanted.DONE, **beside: Content) -> Reader:
    view = "" if option == "--camera" else "--fov 60 "
    held = {"frame.png": PICTURE} | {name.replace("__", "."): content for name, content in beside.items()}
    return Reader(f"reconstruct frame.png {view}{option} {file} --out out", file, good, held, wanted)


CAMERAS: dict[str, bytes | str] = {
    "toml": files.CAMERA, "yaml": files.OPENCV_YAML, "yml": files.ROS_YAML, "xml": files.OPENCV_XML,
    "json": files.OPENCV_JSON, "mat": files.matlab(),
}  # fmt: skip
DEPTHS = {"npy": files.npy(files.depth()), "exr": files.exr(files.depth()), "tif": files.encoded(".tif", files.depth())}
MESHES: dict[str, bytes | str] = {"ply": files.ply(), "obj": files.obj(), "stl": files.stl(), "vtk": files.vtk()}

TOML = {
    "render": Reader("render x.toml --out out", "x.toml", files.SCENE, wanted=Wanted.DONE),
    "export": Reader("export x.toml --out out", "x.toml", files.SCENE, wanted=Wanted.DONE),
    "views": Reader("views x.toml --out out", "x.toml", files.SCENE, slow=True),
    "view": Reader("view x.toml --screenshot out.png", "x.toml", files.SCENE, slow=True),
    "validate": Reader("validate x.toml --out out", "x.toml", files.EXPERIMENT, wanted=Wanted.DONE, slow=True),
    "dataset": Reader("dataset x.toml --out out", "x.toml", files.DATASET, wanted=Wanted.DONE, slow=True),
    "nightly": Reader("nightly --profile x.toml --reports out", "x.toml", files.PROFILE, slow=True),
    "mesh colon": Reader("mesh colon --recipe x.toml --out out.ply", "x.toml", files.COLON),
    "mesh liver": Reader("mesh liver --recipe x.toml --out out.ply", "x.toml", files.LIVER),
    "fit": Reader("fit p.png --recipe x.toml --out out.toml", "x.toml", files.DATASET, {"p.png": PICTURE}, slow=True),
}
MANIFEST = {
    f"dataset {verb}, manifest": Reader(f"dataset {verb} d{rest}", "d/manifest.json", "{", damaged=0)
    for verb, rest in (("verify", ""), ("preview", ""), ("sample", " 0"))
}
READERS = {
    **TOML,
    **{f"reconstruct, picture {suffix}": Reader(f"reconstruct x{suffix} --fov 60 --out out", f"x{suffix}",
                                                files.encoded(suffix), wanted=Wanted.DONE) for suffix in SUFFIXES},
    "reconstruct, film": Reader("reconstruct x.avi --fov 60 --out out", "x.avi",
                                b"RIFF\x10\0\0\0AVI LIST" + bytes(200)),
    **{f"camera .{suffix}": _reconstruct("--camera", f"c.{suffix}", good) for suffix, good in CAMERAS.items()},
    "calibration": _reconstruct("--camera", "c.toml", files.CALIBRATION),
    **{f"{option} .{suffix}": _reconstruct(option, f"d.{suffix}", good)
       for option in ("--depth", "--reference") for suffix, good in DEPTHS.items()},
    "pose": _reconstruct("--reference m.ply --camera-from-model", "p.toml", files.POSE, m__ply=files.ply()),
    # A tetrahedron is too coarse for highlights, which is a verdict: exit code 1.
    **{f"mesh check: .{suffix}": Reader(f"mesh check m.{suffix}", f"m.{suffix}", good)
       for suffix, good in MESHES.items()},
    **MANIFEST,
    "dataset, manifest": Reader("dataset x.toml --out d", "d/manifest.json", "{", {"x.toml": files.DATASET}, damaged=0),
    "nightly, baseline": Reader("nightly --profile x.toml --reports out", "out/baseline/x/run.json", "{",
                                {"x.toml": files.PROFILE}, damaged=0),
    "nightly accept": Reader("nightly accept --reason x --reports out", "out/nightly/quick/run.json", "{", damaged=0),
    "realism": Reader("realism x.png --against plane --out out", "x.png", PICTURE, damaged=0),
    "fit, frames": Reader("fit x.png --recipe tiny --scene plane --out o.toml", "x.png", PICTURE, damaged=0),
}  # fmt: skip
"""By the start of the cases' names."""


def cases() -> Iterator[Case]:
    """Yield all cases; no two have one name."""
    for number, (name, reader) in enumerate(READERS.items()):
        yield from _files(name, reader, number)
    for name, reader in TOML.items():
        yield from _tables(name, reader)
    yield from _strange_files()
    yield from _too_much()
    yield from _folders()
    yield from _values()
    yield from _commands()


def _files(name: str, reader: Reader, number: int) -> Iterator[Case]:
    """Yield the good file, what is no plain file, a missing one, and damaged copies."""
    if reader.wanted is Wanted.DONE:
        yield Case(f"{name}: good", reader.line(), reader.held(reader.good), Wanted.DONE)
    for what, content in files.no_files(reader.good):
        yield Case(f"{name}: {what}", reader.line(), reader.held(content))
    if reader.file in reader.line():
        yield Case(f"{name}: missing", reader.line("no such name"), reader.beside, says="no such name")
        yield Case(f"{name}: name too long", reader.line("n" * 5000), reader.beside, says="nnn")
    end = "\n]" if reader.slow else ""
    for i, data in enumerate(files.damaged(reader.good, 100 + number, reader.damaged)):
        yield Case(f"{name}: damaged {i}", reader.line(), reader.held(data + end.encode()), Wanted.ORDERLY)
    if isinstance(reader.good, str):
        for i, text in enumerate(files.damaged_words(reader.good, 200 + number, reader.damaged)):
            yield Case(f"{name}: strange words {i}", reader.line(), reader.held(text + end), Wanted.ORDERLY)


def _tables(name: str, reader: Reader) -> Iterator[Case]:
    """Yield files that are no TOML, or strange TOML."""
    spoilt = {
        "not TOML": "distance = = 3",
        "a table twice": f"{reader.good}\n[a]\n[a]\n",
        "a key twice": f"q = 1\nq = 2\n{reader.good}",
        "unknown key": f"speed = 3\n{reader.good}",
        "unknown table": f"{reader.good}\n[speed]\nx = 1\n",
        "nested deeply": f"{reader.good}\nx = " + "[" * 50_000,
        "nested tables": f"{reader.good}\n[" + ".".join("a" * 3000) + "]\n",
        "5000 digits": f"q = {'9' * 5000}\n{reader.good}",
        "a long key": f"{'k' * 5000} = 1\n{reader.good}",
        "a line break in a key": f'"a\\nb" = 1\n{reader.good}',
        "an escape in a key": f'"\\u001b[31mred" = 1\n{reader.good}',
        "2 MB": f"{reader.good}{'#' * 2_000_000}",
    }
    for what, text in spoilt.items():
        yield Case(f"{name}: {what}", reader.line(), reader.held(text), says="x.toml")


def _strange_files() -> Iterator[Case]:
    """Yield files that a parser may trip over: nested, growing, with sizes that no file has, or that leave a folder."""
    laughs = "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
    laughs = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">{laughs}]>'
    header = b"\x93NUMPY\x01\0v\0" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (9000000000, 9000), }".ljust(
        118
    )
    exr = DEPTHS["exr"]
    at = exr.index(b"dataWindow")
    ply, vtk = files.ply(), files.vtk()
    entry = {"bytes": 5, "sha256": "0" * 64}
    plane = {"name": "x", "families": [{"scene": "plane"}]}
    strange: dict[str, dict[str, Content]] = {
        "camera .toml": {"nested deeply": "a = " + "[" * 50_000, "principal point far": f"{files.CAMERA}cx = 5000.0\n",
                         "mask of nothing": f"{files.CAMERA}view_mask = {{radius = 1, cx = 9e5}}\n"},
        "camera .yaml": {"nested deeply": "[" * 50_000, "4 rows": files.OPENCV_YAML.replace("rows: 3", "rows: 4"),
                         "an alias": files.OPENCV_YAML.replace("dt: d", "dt: &a d", 1),
                         "an object": f'{files.OPENCV_YAML}x: !!python/object/apply:os.system ["true"]\n'},
        "camera .json": {"nested deeply": "[" * 50_000},
        "camera .xml": {"nested deeply": "<a>" * 50_000,
                        "grows": f"{laughs}<opencv_storage><image_width>&j;</image_width></opencv_storage>"},
        "camera .mat": {"K of structs": files.matlab(K={"a": 1}), "K of text": files.matlab(K="K")},
        "--depth .npy": {"324 TB": header, "turned": files.npy(files.depth().T),
                         "NaN": files.npy(np.full((48, 64), np.nan))},
        "--depth .exr": {"large": exr[: at + 29] + b"\xff\xff\xff\x7f" * 2 + exr[at + 37 :]},
        "pose": {"far": files.POSE.replace("40", "1e300"), "mirrored": files.POSE.replace("[[1,", "[[-1,"),
                 "ragged": "matrix = [[1], [2, 3]]", "zero": f"matrix = {[[0] * 4] * 4}"},
        "mesh check: .ply": {"9e9 faces": ply.replace("face 4", "face 9000000000"),
                             "9e9 vertices": ply.replace("vertex 4", "vertex 9000000000"),
                             "400 million vertices": ply.replace("vertex 4", "vertex 400000000"),
                             "a face of vertex 9": files.ply(sides=[(3, 1, 2), (0, 1, 9)]),
                             "a negative vertex": files.ply(sides=[(0, 1, -2), *files.SIDES]),
                             "no list": ply.replace("property list uchar int vertex_indices", "property int a"),
                             "NaN": files.ply(((0, 0, 0), ("nan", 0, 0), (0, 40, 0), (0, 0, 40))),
                             "flat": files.ply([(0, 0, 0)] * 4),
                             "binary": ply.replace("ascii", "binary_little_endian")},
        "mesh check: .vtk": {"9e9 points": vtk.replace("POINTS 4", "POINTS 9000000000"),
                             "9e9 cells": vtk.replace("POLYGONS 4", "POLYGONS 9000000000"),
                             "a cell of vertex 99": vtk.replace("3 0 2 1", "3 0 2 99"),
                             "a cell of 1e9 corners": vtk.replace("\n3 0 2 1", "\n999999999 0 2 1")},
        "mesh check: .stl": {"4e9 faces": files.stl()[:80] + b"\xff" * 4 + files.stl()[84:]},
        "mesh check: .obj": {"no such vertex": "v 0 0 0\nf 1 2 3\n", "vertices alone": "v 0 0 0\n",
                             "includes": f"mtllib /etc/passwd\n{files.obj()}f 9 9 9\n",
                             "large": files.sparse("v 0 0 0\n" * 600, 390_000_000)},
        **{name: {"another digest": _manifest("0" * 64), "a list": "[]", "shards a list": _manifest(shards=[]),
                  "leaves": _manifest(shards={"../../up": entry}), "absolute": _manifest(shards={"/etc/passwd": entry}),
                  "a missing shard": _manifest(dataset=plane, shards={"a.tar": entry}),
                  "nested deeply": "[" * 100_000, "1e12 samples": _manifest(dataset={**plane, "samples": 10**12}),
                  "families of nothing": _manifest(dataset={"name": "x", "families": [{"scene": "nowhere"}]})}
           for name in MANIFEST},
        "nightly": {"unknown label": files.PROFILE.replace('"plane"', '"pluto"'),
                    "1e7 realisations": files.PROFILE.replace("= 1", "= 10000000")},
    }  # fmt: skip
    for name, contents in strange.items():
        for what, content in contents.items():
            yield Case(f"{name}: strange, {what}", READERS[name].line(), READERS[name].held(content))


def _manifest(digest: str | None = None, **changed: object) -> str:
    named = ("dataset", "origin", "environment", "shards", "tables")
    content = {"format": "simtest dataset, version 2", "complete": True, **{name: {} for name in named}, **changed}
    own = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps({**content, "digest": digest or own})


GROUP = '[[groups]]\nscene = "plane"\n'
LONG = ", ".join(map(str, range(1, 90_001)))
SWEPT = {"surface.tilt_deg": 1, "reflectance.exponent": 40, "surface.distance_mm": 1}
SWEEPS = [f'{{ "{key}" = {[round(low + i / 1000, 3) for i in range(433)]} }}' for key, low in SWEPT.items()]

EXPERIMENTS = {
    "81 million settings": f"sweep = [{', '.join(SWEEPS)}]",
    "90,000 values of a sweep": f'sweep = [{{ "reflectance.exponent" = [{LONG}] }}]',
    "90,000 pooled values": f'pool = [{{ "reflectance.exponent" = [{LONG}] }}]',
    "1e6 realisations of 1e5 settings": f"realisations = 1000000\nsweep = [{', '.join(SWEEPS[:2])}]",
    "sweep of tables": 'sweep = [{ "surface" = [{ type = "cone" }] }]',
    "sweep of dates": 'sweep = [{ "surface.tilt_deg" = [1979-05-27] }]',
    "a deep key": 'set = { "' + "a." * 3000 + 'b" = 1 }',
}
SETTINGS = (
    "camera.width=65500", "camera.width=16384 camera.height=16384", "render.samples_per_pixel=100000",
    "camera.width=4000 camera.height=4000 render.samples_per_pixel=4096", "render.path_depth=1000000",
    "sensor.noise_sigma=1e300", "reflectance.exponent=1e300", "rig.lights.0.position_mm=[0,0,1e9]",
    "camera.distortion={type='brown_conrady',k1=-100}", "rig.lights=[" + "{}," * 2000 + "]",
    "surface.relief={bands=[" + "{slope_deg=4,wavelength_mm=1}," * 2000 + "]}", "rig.lights.0.power=inf",
    "surface.distance_mm", "=3", "surface..x=1", "a\nb", ".".join("a" * 3000) + "=1", "x=" + "[" * 50_000,
    "rig.lights.99.power=1", "rig.lights.-1.power=1", "surface.distance_mm=" + "9" * 4400,
    "surface.relief=" + "{a=" * 900 + "1" + "}" * 900,
)  # fmt: skip


def _too_much() -> Iterator[Case]:
    """Yield input that asks for more than any machine has, or settings that no parser should follow."""
    for what, text in EXPERIMENTS.items():
        yield Case(f"validate: {what}", TOML["validate"].line(), {"x.toml": GROUP + text})
    for setting in SETTINGS:
        shown = setting.encode("unicode_escape").decode()[:40]
        words = [word for part in setting.split(" ") for word in ("--set", part)]
        for name in ("render", "dataset"):
            reader = TOML[name]
            yield Case(f"{name}: --set {shown} ({len(setting)})", (*reader.line(), *words), reader.held(reader.good))
    huge = ((10000, 9999), (65500, 1), (1, 65500), (65500, 1000), (20000, 20000), (2**31 - 1, 1), (2**31 - 1,) * 2)
    for width, height in (*huge, (0, 0)):
        made: Content = partial(_write_png, width=width, height=height)
        line = READERS["reconstruct, picture .png"].line()
        yield Case(f"reconstruct: picture of {width} x {height} px", line, {"x.png": made}, says="x.png")
    for kind, suffix in (("GIF", "gif"), ("PNG", "png"), ("WEBP", "webp"), ("TIFF", "tif")):
        held = {f"x.{suffix}": files.animated(kind, sizes=kind == "TIFF")}
        line = ("reconstruct", f"x.{suffix}", "--fov", "60", "--out", "out")
        yield Case(f"reconstruct: animated {kind}", line, held, Wanted.ORDERLY)


def _write_png(path: Path, width: int, height: int) -> None:
    """Write a PNG of any size; one that takes too long to compress has a header alone."""
    path.write_bytes(files.png(width, height, b"" if width * height > 4 * 10**8 or not width else None))


OUTS: tuple[tuple[str, str, dict[str, Content]], ...] = (
    ("nothing", "", {}),
    ("a file", "out", {"out": "mine"}),
    ("below a file", "f/out", {"f": "mine"}),
    ("FIFO", "pipe", {"pipe": files.fifo}),
    ("below a device", "/dev/null/out", {}),
    ("in /proc", "/proc/out", {}),
    ("name too long", "n" * 300, {}),
    ("path too long", "/".join(["n" * 200] * 30), {}),
    ("link to itself", "l", {"l": files.loop}),
)
"""Folders for results that cannot be: name, path, and what stands there."""


def _folders() -> Iterator[Case]:
    """Yield folders that cannot be written to or read, or in which something else stands where a run's files should."""
    writers = {**TOML, "reconstruct": READERS["reconstruct, picture .png"]}
    for name, reader in writers.items():
        for what, out, made in OUTS:
            # A file is what `mesh`, `fit` and `view` write.
            if not (name.startswith(("mesh", "fit", "view")) and name != "views" and what in ("a file", "FIFO")):
                yield Case(f"{name}: --out, {what}", (*reader.line()[:-1], out), reader.held(reader.good) | made)
    many: Content = partial(_many_files, count=3000)
    others: dict[str, dict[str, Content]] = {
        "other things": {"out/notes.txt": "mine", "out/.hidden": "mine"}, "3000 files": {"out": many},
        "no files": {"out/a": files.fifo, "out/b": files.sparse(), "out/c": files.endless},
    }  # fmt: skip
    for name in ("validate", "dataset"):
        for what, made in others.items():
            held = TOML[name].held(TOML[name].good) | made
            yield Case(f"{name}: --out, a folder of {what}", TOML[name].line(), held, says="out")
    folders: dict[str, dict[str, Content]] = {
        "empty": {"d": files.folder}, "text": {"d/a.txt": "a"}, "a file": {"d": "x"}, "FIFO": {"d": files.fifo},
        "broken pictures": {"d/a.png": b"no", "d/b.png": PICTURE[:200], "d/c.png": b""},
        "no files": {"d/a.png": files.fifo, "d/b.png": files.sparse(PICTURE), "d/c.png": files.endless},
    }  # fmt: skip
    for command in ("reconstruct d --fov 60 --out out", "dataset verify d", "dataset preview d",
                    "realism d --against plane --out out", "fit d --recipe tiny --scene plane --out o.toml",
                    ):  # fmt: skip
        for what, made in folders.items():
            yield Case(f"{command.split(' --')[0]}: folder, {what}", tuple(command.split(" ")), made)
    frames = Reader("reconstruct d --fov 60 --out out", "d/a.png", PICTURE)
    for name, reader, own in (
        ("validate: summary", TOML["validate"], "out/summary.json"),
        ("validate: results", TOML["validate"], "out/results.parquet"),
        ("validate: fingerprint", TOML["validate"], "out/parts/fingerprint.json"),
        ("validate: lock", TOML["validate"], "out/.lock"),
        ("dataset: lock", TOML["dataset"], "out/.lock"),
        ("reconstruct: run", frames, "out/run.json"),
        ("reconstruct: frame", frames, "out/frames/000000.json"),
    ):
        for what, content in (("FIFO", files.fifo), ("endless", files.endless), ("6 GB", files.sparse("{")),
                              ("folder", files.folder), ("nested", "[" * 100_000)):  # fmt: skip
            held = reader.held(reader.good) | {own: content}
            yield Case(f"{name}, {what}", reader.line(), held, Wanted.ORDERLY)


def _many_files(path: Path, count: int) -> None:
    path.mkdir()
    for i in range(count):
        (path / f"{i}.txt").touch()


OPTIONS: dict[str, dict[str, tuple[str, ...]]] = {
    "validate": {"--realisations": ("0", "2.5", "x", "1e9", "9" * 20), "--seed": ("-1", "x", "9" * 30),
                 "--workers": ("0", "257", "x"), "--engine": ("mpi", ""), "--variant": ("magic", ""),
                 "--estimator": ("magic", "", "x" * 3000), "--address": ("nowhere:1",)},
    "dataset": {"--seed": ("-1", "x", "9" * 30), "--workers": ("0", "257", "x"), "--engine": ("mpi", "")},
    "nightly": {"--workers": ("0", "257", "x"), "--engine": ("mpi", ""), "--variant": ("magic", "")},
    "views": {"--count": ("0", "1001", "-1", "x"), "--along": ("", "0", "0.8,0.2", "nan,nan", "a,b", "0,inf")},
    "render": {"--variant": ("magic", "scalar_rgb; rm", "", "\u202e")},
    "mesh check: .ply": {"--distance": ("0", "nan", "inf", "x"), "--exponent": ("0", "inf", "1e300"),
                         "--roughness": ("0", "nan", "2"), "--kind": ("gut", "")},
    "mesh liver": {"--seed": ("-1", "x", "9" * 40), "--edge-mm": ("0", "nan", "inf", "1e-300", "1e300", "x")},
    "reconstruct, picture .png": {
        "--fov": ("0", "180", "nan", "inf", "1e-300", "179.9999999", "x", ""),
        "--roi": ("1,2,3", "0,0,65,48", "0,0,0,0", "a,b,c,d", "", "9" * 400 + ",0,1,1", "0,0,inf,1", "\u00b2,0,1,1"),
        "--smoothing": ("-1", "nan", "inf", "1e9", "x"), "--detector": ("magic", "", "a:b", "os:system"),
        "--estimator": ("magic", "", "a:b", "../x", "x" * 3000, "simtest.estimators.cone_axis"),
        "--depth": ("inf", "nan", "-1", "0", "1e300", "1e-300", "x", ""), "--encoding": ("rec709", ""),
        "--target": ("top", ""), "--speed": ("3",),
    },
    "realism": {"--count": ("0", "-1", "x", "99999999999"), "--surface": ("x",)},
    "fit, frames": {"--size": ("0", "-1", "x", "99999999999")},
}  # fmt: skip


def _values() -> Iterator[Case]:
    """Yield options whose value makes no sense."""
    for name, options in OPTIONS.items():
        reader = READERS[name]
        for option, values in options.items():
            for value in values:
                # Beside another camera, `--fov` would be refused for being the second.
                words = tuple(word for word in reader.line() if option != "--fov" or word not in ("--fov", "60"))
                shown = f"{name}: {option} {value[:20]!a} ({len(value)})"
                yield Case(shown, (*words, option, value), reader.held(reader.good))
    for out in ("m.xyz", "m", "m.vtk", ".", "nowhere/m.ply", "n" * 300 + ".ply", "/proc/m.ply"):
        yield Case(f"mesh colon: --out {out[:20]}", ("mesh", "colon", "--out", out), says=out[:20])


COMMANDS = (
    "magic", "render", "reconstruct", "validate", "mesh magic", "nightly magic", "schema lamp", "doctor --speed",
    "view", "export plane", "--speed", "render plane plane --out out", "dataset magic", "render plane --out",
    "validate overview --realisations", "views plane --out out", "fit", "realism", "\u00e9", "\n", "x" * 100_000,
    "view plane --screenshot x.gif", "view plane --screenshot nowhere/x.png", "mesh colon --curvature --out m.obj",
    "nightly accept --reason x --reports out", "nightly accept --reason x --profile weekly",
    "realism a.png --against nowhere --out out", "dataset verify nowhere", "dataset sample d -1",
)  # fmt: skip


def _commands() -> Iterator[Case]:
    """Yield command lines that no command takes."""
    for line in COMMANDS:
        shown = line.encode("unicode_escape").decode()[:60]
        yield Case(f"command: {shown}", tuple(line.split(" ")), {"a.png": PICTURE})
    picture, camera = {"frame.png": PICTURE}, {"c.toml": files.CAMERA}
    yield Case("reconstruct: no camera", ("reconstruct", "frame.png", "--out", "out"), picture)
    twice = ("reconstruct", "frame.png", "--fov", "60", "--camera", "c.toml", "--out", "out")
    yield Case("reconstruct: camera twice", twice, {**picture, **camera})
    for name in ("render", "validate", "dataset"):
        yield Case(f"{name}: a name that is no UTF-8", TOML[name].line("\udcff.toml"), {"x.toml": TOML[name].good})
