"""Laws of lenses, view masks, camera files and rigs against their published formulas."""

import math
import tempfile
from pathlib import Path

import numpy as np

from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Scaramuzza, ViewMask
from simtest.geometry.vectors import bisect
from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.spec import load_camera, scene_from_dict
from simtest.spec.lights import Rig
from tests.laws.law import Law, law

FX, FY, CX, CY, SKEW = 310.0, 300.0, 163.3, 117.8, 7.0
BROWN = {"k1": -0.21, "k2": 0.06, "p1": 0.004, "p2": -0.006, "k3": -0.02, "k4": 0.03, "k5": -0.015, "k6": 0.012}
FISHEYE = {"k1": 0.05, "k2": -0.02, "k3": 0.008, "k4": -0.003}
OMNI = {"k2": -0.55, "k3": 0.21, "k4": -0.17, "c": 0.997, "d": 0.006, "e": -0.004}

SMALL = {"width": 48, "height": 36, "fx": 31.0, "fy": 30.0, "cx": 25.3, "cy": 17.8, "skew": 1.5}
DISTANCE_MM, TILT_DEG, AZIMUTH_DEG = 10.0, 12.0, 40.0


def lenses() -> list[Law]:
    """Project directions through all lenses with all coefficients and a skew, by hand, and back."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.45, 0.45, 9), np.linspace(-0.35, 0.35, 7)))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays /= np.sqrt((rays**2).sum(axis=1, keepdims=True))
    wide = np.stack([2.2 * x, 2.2 * y, np.ones_like(x)], axis=-1)
    wide /= np.sqrt((wide**2).sum(axis=1, keepdims=True))
    made = []
    for name, lens, seen, normalised in (
        ("brown_conrady", BrownConrady(**BROWN), rays, _brown(x, y)),
        ("kannala_brandt", KannalaBrandt(**FISHEYE), wide, _fisheye(wide)),
        ("scaramuzza", Scaramuzza(**OMNI), wide, _omni(wide)),
    ):
        camera = Camera(320, 240, FX, FY, CX, CY, SKEW, lens)
        u, v = normalised
        pixels = np.stack([FX * u + SKEW * v + CX, FY * v + CY], axis=-1)
        off = float(np.abs(camera.project(seen) - pixels).max())
        back = float(np.abs(camera.unproject(pixels) - seen).max())
        about = "all coefficients and a skew; the model's formula by hand"
        made += [
            law("lens", f"{name}_off", "px", off, 1e-9, n=len(seen), about=about),
            law("lens", f"{name}_back", "", back, 1e-9, n=len(seen), about="pixels by hand back to directions"),
        ]
    return made


def lens_rays() -> list[Law]:
    """Trace a tilted plane through a skewed pinhole, fisheye and omnidirectional lens; compare with rays by hand."""
    tilt, azimuth = math.radians(TILT_DEG), math.radians(AZIMUTH_DEG)
    normal = np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), -math.cos(tilt)])
    made, session = [], None
    for name, lens in (
        ("pinhole", None),
        ("fisheye", {"type": "kannala_brandt", **FISHEYE}),
        ("omni", {"type": "scaramuzza", **OMNI}),
    ):
        surface = {"type": "plane", "distance_mm": DISTANCE_MM, "tilt_deg": TILT_DEG, "azimuth_deg": AZIMUTH_DEG}
        scene = scene_from_dict({"surface": surface, "camera": {**SMALL, "distortion": lens}}, "law")
        if session is None:
            session = Session(scene)
        session.update(scene)
        rays = _rays(name)
        along = DISTANCE_MM * normal[2] / (rays @ normal)
        seen = along > 0
        points = session.frame().labels.position.astype(float)
        off = np.abs(points - rays * along[..., None])[seen].max()
        about = "single precision leaves 1e-6 of the distance"
        made.append(law("lens_rays", f"{name}_off", "mm", float(off), 2e-4, n=int(seen.sum()), about=about))
    return made


def view_masks() -> list[Law]:
    """Count the pixels of a round view and of an octagon, whose borders are simple to write down."""
    x, y = np.meshgrid(np.arange(120) + 0.5 - 63.0, np.arange(100) + 0.5 - 47.0)
    wanted = {
        "round": (ViewMask(63.0, 47.0, 41.0), np.sqrt(x * x + y * y) <= 41.0),
        "cut": (ViewMask(63.0, 47.0, 50.0, 20.0, 35.0),
                (abs(x) <= 50) & (abs(y) <= 35) & (abs(x) + abs(y) <= 50 + 35 - 20)),
    }  # fmt: skip
    made = []
    for name, (mask, by_hand) in wanted.items():
        seen = Camera(120, 100, 100.0, 100.0, 60.0, 50.0, view_mask=mask).seen
        differ = float("nan") if seen is None else float((seen != by_hand).sum())
        made.append(law("view_mask", f"{name}_pixels_off", "", differ, 0, n=x.size, about="pixels in or out, by hand"))
    return made


def camera_files() -> list[Law]:
    """Read a camera from files of OpenCV, ROS, MATLAB and COLMAP, whose first pixels are centred at 0, 0, 1 and 0.5."""
    from scipy.io import savemat

    K = [[500.0, 2.0, 310.25], [0.0, 480.0, 225.75], [0.0, 0.0, 1.0]]
    flat = ", ".join(f"{value}" for row in K for value in row)
    lens = "-0.2, 0.05, 0.001, -0.002, 0.01"
    texts = {
        "opencv.yml": "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {flat} ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ {lens} ]\n",
        "ros.yaml": "image_width: 640\nimage_height: 480\ndistortion_model: plumb_bob\n"
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{flat}]\n"
        f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{lens}]\n",
        "colmap.txt": "1 FULL_OPENCV 640 480 500 480 310.25 225.75 -0.2 0.05 0.001 -0.002 0.01 0 0 0\n",
    }
    first = {"opencv.yml": 0.0, "ros.yaml": 0.0, "matlab.mat": 1.0, "colmap.txt": 0.5}
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for name, centre in first.items():
            path = Path(folder) / name
            if name in texts:
                path.write_text(texts[name], encoding="utf-8")
            else:
                radial, tangential = [-0.2, 0.05, 0.01], [0.001, -0.002]
                savemat(path, {"s": {"K": K, "ImageSize": [480, 640], "RadialDistortion": radial,
                                     "TangentialDistortion": tangential}})  # fmt: skip
            camera = load_camera(path)
            # Pixel centres lie at + 0.5 here, at `centre` there.
            skew = 0.0 if name == "colmap.txt" else 2.0
            wanted = [500.0, 480.0, 310.25 + 0.5 - centre, 225.75 + 0.5 - centre, skew, -0.2, 0.05, 0.001, -0.002, 0.01]
            d = camera.distortion
            found = [camera.fx, camera.fy, camera.cx, camera.cy, camera.skew]
            found += [getattr(d, key, math.nan) for key in ("k1", "k2", "p1", "p2", "k3")]
            off = float(np.abs(np.array(found) - wanted).max())
            about = "every number of the file; the principal point moves by half a pixel"
            made.append(law("camera files", f"{path.suffix[1:]}_off", "", off, 1e-12, n=len(wanted), about=about))
    return made


def rigs() -> list[Law]:
    """Compare lights on a ring, by an angle, or drawn, with trigonometry by hand; and a bisector with its angles."""
    one = Rig.model_validate({"lights": [{"offset_mm": 2.0, "azimuth_deg": 35.0}]}).nominal_mm()[0]
    by_angle = [2 * math.cos(35 / 180 * math.pi), 2 * math.sin(35 / 180 * math.pi), 0.0]
    ring = Rig.model_validate(
        {"preset": "colonoscope_3", "azimuth_deg": 20.0, "radius_mm": 5.0, "axial_mm": -1.0, "power": 6.0}
    )
    angles = [(20 + 120 * i) / 180 * math.pi for i in range(3)]
    on_ring = np.array([[5 * math.cos(a), 5 * math.sin(a), -1.0] for a in angles])
    powers = np.array([light.power for light in ring.lights])
    off = max(np.abs(one - by_angle).max(), np.abs(ring.nominal_mm() - on_ring).max())
    # Drawn deviations, three of each of many seeds
    loose = {"lights": [{"position_mm": [1.0, 2.0, 0.0], "position_error_mm": 0.5}]}
    drawn = np.array([Rig.model_validate({**loose, "seed": seed}).true_mm()[0] for seed in range(400)])
    sigma = float(np.sqrt(np.mean((drawn - [1.0, 2.0, 0.0]) ** 2))) / 0.5
    gap = 5 / math.sqrt(2 * drawn.size)
    # A bisector makes the same angle with the directions to light and camera, and lies in their plane.
    point, light = np.array([1.0, -2.0, 9.0]), np.array([3.0, 1.0, 0.5])
    middle = bisect(point, light)
    cosines = [middle @ (to - point) / math.sqrt(((to - point) ** 2).sum()) for to in (light, np.zeros(3))]
    aside = abs(float(middle @ np.cross(light - point, -point)))
    return [
        law("rig", "position_off", "mm", float(off), 1e-12, n=4, about="azimuth from x to y, at right angles to z"),
        law("rig", "power_off", "", float(np.abs(powers - 2.0).max()), 1e-12, n=3, about="6 shared by three lights"),
        law("rig", "sigma", "x", sigma, 1 + gap, 1 - gap, drawn.size, "drawn deviations of 0.5 mm; 5 standard errors"),
        law("bisector", "angles_off", "", abs(cosines[0] - cosines[1]) + aside, 1e-12, about="equal angles, one plane"),
    ]


def _brown(x: Array, y: Array) -> tuple[Array, Array]:
    """Distort normalised coordinates by OpenCV's rational model."""
    c = BROWN
    r2 = x * x + y * y
    radial = (1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3) / (
        1 + c["k4"] * r2 + c["k5"] * r2**2 + c["k6"] * r2**3
    )
    u = x * radial + 2 * c["p1"] * x * y + c["p2"] * (r2 + 2 * x * x)
    v = y * radial + c["p1"] * (r2 + 2 * y * y) + 2 * c["p2"] * x * y
    return u, v


def _radius(theta: Array) -> Array:
    """Compute the fisheye's image radius of an angle off the axis."""
    c = FISHEYE
    return np.asarray(theta + c["k1"] * theta**3 + c["k2"] * theta**5 + c["k3"] * theta**7 + c["k4"] * theta**9)


def _fisheye(rays: Array) -> tuple[Array, Array]:
    """Image unit directions by OpenCV's fisheye model."""
    theta, phi = np.arccos(rays[:, 2]), np.arctan2(rays[:, 1], rays[:, 0])
    return _radius(theta) * np.cos(phi), _radius(theta) * np.sin(phi)


def _omni(rays: Array) -> tuple[Array, Array]:
    """Image unit directions by Scaramuzza's model: the smallest positive root of its quartic in r, ray by ray."""
    c = OMNI
    made = []
    for x, y, z in rays.tolist():
        across = math.sqrt(x * x + y * y)
        if across == 0:
            made.append((0.0, 0.0))
            continue
        roots = np.roots([c["k4"], c["k3"], c["k2"], -z / across, 1.0])
        r = min(root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0)
        made.append((r * x / across, r * y / across))
    x, y = np.array(made).T
    return c["c"] * x + c["d"] * y, c["e"] * x + y


def _rays(kind: str) -> Array:
    """Compute unit sightlines of the small camera, shape (H, W, 3); a fisheye's angle by bisection."""
    c = SMALL
    px, py = np.meshgrid(np.arange(c["width"]) + 0.5, np.arange(c["height"]) + 0.5)
    v = (py - c["cy"]) / c["fy"]
    u = (px - c["cx"] - c["skew"] * v) / c["fx"]
    if kind == "omni":
        m = OMNI
        x, y = np.linalg.solve([[m["c"], m["d"]], [m["e"], 1.0]], [u.ravel(), v.ravel()])
        r = np.sqrt(x * x + y * y)
        rays = np.stack([x, y, 1 + m["k2"] * r**2 + m["k3"] * r**3 + m["k4"] * r**4], axis=-1).reshape(*u.shape, 3)
        return np.asarray(rays / np.sqrt((rays**2).sum(axis=-1, keepdims=True)))
    if kind == "pinhole":
        rays = np.stack([u, v, np.ones_like(u)], axis=-1)
        return np.asarray(rays / np.sqrt((rays**2).sum(axis=-1, keepdims=True)))
    radius = np.sqrt(u * u + v * v)
    low, high = np.zeros_like(radius), np.full_like(radius, 1.5)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = np.where(_radius(middle) < radius, middle, low), np.where(_radius(middle) < radius, high, middle)
    return np.stack([np.sin(low) * u / radius, np.sin(low) * v / radius, np.cos(low)], axis=-1)
