"""Bad meshes, dataset folders, reports, frame sets, and command lines."""

import hashlib
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from studies.bad_inputs import files
from studies.bad_inputs.case import Case, Content, Wanted
from studies.bad_inputs.spec_cases import READERS

GOOD_MESHES: dict[str, bytes | str] = {
    "ply": files.ply(),
    "obj": files.obj(),
    "stl": files.stl(),
    "vtk": files.vtk(),
}


def cases() -> Iterator[Case]:
    """Yield all of these cases."""
    yield from _meshes()
    yield from _mesh_options()
    yield from _datasets()
    yield from _reports()
    yield from _frames()
    yield from _strangers()
    yield from _commands()


def _meshes() -> Iterator[Case]:
    for number, (suffix, good) in enumerate(GOOD_MESHES.items()):
        line = ("mesh", "check", f"m.{suffix}")
        # A tetrahedron is too coarse for highlights, which is a verdict: exit code 1.
        yield Case(f"mesh check: good .{suffix}", line, {f"m.{suffix}": good}, says="edge")
        for what, content in files.no_files(good):
            yield Case(f"mesh check: {what} .{suffix}", line, {f"m.{suffix}": content}, says=f"m.{suffix}")
        for i, data in enumerate(files.damaged(good, 500 + number, 10)):
            yield Case(f"mesh check: damaged .{suffix} {i}", line, {f"m.{suffix}": data}, Wanted.ORDERLY)
        if isinstance(good, str):
            for i, text in enumerate(files.damaged_words(good, 520 + number, 8)):
                yield Case(f"mesh check: strange words .{suffix} {i}", line, {f"m.{suffix}": text}, Wanted.ORDERLY)
    ply, far = files.ply(), [(3, 1, 2), (0, 1, 9)]
    spoilt = {
        "9e9 faces": ply.replace("face 4", "face 9000000000"),
        "9e9 vertices": ply.replace("vertex 4", "vertex 9000000000"),
        "400 million vertices": ply.replace("vertex 4", "vertex 400000000"),
        "no faces": ply.replace("face 4", "face 0"),
        "a face of vertex 9": files.ply(sides=[*files.SIDES[:2], *far]),
        "no header": ply.split("end_header\n")[1],
        "a negative vertex": files.ply(sides=[(0, 1, -2), *files.SIDES]),
        "lines cut": ply[:-14],
        "3 corners": ply.replace("\n3 0", "\n1 0"),
        "infinite": files.ply(((0, 0, 0), ("inf", 0, 0), (0, 40, 0), (0, 0, 40))),
        "in metres": files.ply([[v / 1e6 for v in c] for c in files.CORNERS]),
        "flat": files.ply([(0, 0, 0)] * 4),
        "NaN": files.ply(((0, 0, 0), ("nan", 0, 0), (0, 40, 0), (0, 0, 40))),
        "text": ply.replace("40 0 0", "a b c"),
        "no such type": ply.replace("float x", "text x"),
        "no x": ply.replace("float x", "float q"),
        "no list": ply.replace("property list uchar int vertex_indices", "property int a"),
        "of 1e300": files.ply([[v * 1e300 for v in c] for c in files.CORNERS]),
        "binary that is text": ply.replace("ascii", "binary_little_endian"),
    }
    for name, text in spoilt.items():
        yield Case(f"mesh check: {name}", ("mesh", "check", "m.ply"), {"m.ply": text}, says="m.ply")
        scene = files.SCENE.replace('type = "plane"\ndistance_mm = 10.0', 'type = "anatomy"\npath = "m.ply"')
        if name in ("9e9 faces", "a face of vertex 9", "NaN", "no list"):
            yield Case(f"render: mesh, {name}", READERS["render"][1], {"x.toml": scene, "m.ply": text}, says="m.ply")
    vtk = files.vtk()
    for name, text in {
        "9e9 points": vtk.replace("POINTS 4", "POINTS 9000000000"),
        "a grid": vtk.replace("POLYDATA", "STRUCTURED_POINTS"),
        "9e9 cells": vtk.replace("POLYGONS 4", "POLYGONS 9000000000"),
        "a cell of vertex 99": vtk.replace("3 0 2 1", "3 0 2 99"),
        "sizes wrong": vtk.replace("4 16", "4 99999"),
        "a cell of 1e9 corners": vtk.replace("\n3 0 2 1", "\n999999999 0 2 1"),
    }.items():
        yield Case(f"mesh check: .vtk, {name}", ("mesh", "check", "m.vtk"), {"m.vtk": text}, says="m.vtk")
    stl = files.stl()
    yield Case("mesh check: .stl, 4e9 faces", ("mesh", "check", "m.stl"), {"m.stl": stl[:80] + b"\xff" * 4 + stl[84:]})
    obj = {
        "no such vertex": "v 0 0 0\nf 1 2 3\n",
        "a face of text": "v 0 0 0\nf a b c\n",
        "vertices alone": "v 0 0 0\n",
        "a vertex of 2": files.obj().replace("40 0 0", "40 0"),
        "includes": "mtllib /etc/passwd\n" + files.obj() + "f 9 9 9\n",
    }
    for name, text in obj.items():
        yield Case(f"mesh check: .obj, {name}", ("mesh", "check", "m.obj"), {"m.obj": text}, says="m.obj")


def _mesh_options() -> Iterator[Case]:
    for option, values in {
        "--distance": ("0", "-1", "nan", "inf", "1e9", "x"),
        "--exponent": ("0", "-1", "nan", "inf", "1e300"),
        "--roughness": ("0", "-1", "nan", "inf", "2"),
        "--kind": ("gut", ""),
    }.items():
        for value in values:
            yield Case(
                f"mesh check: {option} {value}", ("mesh", "check", "m.ply", option, value), {"m.ply": files.ply()}
            )
    yield Case(
        "mesh check: exponent and roughness",
        ("mesh", "check", "m.ply", "--exponent", "9", "--roughness", "0.1"),
        {"m.ply": files.ply()},
    )
    for out in ("m.xyz", "m", "m.vtk", ".", "nowhere/m.ply", "", "n" * 300 + ".ply", "/proc/m.ply"):
        yield Case(f"mesh colon: --out {out[:20]}", ("mesh", "colon", "--out", out), says=out[:20] or "--out")
    yield Case("mesh colon: curvature of .obj", ("mesh", "colon", "--curvature", "--out", "m.obj"))
    for seed in ("-1", "x", "1.5", "9" * 40):
        yield Case(f"mesh liver: --seed {seed[:20]}", ("mesh", "liver", "--seed", seed, "--out", "m.ply"))


def _manifest(digest: str | None = None, **changed: Any) -> str:
    content = {
        "format": "simtest dataset, version 2",
        "complete": True,
        "dataset": {},
        "origin": {},
        "environment": {},
        "shards": {},
        "tables": {},
        **changed,
    }
    own = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return json.dumps({**content, "digest": digest or own})


def _datasets() -> Iterator[Case]:
    entry = {"bytes": 5, "sha256": "0" * 64}
    manifests: dict[str, Content] = {
        "another digest": _manifest("0" * 64),
        "no JSON": "{",
        "a list": "[]",
        "a number": "5",
        "another format": _manifest(format="x"),
        "shards a list": _manifest(shards=[]),
        "leaves": _manifest(shards={"../../up": entry}),
        "absolute": _manifest(shards={"/etc/passwd": entry}),
        "bytes a text": _manifest(shards={"a.tar": {"bytes": "5"}}),
        "dataset a text": _manifest(dataset="x"),
        "empty dataset": _manifest(),
        "NaN": _manifest(dataset={"samples": float("nan")}),
        "no samples": _manifest(dataset={"name": "x", "samples": 0, "families": []}),
        "a missing shard": _manifest(dataset={"name": "x", "families": [{"scene": "plane"}]}, shards={"a.tar": entry}),
        "families of nothing": _manifest(dataset={"name": "x", "families": [{"scene": "nowhere"}]}),
        "nested deeply": "[" * 100_000,
        "1e12 samples": _manifest(dataset={"name": "x", "samples": 10**12, "families": [{"scene": "plane"}]}),
        "100 million samples": _manifest(dataset={"name": "x", "samples": 10**8, "families": [{"scene": "plane"}]}),
        "origin of text": _manifest(origin={"versions": "x"}),
    }
    for name, text in manifests.items():
        held = {"d/manifest.json": text}
        yield Case(f"dataset verify: {name}", ("dataset", "verify", "d"), held)
        yield Case(f"dataset preview: {name}", ("dataset", "preview", "d"), held)
        yield Case(f"dataset sample: {name}", ("dataset", "sample", "d", "0"), held)
    for what, content in files.no_files("{"):
        yield Case(f"dataset verify: manifest, {what}", ("dataset", "verify", "d"), {"d/manifest.json": content})
        yield Case(f"dataset preview: manifest, {what}", ("dataset", "preview", "d"), {"d/manifest.json": content})
        yield Case(
            f"dataset: manifest, {what}",
            ("dataset", "x.toml", "--out", "d"),
            {"x.toml": files.DATASET, "d/manifest.json": content},
        )
    for command in ("verify", "preview"):
        for name, folder, made in (
            ("missing", "nowhere", {}),
            ("a file", "f", {"f": "x"}),
            ("FIFO", "p", {"p": files.fifo}),
            ("empty", "d", {"d": files.folder}),
            ("nothing", "", {}),
            ("long", "n" * 5000, {}),
        ):
            yield Case(f"dataset {command}: folder, {name}", ("dataset", command, folder), made)
    for index in ("-1", "x", "1.5", "99999999999999999999"):
        yield Case(f"dataset sample: {index}", ("dataset", "sample", "d", index), {"d/manifest.json": _manifest()})
    for count in ("0", "-1", "x"):
        yield Case(
            f"dataset preview: --samples {count}",
            ("dataset", "preview", "d", "--samples", count),
            {"d/manifest.json": _manifest()},
        )


def _reports() -> Iterator[Case]:
    line, good = READERS["nightly"][1], files.PROFILE
    profiles = {
        "no experiments": "experiments = []",
        "twice": good + '[[experiments]]\nexperiment = "overview"\n',
        "unknown experiment": good.replace("overview", "nowhere"),
        "unknown label": good.replace('"plane"', '"pluto"'),
        "unknown estimator": good + 'estimators = ["magic"]\n',
        "no realisations": good.replace("= 1", "= 0"),
        "set out of range": good + 'set = { "camera.width" = 65500 }\n',
        "an experiment that is a FIFO": good.replace("overview", "pipe.toml"),
        "experiments of 1e6 realisations": good.replace("realisations = 1", "realisations = 10000000"),
    }
    for name, text in profiles.items():
        yield Case(f"nightly: {name}", line, {"x.toml": text, "pipe.toml": files.fifo})
    for what, content in files.no_files("{"):
        held = {"x.toml": good, "out/baseline/x/run.json": content}
        yield Case(f"nightly: baseline, {what}", line, held, says="")
        yield Case(
            f"nightly accept: last night, {what}",
            ("nightly", "accept", "--reason", "x", "--reports", "out"),
            {"out/nightly/quick/run.json": content},
        )
    for name, reason in (("nothing", ""), ("spaces", "  "), ("long", "x" * 2000)):
        yield Case(
            f"nightly accept: reason, {name}",
            ("nightly", "accept", "--reason", reason, "--reports", "out"),
            {"out/nightly": files.folder},
        )
    yield Case("nightly accept: no night", ("nightly", "accept", "--reason", "x", "--reports", "out"))
    yield Case("nightly accept: unknown profile", ("nightly", "accept", "--reason", "x", "--profile", "weekly"))


def _strangers() -> Iterator[Case]:
    """Yield cases of folders in which something else stands where a run's own file should."""
    for name, line, text, own in (
        ("validate: summary", READERS["validate"][1], READERS["validate"][0], "out/summary.json"),
        ("validate: results", READERS["validate"][1], READERS["validate"][0], "out/results.parquet"),
        ("validate: fingerprint", READERS["validate"][1], READERS["validate"][0], "out/parts/fingerprint.json"),
        ("validate: lock", READERS["validate"][1], READERS["validate"][0], "out/.lock"),
        ("dataset: lock", READERS["dataset"][1], READERS["dataset"][0], "out/.lock"),
        ("reconstruct: run", ("reconstruct", "d", "--fov", "60", "--out", "out"), "", "out/run.json"),
        ("reconstruct: frame", ("reconstruct", "d", "--fov", "60", "--out", "out"), "", "out/frames/000000.json"),
    ):
        for what, content in (("FIFO", files.fifo), ("endless", files.endless), ("6 GB", files.sparse("{")),
                              ("folder", files.folder), ("nested", "[" * 100_000)):  # fmt: skip
            made = {"x.toml": text, "d/a.png": files.encoded(".png"), own: content}
            yield Case(f"{name}, {what}", line, made, Wanted.ORDERLY)
    header = files.exr(files.depth())
    at = header.index(b"dataWindow")
    large = header[: at + 29] + b"\xff\xff\xff\x7f" * 2 + header[at + 37 :]
    for suffix, content in (("exr", large), ("obj", files.sparse("v 0 0 0\n" * 600, 390_000_000))):
        line = ("mesh", "check", "m.obj") if suffix == "obj" else (
            "reconstruct", "d/a.png", "--fov", "60", "--depth", "m.exr", "--out", "out")  # fmt: skip
        yield Case(f"{line[0]}: large .{suffix}", line, {f"m.{suffix}": content, "d/a.png": files.encoded(".png")})


def _frames() -> Iterator[Case]:
    picture = files.encoded(".png")
    for command, rest in (
        ("realism", ("--against", "plane", "--out", "out")),
        ("fit", ("--recipe", "tiny", "--out", "o.toml")),
    ):
        for what, content in files.no_files(picture):
            yield Case(f"{command}: frames, {what}", (command, "x.png", *rest), {"x.png": content})
        yield Case(f"{command}: frames, missing", (command, "nowhere", *rest))
        yield Case(f"{command}: frames, none", (command, *rest))
        yield Case(f"{command}: frames, empty folder", (command, "d", *rest), {"d": files.folder})
        held = {"a.png": files.png(64, 48), "b.png": files.png(32, 32), "c.png": picture}
        yield Case(
            f"{command}: frames of three sizes", (command, "a.png", "b.png", "c.png", *rest), held, Wanted.ORDERLY
        )
    good = {"a.png": picture, "b.png": picture}
    for name, against in (
        ("missing", "nowhere"),
        ("nothing", ""),
        ("a file of text", "t.txt"),
        ("FIFO", "p"),
        ("long", "n" * 5000),
    ):
        yield Case(
            f"realism: against, {name}",
            ("realism", "a.png", "--against", against, "--out", "out"),
            {**good, "t.txt": "x", "p": files.fifo},
        )
    for count in ("0", "-1", "x", "99999999999"):
        yield Case(
            f"realism: --count {count}",
            ("realism", "a.png", "--against", "plane", "--count", count, "--out", "out"),
            good,
        )
        yield Case(
            f"fit: --size {count}", ("fit", "a.png", "--recipe", "tiny", "--size", count, "--out", "o.toml"), good
        )
    yield Case(
        "realism: an unknown surface",
        ("realism", "a.png", "--against", "plane", "--surface", "x", "--out", "out"),
        good,
    )
    yield Case(
        "realism: a broken dataset",
        ("realism", "a.png", "--against", "d", "--out", "out"),
        {**good, "d/manifest.json": "{"},
    )
    for out in ("", ".", "o.txt", "nowhere/o.toml", "n" * 300 + ".toml"):
        yield Case(f"fit: --out {out[:20]}", ("fit", "a.png", "--recipe", "tiny", "--out", out), good)


def _commands() -> Iterator[Case]:
    lines: tuple[tuple[str, ...], ...] = (
        ("magic",),
        ("render",),
        ("reconstruct",),
        ("validate",),
        ("dataset",),
        ("mesh",),
        ("nightly", "magic"),
        ("schema", "lamp"),
        ("schema", ""),
        ("doctor", "--speed"),
        ("view",),
        ("export", "plane"),
        ("--speed",),
        ("render", "plane", "plane", "--out", "out"),
        ("dataset", "magic"),
        ("mesh", "kidney"),
        ("", ""),
        ("\n",),
        ("render", "plane", "--out"),
        ("validate", "overview", "--realisations"),
        ("views", "plane", "--out", "out"),
        ("fit",),
        ("realism",),
        ("é",),
        ("x" * 100_000,),
        ("view", "plane", "--screenshot", ""),
        ("view", "plane", "--screenshot", "x.gif"),
        ("view", "plane", "--screenshot", "nowhere/x.png"),
    )
    for line in lines:
        name = " ".join(line).encode("unicode_escape").decode()[:50]
        yield Case(
            f"command: {name or '(nothing)'}",
            line,
            wanted=Wanted.ORDERLY if line in (("dataset",), ("mesh",)) else Wanted.REFUSED,
        )
    for name in ("render", "validate", "dataset"):
        text, line = READERS[name]
        yield Case(
            f"{name}: a name that is no UTF-8",
            tuple("\udcff.toml" if w == "x.toml" else w for w in line),
            {"x.toml": text},
        )
    big: Content = partial(_many_files, count=3000)
    for name in ("validate", "dataset"):
        text, line = READERS[name]
        yield Case(f"{name}: --out, 3000 other files", line, {"x.toml": text, "out": big}, says="out")


def _many_files(path: Path, count: int) -> None:
    path.mkdir()
    for i in range(count):
        (path / f"{i}.txt").touch()
