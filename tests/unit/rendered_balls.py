"""Pictures of a ball that simtest renders with Mitsuba: a glossy sphere from outside, before a wall or before nothing.

Sphere, lens, lobe and shading come from the renderer, and nothing from `pictures`. The renderer has no room light, so
the wall is added where the rays miss the ball; it has no shadow on it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from simtest.calibration import Calibration, Response
from simtest.geometry.camera import Camera
from simtest.rendering import Session
from simtest.spec import Scene, scene_from_dict

Floats = npt.NDArray[np.float64]

CAMERA = {"width": 320, "height": 240, "fx": 230.0, "fy": 228.0, "cx": 163.5, "cy": 117.0}
SAMPLES = 4
"""Rays a pixel along each axis."""

GAMMA = 2.2
"""Of the coding: value = light^(1/gamma)."""

WALL = 0.45
"""Linear value of the wall in its middle; full scale is 1."""

BALL = 0.25
"""Linear value of the brightest matt pixel of the nearest ball."""


@dataclass(frozen=True)
class Rendering:
    """A ball of `radius_mm` at `centres`, shape (V, 3), mm, camera frame, in the light of `lights`, shape (S, 3), mm.

    `wall`: whether a wall in the light of a room is behind the ball; `blur_px`, `noise`: standard deviations of the
    point spread, px, and of the noise, share of full scale.
    """

    lights: Floats
    centres: Floats
    radius_mm: float
    wall: bool = True
    blur_px: float = 0.7
    noise: float = 0.005
    seed: int = 0

    def write(self, folder: Path) -> list[Path]:
        """Write a picture of each centre, 8 bits, grey; return the files."""
        scenes = [ball_scene(self, centre) for centre in self.centres]
        session, files, scale = Session(scenes[0]), [], 0.0
        for number, scene in enumerate(scenes):
            session.update(scene)
            frame = session.frame()
            matt = float(frame.radiance.diffuse.max())
            # One exposure for all pictures; the nearest ball is the brightest.
            scale = scale or BALL / matt
            light = scale * np.asarray(frame.radiance.intensity, dtype=float)
            light = np.where(frame.labels.mask, light, wall_light(light.shape) if self.wall else 0.0)
            files.append(folder / f"{number:02d}.png")
            cv2.imwrite(str(files[-1]), self._encoded(light, number))
        return files

    def _encoded(self, fine: Floats, number: int) -> npt.NDArray[np.uint8]:
        height, width = fine.shape[0] // SAMPLES, fine.shape[1] // SAMPLES
        blurred = gaussian_filter(fine, self.blur_px * SAMPLES)
        seen = blurred.reshape(height, SAMPLES, width, SAMPLES).mean(axis=(1, 3))
        seen += np.random.default_rng([self.seed, number]).normal(0, self.noise, seen.shape)
        return np.asarray(np.rint(255 * np.clip(seen, 0, 1) ** (1 / GAMMA)), dtype=np.uint8)


def wall_light(shape: tuple[int, ...]) -> Floats:
    """Return the wall's light, brighter on one side."""
    y, x = (np.linspace(-1, 1, count) for count in shape)
    return WALL * (1 + 0.15 * x[None] - 0.1 * y[:, None])


def ball_scene(made: Rendering, centre: Floats) -> Scene:
    """Return the scene of a ball at a centre, shape (3,), mm, with `SAMPLES` rays a pixel along each axis."""
    x, y, z = (float(value) for value in centre)
    camera: dict[str, Any] = {name: value * SAMPLES for name, value in CAMERA.items()}
    camera["moved"] = {"translation_mm": [-x, -y, 0.0]}
    surface = {"type": "sphere", "radius_mm": made.radius_mm, "distance_mm": z - made.radius_mm, "side": "outside"}
    return scene_from_dict(
        {
            "surface": surface, "camera": camera, "rig": rig_table(made.lights),
            "reflectance": {"type": "phong", "exponent": 3000.0, "specular": 4.0, "diffuse": 0.3},
        }
    )  # fmt: skip


def rig_table(lights: Floats) -> dict[str, Any]:
    """Return the rig of a scene with lights at these positions."""
    return {"lights": [{"position_mm": [float(value) for value in light]} for light in lights]}


def camera() -> Camera:
    """Return the camera of the pictures."""
    return Camera(**CAMERA)  # type: ignore[arg-type]


def plain_calibration() -> Calibration:
    """Return what is known of the camera before its lights are measured."""
    return Calibration(camera(), response=Response("gamma", GAMMA))


def places(count: int, radius_mm: float, seed: int) -> Floats:
    """Draw centres of a ball that is wholly in view, shape (count, 3), mm; the nearest is first."""
    rng, lens, found = np.random.default_rng([2411, seed]), camera(), []
    while len(found) < count:
        depth = rng.uniform(3.4, 6.0) * radius_mm
        reach = lens.fx * radius_mm / depth * 1.15 + 8
        pixel = rng.uniform([reach, reach], [lens.width - reach, lens.height - reach])
        ray = lens.unproject(pixel)
        found.append(ray * depth / ray[2])
    return np.array(sorted(found, key=lambda centre: float(centre[2])))


def nearest_errors(measured: Sequence[Floats], planted: Floats) -> list[Floats]:
    """Return the error of each measured position against the planted one that is nearest, mm."""
    return [min((each - light for light in planted), key=lambda gap: float(np.linalg.norm(gap))) for each in measured]
