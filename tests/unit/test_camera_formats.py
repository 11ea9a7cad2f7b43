"""Camera files of other programs: each against its format's own definition, written out here, and there and back."""

import json
import shutil

import cv2
import numpy as np
import pytest
from camera_texts import C3VD, FISHEYE_STRUCT, JSON, KALIBR, ROS_FILE, ROS_MESSAGE, STRUCT, TOML, vicalib, written
from scipy.io import loadmat, savemat
from scipy.spatial.transform import Rotation

from simtest import BrownConrady, Camera, InputError, KannalaBrandt, Scaramuzza, ViewMask, load_camera, save_camera
from simtest.spec.camera_formats.files import read_poses, recognise
from simtest.spec.camera_formats.plain_yaml import parse_yaml
from tests.refusals import refused

RNG = np.random.default_rng(11)
RAYS = np.concatenate([RNG.uniform(-0.45, 0.45, (2, 300)), RNG.uniform(0.8, 1.0, (1, 300))]).T
WIDE = np.concatenate([RNG.uniform(-1, 1, (2, 300)), RNG.uniform(0.05, 0.8, (1, 300))]).T
PX = 1e-6
"""px within which project and unproject agree with a format's definition."""


def agrees(camera, project, rays):
    """Check a camera against a format's projection of directions, pixels as simtest counts them, both ways."""
    pixels = np.stack(project(*rays.T), axis=-1)
    assert np.isfinite(pixels).all()
    np.testing.assert_allclose(camera.project(rays), pixels, rtol=0, atol=PX)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    # PX at the focal length as an angle
    np.testing.assert_allclose(camera.unproject(pixels), unit, rtol=0, atol=PX / max(camera.fx, camera.fy))
    # Negative control: half a pixel counts.
    assert np.abs(camera.project(rays) - pixels - 0.5).min() > 0.4


# COLMAP -----------------------------------------------------------------------------------------------------------

COLMAP = {
    "SIMPLE_PINHOLE": "500.5 321.2 239.1",
    "PINHOLE": "500.5 490.1 321.2 239.1",
    "SIMPLE_RADIAL": "500.5 321.2 239.1 -0.12",
    "RADIAL": "500.5 321.2 239.1 -0.12 0.03",
    "OPENCV": "500.5 490.1 321.2 239.1 -0.12 0.03 0.002 -0.001",
    "FULL_OPENCV": "500.5 490.1 321.2 239.1 -0.12 0.03 0.002 -0.001 0.01 0.02 -0.01 0.004",
    "OPENCV_FISHEYE": "300.5 290.1 321.2 239.1 0.02 -0.01 0.003 -0.0004",
    "SIMPLE_RADIAL_FISHEYE": "300.5 321.2 239.1 0.02",
    "RADIAL_FISHEYE": "300.5 321.2 239.1 0.02 -0.01",
    "SIMPLE_FISHEYE": "300.5 321.2 239.1",
    "FISHEYE": "300.5 290.1 321.2 239.1",
}


def colmap(model, told):
    """Return COLMAP's projection, as its manual defines the models; pixel centres are at integer + 0.5."""
    two = model in ("PINHOLE", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE", "FISHEYE")
    fx, fy, cx, cy = told[:4] if two else (told[0], *told[:3])
    k = [*told[4 if two else 3 :], *[0.0] * 8]

    def project(x, y, z):
        u, v = x / z, y / z
        if "FISHEYE" in model:
            r = np.hypot(u, v)
            theta = np.arctan(r)
            bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
            u, v = u * bent / r, v * bent / r
        elif model in ("SIMPLE_RADIAL", "RADIAL"):
            r2 = u * u + v * v
            u, v = u * (1 + k[0] * r2 + k[1] * r2**2), v * (1 + k[0] * r2 + k[1] * r2**2)
        elif "OPENCV" in model:
            r2 = u * u + v * v
            ratio = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
            u, v = (
                u * ratio + 2 * k[2] * u * v + k[3] * (r2 + 2 * u * u),
                v * ratio + 2 * k[3] * u * v + k[2] * (r2 + 2 * v * v),
            )
        return fx * u + cx, fy * v + cy

    return project


@pytest.mark.parametrize("model", COLMAP)
def test_colmaps_models(tmp_path, model):
    path = written(tmp_path, "cameras.txt", f"# comment\n3 {model} 640 480 {COLMAP[model]}\n")
    assert recognise(path) == "colmap"
    told = [float(word) for word in COLMAP[model].split()]
    agrees(load_camera(path), colmap(model, told), WIDE if "FISHEYE" in model else RAYS)


CAMERAS = {
    "pinhole": Camera(640, 480, 500.1, 430.3, 331.2, 225.7),
    "brown": Camera(640, 480, 500.1, 430.3, 331.2, 225.7, 0.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01)),
    "rational": Camera(640, 480, 500.1, 430.3, 331.2, 225.7, 0.0, BrownConrady(-0.3, 0.1, 0.001, -0.002, 0.01, 0.02)),
    "fisheye": Camera(640, 480, 200.1, 190.3, 331.2, 225.7, 0.0, KannalaBrandt(0.02, -0.01), ViewMask(320, 240, 200)),
    "omni": Camera(
        640, 480, 200.1, 200.1, 331.2, 225.7, 0.0, Scaramuzza(-0.4, 0.05, -0.02, 0.999, 0.002, -0.003),
        ViewMask(320, 240, 230, 60.0, 200.0),
    ),
}  # fmt: skip
LACKS = {
    "opencv": {"omni"}, "ros": {"omni"}, "colmap": {"omni"}, "transforms": {"omni", "rational"},
    "matlab": {"fisheye", "rational"},
}  # fmt: skip
FILES = {
    "toml": "c.toml", "opencv": "c.yml", "ros": "c.yaml", "colmap": "cameras.txt", "transforms": "t.json",
    "matlab": "c.mat",
}  # fmt: skip


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("which", CAMERAS)
def test_there_and_back(tmp_path, which, kind):
    path, camera = tmp_path / FILES[kind], CAMERAS[which]
    if which in LACKS.get(kind, ()):
        with pytest.raises(InputError, match=r"camera\.distortion"):
            save_camera(camera, path, kind)
        return
    save_camera(camera, path, None if kind == "opencv" else kind)
    assert recognise(path) == ("opencv" if kind == "ros" else kind)
    back = load_camera(path)
    assert (back.width, back.height, back.view_mask) == (camera.width, camera.height, camera.view_mask)
    pixels = RNG.uniform([0, 0], [640, 480], (200, 2))
    np.testing.assert_allclose(back.unproject(pixels), camera.unproject(pixels), rtol=0, atol=1e-13)
    if kind != "matlab":
        np.testing.assert_allclose(back.K, camera.K, rtol=1e-15)
        assert back.distortion == camera.distortion
    if kind in ("colmap", "toml"):
        assert back == camera


# OpenCV and ROS --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("which", "name"),
    [("pinhole", "c.yml"), ("brown", "c.xml"), ("rational", "c.json"), ("fisheye", "c.yml"), ("fisheye", "c.xml")],
)
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


def test_ros_files(tmp_path):
    lens = BrownConrady(-0.361, 0.123, 0.001, -0.0002)
    camera = Camera(640, 480, 438.78, 437.35, 305.59 + 0.5, 243.74 + 0.5, 0.0, lens)
    assert load_camera(written(tmp_path, "c.yaml", ROS_FILE)) == camera
    message = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 0.0, KannalaBrandt(0.02, -0.01, 0.003))
    assert load_camera(written(tmp_path, "c.yaml", ROS_MESSAGE)) == message


def test_yaml_as_others_write_it():
    """A header that is no YAML directive, tags, a second document; line ends of Windows."""
    text = "%YAML:1.0\n# a comment\n---\ntagged: !!opencv-matrix\n   rows: 1\n   data: [ 1, 2.5e-1,\n       -3 ]\n"
    tagged = {"tagged": {"rows": 1, "data": [1, 0.25, -3]}}
    assert parse_yaml(text) == parse_yaml(text + "...\nignored: 1\n") == tagged
    quoted = 'name: "a: # b"   # and another\nflag: true\nnothing: ~\nflow: { x: 1, z: a b }\n'
    assert parse_yaml(quoted) == {"name": "a: # b", "flag": True, "nothing": None, "flow": {"x": 1, "z": "a b"}}
    assert parse_yaml("a: 1\r\nb:\r\n- [1, 2]\r\n") == {"a": 1, "b": [[1, 2]]}
    assert len(parse_yaml("data: [" + "1.25, " * 20_000 + "2]")["data"]) == 20_001
    assert parse_yaml("") is parse_yaml("---\n") is None


def test_yaml_scalars():
    """Numbers as calibrations write them; what YAML 1.1 reads as octal, base 60, date or truth value stays plain."""
    numbers = parse_yaml("[1e-5, 1.e+00, -.5, .5e1, +3, 010, .inf, -.INF, 123456789012345678901]")
    assert numbers == [1e-5, 1.0, -0.5, 5.0, 3, 10, np.inf, -np.inf, 123456789012345678901.0]
    assert np.isnan(parse_yaml("[.nan, nan]")).all()
    assert parse_yaml("[12:30, 2024-01-01, yes, off, 0x1F, 1_000, '1']") == [
        "12:30", "2024-01-01", "yes", "off", "0x1F", "1_000", "1",
    ]  # fmt: skip
    assert parse_yaml("1: a\ntrue: b\n~: c\n") == {"1": "a", "true": "b", "~": "c"}


# Each is a way in which JSON's camera is written too.
SAME = {
    "as OpenCV has long written it, no valid JSON": [("0.0,", "0.,"), ("400,", "400.,")],
    "other names": [('"K"', '"cameraMatrix"'), ('"D"', '"distCoeffs"')],
    "names of the calibration tutorials": [('"K"', '"mtx"'), ('"D": [', '"dist": [['), ("0.0]}", "0.0]]}")],
    "one size": [('"image_width": 640, "image_height": 480', '"image_size": [640, 480]')],
    "terms that are not known vanish": [("0.05, 0.0, 0.0", "0.05, " + ", ".join(["0.0"] * 12))],
}


@pytest.mark.parametrize("case", SAME)
def test_plain_json(tmp_path, case):
    text = JSON
    for old, new in SAME[case]:
        assert old in text
        text = text.replace(old, new)
    expected = Camera(640, 480, 400.0, 400.0, 320.0, 240.0, 0.0, BrownConrady(-0.2, 0.05))
    assert load_camera(written(tmp_path, "c.json", JSON)) == expected
    assert load_camera(written(tmp_path, "c.json", text)) == expected


def test_coefficients_of_zero_are_a_pinhole(tmp_path):
    assert load_camera(written(tmp_path, "c.json", JSON.replace("-0.2, 0.05", "0, 0"))).distortion is None


# Poses -----------------------------------------------------------------------------------------------------------


def some_poses(count=4):
    made = []
    for i in range(count):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.random(random_state=i).as_matrix(), RNG.normal(0, 30, 3)
        made.append((f"frame_{i}.png", T))
    # A half turn, where a quaternion's first number is 0.
    made[-1][1][:3, :3] = np.diag([-1.0, 1.0, -1.0])
    return made


@pytest.mark.parametrize(("kind", "name"), [("colmap", "cameras.txt"), ("transforms", "transforms.json")])
def test_poses_there_and_back(tmp_path, kind, name):
    poses = some_poses()
    save_camera(CAMERAS["brown"], tmp_path / name, kind, poses)
    for path in [tmp_path / name] if kind == "transforms" else [tmp_path / name, tmp_path, tmp_path / "images.txt"]:
        back = read_poses(path)
        assert [frame for frame, _ in back] == [frame for frame, _ in poses]
        np.testing.assert_allclose([T for _, T in back], [T for _, T in poses], rtol=0, atol=1e-12)
    if kind == "colmap":
        assert load_camera(tmp_path) == CAMERAS["brown"]


def test_colmaps_poses_are_its_own(tmp_path):
    """A line of images.txt takes a world point to the camera: quaternion w x y z, then translation."""
    save_camera(CAMERAS["pinhole"], tmp_path / "cameras.txt", None, some_poses())
    line = next(line for line in (tmp_path / "images.txt").read_text().splitlines() if line.startswith("2 "))
    w, x, y, z, *t = (float(word) for word in line.split()[1:8])
    point = np.array([3.0, -4.0, 5.0])
    seen = Rotation.from_quat([x, y, z, w]).apply(point) + t
    world_from_camera = read_poses(tmp_path)[1][1]
    np.testing.assert_allclose(np.linalg.inv(world_from_camera) @ [*point, 1], [*seen, 1], atol=1e-12)


# NeRF -------------------------------------------------------------------------------------------------------------

TRANSFORMS = {
    "camera_model": "OPENCV", "w": 640, "h": 480, "fl_x": 500.5, "fl_y": 490.1, "cx": 321.2, "cy": 239.1,
    "k1": -0.12, "k2": 0.03, "p1": 0.002, "p2": -0.001,
}  # fmt: skip


def test_transforms_json(tmp_path):
    """Intrinsics as COLMAP's, poses with OpenGL's axes: a point in front of the camera has z < 0 there."""
    pose = np.array([[0.0, 0, 1, 2], [1, 0, 0, 3], [0, 1, 0, 4], [0, 0, 0, 1]])
    frames = [{"file_path": "a.png", "transform_matrix": pose.tolist()}]
    path = written(tmp_path, "transforms.json", json.dumps({**TRANSFORMS, "frames": frames}))
    assert recognise(path) == "transforms"
    told = [TRANSFORMS[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")]
    agrees(load_camera(path), colmap("OPENCV", told), RAYS)
    ((name, world_from_camera),) = read_poses(path)
    assert name == "a.png"
    # x right, y up, z back against x right, y down, z forward
    np.testing.assert_allclose(world_from_camera @ [1, 2, 3, 1], pose @ [1, -2, -3, 1], atol=1e-15)


def test_transforms_json_of_other_kinds(tmp_path):
    angle = {"w": 640, "h": 480, "camera_angle_x": 1.2, "frames": []}
    camera = load_camera(written(tmp_path, "a.json", json.dumps(angle)))
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [320 / np.tan(0.6)] * 2 + [320, 240])
    fisheye = {**TRANSFORMS, "camera_model": "OPENCV_FISHEYE", "k3": 0.004, "k4": -0.001}
    told = [fisheye[key] for key in ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4")]
    path = written(tmp_path, "b.json", json.dumps(fisheye))
    agrees(load_camera(path), colmap("OPENCV_FISHEYE", told), RAYS)
    each = {"frames": [{"file_path": f"{i}.png", "fl_x": 400 + i, "w": 640, "h": 480} for i in range(2)]}
    path = written(tmp_path, "c.json", json.dumps(each))
    assert load_camera(f"{path}#1.png").fx == 401
    with pytest.raises(InputError, match=r"c\.json: holds 2 cameras \(0\.png, 1\.png\); name one as FILE#ID"):
        load_camera(path)


# Kalibr -----------------------------------------------------------------------------------------------------------


def half_a_pixel_on(project):
    """Return a projection whose first pixel has its centre at (0, 0) as simtest counts pixels."""
    return lambda x, y, z: tuple(np.asarray(value) + 0.5 for value in project(x, y, z))


def test_kalibr(tmp_path):
    path = written(tmp_path, "camchain.yaml", KALIBR)
    assert recognise(path) == "kalibr"
    first = [461.6, 460.1, 362.6, 246.0, -0.27, 0.067, 0.00087, 0.00011]
    agrees(load_camera(f"{path}#cam0"), half_a_pixel_on(colmap("OPENCV", first)), RAYS)
    second = [300.5, 290.1, 321.2, 239.1, 0.02, -0.01, 0.003, -0.0004]
    agrees(load_camera(f"{path}#cam1"), half_a_pixel_on(colmap("OPENCV_FISHEYE", second)), WIDE)
    with pytest.raises(InputError, match=r"holds 2 cameras \(cam0, cam1\); name one as FILE#ID"):
        load_camera(path)
    with pytest.raises(InputError, match=r"no camera cam2; must be one of cam0, cam1"):
        load_camera(f"{path}#cam2")
    (_, first_pose), (name, second_pose) = read_poses(path)
    np.testing.assert_array_equal(first_pose, np.eye(4))
    assert name == "cam1"
    # T_cn_cnm1 takes cam0's coordinates to cam1's, in metres.
    in_first = second_pose @ [1.0, 2.0, 3.0, 1.0]
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(R @ in_first[:3] + [-110.0, 20.0, 3.0], [1, 2, 3], atol=1e-12)


# Vicalib ----------------------------------------------------------------------------------------------------------


VICALIB = {
    "calibu_fu_fv_u0_v0": ("PINHOLE", [500.5, 490.1, 321.2, 239.1]),
    "calibu_fu_fv_u0_v0_k1_k2": ("OPENCV", [500.5, 490.1, 321.2, 239.1, -0.12, 0.03]),
    "calibu_fu_fv_u0_v0_k1_k2_k3": ("FULL_OPENCV", [500.5, 490.1, 321.2, 239.1, -0.12, 0.03, 0.01]),
    "calibu_fu_fv_u0_v0_rational6": ("FULL_OPENCV", [500.5, 490.1, 321.2, 239.1, -0.1, 0.03, 0.01, 0.02, -0.01, 0.004]),
    "calibu_fu_fv_u0_v0_kb4": ("OPENCV_FISHEYE", [300.5, 290.1, 321.2, 239.1, 0.02, -0.01, 0.003, -0.0004]),
}


@pytest.mark.parametrize("kind", VICALIB)
def test_vicalib(tmp_path, kind):
    model, params = VICALIB[kind]
    path = written(tmp_path, "Endoscope_01_geometrical.xml", vicalib(kind, "; ".join(map(str, params))))
    assert recognise(path) == "vicalib"
    told = params
    if model == "OPENCV":
        told = [*params, 0.0, 0.0]
    elif model == "FULL_OPENCV":
        # Calibu has no tangential terms.
        told = [*params[:6], 0.0, 0.0, *params[6:]]
    agrees(load_camera(path), half_a_pixel_on(colmap(model, told)), WIDE if model == "OPENCV_FISHEYE" else RAYS)


def test_a_calibration_that_folds_over_in_a_corner_takes_a_view_mask(tmp_path):
    """So does EndoMapper's: its lens ends within the picture, in the black corners."""
    params = "717.6911; 718.0214; 734.7278; 552.0724; -0.1396589; -0.0003139987; 0.001505504; -0.0001316715"
    path = written(tmp_path, "e.xml", vicalib("calibu_fu_fv_u0_v0_kb4", params, 1440, 1080))
    with pytest.raises(InputError, match=r"folds over at 94\.25 deg .* camera convert FILE --view-radius PX"):
        load_camera(path)
    camera = load_camera(path, view_radius_px=700)
    assert (camera.view_mask.cx, camera.view_mask.cy, camera.view_mask.radius) == (720, 540, 700)
    save_camera(camera, tmp_path / "c.toml")
    with pytest.raises(InputError, match="view_mask: stated in the file"):
        load_camera(tmp_path / "c.toml", view_radius_px=700)


# Scaramuzza -------------------------------------------------------------------------------------------------------


def scaramuzza_pixels(told, x, y, z):
    """Return the pixels of directions: the positive root of a4 r^4 + a3 r^3 + a2 r^2 - (z / |xy|) r + a0."""
    across = np.hypot(x, y)
    made = []
    for xi, yi, slope in zip(x / across, y / across, z / across, strict=True):
        roots = np.roots([told["a4"], told["a3"], told["a2"], -slope, told["a0"]])
        real = np.real(roots[np.abs(np.imag(roots)) < 1e-9])
        r = min(real[real > 0])
        made.append([told["c"] * xi * r + told["d"] * yi * r + told["cx"], told["e"] * xi * r + yi * r + told["cy"]])
    return tuple(np.array(made).T)


@pytest.mark.parametrize("form", ["config.ini", "plain.txt", "c3vd.json"])
def test_c3vd(tmp_path, form):
    lines = "; omnidirectional camera intrinsics\n" + "".join(f"{key} = {value!r}\n" for key, value in C3VD.items())
    if form == "plain.txt":
        lines = lines.replace(" =", ":").replace(";", "#")
    path = written(tmp_path, form, json.dumps(C3VD) if form == "c3vd.json" else lines)
    assert recognise(path) == "c3vd"
    camera = load_camera(path)
    agrees(camera, half_a_pixel_on(lambda x, y, z: scaramuzza_pixels(C3VD, x, y, z)), WIDE)
    # The published loader's direction of a pixel, whose numbers begin at 0.
    ix, iy = 1200, 100
    p = np.linalg.inv([[C3VD["c"], C3VD["d"]], [C3VD["e"], 1.0]]) @ [ix - C3VD["cx"], iy - C3VD["cy"]]
    rho = np.hypot(*p)
    ray = np.array([*p, C3VD["a0"] + C3VD["a2"] * rho**2 + C3VD["a3"] * rho**3 + C3VD["a4"] * rho**4])
    np.testing.assert_allclose(camera.unproject([ix + 0.5, iy + 0.5]), ray / np.linalg.norm(ray), atol=1e-14)


def ocamcalib_text():
    """Return calib_results.txt as the toolbox writes it, with an inverse polynomial fitted as it does."""
    direct, radius = [-431.7, 0.0, 6.9e-04, 3.7e-07, -2.3e-10], np.linspace(0.0, 1100.0, 400)
    angle = np.arctan2(np.polynomial.Polynomial(direct)(radius), radius)
    inverse = np.polynomial.Polynomial.fit(angle, radius, 14).convert().coef
    return (
        "#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB).\n\n"
        f"{len(direct)} {' '.join(f'{value:.9e}' for value in direct)} \n\n"
        "#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB).\n\n"
        f"{len(inverse)} {' '.join(f'{value:.9f}' for value in inverse)} \n\n"
        '#center: "row" and "column", starting from 0 (C convention)\n\n522.593375 949.509793\n\n'
        '#affine parameters "c", "d", "e"\n\n1.000997 0.000342 0.000249\n\n'
        '#image size: "height" and "width"\n\n1080 1920\n\n'
    )


def test_ocamcalib(tmp_path):
    """Row before column, z backwards: the direct polynomial is the definition, the inverse one a fit to it."""
    text = ocamcalib_text()
    path = written(tmp_path, "calib_results.txt", text)
    assert recognise(path) == "ocamcalib"
    camera = load_camera(path)
    assert (camera.width, camera.height) == (1920, 1080)
    numbers = [[float(word) for word in line.split()] for line in text.splitlines() if line and line[0] != "#"]
    ss, inverse, (row_c, column_c), (c, d, e) = numbers[0][1:], numbers[1][1:], numbers[2], numbers[3]
    # cam2world
    row, column = RNG.uniform(0, 1080, 400), RNG.uniform(0, 1920, 400)
    back = np.linalg.inv([[c, d], [e, 1.0]]) @ [row - row_c, column - column_c]
    z = np.polynomial.Polynomial(ss)(np.hypot(*back))
    rays = np.stack([back[1], back[0], -z], axis=-1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    pixels = np.stack([column + 0.5, row + 0.5], axis=-1)
    np.testing.assert_allclose(camera.unproject(pixels), rays, atol=1e-12)
    np.testing.assert_allclose(camera.project(rays), pixels, atol=PX)
    assert rays[:, 2].min() < -0.2  # well behind the image plane
    # world2cam, whose polynomial is the toolbox's own approximation
    x, y, z = rays[:, 1], rays[:, 0], -rays[:, 2]
    across = np.hypot(x, y)
    rho = np.polynomial.Polynomial(inverse)(np.arctan(z / across))
    there = np.array([[c, d], [e, 1.0]]) @ (np.array([x, y]) / across * rho)
    assert np.abs(camera.project(rays) - 0.5 - (there[::-1].T + np.array([column_c, row_c]))).max() < 0.01


# MATLAB ----------------------------------------------------------------------------------------------------------

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


@pytest.mark.usefixtures("matlab_here")
def test_matlabs_fisheye(tmp_path):
    savemat(tmp_path / "c.mat", {"s": FISHEYE_STRUCT})
    agrees(load_camera(tmp_path / "c.mat"), half_a_pixel_on(lambda x, y, z: scaramuzza_pixels(C3VD, x, y, z)), WIDE)
    savemat(tmp_path / "nested.mat", {"params": {"Intrinsics": FISHEYE_STRUCT, "EstimateAlignment": 1}})
    assert load_camera(tmp_path / "nested.mat") == load_camera(tmp_path / "c.mat")
    # Written again, the numbers are MATLAB's own.
    save_camera(load_camera(tmp_path / "c.mat"), tmp_path / "again.mat")
    again = loadmat(tmp_path / "again.mat", simplify_cells=True)["camera"]
    for name, value in FISHEYE_STRUCT.items():
        np.testing.assert_allclose(again[name], value, rtol=1e-13)


# Which format it is -----------------------------------------------------------------------------------------------


def test_own_files(tmp_path):
    camera = Camera(640, 480, 300.0, 300.0, 320.0, 240.0, 0.0, KannalaBrandt(0.01), ViewMask(320.0, 240.0, 200.0))
    assert load_camera(written(tmp_path, "c.toml", TOML)) == camera
    beside = "[vignetting]\nx = 1\n[emission]\ny = 2\n[response]\nz = 3\n"
    assert load_camera(written(tmp_path, "c.toml", TOML + beside)) == camera
    assert load_camera(written(tmp_path, "c.toml", "[camera]\n" + TOML + beside)) == camera


def test_a_file_is_known_by_what_it_holds(tmp_path):
    save_camera(CAMERAS["brown"], tmp_path / "cameras.txt", "colmap", some_poses())
    kinds = {"images.txt": "colmap images", "cameras.txt": "colmap", ".": "colmap"}
    assert {name: recognise(tmp_path / name) for name in kinds} == kinds
    # Under another name it is still the same.
    shutil.copy(tmp_path / "cameras.txt", tmp_path / "scope.cfg")
    assert load_camera(tmp_path / "scope.cfg") == CAMERAS["brown"]
    save_camera(CAMERAS["brown"], tmp_path / "own.toml")
    shutil.copy(tmp_path / "own.toml", tmp_path / "own.txt")
    assert recognise(tmp_path / "own.txt") == "toml"
    assert load_camera(tmp_path / "own.txt") == CAMERAS["brown"]
    # A # in a file's own name is no id.
    shutil.copy(tmp_path / "cameras.txt", tmp_path / "a#1.txt")
    assert load_camera(tmp_path / "a#1.txt") == load_camera(f"{tmp_path / 'a#1.txt'}#1") == CAMERAS["brown"]


SKEWED = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 2.0)
CUT = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 0.0, None, ViewMask(320, 240, 230, 60.0, 200.0))
UNSAVED = {
    "skew for COLMAP": (SKEWED, "cameras.txt", "colmap", "camera.skew = 2: must be 0"),
    "skew for NeRF": (SKEWED, "t.json", "transforms", "camera.skew = 2: must be 0"),
    "skew for OpenCV": (SKEWED, "c.yml", None, "camera.skew = 2: must be 0, since OpenCV ignores it"),
    "skew for ROS": (SKEWED, "c.yml", "ros", "since ROS ignores it"),
    "cut corners for OpenCV": (CUT, "c.yml", None, "OpenCV and ROS know round views alone"),
    "OpenCV in .mat": (CAMERAS["brown"], "c.mat", "opencv", "opencv needs a file name that ends in .yml, .yaml, .xml"),
    "TOML in .yml": (CAMERAS["brown"], "c.yml", "toml", "toml needs a file name that ends in .toml"),
    "COLMAP in .yml": (CAMERAS["brown"], "c.yml", "colmap", "colmap needs a file name that ends in .txt"),
    "unknown format": (CAMERAS["brown"], "c.yml", "kalibr", "format = 'kalibr': must be one of toml, opencv, ros"),
    "no camera": (np.eye(3), "c.yml", None, "camera is a ndarray"),
    "no folder": (CAMERAS["brown"], "no/c.yml", None, "No such file or directory"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNSAVED)
def test_what_a_format_cannot_hold_is_refused(tmp_path, case):
    camera, name, kind, fragment = UNSAVED[case]
    refused(lambda: save_camera(camera, tmp_path / name, kind), fragment)
    assert not list(tmp_path.iterdir())


def test_poses_that_a_format_cannot_hold_are_refused(tmp_path):
    def save(name, kind, poses):
        save_camera(CAMERAS["brown"], tmp_path / name, kind, poses)

    refused(lambda: save("c.yml", "opencv", some_poses()), "opencv holds no poses; must be one of colmap, transforms")
    refused(lambda: save("cameras.txt", None, [("a b.png", np.eye(4))]), "must be a name without spaces")
    assert not list(tmp_path.iterdir())
