"""Malformed camera files of other programs: one line each, which names the file, what it holds and what is allowed."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from simtest import InputError, load_calibration, load_camera
from simtest.spec.camera_formats.files import read_poses

COLMAP_LINE = "1 OPENCV 640 480 500 490 320 240 -0.1 0.03 0.002 -0.001"
C3VD = (
    "width = 1350\nheight = 1080\ncx = 678.5\ncy = 543.0\na0 = 769.2\na1 = 0.0\na2 = -0.0008\na3 = 6e-07\na4 = -1e-09\n"
    "c = 1.0\nd = 0.002\ne = -0.003\n"
)
OCAM = "5 -400 0 7e-4 0 0\n3 400 400 10\n540 960\n1.0 0.0 0.0\n1080 1920\n"
KALIBR = (
    "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n  distortion_coeffs: [-0.27, 0.06, 0.001, 0.0]\n"
    "  intrinsics: [461.6, 460.1, 362.6, 246.0]\n  resolution: [752, 480]\n"
)
VICALIB = (
    '<rig><camera><camera_model name="" index="0" type="calibu_fu_fv_u0_v0_kb4" version="0"><width> 640 </width>'
    "<height> 480 </height><right> [ 1; 0; 0 ] </right><down> [ 0; 1; 0 ] </down><forward> [ 0; 0; 1 ] </forward>"
    "<params> [ 300; 290; 320; 240; 0.02; -0.01; 0.003; 0 ] </params></camera_model></camera></rig>"
)
PHOTOMETRIC = (
    '<rig><camera><camera_model index="0" type="gamma"><gamma> [ 2.2 ] </gamma></camera_model></camera><light>'
    '<light_model index="0" type="sls"><sigma> 1.0 </sigma><mu> 2.7 </mu><P> [ 0.0; -0.001; -0.003 ] </P>'
    "<D> [ 0.0; 0.0; 1.0 ] </D></light_model></light></rig>"
)
TRANSFORMS = {"w": 640, "h": 480, "fl_x": 500.0, "frames": []}
MATLAB = {
    "MappingCoefficients": np.array([769.0, -8e-4, 6e-7, -1e-9]),
    "ImageSize": np.array([1080.0, 1350.0]),
    "DistortionCenter": np.array([679.5, 544.0]),
    "StretchMatrix": np.eye(2),
}


def swap(text, old, new):
    assert old in text
    return text.replace(old, new)


def transforms(**told):
    return json.dumps({**TRANSFORMS, **told})


CAMERAS = {
    # COLMAP
    "colmap: few words": (
        "cameras.txt",
        "1 OPENCV 640 480 \n2 PINHOLE\n",
        "line 1: OPENCV: 0 parameters; must be 8: fx",
    ),
    "colmap: unknown model": (
        "cameras.txt",
        swap(COLMAP_LINE, "OPENCV", "OPENVC"),
        "unknown camera model; must be one",
    ),
    "colmap: lens that simtest lacks": ("cameras.txt", swap(COLMAP_LINE, "OPENCV", "THIN_PRISM_FISHEYE"), "lacks this"),
    "colmap: too few parameters": (
        "cameras.txt",
        swap(COLMAP_LINE, " -0.001", ""),
        "7 parameters; must be 8: fx, fy, cx",
    ),
    "colmap: no number": ("cameras.txt", swap(COLMAP_LINE, "490", "x"), "fy = 'x': must be a finite number"),
    "colmap: infinite": ("cameras.txt", swap(COLMAP_LINE, "490", "inf"), "fy = 'inf': must be a finite number"),
    "colmap: part of a pixel": (
        "cameras.txt",
        "1 PINHOLE 640 480 5 5 3 2\n2 PINHOLE 64.5 48 5 5 3 2\n",
        "WIDTH = '64.5'",
    ),
    "colmap: twice": ("cameras.txt", f"{COLMAP_LINE}\n{COLMAP_LINE}\n", "line 2: camera 1 is given twice"),
    "colmap: focal length 0": ("cameras.txt", swap(COLMAP_LINE, "500 ", "0 "), "fx = 0.0"),
    "colmap: broken mask": (
        "cameras.txt",
        f"# simtest view_mask (1\n{COLMAP_LINE}\n",
        "view mask '(1': must be a JSON",
    ),
    "colmap: images": ("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n", "COLMAP images.txt holds no camera"),
    "colmap: binary": ("cameras.bin", "\0\1", "binary models are not read; colmap model_converter"),
    # NeRF
    "transforms: no JSON": ("t.json", '{"fl_x": 5,', "not valid JSON"),
    "transforms: no size": ("t.json", '{"fl_x": 500.0}', "w: missing; a camera needs the size of its pictures"),
    "transforms: no focal length": (
        "t.json",
        '{"w": 64, "h": 48, "frames": [], "fl_x": null}',
        "fl_x: missing; must be",
    ),
    "transforms: angle": (
        "t.json",
        '{"w": 64, "h": 48, "camera_angle_x": 4}',
        "camera_angle_x = 4: must be 0 to pi, rad",
    ),
    "transforms: model": (
        "t.json",
        transforms(camera_model="EQUIRECTANGULAR"),
        "camera_model = 'EQUIRECTANGULAR': simtest",
    ),
    "transforms: model under another key": (
        "t.json",
        transforms(model="OPENCV_FISHEYE"),
        "model = 'OPENCV_FISHEYE': transforms.json names its lens camera_model",
    ),
    "transforms: k4": ("t.json", transforms(k4=0.1), "k4 = 0.1: must be 0; simtest's perspective lens has no term r^8"),
    "transforms: text": ("t.json", transforms(cx="left"), "cx = 'left': must be a finite number"),
    "transforms: frames": ("t.json", transforms(frames=5), "frames = 5: must be a list of objects"),
    "transforms: nameless": (
        "t.json",
        transforms(frames=[{"fl_x": 3}]),
        "frames[0]: file_path = None: must name a picture",
    ),
    "transforms: list of models": (
        "t.json",
        transforms(camera_model=["OPENCV"]),
        "camera_model = ['OPENCV']: simtest lacks it",
    ),
    "transforms: fisheye": ("t.json", transforms(is_fisheye="no"), "is_fisheye = 'no': must be true or false"),
    "transforms: two focal lengths": (
        "t.json",
        transforms(camera_angle_x=1.2),
        "fl_x = 500 and camera_angle_x, which says 467.743 px: must agree within 0.1 %; give one of them",
    ),
    "transforms: two focal lengths along y": (
        "t.json",
        transforms(fl_y=500.0, camera_angle_y=1.0, frames=[{"file_path": "a", "fl_x": 300}]),
        "frames[0]: fl_y = 500 and camera_angle_y, which says 439.3",
    ),
    "transforms: angle beside a focal length": (
        "t.json",
        transforms(camera_angle_x=0),
        "camera_angle_x = 0: must be 0",
    ),
    "transforms: a fisheye and none": (
        "t.json",
        transforms(camera_model="OPENCV", is_fisheye=True),
        "is_fisheye = True: does not fit camera_model = 'OPENCV'",
    ),
    "transforms: twice": (
        "t.json",
        '{"w": 64, "h": 48, "fl_x": 50.0, "fl_x": 60.0}',
        "not valid JSON: fl_x is given twice",
    ),
    "transforms: two cameras of a frame": (
        "t.json",
        transforms(frames=[{"file_path": "a", "fl_x": 300}, {"file_path": "a", "fl_x": 400}]),
        "frames[1]: file_path a has two cameras; must have one",
    ),
    # Kalibr
    "kalibr: model": (
        "c.yaml",
        swap(KALIBR, "pinhole", "ds"),
        "cam0: camera_model = 'ds': simtest lacks it; must be pinhole",
    ),
    "kalibr: intrinsics": ("c.yaml", swap(KALIBR, ", 246.0", ""), "cam0: intrinsics: 3 values; must be 4"),
    "kalibr: mirror": (
        "c.yaml",
        swap(swap(KALIBR, "pinhole", "omni"), "[461.6", "[0.8, 461.6"),
        "cam0: camera_model = 'omni': simtest lacks it; must be pinhole",
    ),
    "opencv: mirror": (
        "c.yml",
        "image_width: 64\nimage_height: 48\nK: [50, 0, 32, 0, 50, 24, 0, 0, 1]\nxi: [0.5]\nD: [0, 0, 0, 0]\n",
        "xi: simtest lacks the lens of OpenCV's omnidir module",
    ),
    "opencv: two sizes": (
        "c.yml",
        "image_size: [64, 48]\nimage_height: 40\nK: [50, 0, 32, 0, 50, 24, 0, 0, 1]\n",
        "image_height = 40: does not fit image_size, which says 48",
    ),
    "kalibr: distortion": ("c.yaml", swap(KALIBR, "radtan", "fov"), "distortion_model = 'fov': simtest lacks it"),
    "kalibr: coefficients": ("c.yaml", swap(KALIBR, ", 0.0]", "]"), "distortion_coeffs: 3 values; must be 4"),
    "kalibr: no resolution": ("c.yaml", swap(KALIBR, "resolution", "size"), "resolution = None: must be a list"),
    "kalibr: no table": ("c.yaml", "cam0: 5\n", "cam0 = 5: must be a table of keys"),
    "kalibr: no YAML": ("c.yaml", "cam0:\n  a: [1\n", "not valid YAML: line"),
    # Vicalib
    "vicalib: type": ("g.xml", swap(VICALIB, "v0_kb4", "v0_w"), "type = 'calibu_fu_fv_u0_v0_w': simtest lacks it"),
    "vicalib: parameters": ("g.xml", swap(VICALIB, "0.003; 0 ]", "0.003 ]"), "camera 0: params: 7 values; must be 8"),
    "vicalib: no parameters": (
        "g.xml",
        swap(VICALIB, "params", "values"),
        "params: missing; must be a list of numbers",
    ),
    "vicalib: axes": ("g.xml", swap(VICALIB, "[ 0; 0; 1 ]", "[ 0; 0; -1 ]"), "forward = [ 0; 0; -1 ]: must be [0.0"),
    "vicalib: no size": ("g.xml", swap(VICALIB, "<height> 480 </height>", ""), "height: missing"),
    "vicalib: no XML": ("g.xml", VICALIB[:-3], "not valid XML"),
    "vicalib: entities": ("g.xml", "<!DOCTYPE rig []>" + VICALIB, "document types and entities are not allowed"),
    # C3VD
    "c3vd: missing": ("c.ini", swap(C3VD, "a4 =", "a5 ="), "a4: missing"),
    "c3vd: no number": ("c.ini", swap(C3VD, "769.2", "f"), "a0 = 'f': must be a finite number"),
    "c3vd: no number of others": ("c.ini", swap(C3VD, "769.2", "7_69"), "a0 = '7_69': must be a finite number"),
    "c3vd: huge": ("c.ini", swap(C3VD, "769.2", "1e300"), "a0 = 1e+300: must be at most 1e+06 px"),
    "c3vd: a1": ("c.ini", swap(C3VD, "a1 = 0.0", "a1 = 0.5"), "a1 = 0.5: must be 0"),
    "c3vd: backwards": ("c.ini", swap(C3VD, "769.2", "-769.2"), "a0 = -769.2: must be > 0, since z points along"),
    "c3vd: twice": ("c.ini", C3VD + "a0 = 1\n", "line 13: a0 is given twice"),
    "c3vd: no key": ("c.ini", C3VD + "nonsense\n", "line 13: nonsense: must be key = value"),
    "c3vd: mirrored": ("c.ini", swap(C3VD, "d = 0.002\ne = -0.003", "d = 2\ne = 2"), "c - d e must be > 0"),
    # OCamCalib
    "ocamcalib: few lines": ("c.txt", OCAM[: OCAM.index("1.0 0.0")], "3 lines of numbers; must be 5"),
    "ocamcalib: count": ("c.txt", swap(OCAM, "5 -400", "6 -400"), "says 6 coefficients and holds 5; must be as many"),
    "ocamcalib: forwards": ("c.txt", swap(OCAM, "-400", "400"), "a0 = 400: must be < 0, since OCamCalib's z points"),
    "ocamcalib: higher terms": ("c.txt", swap(OCAM, "5 -400 0 7e-4 0 0", "6 -400 0 7e-4 0 0 1e-12"), "a3, a4 alone"),
    "ocamcalib: contradiction": ("c.txt", OCAM, "the two polynomials differ by"),
    "ocamcalib: centre": ("c.txt", swap(OCAM, "540 960", "540"), "centre (row, column): 1 values; must be 2"),
    "ocamcalib: size": (
        "c.txt",
        swap(OCAM, "1080 1920", "1080 19.5"),
        "size (height, width) = '19.5': must be a whole",
    ),
}


def refused(call, path, fragment):
    with pytest.raises(InputError) as caught:
        call()
    said = str(caught.value)
    assert said.startswith(str(path)), said
    assert fragment in said, said
    assert "\n" not in said


@pytest.mark.parametrize("case", CAMERAS)
def test_malformed_cameras(tmp_path, case):
    name, text, fragment = CAMERAS[case]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    refused(lambda: load_camera(path), path, fragment)


POSES = {
    "colmap: few words": ("images.txt", "1 1 0 0 0 0 0 0 1\n\n", "holds no pose"),
    "colmap: name": (
        "images.txt",
        "1 1 0 0 0 0 0 0 1 a.png\n\n2 1 0 0 0 0 0 0 1\n\n",
        "line 3: 9 words; must be IMAGE_ID",
    ),
    "colmap: quaternion": ("images.txt", "1 2 0 0 0 0 0 0 1 a.png\n\n", "line 1: quaternion of length 2; must be 1"),
    "colmap: no points": (
        "images.txt",
        "1 1 0 0 0 0 0 0 1 a\n2 1 0 0 0 0 0 0 1 b\n",
        "line 2: must hold an image's points",
    ),
    "colmap: cameras alone": ("cameras.txt", f"{COLMAP_LINE}\n", "images.txt: no such file"),
    "transforms: no matrix": ("t.json", transforms(frames=[{"file_path": "a"}]), "transform_matrix: missing"),
    "transforms: rows": (
        "t.json",
        transforms(frames=[{"file_path": "a", "transform_matrix": [[1, 0], [0, 1]]}]),
        "must be 4 rows of 4",
    ),
    "transforms: stretched": (
        "t.json",
        transforms(frames=[{"file_path": "a", "transform_matrix": (2 * np.eye(4)).tolist()}]),
        "a rotation",
    ),
    "transforms: mirrored": (
        "t.json",
        transforms(frames=[{"file_path": "a", "transform_matrix": np.diag([1, 1, -1, 1]).tolist()}]),
        "rotation",
    ),
    "transforms: huge": (
        "t.json",
        transforms(frames=[{"file_path": "a", "transform_matrix": np.diag([1e200, 1, 1, 1]).tolist()}]),
        "transform_matrix: holds 1e+200; must be at most 1e+09",
    ),
    "transforms: twice": (
        "t.json",
        transforms(frames=[{"file_path": "a", "transform_matrix": np.eye(4).tolist()}] * 2),
        "names a twice; must give each frame one pose",
    ),
    "colmap: far": ("images.txt", "1 1 0 0 0 0 1e308 0 1 a\n\n", "a: a position beyond 1e+09; must be within it"),
    "transforms: none": ("t.json", transforms(), "holds no pose; must hold one for each frame"),
    "kalibr: chain": ("c.yaml", KALIBR + KALIBR.replace("cam0", "cam1"), "cam1: T_cn_cnm1: missing"),
    "vicalib": ("g.xml", VICALIB, "Vicalib XML holds no poses; must be COLMAP's images.txt, transforms.json or"),
}


@pytest.mark.parametrize("case", POSES)
def test_malformed_poses(tmp_path, case):
    name, text, fragment = POSES[case]
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    refused(lambda: read_poses(path), tmp_path, fragment)


LIGHTS = {
    "no lens": (VICALIB, "holds neither a camera_model nor a light_model"),
    "response": (swap(PHOTOMETRIC, '"gamma"', '"lut"'), "camera: type = 'lut': simtest lacks it; must be 'gamma'"),
    "gamma": (swap(PHOTOMETRIC, "2.2", "0"), "gamma = 0: must be 0.1 to 10"),
    "no gamma": (swap(PHOTOMETRIC, "<gamma> [ 2.2 ] </gamma>", ""), "gamma: missing"),
    "light": (swap(PHOTOMETRIC, '"sls"', '"pls"'), "light 0: type = 'pls': simtest lacks it; must be 'sls'"),
    "spread": (swap(PHOTOMETRIC, "2.7", "-1"), "mu = -1: must be 0 to 1000"),
    "place": (swap(PHOTOMETRIC, "-0.001;", ""), "P: 2 values; must be 3"),
    "millimetres": (swap(PHOTOMETRIC, "-0.003", "-3.6"), "P = [0.0, -0.001, -3.6]: must be metres, within 1 m"),
    "direction": (swap(PHOTOMETRIC, "[ 0.0; 0.0; 1.0 ]", "[ 0.0; 0.0; 2.0 ]"), "D has length 2; must be a unit vector"),
    "no direction": (swap(PHOTOMETRIC, "<D> [ 0.0; 0.0; 1.0 ] </D>", ""), "D: missing"),
    "no XML": (PHOTOMETRIC[:-3], "not valid XML"),
}
TWO = PHOTOMETRIC.replace("<light>", "<light>" + PHOTOMETRIC.partition("<light>")[2].partition("</light>")[0], 1)
LIGHTS["two lights"] = (TWO.replace("<mu> 2.7", "<mu> 1.7", 1), "lights of different mu or D")


@pytest.mark.parametrize("case", LIGHTS)
def test_malformed_photometric_calibrations(tmp_path, case):
    text, fragment = LIGHTS[case]
    (tmp_path / "g.xml").write_text(VICALIB)
    path = tmp_path / "p.xml"
    path.write_text(text)
    if case == "no lens":
        fragment = "type = 'calibu_fu_fv_u0_v0_kb4': simtest lacks it; must be 'gamma'"
    refused(lambda: load_calibration(tmp_path / "g.xml", path), path, fragment)


def test_what_two_files_state_is_refused(tmp_path):
    (tmp_path / "p.xml").write_text(PHOTOMETRIC)
    path = tmp_path / "c.toml"
    path.write_text('[camera]\nwidth = 64\nheight = 48\nfx = 60\nfy = 60\n[response]\ntype = "srgb"\n')
    refused(lambda: load_calibration(path, tmp_path / "p.xml"), path, "response: ")
    path.write_text("[camera]\nwidth = 64\nheight = 48\nfx = 60\nfy = 60\n[rig]\ndistance_mm = 30\n")
    calibration = load_calibration(path, tmp_path / "p.xml")
    assert (calibration.priors.lights_mm, calibration.priors.distance_mm.mean) == (((0.0, -1.0, -3.0),), 30)
    refused(lambda: load_camera(tmp_path / "p.xml"), tmp_path, "give it as --photometric beside a camera file")


MATLAB_BAD = {
    "polynomial": ({"MappingCoefficients": np.zeros(3)}, "MappingCoefficients = "),
    "size": ({"ImageSize": np.array([1080.0, np.nan])}, "ImageSize = nan: must be a whole number"),
    "part of a pixel": ({"ImageSize": np.array([1080.0, 640.5])}, "ImageSize = 640.5: must be a whole number"),
    "backwards": ({"MappingCoefficients": np.array([-769.0, 0, 0, 0])}, "a0 = -769: must be > 0"),
    "centre": ({"DistortionCenter": np.zeros(3)}, "DistortionCenter = "),
    "stretch": ({"StretchMatrix": np.array([[1.0, 0.0], [0.0, 2.0]])}, "must have 1 in its last corner"),
    "mask": ({"ViewMask": "round"}, "view mask 'round': must be a JSON object"),
}


@pytest.mark.usefixtures("matlab_here")
@pytest.mark.parametrize("case", MATLAB_BAD)
def test_malformed_fisheyes_of_matlab(tmp_path, case):
    change, fragment = MATLAB_BAD[case]
    path = tmp_path / "c.mat"
    savemat(path, {"s": MATLAB})
    assert load_camera(path).fx == 769
    savemat(path, {"s": {**MATLAB, **change}})
    refused(lambda: load_camera(path), path, fragment)


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
