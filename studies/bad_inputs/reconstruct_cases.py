"""Bad pictures, cameras, depth maps, references and options of `reconstruct`."""

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from studies.bad_inputs import files
from studies.bad_inputs.case import Case, Content, Wanted

GOOD = files.encoded(".png")
NAN, INF = float("nan"), float("inf")


def _case(name: str, *options: str, wanted: Wanted = Wanted.REFUSED, says: str = "", **made: Content) -> Case:
    """Return a case of a good picture, to which options and files are added; "__" in a file's name is its dot."""
    held = {"frame.png": GOOD} | {key.replace("__", "."): content for key, content in made.items()}
    given = options if "--fov" in options or "--camera" in options else ("--fov", "60", *options)
    given = given if "--out" in given else (*given, "--out", "out")
    return Case(f"reconstruct: {name}", ("reconstruct", "frame.png", *given), held, wanted, says)


def cases() -> Iterator[Case]:
    """Yield all cases of `reconstruct`."""
    yield from _good()
    yield from _pictures()
    yield from _sizes()
    yield from _cameras()
    yield from _camera_values()
    yield from _depths()
    yield from _references()
    yield from _options()


def _good() -> Iterator[Case]:
    for suffix, content in GOOD_CAMERAS.items():
        yield _case(f"good .{suffix}", "--camera", f"c.{suffix}", wanted=Wanted.DONE, **{f"c__{suffix}": content})
    yield _case("good calibration", "--camera", "c.toml", wanted=Wanted.DONE, c__toml=files.CALIBRATION)
    for suffix, content in GOOD_DEPTHS.items():
        for option in ("--depth", "--reference"):
            yield _case(
                f"good {option} .{suffix}", option, f"d.{suffix}", wanted=Wanted.DONE, **{f"d__{suffix}": content}
            )
    yield _case(
        "good reference",
        "--reference",
        "m.ply",
        "--camera-from-model",
        "p.toml",
        wanted=Wanted.DONE,
        m__ply=files.ply(),
        p__toml=files.POSE,
    )
    for suffix in (".png", ".jpg", ".tif", ".webp", ".bmp"):
        yield Case(
            f"reconstruct: good picture {suffix}",
            ("reconstruct", f"x{suffix}", "--fov", "60", "--out", "out"),
            {f"x{suffix}": files.encoded(suffix)},
            Wanted.DONE,
        )


def _pictures() -> Iterator[Case]:
    command = ("--fov", "60", "--out", "out")
    for name, content in files.no_files(GOOD):
        # A folder is a sequence, and says what it lacks.
        yield Case(
            f"reconstruct: picture, {name}", ("reconstruct", "x.png", *command), {"x.png": content}, says="x.png"
        )
        yield Case(f"reconstruct: film, {name}", ("reconstruct", "x.mp4", *command), {"x.mp4": content}, says="x.mp4")
    yield Case("reconstruct: picture, missing", ("reconstruct", "x.png", *command), says="x.png")
    yield Case("reconstruct: picture, name too long", ("reconstruct", "x" * 5000 + ".png", *command), says="xxx")
    yield Case("reconstruct: picture, a line break in its name", ("reconstruct", "a\nb.png", *command))
    yield Case("reconstruct: folder without pictures", ("reconstruct", "d", *command), {"d/a.txt": "a"}, says="d")
    held = {"d/a.png": b"no", "d/b.png": GOOD[:200], "d/c.png": b""}
    yield Case("reconstruct: folder of broken pictures", ("reconstruct", "d", *command), held, says="d")
    pipes = {"d/a.png": files.fifo, "d/b.png": files.sparse(GOOD), "d/c.png": files.endless}
    yield Case("reconstruct: folder of no files", ("reconstruct", "d", *command), pipes, says="d")
    for number, suffix in enumerate((".png", ".jpg", ".tif", ".webp", ".bmp")):
        good = files.encoded(suffix)
        for i, data in enumerate(files.damaged(good, 100 + number, 9)):
            yield Case(
                f"reconstruct: damaged {suffix} {i}",
                ("reconstruct", f"x{suffix}", *command),
                {f"x{suffix}": data},
                Wanted.ORDERLY,
            )
    for i, data in enumerate(files.damaged(b"RIFF\x10\0\0\0AVI LIST" + bytes(200), 120, 3)):
        yield Case(f"reconstruct: damaged film {i}", ("reconstruct", "x.avi", *command), {"x.avi": data})


def _sizes() -> Iterator[Case]:
    command = ("reconstruct", "x.png", "--fov", "60", "--out", "out")
    huge = ((10000, 9999), (65500, 1), (1, 65500), (65500, 1000), (20000, 20000), (2**31 - 1, 1), (2**31 - 1,) * 2)
    for width, height in huge:
        made: Content = partial(_write_png, width=width, height=height)
        yield Case(f"reconstruct: picture of {width} x {height} px", command, {"x.png": made}, says="x.png")
    yield Case("reconstruct: picture of 0 x 0 px", command, {"x.png": files.png(0, 0, b"")}, says="x.png")
    for kind, suffix in (("GIF", "gif"), ("PNG", "png"), ("WEBP", "webp"), ("TIFF", "tif")):
        for sizes in (False, True):
            name = f"reconstruct: animated {kind}{', pages of several sizes' if sizes else ''}"
            yield Case(
                name,
                ("reconstruct", f"x.{suffix}", *command[2:]),
                {f"x.{suffix}": files.animated(kind, sizes=sizes and kind == "TIFF")},
                Wanted.ORDERLY,
                "x.",
            )


def _write_png(path: Any, width: int, height: int) -> None:
    """Write a PNG of any size; one that takes too long to compress has a header alone."""
    path.write_bytes(files.png(width, height, b"" if width * height > 4 * 10**8 else None))


GOOD_CAMERAS: dict[str, bytes | str] = {
    "toml": files.CAMERA,
    "yaml": files.OPENCV_YAML,
    "yml": files.ROS_YAML,
    "xml": files.OPENCV_XML,
    "json": files.OPENCV_JSON,
    "mat": files.matlab(),
}


GOOD_DEPTHS = {
    "npy": files.npy(files.depth()),
    "exr": files.exr(files.depth()),
    "tif": files.encoded(".tif", files.depth()),
}


def _cameras() -> Iterator[Case]:
    for number, (suffix, good) in enumerate(GOOD_CAMERAS.items()):
        name = f"c.{suffix}"
        for what, content in files.no_files(good):
            yield _case(f"camera, {what} .{suffix}", "--camera", name, says=name, **{f"c__{suffix}": content})
        for i, data in enumerate(files.damaged(good, 200 + number, 9)):
            yield _case(
                f"camera, damaged .{suffix} {i}", "--camera", name, wanted=Wanted.ORDERLY, **{f"c__{suffix}": data}
            )
        if isinstance(good, str):
            for i, text in enumerate(files.damaged_words(good, 220 + number, 6)):
                yield _case(
                    f"camera, strange words .{suffix} {i}",
                    "--camera",
                    name,
                    wanted=Wanted.ORDERLY,
                    **{f"c__{suffix}": text},
                )
    for i, text in enumerate(files.damaged_words(files.CALIBRATION, 240, 8)):
        yield _case(f"calibration, strange words {i}", "--camera", "c.toml", wanted=Wanted.ORDERLY, c__toml=text)
    deep = {"toml": "a = " + "[" * 50_000, "yaml": "[" * 50_000, "json": "[" * 50_000, "xml": "<a>" * 50_000}
    for suffix, text in deep.items():
        yield _case(
            f"camera, nested deeply .{suffix}", "--camera", f"c.{suffix}", says=f"c.{suffix}", **{f"c__{suffix}": text}
        )
    laughs = (
        '<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
        + "".join(f'<!ENTITY {chr(98 + i)} "{f"&{chr(97 + i)};" * 10}">' for i in range(9))
        + "]><opencv_storage><image_width>&j;</image_width></opencv_storage>"
    )
    yield _case("camera, XML that grows when it is read", "--camera", "c.xml", c__xml=laughs, says="c.xml")


SQUARE = [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]

YAML_FAULTS = {
    "dt: u": files.OPENCV_YAML.replace("dt: d", "dt: u", 1),
    "dt: a number": files.OPENCV_YAML.replace("dt: d", "dt: 5", 1),
    "dt of several": files.OPENCV_YAML.replace("dt: d", 'dt: "3d"', 1),
    "4 rows": files.OPENCV_YAML.replace("rows: 3", "rows: 4"),
    "2 columns": files.OPENCV_YAML.replace("cols: 3", "cols: 2"),
    "rows as a text": files.OPENCV_YAML.replace("rows: 3", "rows: three"),
    "9 rows of 1": files.OPENCV_YAML.replace("rows: 3", "rows: 9").replace("cols: 3", "cols: 1"),
    "5 coefficients in 4 columns": files.OPENCV_YAML.replace("cols: 5", "cols: 4"),
    "no width": files.OPENCV_YAML.replace("image_width", "w"),
    "principal point far outside": files.OPENCV_YAML.replace("31.5", "31500."),
    "NaN": files.OPENCV_YAML.replace("31.5", ".nan"),
    "endless focal length": files.OPENCV_YAML.replace("60.", ".inf", 1),
    "width 0": files.OPENCV_YAML.replace("width: 64", "width: 0"),
    "width 65500": files.OPENCV_YAML.replace("width: 64", "width: 65500"),
    "focal length 0": files.OPENCV_YAML.replace("60.", "0.", 1),
    "focal length -60": files.OPENCV_YAML.replace("60.", "-60.", 1),
    "an alias": files.OPENCV_YAML.replace("dt: d", "dt: &a d", 1),
    "lens that folds": files.OPENCV_YAML.replace("-0.1,", "-100.,"),
    "lens of 1e300": files.OPENCV_YAML.replace("-0.1,", "1e300,"),
    "an object of Python": files.OPENCV_YAML + 'x: !!python/object/apply:os.system ["true"]\n',
}

XML_FAULTS = {
    "dt u": files.OPENCV_XML.replace("<dt>d", "<dt>u", 1),
    "4 rows": files.OPENCV_XML.replace("<rows>3", "<rows>4"),
    "text in a matrix": files.OPENCV_XML.replace("60. 0.", "sixty 0."),
    "matrix cut": files.OPENCV_XML.replace(" 0. 0. 1.<", "<"),
    "K twice": files.OPENCV_XML.replace("<opencv_storage>", "<opencv_storage><K>1</K>"),
    "no K": files.OPENCV_XML.replace("camera_m", "m"),
}

TOML_FAULTS = {
    "principal point far outside": files.CAMERA + "cx = 5000.0\n",
    "principal point far above": files.CAMERA + "cy = -3000.0\n",
    "principal point endless": files.CAMERA + "cx = inf\n",
    "focal length tiny": files.CAMERA.replace("fx = 60.0", "fx = 1e-300"),
    "focal length of 1e5 widths": files.CAMERA.replace("fx = 60.0", "fx = 6.4e6"),
    "fx 1e-3": files.CAMERA.replace("60.0", "1e-3"),
    "width 65500": files.CAMERA.replace("64", "65500"),
    "width 1e30": files.CAMERA.replace("64", "1e30"),
    "another size": files.CAMERA.replace("64", "32"),
    "fx true": files.CAMERA.replace("60.0", "true"),
    "skew": files.CAMERA + "skew = 9e5\n",
    "unknown key": files.CAMERA + "fov = 60\n",
    "mask that shows nothing": files.CAMERA + "view_mask = {radius = 1, cx = 9e5}\n",
    "noise": files.CAMERA + "[sensor]\nnoise_sigma = -1\n",
    "response": files.CAMERA + '[response]\ntype = "gamma"\ngamma = 0\n',
    "response unknown": files.CAMERA + '[response]\ntype = "log"\n',
    "focal lengths apart": files.CAMERA.replace("60.0", "6e5", 1),
    "distance NaN": files.CAMERA + "[surface]\ndistance_mm = nan\n",
    "light": files.CAMERA + "[rig]\nlights = []\n",
}

MATLAB_FAULTS: dict[str, dict[str, Any]] = {
    "K of 2 rows": {"K": SQUARE[:2]},
    "K of 4": {"K": np.eye(4)},
    "K of text": {"K": "K"},
    "K of 9 in a row": {"K": np.ravel(SQUARE)},
    "K of NaN": {"K": np.full((3, 3), NAN)},
    "K of complex numbers": {"K": np.array(SQUARE) * 1j},
    "no size": {"ImageSize": None},
    "size 0": {"ImageSize": [0, 0]},
    "size huge": {"ImageSize": [48, 65500]},
    "size of 3": {"ImageSize": [48, 64, 3]},
    "1 radial coefficient": {"RadialDistortion": [0.1]},
    "lens of text": {"RadialDistortion": "none"},
    "lens of NaN": {"RadialDistortion": [NAN, 0.0]},
    "principal point far outside": {"K": [[60.0, 0, 1e5], [0, 60.0, 24], [0, 0, 1]]},
    "K of structs": {"K": {"a": 1}},
    "fisheye": {"MappingCoefficients": [1.0]},
    "empty K": {"K": np.empty((0, 0))},
}


def _camera_values() -> Iterator[Case]:
    """Yield cases of camera files that can be read and make no sense."""
    told = {"yaml": (YAML_FAULTS, "c.yaml"), "xml": (XML_FAULTS, "c.xml"), "toml": (TOML_FAULTS, "")}
    for suffix, (faults, says) in told.items():
        for name, text in faults.items():
            yield _case(f"camera .{suffix}, {name}", "--camera", f"c.{suffix}", says=says, **{f"c__{suffix}": text})
    for name, given in MATLAB_FAULTS.items():
        yield _case(f"camera .mat, {name}", "--camera", "c.mat", c__mat=files.matlab(**given), says="c.mat")


def _depths() -> Iterator[Case]:
    for option in ("--depth", "--reference"):
        for number, (suffix, data) in enumerate(GOOD_DEPTHS.items()):
            for what, content in files.no_files(data):
                yield _case(f"{option}, {what} .{suffix}", option, f"d.{suffix}", **{f"d__{suffix}": content})
            if option == "--depth":
                for i, broken in enumerate(files.damaged(data, 300 + number, 8)):
                    yield _case(
                        f"{option}, damaged .{suffix} {i}",
                        option,
                        f"d.{suffix}",
                        wanted=Wanted.ORDERLY,
                        **{f"d__{suffix}": broken},
                    )
    whole = files.depth()
    arrays: dict[str, Any] = {
        "infinite": whole * INF,
        "NaN": whole * NAN,
        "negative": -whole,
        "zero": whole * 0,
        "turned": whole.T,
        "integers": whole.astype(np.int32),
        "text": np.array([["a"]]),
        "complex": whole * 1j,
        "1D": whole[0],
        "empty": np.empty((0, 0)),
        "5D": whole[None, None, None],
        "of 1e300 mm": whole.astype(float) * 1e300,
        "of 1e-300 mm": whole.astype(float) * 1e-300,
        "of truths": whole > 0,
    }
    for name, values in arrays.items():
        for option in ("--depth", "--reference"):
            yield _case(f"{option}, {name}", option, "d.npy", d__npy=files.npy(values), says="d")
    yield _case("--depth, objects", "--depth", "d.npy", d__npy=files.npy(np.array([{}, []], object)), says="d.npy")
    header = b"\x93NUMPY\x01\0v\0" + b"{'descr': '<f4', 'fortran_order': False, 'shape': (9000000000, 9000), }".ljust(
        118
    )
    yield _case("--depth, a header of 324 TB", "--depth", "d.npy", d__npy=header, says="d.npy")
    for value in ("inf", "nan", "-1", "0", "1e300", "1e-300", "1e308", "x", "", "d.txt", "1e999", "0x10", "1_0e9"):
        yield _case(f"--depth {value}", "--depth", value, says="--depth" if value not in ("", "d.txt") else "")
    for value in ("inf", "nan", "-1", "0", "1e300", "1e-300"):
        yield _case(f"--depth-scale {value}", "--depth", "d.npy", "--depth-scale", value, d__npy=files.npy(whole))


def _references() -> Iterator[Case]:
    given = ("--reference", "m.ply", "--camera-from-model", "p.toml")
    for what, content in files.no_files(files.POSE):
        yield _case(f"pose, {what}", *given, m__ply=files.ply(), p__toml=content, says="p.toml")
    poses = {
        "endless": "translation_mm = [inf, 0, 0]\nrotation = [[1,0,0],[0,1,0],[0,0,1]]",
        "no rotation": "matrix = 5",
        "2 x 2": "matrix = [[1, 0], [0, 1]]",
        "mirrored": files.POSE.replace("[[1,", "[[-1,"),
        "scaled": files.POSE.replace("1", "2"),
        "text": 'matrix = "identity"',
        "ragged": "matrix = [[1], [2, 3]]",
        "unknown key": "position = [0, 0, 0]",
        "far": files.POSE.replace("40", "1e300"),
        "empty table": "[matrix]",
        "zero": "matrix = [[0,0,0,0],[0,0,0,0],[0,0,0,0],[0,0,0,0]]",
        "NaN": files.POSE.replace("40", "nan"),
        "last row": "matrix = [[1,0,0,0],[0,1,0,0],[0,0,1,40],[0,0,1,1]]",
        "truth": files.POSE.replace("40", "true"),
    }
    for name, text in poses.items():
        yield _case(f"pose, {name}", *given, m__ply=files.ply(), p__toml=text, says="p.toml")
    yield _case("reference without a pose", *given[:2], m__ply=files.ply(), says="--camera-from-model")
    yield _case("pose without a reference", *given[2:], p__toml=files.POSE, says="--reference")
    yield _case("reference of an unknown kind", "--reference", "m.xyz", *given[2:], m__xyz="0 0 0", p__toml=files.POSE)


def _options() -> Iterator[Case]:
    for value in ("0", "180", "-60", "nan", "inf", "1e-300", "179.9999999", "1e-9", "0.001", "x", "", "1e999", "360"):
        yield _case(f"--fov {value}", "--fov", value)
    yield Case("reconstruct: no camera", ("reconstruct", "frame.png", "--out", "out"), {"frame.png": GOOD})
    yield _case("camera twice", "--fov", "60", "--camera", "c.toml", c__toml=files.CAMERA)
    boxes = (
        "1,2,3",
        "0,0,65,48",
        "-1,0,5,5",
        "0,0,0,0",
        "a,b,c,d",
        "",
        "1.5,0,4,4",
        "1,2,3,4,5",
        "9" * 400 + ",0,1,1",
        "0,0,inf,1",
        "0 0 1 1",
        "0,0,1e1,1",
        "63,47,2,2",
        "²,0,1,1",
    )
    for box in boxes:
        yield _case(f"--roi {box[:20]}", "--roi", box)
    for value in ("-1", "nan", "inf", "1e9", "x", "51", "1e300"):
        yield _case(f"--smoothing {value}", "--smoothing", value)
    for option, values in {
        "--estimator": ("magic", "", "cone_axis,bisector", "a:b", "../x", "x" * 3000, "simtest.estimators.cone_axis"),
        "--detector": ("magic", "", "a:b", "os:system"),
        "--encoding": ("rec709", ""),
        "--target": ("top", ""),
    }.items():
        for value in values:
            yield _case(f"{option} {value[:20] or '(nothing)'}", option, value)
    yield _case("estimator twice", "--estimator", "cone_axis", "--estimator", "cone_axis")
    for name, out, made in OUTS:
        named = out.replace("__", ".")
        yield _case(f"--out, {name}", "--out", named, says=named[:20], **made)
    yield _case("unknown option", "--speed", "3")
    yield _case("an option without a value", "--roi")


OUTS: tuple[tuple[str, str, dict[str, Content]], ...] = (
    ("nothing", "", {}),
    ("a file", "out__", {"out__": "mine"}),
    ("below a file", "f/out", {"f": "mine"}),
    ("FIFO", "pipe", {"pipe": files.fifo}),
    ("below a device", "/dev/null/out", {}),
    ("in /proc", "/proc/out", {}),
    ("name too long", "n" * 300, {}),
    ("path too long", "/".join(["n" * 200] * 30), {}),
    ("link to itself", "l", {"l": files.loop}),
)
"""Folders for results that cannot be: name, path, and what stands there; "__" in a name is a dot."""
