"""Rendered colour frames to detect specularities in: generated colons and livers, textured, as an endoscope shows them.

Mono radiance is rendered once; the diffuse part is coloured and textured afterwards, which for direct light is what a
textured albedo does. Lens, exposure, shot and read noise, response and 8 bits are the sensor's own.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.geometry import Camera
from simtest.rendering import Radiance, Session
from simtest.runtime.files import make_folder, write_atomically
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.sensor import capture, collect
from simtest.spec import Scene, scene_from_dict
from simtest.spec.toml_files import toml_value
from simtest.surfaces.recipe import load_anatomy

Image = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]

SPLITS = {"tuning": 100, "figures": 900}
"""Where the seeds of the anatomies begin: no anatomy is in both."""

ANATOMIES = 3
"""Anatomies of each kind."""

WIDTH, HEIGHT = 640, 480

COLOURS = {"colon": (0.80, 0.44, 0.36), "liver": (0.46, 0.16, 0.13)}
"""Linear colour of the tissue: mucosa, and the darker red of a liver; each frame's is drawn around it."""

EXPOSED_PERCENTILE = 90.0
"""This percentile of the tissue's strongest channel becomes full scale, divided by the exposure's gain."""

WAVES = 10
"""Plane waves that a texture is made of."""


@dataclass(frozen=True)
class StudyFrame:
    """A frame with all that its truth needs.

    `name`: anatomy and number; `picture` (shape (H, W, 3)): RGB as encoded; `specular`, `other` (shape (H, W)):
    light behind the lens, mean of the channels, over full scale; `noise` (shape (H, W)): standard deviation of the
    channels' mean, over full scale; `camera`: with the view mask, if any; `radiance`: as rendered; `scene`: as
    rendered.
    """

    name: str
    picture: Bytes
    specular: Image
    other: Image
    noise: Image
    camera: Camera
    radiance: Radiance
    scene: Scene


def study_frames(split: str, count: int, folder: Path, seed: int = 0) -> Iterator[StudyFrame]:
    """Render the frames of a split, half of them of colons, half of livers.

    `split`: which anatomies; `count`: frames in all; `folder`: for the recipes; `seed`: of everything drawn.
    """
    make_folder(folder)
    session: Session | None = None
    for kind in COLOURS:
        share = count // 2
        for k in range(ANATOMIES):
            recipe = _recipe(kind, SPLITS[split] + k, folder)
            for number in range(k * share // ANATOMIES, (k + 1) * share // ANATOMIES):
                scene = _scene(recipe, number, seed)
                if session is None:
                    session = Session(scene)
                session.update(scene)
                yield _frame(session, scene, kind, f"{recipe.stem}-{number}", seed)


def _recipe(kind: str, seed: int, folder: Path) -> Path:
    """Write the recipe of an anatomy: the shipped one with other random numbers, and a fine relief."""
    rng = generator(seed, "detection", kind, 0, Stage.SWEEP)
    settings: dict[str, Any] = {"relief_mm": float(rng.uniform(0.05, 0.12)) if kind == "colon" else 0.5}
    if kind == "colon":
        settings |= {"relief_length_mm": float(rng.uniform(4, 8)), "fold_depth_mm": float(rng.uniform(5, 8))}
    else:
        settings |= {"relief_length_mm": float(rng.uniform(18, 36))}
    described = load_anatomy(kind, seed=seed, settings=settings).model_dump(exclude_none=True)
    text = "".join(f"{key} = {toml_value(value)}\n" for key, value in described.items())
    path = folder / f"{kind}_{seed}.toml"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
    return path


def _scene(recipe: Path, number: int, seed: int) -> Scene:
    """Draw a scene: viewpoint, lobe, light, lens, exposure, sensor."""
    rng = generator(seed, "detection", recipe.stem, number, Stage.VIEWPOINT)
    focal = float(rng.uniform(300, 420))
    camera: dict[str, Any] = {"width": WIDTH, "height": HEIGHT, "fx": focal, "fy": focal}
    if rng.random() < 0.5:
        radius = float(rng.uniform(0.52, 0.72) * HEIGHT)
        camera["view_mask"] = {"cx": WIDTH / 2, "cy": HEIGHT / 2, "radius": radius}
    return scene_from_dict(
        {
            "surface": {"type": "anatomy", "path": str(recipe), "viewpoint": number},
            "reflectance": {
                "type": "phong",
                "exponent": float(np.exp(rng.uniform(math.log(60), math.log(500)))),
                "specular": float(np.exp(rng.uniform(math.log(0.15), math.log(1.5)))),
                "diffuse": 0.5,
            },
            "rig": {"lights": [{"offset_mm": float(rng.uniform(0, 4)), "azimuth_deg": float(rng.uniform(0, 360))}]},
            "camera": camera,
            "sensor": {
                "point_spread_px": float(rng.uniform(0.6, 1.2)),
                "vignetting": {"type": "cosine", "power": float(rng.uniform(1, 4))},
                "exposure": {"percentile": EXPOSED_PERCENTILE, "gain": float(rng.uniform(0.25, 0.6))},
                "full_well": float(np.exp(rng.uniform(math.log(2000), math.log(15000)))),
                "read_noise": 8.0,
                "response": {"type": "srgb"},
                "bits": 8,
            },
        },
        f"detection {recipe.stem} {number}",
    )


def _frame(session: Session, scene: Scene, kind: str, name: str, seed: int) -> StudyFrame:
    frame = session.frame()
    radiance = frame.radiance
    rng = generator(seed, "detection", name, 0, Stage.SWEEP)
    colour = np.array(COLOURS[kind]) * rng.uniform(0.85, 1.15, 3)
    albedo = (colour * _texture(frame.labels.position, rng)).astype(np.float32)
    diffuse = collect(radiance.diffuse[:, :, None] * albedo, scene.sensor, session.camera)
    specular = collect(radiance.specular, scene.sensor, session.camera)
    seen = session.camera.seen
    total = diffuse + specular[:, :, None]
    if seen is not None:
        total[~seen] = 0
    lit = diffuse.max(axis=2)[diffuse.max(axis=2) > 0]
    # Exposed for the tissue, as an endoscope does: its highlights clip.
    sensor = scene.sensor
    full_scale = float(np.percentile(lit, EXPOSED_PERCENTILE)) / sensor.exposure.gain
    values = capture(total, full_scale, sensor, generator(seed, "detection", name, 0, Stage.SENSOR))
    other = diffuse.mean(axis=2) / full_scale
    noise = sensor.noise_model().at(np.clip(other + specular / full_scale, 0, 1), 3)
    picture = np.rint(255 * values).astype(np.uint8)
    return StudyFrame(
        name, picture, (specular / full_scale).astype(np.float32), other.astype(np.float32),
        np.asarray(noise, dtype=np.float32), session.camera, radiance, scene,
    )  # fmt: skip


def _texture(position: Image, rng: np.random.Generator) -> Image:
    """Return the factor of the albedo at surface points, shape (H, W, 3): mottling, and vessels, which are redder."""
    points = np.nan_to_num(position).reshape(-1, 3)
    wavelengths = np.exp(rng.uniform(math.log(1.5), math.log(25), WAVES))
    directions = rng.normal(size=(WAVES, 3))
    directions *= (2 * math.pi / wavelengths / np.linalg.norm(directions, axis=1))[:, None]
    waves = np.sin(points @ directions.T.astype(np.float32) + rng.uniform(0, 2 * math.pi, WAVES).astype(np.float32))
    # Brightness varies more than hue, and each channel of its own besides.
    common = rng.uniform(0.03, 0.12) * waves.mean(axis=1)
    own = rng.uniform(0.02, 0.10) * waves @ rng.normal(size=(WAVES, 3)).astype(np.float32) / WAVES
    mottled = np.exp(math.sqrt(WAVES) * (common[:, None] + own))
    # A vessel runs where a smooth field passes through zero.
    field = waves[:, : WAVES // 2].sum(axis=1)
    vessel = np.exp(-((field / rng.uniform(0.1, 0.25)) ** 2)) * rng.uniform(0.0, 0.6)
    strength = np.array([0.25, 0.8, 0.7])
    factor = mottled * (1 - vessel[:, None] * strength)
    return np.asarray(factor, dtype=np.float32).reshape(*position.shape)
