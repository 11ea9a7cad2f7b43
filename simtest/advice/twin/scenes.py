"""Draws the scene of one frame of the bank: what the user told as told, everything else from its prior.

The pool of quadric patches with relief and pattern is fixed, so that its reliefs and patterns are made once and then
read from the user's cache. What differs between twins is the view of a patch, the lights, the film's lobe and the
camera chain.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.advice.tissue import ANY, NAMES, ORGANS, Tissue, between
from simtest.calibration import Calibration, CameraPrior, Distribution, LogUniform, Uniform
from simtest.calibration.photometry import AngularProfile
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array, Image, Mask
from simtest.runtime.resources import find
from simtest.runtime.seeds import from_integer
from simtest.spec import Scene, apply_settings, read_toml, scene_from_dict
from simtest.spec.camera_tables import camera_table

POOL = 16
"""Patches in the pool."""

POOL_SEED = 230_601
"""Of the pool; no study draws its frames from it."""

ANCHOR_MM = 40.0
"""Depth of a patch's anchor in the view that its surface keys state; the camera is then moved to its own view."""

REACH_MM = 10.0
"""The point of a patch that a twin looks at lies within so much of the anchor along each axis, mm."""

MOST_TILT_DEG = 35.0
"""Largest angle between the base's normal and the reversed sightline at that point: highlights farther out are rare."""

LEAST_GAIN = 0.2
"""Smallest abs(1 + d k) of the base at that point: nearer to 0 a wall shows a streak, not highlights. 1 + d k is
negative where the wall bends around the camera, as the far wall of a lumen does."""


@dataclass(frozen=True)
class TissuePatch:
    """A patch of tissue."""

    k_per_mm: tuple[float, float]  # principal curvatures of its base at the anchor, convex positive
    surface: dict[str, Any]  # table of a scene

    def points(self, u: float, v: float) -> tuple[Array, Array]:
        """Return a point of the base and its normal, shape (3,) each, mm, in the patch's own frame."""
        k1, k2 = self.k_per_mm
        normal = np.array([k1 * u, k2 * v, 1.0])
        return np.array([u, v, -(k1 * u * u + k2 * v * v) / 2]), normal / np.linalg.norm(normal)


def make_pool(count: int = POOL, tissue: Tissue = ANY) -> list[TissuePatch]:
    """Return the pool of a tissue, its first `count` patches: curvature of a fold, a lumen or a body, and a relief."""
    pool = []
    for number in range(count):
        rng = from_integer(POOL_SEED + number)
        k1, k2 = tissue.draw_curvatures(rng)
        surface = {
            "type": "quadric", "distance_mm": ANCHOR_MM, "k1_per_mm": k1, "k2_per_mm": k2,
            "relief": {"seed": number, "bands": [band.draw(rng) for band in tissue.bands]},
        }  # fmt: skip
        pool.append(TissuePatch((k1, k2), surface))
    return pool


def look_at(
    patch: TissuePatch, rng: np.random.Generator, sightline: Array, distance: float, tries: int = 20
) -> dict[str, tuple[float, float, float]] | None:
    """Draw a view of a patch in which a unit sightline, camera frame, meets it at a distance, mm.

    Drawn are the point looked at, the tilt of the base there, and the turn about the normal. Before the camera is
    moved, the patch's anchor stands at (0, 0, `ANCHOR_MM`), its normal (0, 0, -1). Returns the table `camera.moved` of
    a scene; None where none of `tries` points lies well in view of the camera.
    """
    for _ in range(tries):
        u, v = rng.uniform(-REACH_MM, REACH_MM, 2)
        point, normal = patch.points(float(u), float(v))
        if min(abs(1 + distance * k) for k in patch.k_per_mm) < LEAST_GAIN:
            return None
        # Even in solid angle about the reversed sightline.
        tilt = math.acos(rng.uniform(math.cos(math.radians(MOST_TILT_DEG)), 1.0))
        leaned = _turned(-sightline, _across(sightline, float(rng.uniform(0, 2 * math.pi))), tilt)
        # patch_from_moved: takes the leaned normal to the patch's, with any turn about it.
        rotation = _frame(normal, float(rng.uniform(0, 2 * math.pi))) @ _frame(leaned, 0.0).T
        centre = point - rotation @ (distance * sightline)
        k1, k2 = patch.k_per_mm
        if centre[2] + (k1 * centre[0] ** 2 + k2 * centre[1] ** 2) / 2 > 0.3 * distance:
            return _moved(rotation, centre)
    return None


def _moved(rotation: Array, centre: Array) -> dict[str, tuple[float, float, float]]:
    """Return the motion from the view that the surface keys state, from the camera's pose in the patch's frame."""
    # unmoved_from_patch: x to the right stays, the patch's z points back at the camera.
    turn = np.diag([1.0, -1.0, -1.0])
    R = turn @ rotation
    t = turn @ centre + np.array([0.0, 0.0, ANCHOR_MM])
    angle = math.acos(float(np.clip((np.trace(R) - 1) / 2, -1, 1)))
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        # A half turn, or none.
        axis = np.sqrt(np.maximum((np.diag(R) + 1) / 2, 0)) if angle > 1 else np.array([1.0, 0.0, 0.0])
        length = float(np.linalg.norm(axis))
    turned = np.degrees(angle) * axis / length
    x, y, z = t.tolist()
    rx, ry, rz = turned.tolist()
    return {"translation_mm": (x, y, z), "rotation_deg": (rx, ry, rz)}


def _frame(normal: Array, spin: float) -> Array:
    """Return a rotation whose third column is a unit vector."""
    first = _across(normal, spin)
    return np.stack([first, np.cross(normal, first), normal], axis=1)


def _across(direction: Array, spin: float) -> Array:
    """Return a unit vector perpendicular to a unit direction, turned about it by an angle, rad."""
    least = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first)
    return np.asarray(math.cos(spin) * first + math.sin(spin) * np.cross(direction, first))


def _turned(direction: Array, axis: Array, angle: float) -> Array:
    """Return a unit direction turned about an axis perpendicular to it, rad."""
    return np.asarray(math.cos(angle) * direction + math.sin(angle) * np.cross(axis, direction))


SCENES = tuple(ORGANS[name].scene for name in NAMES)
"""Shipped scenes whose colour and translucency tissue is given: that of the nearest colour."""

CHAINS = ("colonoscope_hd", "laparoscope_hd", "old_sd")
"""Camera chains that are drawn from; which one made a frame is not known."""

RIGS = ((1, 0.3), (2, 0.3), (3, 0.2), (8, 0.2))
"""Numbers of lights around the lens where nobody told the rig, with their shares."""

MEAN_LEVELS = (0.1, 0.8)
"""Mean values of a picture that an exposure can be set to."""

DARK, BRIGHT = 0.1, 0.95
"""Pixels below this share of the encoded value at this quantile show no tissue, but what lies far behind it."""

RESPONSE_KEYS: dict[str, tuple[str, ...]] = {"gamma": ("gamma",), "table": ("light", "value"), "linear": ()}
"""Of a told response, by its kind; of another one the chain's own is taken."""

SAMPLES = 4
"""Rays of a pixel."""

TRIES = 10
"""Draws of a view before a frame is given up."""


@dataclass(frozen=True)
class Look:
    """What the frame itself shows of its tissue and exposure."""

    organ: str  # shipped scene whose colour and translucency twins have: of the told organ, or of the nearest colour
    mean: float  # encoded value of the pixels that show tissue


def look_of(picture: Image, seen: Mask | None, tissue: Tissue = ANY) -> Look:
    """Measure a picture as encoded, shape (H, W) or (H, W, 3); `seen`, shape (H, W), are the pixels of its view.

    A black background has the colour of no tissue, and an exposure set by an average does not count it. A colour does
    not tell how dark the tissue is, but the film shines as brightly on dark tissue as on pale: so a told organ decides.
    """
    values = picture.reshape(-1, *picture.shape[2:]) if seen is None else picture[seen]
    levels = values if values.ndim == 1 else values.mean(axis=1)
    values = values[levels >= DARK * np.quantile(levels, BRIGHT)]
    mean = float(np.clip(values.mean(), *MEAN_LEVELS))
    if tissue.organ is not None or picture.ndim == 2:
        return Look(tissue.organ.scene if tissue.organ else SCENES[0], mean)
    linear = np.median(values, axis=0).astype(float) ** 2.2 + 1e-3
    bases = {organ: _base_colour(organ) for organ in SCENES}
    # Colour alone: the level is the exposure's.
    away = {organ: float(angle_deg(base / np.linalg.norm(base), linear / np.linalg.norm(linear)))
            for organ, base in bases.items()}  # fmt: skip
    return Look(min(away, key=lambda organ: away[organ]), mean)


def _base_colour(organ: str) -> Array:
    albedo = scene_from_dict({**read_toml(find(organ, "scenes")), "name": organ}).albedo
    assert albedo is not None
    return np.array(albedo.base, dtype=float)


class SceneDraws:
    """Draws scenes as a user's frame may have been taken: lights, distances and a camera from what the user told."""

    def __init__(self, calibration: Calibration, look: Look, tissue: Tissue = ANY) -> None:
        self._calibration, self._look, self.tissue = calibration, look, tissue
        self._base = read_toml(find(look.organ, "scenes"))

    def draw(self, rng: np.random.Generator, patch: TissuePatch, pixels: Array, share: float) -> Scene | None:
        """Draw a scene that shows a patch at one of some pixels, shape (N, 2), px.

        `share`, in (0, 1), is the quantile of its distance, so that the distances of a bank are even. None where no
        view of the patch is possible, as where it is bent towards a camera that far away.
        """
        priors = self._calibration.priors
        for _ in range(TRIES):
            pixel = pixels[int(rng.integers(len(pixels)))]
            sightline = self._calibration.camera.unproject(pixel)
            distance = _distance(priors.distance, share)
            moved = look_at(patch, rng, sightline, distance) if np.isfinite(sightline).all() else None
            if moved is None:
                continue
            values = {
                "surface": patch.surface, "rig": self._rig(rng), "reflectance.film": self._film(rng),
                "sensor": self._sensor(rng), "render.samples_per_pixel": SAMPLES,
            }  # fmt: skip
            try:
                values["camera"] = {**drawn_camera(self._calibration.camera, priors.camera, rng), "moved": moved}
                organ = self._look.organ
                return scene_from_dict({**apply_settings(self._base, values, organ), "name": organ}, organ)
            except InputError:
                # A drawn lens may fold, or a light lie in the tissue: another draw.
                continue
        return None

    def _film(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw the liquid film: its lobe, and how far it fills the valleys."""
        film = dict(self._base["reflectance"]["film"])
        film["alpha"] = between(rng, self.tissue.alpha)
        film["level"] = float(rng.uniform(*self.tissue.level))
        return film

    def _rig(self, rng: np.random.Generator) -> dict[str, Any]:
        """Return the lights: where they were told, or on a ring as the prior has it; their exits are drawn."""
        priors = self._calibration.priors
        source = {"type": "disc", "radius_mm": float(rng.uniform(0.5, 1.3))}
        each = {"source": source, "profile": {"type": "cosine", "power": float(rng.uniform(0.0, 2.0))}}
        if not self._calibration.emission.is_uniform:
            each["profile"] = _profile(self._calibration.emission)
        if priors.lights_mm:
            return {"lights": [{"position_mm": list(light), **each} for light in priors.lights_mm]}
        counts, shares = zip(*RIGS, strict=True)
        count = int(rng.choice(counts, p=shares))
        radius, azimuth = _drawn(priors.light_offset_mm, rng), float(rng.uniform(0, 360))
        ring = [{"offset_mm": radius, "azimuth_deg": (azimuth + 360 * i / count) % 360} for i in range(count)]
        return {"lights": [{**light, "power": 1 / count, **each} for light in ring]}

    def _sensor(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw a camera chain with the frame's mean level, its response where it was told."""
        calibration = self._calibration
        response = calibration.response
        sensor: dict[str, Any] = {
            "preset": CHAINS[int(rng.integers(len(CHAINS)))],
            "point_spread_px": float(rng.uniform(0.55, 1.0)),
            "exposure": {"average": float(np.clip(self._look.mean * rng.uniform(0.9, 1.1), *MEAN_LEVELS))},
            "full_well": math.exp(rng.uniform(math.log(3000), math.log(40000))),
            "vignetting": {"type": "cosine", "power": float(rng.uniform(0.0, 4.5))},
            "sharpening": {
                "radius_px": math.exp(rng.uniform(math.log(1.0), math.log(2.9))),
                "amount": float(rng.uniform(0.3, 1.8)),
            },
            "coding": {"type": "jpeg", "quality": int(rng.integers(70, 96)), "chroma": "4:2:0"},
            "seed": int(rng.integers(2**31)),
        }  # fmt: skip
        if response is not None and (keys := RESPONSE_KEYS.get(response.kind)) is not None:
            sensor["response"] = {"type": response.kind, **{key: getattr(response, key) for key in keys}}
        if not calibration.vignetting.is_uniform:
            sensor["vignetting"] = _profile(calibration.vignetting)
        return sensor


def drawn_camera(camera: Camera, prior: CameraPrior, rng: np.random.Generator) -> dict[str, Any]:
    """Return the table of a camera about the told one, as far as its prior leaves it open."""
    scale = max(1 + prior.focal_sd * float(rng.standard_normal()), 0.3)
    shift = prior.centre_sd_px * rng.standard_normal(2)
    error = prior.distortion_sd * float(rng.standard_normal())
    camera = camera.with_radial_error(error, prior.edge_reach)
    table: dict[str, Any] = camera_table(camera)
    table |= {"fx": camera.fx * scale, "fy": camera.fy * scale}
    return table | {"cx": camera.cx + float(shift[0]), "cy": camera.cy + float(shift[1])}


def _profile(profile: AngularProfile) -> dict[str, Any]:
    """Return the table of a told profile."""
    if profile.angles:
        return {"type": "table", "angle_deg": np.degrees(profile.angles).tolist(), "value": list(profile.values)}
    return {"type": "cosine", "power": profile.power}


def _distance(prior: Distribution, share: float) -> float:
    """Return the distance below which a share of the draws lies, mm.

    Of a range the ends alone are known, and errors go with 1 / distance: it is drawn evenly in the logarithm.
    """
    if isinstance(prior, Uniform) and prior.low > 0:
        prior = LogUniform(prior.low, prior.high)
    return float(prior.quantile(np.array(share)))


def _drawn(prior: Distribution, rng: np.random.Generator) -> float:
    """Draw from a distribution."""
    return float(prior.quantile(np.array(rng.uniform(1e-6, 1 - 1e-6))))
