"""Malformed camera files of other programs: one line each, which names the file, what it holds and what is allowed."""

import json
import struct
import sys

import numpy as np
import pytest
from camera_texts import (
    FISHEYE_STRUCT,
    JSON,
    KALIBR,
    PHOTOMETRIC,
    ROS_FILE,
    ROS_MESSAGE,
    STRUCT,
    TOML,
    vicalib,
    written,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from simtest import BrownConrady, Camera, InputError, load_calibration, load_camera, save_camera
from simtest.spec.camera_formats import plain_yaml
from simtest.spec.camera_formats.files import read_poses
from simtest.spec.camera_formats.matlab import struct_of
from simtest.spec.camera_formats.plain_yaml import parse_yaml
from tests.example_counts import examples
from tests.refusals import refused

COLMAP_LINE = "1 OPENCV 640 480 500 490 320 240 -0.1 0.03 0.002 -0.001"
OCAM = "5 -400 0 7e-4 0 0\n3 400 400 10\n540 960\n1.0 0.0 0.0\n1080 1920\n"
INI = (
    "width = 1350\nheight = 1080\ncx = 678.5\ncy = 543.0\na0 = 769.2\na1 = 0.0\na2 = -0.0008\na3 = 6e-07\na4 = -1e-09\n"
    "c = 1.0\nd = 0.002\ne = -0.003\n"
)
VICALIB = vicalib("calibu_fu_fv_u0_v0_kb4", "300; 290; 320; 240; 0.02; -0.01; 0.003; 0")
TRANSFORMS = {"w": 640, "h": 480, "fl_x": 500.0, "frames": []}
EIGHT = (
    "image_width: 640\nimage_height: 480\ndistortion_model: PLUMB_BOB\nK: [400, 0, 319.5, 0, 400, 239.5, 0, 0, 1]\n"
    "D: [-0.1, 0, 0, 0, 0, 0, 0, 0]\n"
)


def swap(text, old, new):
    assert old in text
    return text.replace(old, new)


def transforms(**told):
    return json.dumps({**TRANSFORMS, **told})


CAMERAS = {
    # Of each the file's name stands before what is wrong.
    "cameras.txt: unknown model": (swap(COLMAP_LINE, "OPENCV", "OPENVC"), "unknown camera model; must be one"),
    "cameras.txt: lens that simtest lacks": (swap(COLMAP_LINE, "OPENCV", "THIN_PRISM_FISHEYE"), "lacks this"),
    "cameras.txt: too few parameters": (swap(COLMAP_LINE, " -0.001", ""), "7 parameters; must be 8: fx, fy, cx"),
    "cameras.txt: part of a pixel": ("1 PINHOLE 640 480 5 5 3 2\n2 PINHOLE 64.5 48 5 5 3 2\n", "WIDTH = '64.5'"),
    "cameras.txt: twice": (f"{COLMAP_LINE}\n{COLMAP_LINE}\n", "line 2: camera 1 is given twice"),
    "cameras.txt: broken mask": (f"# simtest view_mask (1\n{COLMAP_LINE}\n", "view mask '(1': must be a JSON"),
    "images.txt: images": ("1 1 0 0 0 0 0 0 1 a.png\n\n", "COLMAP images.txt holds no camera"),
    "cameras.bin: binary": ("\0\1", "binary models are not read; colmap model_converter"),
    "t.json: no size": ('{"fl_x": 500.0}', "w: missing; a camera needs the size of its pictures"),
    "t.json: no focal length": ('{"w": 64, "h": 48, "frames": [], "fl_x": null}', "fl_x: missing; must be"),
    "t.json: angle": ('{"w": 64, "h": 48, "camera_angle_x": 4}', "camera_angle_x = 4: must be 0 to pi, rad"),
    "t.json: model": (transforms(camera_model="EQUIRECTANGULAR"), "camera_model = 'EQUIRECTANGULAR': simtest"),
    "t.json: model under another key": (transforms(model="OPENCV_FISHEYE"), "model = 'OPENCV_FISHEYE': transforms"),
    "t.json: k4": (transforms(k4=0.1), "k4 = 0.1: must be 0; simtest's perspective lens has no term r^8"),
    "t.json: nameless": (transforms(frames=[{"fl_x": 3}]), "frames[0]: file_path = None: must name a picture"),
    "t.json: two focal lengths": (transforms(camera_angle_x=1.2), "fl_x = 500 and camera_angle_x, which says 467.743"),
    "t.json: two focal lengths along y": (
        transforms(fl_y=500.0, camera_angle_y=1.0, frames=[{"file_path": "a", "fl_x": 300}]),
        "frames[0]: fl_y = 500 and camera_angle_y, which says 439.3",
    ),
    "t.json: a fisheye and none": (transforms(camera_model="OPENCV", is_fisheye=True), "is_fisheye = True: does not"),
    "t.json: twice": ('{"w": 64, "h": 48, "fl_x": 50.0, "fl_x": 60.0}', "not valid JSON: fl_x is given twice"),
    "t.json: two cameras of a frame": (
        transforms(frames=[{"file_path": "a", "fl_x": 300}, {"file_path": "a", "fl_x": 400}]),
        "frames[1]: file_path a has two cameras; must have one",
    ),
    "chain.yaml: model": (swap(KALIBR, "pinhole", "ds"), "cam0: camera_model = 'ds': simtest lacks it; must be"),
    "chain.yaml: distortion": (swap(KALIBR, "radtan", "fov"), "distortion_model = 'fov': simtest lacks it"),
    "chain.yaml: no resolution": (swap(KALIBR, "resolution", "size"), "resolution = None: must be a list"),
    "c.yml: mirror": (
        "image_width: 64\nimage_height: 48\nK: [50, 0, 32, 0, 50, 24, 0, 0, 1]\nxi: [0.5]\nD: [0, 0, 0, 0]\n",
        "xi: simtest lacks the lens of OpenCV's omnidir module",
    ),
    "c.yml: two sizes": (
        "image_size: [64, 48]\nimage_height: 40\nK: [50, 0, 32, 0, 50, 24, 0, 0, 1]\n",
        "image_height = 40: does not fit image_size, which says 48",
    ),
    "g.xml: type": (swap(VICALIB, "v0_kb4", "v0_w"), "type = 'calibu_fu_fv_u0_v0_w': simtest lacks it"),
    "g.xml: parameters": (swap(VICALIB, "0.003; 0 ]", "0.003 ]"), "camera 0: params: 7 values; must be 8"),
    "g.xml: axes": (swap(VICALIB, "[ 0; 0; 1 ]", "[ 0; 0; -1 ]"), "forward = [ 0; 0; -1 ]: must be [0.0"),
    "c.ini: missing": (swap(INI, "a4 =", "a5 ="), "a4: missing"),
    "c.ini: no number of others": (swap(INI, "769.2", "7_69"), "a0 = '7_69': must be a finite number"),
    "c.ini: a1": (swap(INI, "a1 = 0.0", "a1 = 0.5"), "a1 = 0.5: must be 0"),
    "c.ini: backwards": (swap(INI, "769.2", "-769.2"), "a0 = -769.2: must be > 0, since z points along"),
    "c.ini: twice": (INI + "a0 = 1\n", "line 13: a0 is given twice"),
    "c.ini: mirrored": (swap(INI, "d = 0.002\ne = -0.003", "d = 2\ne = 2"), "c - d e must be > 0"),
    "c.txt: few lines": (OCAM[: OCAM.index("1.0 0.0")], "3 lines of numbers; must be 5"),
    "c.txt: count": (swap(OCAM, "5 -400", "6 -400"), "says 6 coefficients and holds 5; must be as many"),
    "c.txt: forwards": (swap(OCAM, "-400", "400"), "a0 = 400: must be < 0, since OCamCalib's z points"),
    "c.txt: higher terms": (swap(OCAM, "5 -400 0 7e-4 0 0", "6 -400 0 7e-4 0 0 1e-12"), "a3, a4 alone"),
    "c.txt: contradiction": (OCAM, "the two polynomials differ by"),
    "c.json: no JSON": ("{", "not valid JSON: "),
    "c.json: deep JSON": ('{"a": ' + "[" * 100_000, "not valid JSON: "),
    "c.json: no size": (swap(JSON, '"image_width": 640, ', ""), "image_width: missing; a camera needs the size"),
    "c.json: no K": (swap(JSON, '"K"', '"L"'), "camera_matrix: missing; allowed names: camera_matrix, cameraMatrix"),
    "c.json: two K": (swap(JSON, '"D"', '"cameraMatrix": 1, "D"'), "K: given beside cameraMatrix; only one"),
    "c.json: transposed K": (
        swap(JSON, "[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]", "[400, 0, 0], [0, 400, 0], [319, 239, 1]"),
        "must be upper triangular with 1 in its last corner",
    ),
    "c.json: three": (swap(JSON, ", 0.0, 0.0]", ", 0.0]"), "D: 3 values; must be 4 or 5 or 8 or 12 or 14"),
    "c.json: thin prism": (swap(JSON, "0.0, 0.0]", "0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]"), "s1 = 0.1 (thin prism)"),
    "c.json: folds": (swap(JSON, "-0.2", "-2"), "distortion: the lens folds over at 2"),
    "c.json: mask": (swap(JSON, '"D"', '"view_mask": [1, 2], "D"'), "view_mask: 2 values; must be 3"),
    "c.xml: entities": (
        "<!DOCTYPE a [<!ENTITY b 'bb'>]><opencv_storage><a>&b;</a></opencv_storage>",
        "not valid XML: document types and entities are not allowed",
    ),
    "c.xml: deep XML": ("<?xml version='1.0'?>" + "<a>" * 60_000 + "</a>" * 60_000, "nested too deeply"),
    "c.xml: XML twice": ("<a><K>1</K><K>2</K></a>", "not valid XML: K is given twice"),
    "c.yaml: model": (ROS_FILE.replace("plumb_bob", "omni"), "distortion_model = 'omni': must be one of plumb_bob, "),
    "c.yaml: model and count": (ROS_FILE.replace("plumb_bob", "equidistant"), "5 values; must be 4"),
    "c.yaml: model and flag": (ROS_FILE + "fisheye_model: 1\n", "does not fit distortion_model = 'plumb_bob'"),
    "c.yaml: fisheye alone": ("fisheye_model: 1\n" + ROS_FILE.split("distortion_model")[0], "a fisheye has 4"),
    "c.yaml: model in capitals": (EIGHT, "8 values; must be 4 or 5"),
    "c.yaml: binned": (ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), "binning_x = 2: must be 0 or 1"),
    "c.yaml: cropped": (ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"), "roi.x_offset = 8: must be 0"),
    "c.toml: empty view": (swap(TOML, "radius = 200.0", "radius = 2, cx = -50"), "view_mask = "),
    "c.toml: folds": (swap(TOML, "0.01", "-0.9"), "distortion: the lens folds over at 34.87 deg off its axis"),
    "c.toml: no focal length": ("width = 640\nheight = 480\n", "fx: missing; a camera needs width, height, and"),
}  # fmt: skip


@pytest.mark.parametrize("case", CAMERAS)
def test_malformed_cameras(tmp_path, case):
    text, fragment = CAMERAS[case]
    path = written(tmp_path, case.partition(": ")[0], text)
    refused(lambda: load_camera(path), f"{path}: ", fragment)


@pytest.mark.parametrize(
    "lines",
    ["distortion_coeffs: {rows: 1, cols: 5, data: [-0.15, 0, 0, 0, 0]}", "distortion_model: plumb_bob", "Dist: [0.1]"],
)
def test_a_lens_under_a_name_that_is_not_read_is_refused(tmp_path, lines):
    """Taken for a pinhole without a word, the angles would be off by a degree."""
    matrix = "camera_matrix: {rows: 3, cols: 3, data: [400, 0, 200, 0, 400, 150, 0, 0, 1]}"
    path = written(tmp_path, "lens.yaml", f"image_width: 400\nimage_height: 300\n{matrix}\n{lines}\n")
    refused(lambda: load_camera(path), "speaks of a lens whose coefficients are missing; allowed names: dist")


@pytest.mark.parametrize("name", ["c.toml", "c.yml", "c.mat"])
def test_missing_files(tmp_path, name):
    refused(lambda: load_camera(tmp_path / name), name)
    (tmp_path / name).mkdir()
    refused(lambda: load_camera(tmp_path / name), name)


# Poses -----------------------------------------------------------------------------------------------------------

POSES = {
    "images.txt: name": ("1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1\n\n", "line 3: 9 words; must be IMAGE_ID"),
    "images.txt: quaternion": ("1 2 0 0 0 0 0 0 1 a.png\n\n", "line 1: quaternion of length 2; must be 1"),
    "images.txt: no points": ("1 1 0 0 0 0 0 0 1 a\n2 1 0 0 0 0 0 0 1 b\n", "line 2: must hold an image's points"),
    "cameras.txt: cameras alone": (f"{COLMAP_LINE}\n", "images.txt: no such file"),
    "t.json: no matrix": (transforms(frames=[{"file_path": "a"}]), "transform_matrix: missing"),
    "t.json: stretched": (
        transforms(frames=[{"file_path": "a", "transform_matrix": np.diag([2, 2, 2, 1]).tolist()}]), "rotation",
    ),
    "t.json: mirrored": (
        transforms(frames=[{"file_path": "a", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]), "rotation",
    ),
    "t.json: twice": (
        transforms(frames=[{"file_path": "a", "transform_matrix": np.eye(4).tolist()}] * 2),
        "names a twice; must give each frame one pose",
    ),
    "images.txt: far": ("1 1 0 0 0 0 1e308 0 1 a\n\n", "a: a position beyond 1e+09; must be within it"),
    "t.json: none": (transforms(), "holds no pose; must hold one for each frame"),
    "chain.yaml: chain": (swap(KALIBR, "T_cn_cnm1", "T_cam_imu"), "cam1: T_cn_cnm1: missing"),
    "g.xml: vicalib": (VICALIB, "Vicalib XML holds no poses; must be COLMAP's images.txt, transforms.json or"),
}  # fmt: skip


@pytest.mark.parametrize("case", POSES)
def test_malformed_poses(tmp_path, case):
    text, fragment = POSES[case]
    path = written(tmp_path, case.partition(": ")[0], text)
    refused(lambda: read_poses(path), str(tmp_path), fragment)


# YAML ------------------------------------------------------------------------------------------------------------

HOSTILE = {
    "billion laughs": ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "line 1: &a: anchors and aliases are not"),
    "alias": ("a: *b\n", "line 1: *b: anchors and aliases are not allowed"),
    "merge key": ("a: {b: 1}\n<<: {c: 2}\n", "line 2: merge keys (<<) are not allowed"),
    "Python": ("a: !!python/object/apply:os.system [ls]\n", "line 1: tag !!python/object/apply:os.system is not"),
    "own tag": ("a: !mine 1\n", "line 1: tag !mine is not allowed; only !!opencv-... is"),
    "map as key": ("[1, 2]: 3\n", "line 1: must be key: value, and the key a word"),
    "tab": ("a:\n\tb: 1\n", "line 2: found character"),
    "long key": ("a" + " " * 50_000 + "b: 1\n", "line 1: mapping values are not allowed here"),
    "deep blocks": ("".join(f"{' ' * i}a:\n" for i in range(1000)), "line 32: nested too deeply; at most 32"),
    "deep lists": ("- " * 400_000, "line 1: nested too deeply; at most 32 levels are allowed"),
    "deep maps": ("{" * 900_000, "line 1: nested too deeply; at most 32 levels are allowed"),
    "huge row": ("a: [" + "1," * 110_000 + "1]", "line 1: too many values; at most 100000 are allowed"),
    "huge file": ("a: [" + "1," * 500_000 + "1]", "1000006 bytes; at most 1000000 are allowed"),
    "many digits": (ROS_FILE.replace("438.78", "9" * 5000), "fx = inf: must be a finite number"),
    "only a comment": ("%YAML:1.0\n# nothing\n", "holds no keys"),
    "quotes": ("'" * 900_000, "holds no keys"),
    "digits": ("a: " + "9" * 900_000 + "x", "image_width: missing"),
    "colons": (":" * 900_000, "line 1: mapping values are not allowed here"),
}  # fmt: skip


SLOW = {"huge row"}
"""Told on a smaller scale by the test after this one."""


@pytest.mark.parametrize("case", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in HOSTILE])
def test_hostile_yaml_is_one_line(tmp_path, case):
    text, fragment = HOSTILE[case]
    path = written(tmp_path, "c.yaml", text)
    refused(lambda: load_camera(path), f"{path}: ", fragment)


def test_values_are_counted_up_to_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(plain_yaml, "MAX_VALUES", 100)
    # Beside the list's values there are the map, the key and the list itself.
    for count, said in ((97, "image_width: missing"), (98, "too many values; at most 100 are allowed")):
        with pytest.raises(InputError, match=said):
            load_camera(written(tmp_path, "c.yaml", f"a: [{', '.join('1' * count)}]"))


RATIONAL = Camera(
    640, 480, 500.1, 430.3, 331.2, 225.7, 0.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, 0.03, 0.04)
)


@settings(max_examples=examples(300), deadline=2000, derandomize=True)
@given(st.text(alphabet="ab1.-: \n\t[]{},&*!|>'\"%@`?#~<", max_size=60))
def test_yaml_raises_value_errors_only(text):
    said = "line "
    try:
        parse_yaml(text)
    except ValueError as error:
        said = str(error)
    assert said.startswith("line ")
    assert "\n" not in said


@settings(max_examples=examples(150), deadline=None, derandomize=True)
@given(st.sampled_from(["c.yml", "c.xml", "c.json", "c.yaml"]), st.integers(0, 10**6), st.binary(max_size=3))
def test_damaged_files_raise_input_errors_only(tmp_path_factory, name, place, damage):
    path = tmp_path_factory.mktemp("damaged") / name
    save_camera(RATIONAL, path, "ros" if name == "c.yaml" else None)
    data = path.read_bytes()
    cut = place % len(data)
    path.write_bytes(data[:cut] + damage + data[cut + len(damage) + place % 5 :])
    said = ""
    try:
        load_camera(path)
    except InputError as error:
        said = str(error)
    assert "\n" not in said


# MATLAB ----------------------------------------------------------------------------------------------------------


def plain(**told):
    return {"s": {**STRUCT, **told}}


def fisheye(**told):
    return {"s": {**FISHEYE_STRUCT, **told}}


MATLAB = {
    "no struct": ({"x": 1.0}, "holds no struct with IntrinsicMatrix or K"),
    "two": ({"a": STRUCT, "b": STRUCT}, "holds 2 calibrations (a, b); must be one"),
    "missing": ({"s": {k: v for k, v in STRUCT.items() if k != "RadialDistortion"}}, "RadialDistortion: missing"),
    "text": (plain(TangentialDistortion="ab"), "TangentialDistortion = 'ab': must be 2 numbers"),
    "not transposed": (plain(IntrinsicMatrix=STRUCT["IntrinsicMatrix"].T), "must be triangular"),
    "two focal lengths": (plain(FocalLength=[500.0, 500.0]), "FocalLength(2) = 500 and IntrinsicMatrix, "),
    "two centres": (plain(PrincipalPoint=[320.0, 241.0]), "PrincipalPoint(1) = 320 and IntrinsicMatrix, "),
    "two matrices": (plain(K=np.array([[500.0, 3, 321], [0, 480, 214], [0, 0, 1]])), "IntrinsicMatrix(3,2) = 241 and"),
    "polynomial": (fisheye(MappingCoefficients=np.zeros(3)), "MappingCoefficients = "),
    "size": (fisheye(ImageSize=np.array([1080.0, np.nan])), "ImageSize = nan: must be a whole number"),
    "part of a pixel": (fisheye(ImageSize=np.array([1080.0, 640.5])), "ImageSize = 640.5: must be a whole number"),
    "backwards": (fisheye(MappingCoefficients=np.array([-769.0, 0, 0, 0])), "a0 = -769: must be > 0"),
    "stretch": (fisheye(StretchMatrix=np.array([[1.0, 0.0], [0.0, 2.0]])), "must have 1 in its last corner"),
    "mask": (fisheye(ViewMask="round"), "view mask 'round': must be a JSON object"),
}  # fmt: skip


@pytest.mark.usefixtures("matlab_here")
@pytest.mark.parametrize("case", MATLAB)
def test_malformed_structs_of_matlab(tmp_path, case):
    data, fragment = MATLAB[case]
    path = tmp_path / "c.mat"
    savemat(path, data)
    refused(lambda: load_camera(path), f"{path}: ", fragment)


def opaque_file():
    """Return the bytes of a MATLAB file with one object: a variable of class 17, as a cameraParameters object is."""

    def text(word):
        return struct.pack("<II", 1, len(word)) + word.ljust(-(-len(word) // 8) * 8, b"\0")

    inner = struct.pack("<IIII", 6, 8, 6, 0) + struct.pack("<IIii", 5, 8, 1, 1) + struct.pack("<II", 1, 0)
    inner += struct.pack("<IId", 9, 8, 1.0)
    body = struct.pack("<IIII", 6, 8, 17, 0) + text(b"cameraParams") + text(b"MCOS") + text(b"cameraParameters")
    body += struct.pack("<II", 14, len(inner)) + inner
    header = b"MATLAB 5.0 MAT-file".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
    return header + struct.pack("<II", 14, len(body)) + body


def test_matlab_objects_and_new_files(tmp_path):
    path = tmp_path / "c.mat"
    path.write_bytes(opaque_file())
    with pytest.raises(InputError, match=r"holds an object, which only MATLAB can read; in MATLAB: s = toStruct\("):
        load_camera(path)
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<H", 0x0200) + b"IM" + b"\x89HDF\r\n\x1a\n" * 50)
    with pytest.raises(InputError, match=r"MATLAB 7\.3 files \(HDF5\) are not read; in MATLAB: "):
        load_camera(path)
    for junk in (b"", b"no", b"x" * 1000):
        path.write_bytes(junk)
        with pytest.raises(InputError, match=r"c\.mat: "):
            load_camera(path)


DAMAGES = {
    # a byte of STRUCT's file, its new value, and what is said
    "crash": (297, 220, "a damaged MATLAB file: SciPy breaks down over it; in MATLAB: "),
    "8 GiB": (163, 64, "a damaged MATLAB file: Unable to allocate 8.00 GiB"),
}


@pytest.mark.skipif(sys.platform != "linux", reason="other systems set no such limit of memory")
@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_matlab_files_end_neither_the_process_nor_its_memory(tmp_path, case):
    index, value, fragment = DAMAGES[case]
    path = tmp_path / "c.mat"
    savemat(path, {"s": {key: value for key, value in STRUCT.items() if key != "WorldUnits"}})
    assert struct_of(str(path))["ImageSize"] == [480.0, 640.0]
    damaged = bytearray(path.read_bytes())
    damaged[index] = value
    path.write_bytes(damaged)
    refused(lambda: load_camera(path), f"{path}: {fragment}")


# EndoMapper's photometric calibrations ---------------------------------------------------------------------------

LIGHT = PHOTOMETRIC.partition("<light>")[2].partition("</light>")[0]
LIGHTS = {
    "no lens": (VICALIB, "type = 'calibu_fu_fv_u0_v0_kb4': simtest lacks it; must be 'gamma'"),
    "response": (swap(PHOTOMETRIC, '"gamma"', '"lut"'), "camera: type = 'lut': simtest lacks it; must be 'gamma'"),
    "gamma": (swap(PHOTOMETRIC, "2.2", "0"), "gamma = 0: must be 0.1 to 10"),
    "light": (swap(PHOTOMETRIC, '"sls"', '"pls"'), "light 0: type = 'pls': simtest lacks it; must be 'sls'"),
    "place": (swap(PHOTOMETRIC, "-0.001;", ""), "P: 2 values; must be 3"),
    "millimetres": (swap(PHOTOMETRIC, "-0.003", "-3.6"), "P = [0.0, -0.001, -3.6]: must be metres, within 1 m"),
    "direction": (swap(PHOTOMETRIC, "[ 0.0; 0.0; 1.0 ]", "[ 0.0; 0.0; 2.0 ]"), "D has length 2; must be a unit vector"),
    "two lights": (
        swap(PHOTOMETRIC, "<light>", "<light>" + LIGHT).replace("<mu> 2.7", "<mu> 1.7", 1),
        "lights of different mu or D",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", LIGHTS)
def test_malformed_photometric_calibrations(tmp_path, case):
    text, fragment = LIGHTS[case]
    camera, path = written(tmp_path, "g.xml", VICALIB), written(tmp_path, "p.xml", text)
    refused(lambda: load_calibration(camera, path), f"{path}: ", fragment)


def test_what_two_files_state_is_refused(tmp_path):
    (tmp_path / "p.xml").write_text(PHOTOMETRIC)
    path = tmp_path / "c.toml"
    path.write_text('[camera]\nwidth = 64\nheight = 48\nfx = 60\nfy = 60\n[response]\ntype = "srgb"\n')
    refused(lambda: load_calibration(path, tmp_path / "p.xml"), f"{path}: response: ")
    path.write_text("[camera]\nwidth = 64\nheight = 48\nfx = 60\nfy = 60\n[rig]\ndistance_mm = 30\n")
    calibration = load_calibration(path, tmp_path / "p.xml")
    assert (calibration.priors.lights_mm, calibration.priors.distance_mm.mean) == (((0.0, -1.0, -3.0),), 30)
    refused(lambda: load_camera(tmp_path / "p.xml"), str(tmp_path), "give it as --photometric beside a camera file")


# What is no damage -----------------------------------------------------------------------------------------------


def test_files_that_programs_write_may_be_larger(tmp_path):
    path = tmp_path / "images.txt"
    points = " ".join(["100.25 200.25 -1"] * 1200)
    path.write_text("".join(f"{i} 1 0 0 0 0 0 0 1 f{i}.png\n{points}\n" for i in range(60)))
    assert path.stat().st_size > 1e6
    assert len(read_poses(path)) == 60


def test_names_of_frames_are_kept_where_numbers_are_mended(tmp_path):
    path = tmp_path / "t.json"
    path.write_text(transforms(frames=[{"file_path": "take 1. png", "transform_matrix": np.eye(4).tolist()}]))
    assert read_poses(path)[0][0] == "take 1. png"
    path.write_text(path.read_text().replace("take 1. png", "a").replace("500.0,", "500.,"))
    assert load_camera(path).fx == 500


def test_what_tells_the_format_may_stand_last(tmp_path):
    path = tmp_path / "t.json"
    path.write_text(json.dumps({"note": ["x"] * 8000, **TRANSFORMS}))
    assert load_camera(path).fx == 500


def test_two_statements_of_one_focal_length_may_be_rounded(tmp_path):
    path = tmp_path / "t.json"
    angle = 2 * np.arctan(640 / 2 / 500)
    path.write_text(transforms(camera_angle_x=round(angle, 4)))
    assert load_camera(path).fx == 500
    # A frame's own focal length replaces the angle of the others.
    path.write_text(transforms(camera_angle_x=angle, frames=[{"file_path": "a", "fl_x": 300}, {"file_path": "b"}]))
    assert (load_camera(f"{path}#a").fx, load_camera(f"{path}#b").fx) == (300, 500)
    # The angle of a fisheye is another law's.
    path.write_text(transforms(camera_angle_x=1.28, camera_model="OPENCV_FISHEYE"))
    assert load_camera(path).fx == 500
