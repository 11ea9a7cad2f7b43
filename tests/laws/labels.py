"""Laws of labels and files: what stands in truth, traced labels, frame files and datasets, against rays by hand."""

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from simtest.dataset.fields import BY_NAME
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session
from simtest.runtime.arrays import AnyArray, Array
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import encoded_png, write_frame
from simtest.spec import scene_from_dict
from simtest.spec.recipes import Dataset
from simtest.spec.sensor import Sensor
from tests.laws import by_hand
from tests.laws.law import Law, law

CAMERA = {"width": 60, "height": 48, "fx": 55.0, "fy": 55.0, "cx": 31.2, "cy": 22.8}
DISTANCE_MM, RADIUS_MM = 10.0, 3.0


def surfaces(session: Session) -> list[Law]:
    """Compare truth and traced labels of a sphere from outside, one from inside and a cylinder with rays by hand."""
    made = []
    for side, radius in (("outside", RADIUS_MM), ("inside", 14.0)):
        scene = _scene({"type": "sphere", "radius_mm": radius, "side": side})
        session.update(scene)
        truth, labels = session.truth(), session.frame().labels
        depth, normal = _sphere(radius, side == "inside")
        hit = np.isfinite(depth)
        k = 1 / radius if side == "outside" else -1 / radius
        for name, maps, close in (("exact", truth, 1e-9), ("traced", labels, 2e-5)):
            about = f"a sphere of {radius:g} mm from {side}, its rays by hand"
            off = {
                "depth_off": (np.abs(maps.depth - depth)[hit].max(), "mm", DISTANCE_MM),
                "normal_off": (by_hand.angle_deg(maps.normal[hit].astype(float), normal[hit]).max(), "deg", 60.0),
                "curvature_off": (
                    max(np.abs(maps.k_min[hit] - k).max(), np.abs(maps.k_max[hit] - k).max()),
                    "1/mm",
                    1.0,
                ),
            }
            for quantity, (value, unit, scale) in off.items():
                label = f"{side}_{name}_{quantity}"
                made.append(law("labels", label, unit, float(value), close * scale, n=int(hit.sum()), about=about))
        # The light is at the camera: the highlight is the point nearest to it.
        at = [(own.distance - DISTANCE_MM, own.kd_min - k * DISTANCE_MM, own.kd_max - k * DISTANCE_MM)
              for own in session.highlights()]  # fmt: skip
        gap = float(np.abs(at).max()) if len(at) == 1 else math.nan
        about = "distance, and distance times curvatures, of the one highlight"
        made.append(law("labels", f"{side}_highlight_off", "", gap, 1e-6, about=about))
        covered = {"exact": truth.mask, "traced": labels.instance == 0, "depth": np.isfinite(labels.depth)}
        for name, mask in covered.items():
            wrong = float((mask != hit).sum())
            made.append(law("mask", f"{side}_{name}_pixels_off", "", wrong, 0, n=hit.size, about="rays that hit it"))
    return [*made, _directions(session)]


def polyps(session: Session) -> list[Law]:
    """Compare polyps on a straight round tube with their closed form: which pixels show one, and its normals."""
    radius, domes = 20.0, ((45.0, 80.0, 4.0, 9.0, 0.0), (58.0, 20.0, 3.0, 7.0, 5.0))
    listed = [dict(zip(("along_mm", "around_deg", "height_mm", "width_mm", "steepness"), own, strict=True))
              for own in domes]  # fmt: skip
    tube = {"length_mm": 115.0, "radius_mm": radius, "bend_deg": 0.0, "sway_deg": 0.0, "taenia_mm": 0.0,
            "fold_depth_mm": 0.0, "polyps": listed}  # fmt: skip
    surface = {"type": "anatomy", "path": "colon", "recipe": tube, "view": "path", "path_share": 0.3}
    scene = scene_from_dict({"surface": surface, "camera": CAMERA | {"fx": 30.0, "fy": 30.0}}, "law")
    session.update(scene)

    def rises(X: Array) -> Array:
        """Return the height of each dome over its own, (2, N), from positions in the tube's frame, z along it."""
        made = []
        for along, around, _, width, steep in domes:
            # In units of the distance at half height, where t + steep t^2 = ln 2
            half = math.log(2) if not steep else (math.sqrt(1 + 4 * steep * math.log(2)) - 1) / (2 * steep)
            scale = half / (width / 2) ** 2
            turn = np.arctan2(X[:, 1], X[:, 0]) - math.radians(around)
            t = scale * ((X[:, 2] - along) ** 2 + 2 * radius**2 * (1 - np.cos(turn)))
            made.append(np.exp(-t - steep * t**2))
        return np.array(made)

    def free(X: Array) -> Array:
        return np.hypot(X[:, 0], X[:, 1]) - radius + np.array([own[2] for own in domes]) @ rises(X)

    truth, labels = session.truth(), session.frame().labels
    seen = truth.mask
    X, pose = session.to_model(truth.position[seen]), session.surface.model_from_camera
    share = rises(X)
    wanted = np.where(share.max(axis=0) > 0.1, 1 + share.argmax(axis=0), 0)
    # At the edge itself, whose place the mesh rounds, nothing is asked.
    sure = (np.abs(share - 0.1) > 2e-3).all(axis=0)
    step = 1e-5 * np.eye(3)
    gradient = np.stack([free(X + axis) - free(X - axis) for axis in step], axis=1)
    on = wanted > 0
    turned = by_hand.angle_deg(truth.normal[seen][on] @ pose[:3, :3].T, -gradient[on])
    made = [
        law("polyps", "off_surface", "mm", float(np.abs(free(X)).max()), 1e-8, n=len(X), about="closed form"),
        law(
            "polyps",
            "normal_off",
            "deg",
            max(turned.tolist(), default=math.nan),
            1e-3,
            n=int(on.sum()),
            about="closed form, differences",
        ),
    ]
    for name, maps in (("exact", truth), ("traced", labels)):
        assert maps.polyp is not None
        wrong = (maps.polyp[seen] != wanted)[sure].sum() + maps.polyp[~seen].sum()
        made.append(law("polyps", f"{name}_pixels_off", "", float(wrong), 0, n=int(sure.sum()), about="a tenth of it"))
    for number in (1, 2):
        shown = float((wanted == number).sum())
        made.append(law("polyps", f"shown_{number}", "px", shown, math.inf, 20, about="it is in view"))
    return made


def frame_files(session: Session) -> list[Law]:
    """Write a labelled frame, and read its files as another program would."""
    scene = _scene({"type": "cylinder", "radius_mm": 4.0, "spin_deg": 90.0, "tilt_deg": 6.0})
    with tempfile.TemporaryDirectory() as folder:
        write_frame(make_frame(scene, session.variant), Path(folder))
        truth = dict(np.load(Path(folder) / "truth.npz"))
        picture: Any = cv2.imread(str(Path(folder) / "frame.png"), cv2.IMREAD_UNCHANGED)
        described = json.loads((Path(folder) / "frame.json").read_text(encoding="utf-8"))
    mask, rays = truth["mask"], _rays()
    points = truth["position_mm"][mask].astype(float)
    along = np.abs(np.sqrt((points**2).sum(axis=1)) - truth["depth_mm"][mask]).max()
    aside = by_hand.angle_deg(points, rays[mask]).max()
    k_min, k_max = np.moveaxis(truth["curvature"][mask].astype(float), -1, 0)
    bent = max(np.abs(k_min).max(), np.abs(k_max - 0.25).max())
    behind = int((np.einsum("nc,nc->n", truth["normal"][mask], rays[mask]) >= 0).sum())
    # The picture's brightest value stands at the highlight that frame.json lists.
    ((x, y),) = [own["bp_px"] for own in described["highlights"]] or [(math.nan, math.nan)]
    row, column = np.unravel_index(int(picture.argmax()), picture.shape[:2])
    gap = max(abs(column + 0.5 - x), abs(row + 0.5 - y))
    # Colours: OpenCV reads blue first.
    red = np.zeros((2, 2, 3), dtype=np.float32)
    red[..., 0], red[..., 1] = 1.0, 0.2158605
    read: Any = cv2.imdecode(np.frombuffer(encoded_png(red, Sensor()), np.uint8), cv2.IMREAD_COLOR)
    decoded = read[0, 0].tolist()
    return [
        law("labels", "file_depth_off", "mm", float(along), 2e-5, n=len(points), about="length of position_mm"),
        law("labels", "file_rays_off", "deg", float(aside), 1e-4, n=len(points), about="on the sightline"),
        law("labels", "file_curvature_off", "1/mm", float(bent), 1e-6, n=len(points), about="0 and 1/4"),
        law("labels", "file_normals_behind", "", behind, 0, n=len(points), about="normals facing the camera"),
        law("labels", "file_highlight_off", "px", float(gap), 1.01, about="brightest pixel at the listed highlight"),
        law("encoding", "png_colour_off", "", float(np.abs(np.array(decoded) - [0, 128, 255]).max()), 0.5,
               about="linear red 1, green 0.21586 and blue 0 are blue 0, green 128 and red 255 for OpenCV"),
    ]  # fmt: skip


def encodings() -> list[Law]:
    """Decode each image of a sample by its documented formula from a PNG that OpenCV reads, and by the package."""
    rng = np.random.default_rng(30)
    normal = rng.standard_normal((24, 20, 3))
    normal /= np.sqrt((normal**2).sum(axis=-1, keepdims=True))
    depth = rng.uniform(3.0, 300.0, (24, 20))
    curvature = np.sort(rng.uniform(-3, 3, (24, 20, 2)), axis=-1)
    for image in (normal, depth, curvature):
        image[3, 4] = math.nan
    high, middle, low = np.split(_png("depth", depth).astype(float), 3)
    counts, scale = 65536 * high + 256 * middle + low, float(np.nanmax(depth)) / (2**22 - 1)
    deep = np.where(counts == 0, math.nan, counts * scale)
    u, v = (2 * (half.astype(float) - 1) / 16382 - 1 for half in np.split(_png("normal", normal), 2))
    z = np.abs(u) + np.abs(v) - 1
    folded = np.where(z > 0, np.copysign(1 - np.abs(v), u), u), np.where(z > 0, np.copysign(1 - np.abs(u), v), v)
    octahedral = np.stack([*folded, z], axis=-1)
    bent = np.stack(
        [(half.astype(float) - 32768) * 1e-4 for half in np.split(_png("curvature", curvature), 2)], axis=-1
    )
    sound = np.isfinite(depth)
    meta: Any = {"depth_scale_mm": scale}
    own = {name: BY_NAME[name].codec.decode(BY_NAME[name].codec.encode(image), meta)
           for name, image in (("depth", depth), ("normal", normal), ("curvature", curvature))}  # fmt: skip
    made = []
    for name, by_formula, wanted, quantum in (
        ("depth", deep, depth, 0.5 * scale + 300 * 2**-24), ("normal", octahedral, normal, 0.015),
        ("curvature", bent, curvature, 0.5e-4),
    ):  # fmt: skip
        for reader, found in (("formula", by_formula), ("reader", own[name])):
            if name == "normal":
                off = by_hand.angle_deg(found[sound].astype(float), wanted[sound]).max()
            else:
                off = np.abs(found - wanted)[sound].max()
            lost = np.isfinite(own[name][3, 4]).any()
            about = "half a step of the documented encoding; NaN stays"
            value = math.nan if lost else float(off)
            made.append(
                law(
                    "encoding", f"{name}_{reader}_off", "", value, quantum * (1 + 1e-3), n=int(sound.sum()), about=about
                )
            )
    return made


def dataset() -> list[Law]:
    """Make one sample of a plane, and compare its pictures, parts, regions and depth with the radiance by hand."""
    described = {
        "samples": 1, "highlights": 0, "shard_mb": 1.0, "splits": {"train": 1.0, "validation": 0.0, "test": 0.0},
        "families": [{"scene": "plane", "set": {
            **{f"camera.{key}": value for key, value in CAMERA.items()}, "surface.tilt_deg": 12.0,
            "reflectance.exponent": 40.0, "reflectance.diffuse": 0.3, "sensor.noise_sigma": 0.0,
            "surface.distance_mm": 10.0,
        }}],
    }  # fmt: skip
    plan = Plan(Dataset.model_validate({"name": "law", "estimators": ["brightest_point"], **described}))
    sample = Maker(plan).make(0)
    meta: Any = sample.meta
    images = {name: np.asarray(image) for name, image in sample.images.items()}
    rays = _rays()
    normal = by_hand.anchor_normal(12.0, float(meta["scene"]["surface"]["azimuth_deg"]))
    cosine = -(rays @ normal)
    depth = -10.0 * normal[2] / cosine
    # Light at the camera: cos^n(2 theta) and albedo/pi cos(theta), over the squared distance.
    lobe, base = np.maximum(2 * cosine**2 - 1, 0) ** 40 / depth**2, 0.3 / math.pi * cosine / depth**2
    off = {}
    for name, part in (("specular", lobe), ("diffuse", base), ("image", lobe + base)):
        wanted = _srgb(np.minimum(part / meta["full_scale"], 1.0)) * 255
        off[name] = float(np.abs(images[name][..., 0].astype(float) - wanted).max())
    # The region above half of the lobe's peak
    total = lobe + base
    (row, column) = np.unravel_index(int(total.argmax()), total.shape)
    region, at_peak = images["instance"], int(images["instance"][row, column])
    differ = float(((region == 1) != (lobe >= 0.5 * lobe.max())).sum())
    listed = [own["bp_px"] for own in meta["highlights"] if own["isolated"]]
    about = "sRGB of the radiance by hand, in steps of 255; half a step and the smallest rounding"
    deep = float(np.nanmax(np.abs(images["depth"] - depth)))
    return [
        *(
            law("encoding", f"{name}_picture_off", "", value, 0.6, n=total.size, about=about)
            for name, value in off.items()
        ),
        law("encoding", "sample_depth_off", "mm", deep, 1e-4, n=total.size, about="along the ray"),
        law("instances", "number_at_peak", "", at_peak, 1, 1, about="1 + the index of the only highlight"),
        law("instances", "others", "", float((region > 1).sum()), 0, n=region.size, about="0 or 1"),
        law("instances", "pixels_off", "", differ, 2, n=region.size, about="above half of the lobe's peak"),
        law("instances", "listed", "", len(listed), 1, 1, about="isolated highlights of a plane"),
    ]  # fmt: skip


def _scene(surface: dict[str, Any]) -> Any:
    return scene_from_dict(
        {
            "surface": {"distance_mm": DISTANCE_MM, **surface}, "camera": CAMERA,
            "reflectance": {"type": "phong", "exponent": 60.0}, "sensor": {"noise_sigma": 0.0},
        },
        "law",
    )  # fmt: skip


def _rays() -> Array:
    x, y = np.meshgrid(np.arange(CAMERA["width"]) + 0.5, np.arange(CAMERA["height"]) + 0.5)
    rays = np.stack([(x - CAMERA["cx"]) / CAMERA["fx"], (y - CAMERA["cy"]) / CAMERA["fy"], np.ones_like(x)], axis=-1)
    return np.asarray(rays / np.sqrt((rays**2).sum(axis=-1, keepdims=True)))


def _sphere(radius: float, inside: bool) -> tuple[Array, Array]:
    """Intersect the rays with a sphere through (0, 0, d); return distances, NaN for a miss, and facing normals."""
    rays = _rays()
    centre = np.array([0.0, 0.0, DISTANCE_MM - radius if inside else DISTANCE_MM + radius])
    along = rays @ centre
    under = along**2 - (centre @ centre - radius**2)
    root = np.sqrt(np.where(under >= 0, under, np.nan))
    depth = along + root if inside else along - root
    normal = (rays * depth[..., None] - centre) / radius
    return depth, -normal if inside else normal


def _directions(session: Session) -> Law:
    """Compare the principal directions of a cylinder with its axis and the direction around it."""
    spin = 25.0 * math.pi / 180
    session.update(_scene({"type": "cylinder", "radius_mm": 6.0, "spin_deg": 25.0}))
    maps = session.truth()
    # At spin 0 it is curved along x; its axis stands at right angles to that, across the optical axis.
    axis = np.array([-math.sin(spin), math.cos(spin), 0.0])
    along, around = maps.direction_min[maps.mask], maps.direction_max[maps.mask]
    off = max(float((1 - np.abs(along @ axis)).max()), float(np.abs(around @ axis).max()))
    return law("labels", "directions_off", "", off, 1e-9, n=len(along), about="the flat direction is the axis")


def _png(name: str, image: AnyArray) -> AnyArray:
    """Encode an image as a field, and read the PNG by OpenCV."""
    return np.asarray(cv2.imdecode(np.frombuffer(BY_NAME[name].codec.encode(image), np.uint8), cv2.IMREAD_UNCHANGED))


def _srgb(linear: Array) -> Array:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
