"""Camera files of others: what they mean, where their pixels begin, and what is refused."""

import json
import struct
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from simtest import BrownConrady, Camera, InputError, KannalaBrandt, ViewMask, load_camera, save_camera
from simtest.spec import scene_from_dict
from simtest.spec.camera_formats import plain_yaml
from simtest.spec.camera_formats.matlab import struct_of
from simtest.spec.camera_formats.plain_yaml import parse_yaml
from tests.example_counts import examples

PINHOLE = Camera(640, 480, 500.1, 430.3, 331.2, 225.7)
PLUMB_BOB = Camera(640, 480, 500.1, 430.3, 331.2, 225.7, 0.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01))
RATIONAL = Camera(
    640, 480, 500.1, 430.3, 331.2, 225.7, 0.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01, 0.02, 0.03, 0.04)
)
FISHEYE = Camera(
    640, 480, 200.1, 190.3, 331.2, 225.7, 0.0, KannalaBrandt(0.02, -0.01, 0.003, -0.0004), ViewMask(320.3, 240.1, 200.7)
)
CAMERAS = {"pinhole": PINHOLE, "plumb_bob": PLUMB_BOB, "rational": RATIONAL, "fisheye": FISHEYE}
FORMATS = [
    ("c.toml", None),
    ("c.yml", None),
    ("c.yaml", "opencv"),
    ("c.xml", None),
    ("c.json", None),
    ("c.yaml", "ros"),
]


def numbers(camera):
    mask = camera.view_mask
    centre = [camera.fx, camera.fy, camera.cx, camera.cy, camera.skew]
    return centre + ([] if mask is None else [mask.cx, mask.cy, mask.radius])


@pytest.mark.parametrize(("name", "kind"), FORMATS)
@pytest.mark.parametrize("which", CAMERAS)
def test_export_and_import_are_the_identity(tmp_path, which, name, kind):
    camera = CAMERAS[which]
    save_camera(camera, tmp_path / name, kind)
    back = load_camera(tmp_path / name)
    assert (back.width, back.height, back.distortion) == (camera.width, camera.height, camera.distortion)
    np.testing.assert_allclose(numbers(back), numbers(camera), rtol=1e-15)
    if name == "c.toml":
        assert back == camera


@pytest.mark.parametrize("name", ["c.yml", "c.xml", "c.json"])
@pytest.mark.parametrize("which", CAMERAS)
def test_the_file_means_the_same_to_opencv(tmp_path, which, name):
    """OpenCV, given the file's own numbers, sees a point half a pixel before simtest."""
    camera = CAMERAS[which]
    save_camera(camera, tmp_path / name)
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    coefficients = storage.getNode("distortion_coefficients").mat()
    points = np.random.default_rng(0).uniform([-3, -3, 8], [3, 3, 10], (50, 1, 3))
    zero = np.zeros((3, 1))
    if storage.getNode("fisheye_model").real():
        seen, _ = cv2.fisheye.projectPoints(points, zero, zero, matrix, coefficients)
    else:
        seen, _ = cv2.projectPoints(points, zero, zero, matrix, coefficients)
    np.testing.assert_allclose(load_camera(tmp_path / name).project(points[:, 0]), seen[:, 0] + 0.5, atol=1e-9)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.floats(-100, 900), st.floats(-100, 900), st.sampled_from(FORMATS))
def test_the_half_pixel_comes_and_goes(tmp_path_factory, cx, cy, format):
    path = tmp_path_factory.mktemp("camera") / format[0]
    save_camera(Camera(640, 480, 500.0, 500.0, cx, cy), path, format[1])
    back = load_camera(path)
    np.testing.assert_allclose([back.cx, back.cy], [cx, cy], atol=1e-12)


# ROS -------------------------------------------------------------------------------------------------------------

ROS_FILE = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.78, 0.00000, 305.59,
         0.     , 437.35, 243.74,
         0.     , 0.    , 1.    ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.361, 0.123, 0.001, -0.0002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""

ROS_MESSAGE = """header:
  stamp:
    sec: 5
    nanosec: 0
  frame_id: endoscope
height: 480
width: 640
distortion_model: equidistant
d:
- 0.02
- -0.01
- 0.003
- 0.0
k:
- 300.0
- 0.0
- 319.5
- 0.0
- 300.0
- 239.5
- 0.0
- 0.0
- 1.0
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""


def read(tmp_path, text, name="c.yaml"):
    (tmp_path / name).write_text(text)
    return load_camera(tmp_path / name)


def test_ros_files(tmp_path):
    camera = read(tmp_path, ROS_FILE)
    lens = BrownConrady(-0.361, 0.123, 0.001, -0.0002)
    assert camera == Camera(640, 480, 438.78, 437.35, 305.59 + 0.5, 243.74 + 0.5, 0.0, lens)
    message = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 0.0, KannalaBrandt(0.02, -0.01, 0.003))
    assert read(tmp_path, ROS_MESSAGE) == message


def test_yaml_as_others_write_it():
    """The plain part of YAML: comments, quotes, tags, flow maps, lists of lists."""
    text = """%YAML:1.0
# a comment
---
name: "a: # b"   # and another
other: 'x'
flag: true
nothing: ~
number: 1.
tagged: !!opencv-matrix
   rows: 1
   data: [ 1, 2.5e-1,
       -3 ]
flow: { x: 1, y: [2, .Nan], z: a b }
rows:
- [1, 2]
- - 3
  - 4
nested:
  - a: 1
    b: 2
  -
    c: 3
...
ignored: 1
"""
    data = parse_yaml(text)
    assert np.isnan(data["flow"]["y"].pop())
    assert data == {
        "name": "a: # b", "other": "x", "flag": True, "nothing": None, "number": 1.0,
        "tagged": {"rows": 1, "data": [1, 0.25, -3]}, "flow": {"x": 1, "y": [2], "z": "a b"},
        "rows": [[1, 2], [3, 4]], "nested": [{"a": 1, "b": 2}, {"c": 3}],
    }  # fmt: skip
    assert parse_yaml("") is None
    assert parse_yaml("[1, 2]") == [1, 2]
    assert len(parse_yaml("data: [" + "1.25, " * 20_000 + "2]")["data"]) == 20_001
    assert parse_yaml("a: 1\r\nb: 2\r\n") == {"a": 1, "b": 2}
    assert parse_yaml("---\n") is None


def test_yaml_scalars():
    """Numbers as calibrations write them; what YAML 1.1 reads as octal, base 60, date or truth value stays plain."""
    numbers = parse_yaml("[1e-5, 1.e+00, -.5, .5e1, +3, 010, .inf, -.INF, 123456789012345678901]")
    assert numbers == [1e-5, 1.0, -0.5, 5.0, 3, 10, np.inf, -np.inf, 123456789012345678901.0]
    assert np.isnan(parse_yaml("[.nan, nan]")).all()
    assert parse_yaml("[12:30, 2024-01-01, yes, off, 0x1F, 1_000, '1']") == [
        "12:30", "2024-01-01", "yes", "off", "0x1F", "1_000", "1",
    ]  # fmt: skip
    assert parse_yaml("1: a\ntrue: b\n~: c\n") == {"1": "a", "true": "b", "~": "c"}


# Plain JSON and other names ----------------------------------------------------------------------------------------

JSON = (
    '{"image_width": 640, "image_height": 480, "K": [[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]], '
    '"D": [-0.2, 0.05, 0.0, 0.0]}'
)


def test_plain_json(tmp_path):
    expected = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.0, BrownConrady(-0.2, 0.05))
    assert read(tmp_path, JSON, "c.json") == expected
    # As OpenCV has long written it: no valid JSON.
    assert read(tmp_path, JSON.replace("0.0,", "0.,").replace("400,", "400.,"), "c.json") == expected
    named = JSON.replace('"K"', '"cameraMatrix"').replace('"D"', '"distCoeffs"')
    assert read(tmp_path, named, "c.json") == expected
    sized = JSON.replace('"image_width": 640, "image_height": 480', '"image_size": [640, 480]')
    assert read(tmp_path, sized, "c.json") == expected
    # 12 and 14 coefficients are read where the terms that are not known vanish.
    many = JSON.replace("0.05, 0.0, 0.0", "0.05, " + ", ".join(["0.0"] * 12))
    assert read(tmp_path, many, "c.json") == expected
    assert read(tmp_path, JSON.replace("-0.2, 0.05", "0, 0"), "c.json").distortion is None


def swapped(old, new):
    assert old in JSON
    return JSON.replace(old, new)


EIGHT = (
    "image_width: 640\nimage_height: 480\ndistortion_model: PLUMB_BOB\nK: [400, 0, 319.5, 0, 400, 239.5, 0, 0, 1]\n"
    "D: [-0.1, 0, 0, 0, 0, 0, 0, 0]\n"
)

BAD = {
    "no JSON": ("c.json", "{", "not valid JSON: "),
    "a list": ("c.json", "[1, 2]", "holds no keys"),
    "empty": ("c.yaml", "", "holds no keys"),
    "broken YAML": ("c.yml", "a: [1, 2\n", "not valid YAML: line 2: expected ',' or ']', but got"),
    "no YAML": ("c.yml", "\x01\x02", "not valid YAML: line 1: special characters are not allowed"),
    "level": ("c.yml", "a: 1\n  b: 2\n", "not valid YAML: line 2: mapping values are not allowed here"),
    "twice": ("c.yml", "a: 1\na: 2\n", "line 2: a is given twice"),
    "anchor": ("c.yml", "a: &b 1\n", "line 1: &b: anchors and aliases are not allowed"),
    "no key": ("c.yml", "a: 1\nb\n", "line 3: could not find expected ':'"),
    "missing comma": ("c.yml", "a: [1 [2]]\n", "line 1: expected ',' or ']', but got '['"),
    "broken XML": ("c.xml", "<?xml version='1.0'?><opencv_storage><a>", "not valid XML: "),
    "deep YAML": ("c.yaml", "a: " + "[" * 9999 + "]" * 9999, "line 1: nested too deeply"),
    "entities": (
        "c.xml",
        "<!DOCTYPE a [<!ENTITY b 'bb'>]><opencv_storage><a>&b;</a></opencv_storage>",
        "not valid XML: document types and entities are not allowed",
    ),
    "deep XML": ("c.xml", "<?xml version='1.0'?>" + "<a>" * 60_000 + "</a>" * 60_000, "nested too deeply"),
    "open XML": ("c.xml", "<?xml version='1.0'?><opencv_storage><a>1</b></opencv_storage>", "not valid XML: mism"),
    "deep JSON": ("c.json", '{"a": ' + "[" * 100_000, "not valid JSON: "),
    "no size": ("c.json", swapped('"image_width": 640, ', ""), "image_width: missing; a camera needs the size"),
    "no K": ("c.json", swapped('"K"', '"L"'), "camera_matrix: missing; allowed names: camera_matrix, cameraMatrix"),
    "two K": ("c.json", swapped('"D"', '"cameraMatrix": 1, "D"'), "K: given beside cameraMatrix; only one"),
    "short K": ("c.json", swapped(", [0, 0, 1]", ""), "K: rows of [3, 3] values; must be 3 rows of 3"),
    "text in K": ("c.json", swapped("319.5", '"319.5"'), "K = [[400, 0, '319.5']"),
    "NaN in K": ("c.json", swapped("319.5", "NaN"), "cx = nan: must be a finite number"),
    "transposed K": (
        "c.json", swapped("[400, 0, 319.5], [0, 400, 239.5], [0, 0, 1]", "[400, 0, 0], [0, 400, 0], [319, 239, 1]"),
        "must be upper triangular with 1 in its last corner",
    ),
    "singular": ("c.json", swapped("[0, 400,", "[0, 0,"), "fy = 0.0: must be greater than"),
    "fraction": ("c.json", swapped("640", "640.5"), "width = 640.5: must be a valid integer"),
    "three": ("c.json", swapped(", 0.0, 0.0]", ", 0.0]"), "D: 3 values; must be 4 or 5 or 8 or 12 or 14"),
    "thin prism": ("c.json", swapped("0.0, 0.0]", "0, 0, 0, 0, 0, 0, 0.1, 0, 0, 0]"), "s1 = 0.1 (thin prism)"),
    "tilted": (
        "c.json", swapped("0.0, 0.0]", "0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0]"), "tauX = 0.1 (tilted sensor)",
    ),
    "folds": ("c.json", swapped("-0.2", "-2"), "distortion: the lens folds over at 2"),
    "model": ("c.yaml", ROS_FILE.replace("plumb_bob", "omni"), "distortion_model = 'omni': must be one of plumb_bob, "),
    "model and count": ("c.yaml", ROS_FILE.replace("plumb_bob", "equidistant"), "5 values; must be 4"),
    "model and flag": ("c.yaml", ROS_FILE + "fisheye_model: 1\n", "does not fit distortion_model = 'plumb_bob'"),
    "fisheye alone": ("c.yaml", "fisheye_model: 1\n" + ROS_FILE.split("distortion_model")[0], "a fisheye has 4"),
    "flag in words": ("c.yaml", "fisheye_model: no\n" + ROS_FILE.split("distortion_model")[0], "= 'no': must be 0 "),
    "model in capitals": ("c.yaml", EIGHT, "8 values; must be 4 or 5"),
    "XML twice": ("c.xml", "<a><K>1</K><K>2</K></a>", "not valid XML: K is given twice"),
    "binned": ("c.yaml", ROS_MESSAGE.replace("binning_x: 0", "binning_x: 2"), "binning_x = 2: must be 0 or 1"),
    "cropped": ("c.yaml", ROS_MESSAGE.replace("x_offset: 0", "x_offset: 8"), "roi.x_offset = 8: must be 0"),
    "mask": ("c.json", swapped('"D"', '"view_mask": [1, 2], "D"'), "view_mask: 2 values; must be 3"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_malformed_files(tmp_path, case):
    name, text, fragment = BAD[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, name)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / name}: ")
    assert fragment in message
    assert "\n" not in message


HOSTILE = {
    "billion laughs": ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "line 1: &a: anchors and aliases are not"),
    "alias": ("a: *b\n", "line 1: *b: anchors and aliases are not allowed"),
    "itself": ("&a [*a]", "line 1: &a: anchors and aliases are not allowed"),
    "merge key": ("a: {b: 1}\n<<: {c: 2}\n", "line 2: merge keys (<<) are not allowed"),
    "Python": (
        "a: !!python/object/apply:os.system [ls]\n",
        "line 1: tag !!python/object/apply:os.system is not allowed",
    ),
    "Python name": ("a: !!python/name:os.system\n", "line 1: tag !!python/name:os.system is not allowed; only !!open"),
    "own tag": ("a: !mine 1\n", "line 1: tag !mine is not allowed; only !!opencv-... is"),
    "binary": ("a: !!binary aGk=\n", "line 1: tag !!binary is not allowed"),
    "map as key": ("[1, 2]: 3\n", "line 1: must be key: value, and the key a word"),
    "twice, in a flow": ("a: {b: 1, b: 2}\n", "line 1: b is given twice"),
    "tab": ("a:\n\tb: 1\n", "line 2: found character"),
    "two in a line": ("a: 1: 2\n", "line 1: mapping values are not allowed here"),
    "long key": ("a" + " " * 50_000 + "b: 1\n", "line 1: mapping values are not allowed here"),
    "deep blocks": ("".join(f"{' ' * i}a:\n" for i in range(1000)), "line 32: nested too deeply; at most 32"),
    "deep lists": ("- " * 400_000, "line 1: nested too deeply; at most 32 levels are allowed"),
    "deep keys": ("? " * 400_000, "line 1: nested too deeply; at most 32 levels are allowed"),
    "deep maps": ("{" * 900_000, "line 1: nested too deeply; at most 32 levels are allowed"),
    "huge row": ("a: [" + "1," * 110_000 + "1]", "line 1: too many values; at most 100000 are allowed"),
    "huge file": ("a: [" + "1," * 500_000 + "1]", "1000006 bytes; at most 1000000 are allowed"),
    "NaN": (ROS_FILE.replace("438.78", ".nan"), "fx = nan: must be a finite number"),
    "infinity": (ROS_FILE.replace("438.78", "-.inf"), "fx = -inf: must be a finite number"),
    "many digits": (ROS_FILE.replace("438.78", "9" * 5000), "fx = inf: must be a finite number"),
    "only a comment": ("%YAML:1.0\n# nothing\n", "holds no keys"),
    "quotes": ("'" * 900_000, "holds no keys"),
    "digits": ("a: " + "9" * 900_000 + "x", "image_width: missing"),
    "colons": (":" * 900_000, "line 1: mapping values are not allowed here"),
}


SLOW = {"huge row"}
"""Told on a smaller scale by the test after this one."""


@pytest.mark.parametrize("case", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in HOSTILE])
def test_hostile_yaml_is_one_line(tmp_path, case):
    text, fragment = HOSTILE[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'c.yaml'}: ")
    assert fragment in message
    assert "\n" not in message


def test_values_are_counted_up_to_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(plain_yaml, "MAX_VALUES", 100)
    # Beside the list's values there are the map, the key and the list itself.
    for count, said in ((97, "image_width: missing"), (98, "too many values; at most 100 are allowed")):
        with pytest.raises(InputError, match=said):
            read(tmp_path, f"a: [{', '.join('1' * count)}]")


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


@pytest.mark.parametrize("name", ["c.toml", "c.yml", "c.xml", "c.json", "c.mat"])
def test_missing_files(tmp_path, name):
    with pytest.raises(InputError, match=name):
        load_camera(tmp_path / name)
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=name):
        load_camera(tmp_path / name)


# MATLAB ----------------------------------------------------------------------------------------------------------

STRUCT = {
    "IntrinsicMatrix": np.array([[500.0, 0.0, 0.0], [3.0, 480.0, 0.0], [321.0, 241.0, 1.0]]),
    "RadialDistortion": np.array([-0.3, 0.1, 0.01]),
    "TangentialDistortion": np.array([0.001, -0.002]),
    "ImageSize": np.array([480.0, 640.0]),
    "WorldUnits": "mm",
}
MATLAB = Camera(640, 480, 500.0, 480.0, 320.5, 240.5, 3.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01))


def matlab(tmp_path, data):
    savemat(tmp_path / "c.mat", data)
    return load_camera(tmp_path / "c.mat")


@pytest.mark.usefixtures("matlab_here")
def test_matlab_structs(tmp_path):
    assert matlab(tmp_path, {"s": STRUCT}) == MATLAB
    assert matlab(tmp_path, {"params": STRUCT, "note": "text", "x": 5.0}) == MATLAB
    assert matlab(tmp_path, STRUCT) == MATLAB  # save(..., '-struct', 's')
    newer = {key: value for key, value in STRUCT.items() if key != "IntrinsicMatrix"}
    newer["K"] = STRUCT["IntrinsicMatrix"].T
    assert matlab(tmp_path, {"s": newer}) == MATLAB
    assert (
        matlab(tmp_path, {"s": {**STRUCT, "FocalLength": [500.0, 480.0], "PrincipalPoint": [321.0, 241.0]}}) == MATLAB
    )
    plain = {**STRUCT, "RadialDistortion": np.zeros(2), "TangentialDistortion": np.zeros(2)}
    assert matlab(tmp_path, {"s": plain}).distortion is None
    # MATLAB's first pixel is (1, 1): OpenCV's c is 1 less, and half a pixel less than simtest's.
    point = np.array([[[0.3, -0.2, 2.0]]])
    K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0, 0, 1]])
    seen, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), K, np.array([-0.3, 0.1, 0.001, -0.002, 0.01]))
    without_skew = matlab(
        tmp_path, {"s": {**STRUCT, "IntrinsicMatrix": np.array([[500.0, 0, 0], [0, 480, 0], [321, 241, 1]])}}
    )
    np.testing.assert_allclose(without_skew.project(point[0, 0]), seen[0, 0] + 0.5, atol=1e-9)


MATLAB_BAD = {
    "no struct": ({"x": 1.0}, "holds no struct with IntrinsicMatrix or K"),
    "two": ({"a": STRUCT, "b": STRUCT}, "holds 2 calibrations (a, b); must be one"),
    "no size": ({"s": {**STRUCT, "ImageSize": np.zeros((0, 0))}}, "ImageSize = "),
    "missing": ({"s": {k: v for k, v in STRUCT.items() if k != "RadialDistortion"}}, "RadialDistortion: missing"),
    "text": ({"s": {**STRUCT, "TangentialDistortion": "ab"}}, "TangentialDistortion = 'ab': must be 2 numbers"),
    "not transposed": ({"s": {**STRUCT, "IntrinsicMatrix": STRUCT["IntrinsicMatrix"].T}}, "must be triangular"),
    "two focal lengths": (
        {"s": {**STRUCT, "FocalLength": [500.0, 500.0]}},
        "FocalLength(2) = 500 and IntrinsicMatrix, ",
    ),
    "two centres": (
        {"s": {**STRUCT, "PrincipalPoint": [320.0, 241.0]}},
        "PrincipalPoint(1) = 320 and IntrinsicMatrix, ",
    ),
    "two matrices": (
        {"s": {**STRUCT, "K": np.array([[500.0, 3, 321], [0, 480, 214], [0, 0, 1]])}},
        "IntrinsicMatrix(3,2) = 241 and K, which says 214 px: must agree within 0.1 %; give one of them",
    ),
    "fisheye": ({"s": {"MappingCoefficients": np.zeros(4)}}, "ImageSize: missing"),
}


@pytest.mark.usefixtures("matlab_here")
@pytest.mark.parametrize("case", MATLAB_BAD)
def test_matlab_structs_that_are_none(tmp_path, case):
    data, fragment = MATLAB_BAD[case]
    with pytest.raises(InputError) as caught:
        matlab(tmp_path, data)
    assert str(caught.value).startswith(f"{tmp_path / 'c.mat'}: ")
    assert fragment in str(caught.value)


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
    with pytest.raises(InputError) as caught:
        load_camera(path)
    assert str(caught.value).startswith(f"{path}: {fragment}")


# simtest's own ---------------------------------------------------------------------------------------------------

TOML = """width = 640
height = 480
fx = 300.0
fy = 300.0
distortion = { type = "kannala_brandt", k1 = 0.01 }
view_mask = { radius = 200.0 }
"""


def test_own_files(tmp_path):
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 0.0, KannalaBrandt(0.01), ViewMask(320.0, 240.0, 200.0))
    assert read(tmp_path, TOML, "c.toml") == camera
    beside = "[vignetting]\nx = 1\n[emission]\ny = 2\n[response]\nz = 3\n"
    assert read(tmp_path, TOML + beside, "c.toml") == camera
    assert read(tmp_path, "[camera]\n" + TOML + beside, "c.toml") == camera
    scene = scene_from_dict(
        {"surface": {"type": "plane"}, "camera": {"distortion": {"type": "brown_conrady", "k1": 0.1}}}
    )
    assert scene.camera.model() == Camera(406, 406, 406.0, 406.0, 203.0, 203.0, 0.0, BrownConrady(0.1))


OWN_BAD = {
    "unknown lens": (
        TOML.replace("kannala_brandt", "omni"),
        "distortion.type = 'omni': unknown; allowed: brown_conrady, k",
    ),
    "unknown key": (TOML.replace("k1", "k9"), "distortion.k9 = 0.01: unknown key; allowed: "),
    "no type": (TOML.replace('type = "kannala_brandt", ', ""), "distortion.type: missing; allowed: brown_conrady, k"),
    "text": (TOML.replace("0.01", '"a"'), "distortion.k1 = 'a': must be a number"),
    "no table": (TOML.replace('{ type = "kannala_brandt", k1 = 0.01 }', "5"), "distortion = 5"),
    "no radius": (TOML.replace("radius", "cx"), "view_mask.radius: missing; it must be given"),
    "empty view": (TOML.replace("radius = 200.0", "radius = 2, cx = -50"), "view_mask = "),
    "folds": (TOML.replace("0.01", "-0.9"), "distortion: the lens folds over at 34.87 deg off its axis"),
}


@pytest.mark.parametrize("case", OWN_BAD)
def test_own_files_that_are_malformed(tmp_path, case):
    text, fragment = OWN_BAD[case]
    with pytest.raises(InputError) as caught:
        read(tmp_path, text, "c.toml")
    assert str(caught.value).startswith(f"{tmp_path / 'c.toml'}: ")
    assert fragment in str(caught.value)


def test_what_cannot_be_saved(tmp_path):
    skewed = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 2.0)
    for camera, name, kind, fragment in (
        (skewed, "c.yml", None, "camera.skew = 2: must be 0, since OpenCV ignores it"),
        (skewed, "c.yml", "ros", "since ROS ignores it"),
        (PINHOLE, "c.mat", "opencv", "opencv needs a file name that ends in .yml, .yaml, .xml, .json"),
        (PINHOLE, "c.yml", "toml", "toml needs a file name that ends in .toml"),
        (PINHOLE, "c.yml", "kalibr", "format = 'kalibr': must be one of toml, opencv, ros"),
        (np.eye(3), "c.yml", None, "camera is a ndarray"),
        (PINHOLE, "no/c.yml", None, "No such file or directory"),
    ):
        with pytest.raises(InputError) as caught:
            save_camera(camera, tmp_path / name, kind)
        assert fragment in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "lines",
    ["distortion_coeffs: {rows: 1, cols: 5, data: [-0.15, 0, 0, 0, 0]}", "distortion_model: plumb_bob", "Dist: [0.1]"],
)
def test_a_lens_under_a_name_that_is_not_read_is_refused(tmp_path, lines):
    """Taken for a pinhole without a word, the angles would be off by a degree."""
    path = tmp_path / "lens.yaml"
    matrix = "camera_matrix: {rows: 3, cols: 3, data: [400, 0, 200, 0, 400, 150, 0, 0, 1]}"
    path.write_text(f"image_width: 400\nimage_height: 300\n{matrix}\n{lines}\n")
    with pytest.raises(InputError, match="speaks of a lens whose coefficients are missing; allowed names: dist"):
        load_camera(path)


def test_names_of_the_calibration_tutorials_are_read(tmp_path):
    path = tmp_path / "tutorial.json"
    described = {"image_width": 400, "image_height": 300, "mtx": [[400, 0, 200], [0, 400, 150], [0, 0, 1]]}
    path.write_text(json.dumps({**described, "dist": [[-0.15, 0.01, 0, 0, 0]]}))
    assert load_camera(path).distortion.k1 == -0.15
