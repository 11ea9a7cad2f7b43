"""Rigs with planted lights, and the pictures of a ball that they take."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Response
from simtest.geometry.camera import Camera
from simtest.geometry.lenses import BrownConrady, KannalaBrandt
from simtest.spec.calibration_file import save_calibration
from studies.light_calibration.pictures import Floats, Look, picture_of_ball

WIDTH, HEIGHT = 640, 512
LENSES = ("pinhole", "brown_conrady", "kannala_brandt")
KINDS = ("wet", "chrome")
VIEWS = 8
APART_MM = 3.0
"""Least distance of two lights: nearer ones show one highlight on most balls."""

NEAREST_MM, FARTHEST_MM = 20.0, 60.0


@dataclass(frozen=True)
class Planting:
    """A rig: camera, lights, shape (S, 3), mm, the ball's kind and radius, mm, and its centres, shape (V, 3), mm."""

    lens: str
    kind: str
    camera: Camera
    lights: Floats
    radius_mm: float
    centres: Floats
    look: Look
    seed: int

    def pictures(self, lights: Floats | None = None) -> list[tuple[str, Callable[[], npt.NDArray[np.float32]]]]:
        """Return name and reader of each picture; `lights`, shape (V, S, 3), replaces the planted ones."""
        return [(f"{view:02d}.png", partial(self._picture, view, lights)) for view in range(len(self.centres))]

    def _picture(self, view: int, lights: Floats | None) -> npt.NDArray[np.float32]:
        rng = np.random.default_rng([self.seed, view])
        shown = self.lights if lights is None else lights[view]
        return picture_of_ball(self.camera, self.centres[view], self.radius_mm, shown, self.look, rng)


def write_pictures(planting: Planting, folder: Path) -> None:
    """Write a rig's pictures as PNG, and the calibration file that lacks its lights, scope.toml, beside the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, read in planting.pictures():
        cv2.imwrite(str(folder / name), np.round(255 * read()).astype(np.uint8))
    known = Calibration(planting.camera, Response("gamma", planting.look.gamma))
    save_calibration(known, folder.parent / "scope.toml")


def plant(seed: int, count: int | None = None, **look: float) -> Planting:
    """Draw a rig: 1 to 4 lights 0.5 to 6 mm beside the camera, on a ring or not, and a ball at 8 places."""
    rng = np.random.default_rng([2311, seed])
    lens = LENSES[seed % len(LENSES)]
    camera = _camera(lens, rng)
    lights = _lights(rng, int(rng.integers(1, 5)) if count is None else count)
    radius = float(rng.uniform(3.0, 10.0))
    drawn = {
        "diffuse": float(rng.uniform(0.05, 0.4)), "specular": float(10 ** rng.uniform(0.6, 1.6)),
        "exponent": float(10 ** rng.uniform(3.3, 4.5)), "room": float(rng.uniform(0.6, 0.95)),
        "wall_mm": radius * float(rng.uniform(2.0, 6.0)),
        "blur_px": float(rng.uniform(0.5, 1.0)), "noise": float(rng.uniform(0.002, 0.015)),
    }  # fmt: skip
    kind = KINDS[seed // len(LENSES) % len(KINDS)]
    if kind == "chrome":
        drawn |= _chrome(np.random.default_rng([2312, seed]))
    centres = np.array([_centre(rng, camera, radius) for _ in range(VIEWS)])
    return Planting(lens, kind, camera, lights, radius, centres, Look(**(drawn | look)), seed)  # type: ignore[arg-type]


def _chrome(rng: np.random.Generator) -> dict[str, float]:
    """Draw the look of a polished ball: it mirrors the room, and shows nearly no shading of its own."""
    return {
        "diffuse": float(rng.uniform(0.0, 0.03)), "mirrored": float(rng.uniform(0.15, 0.7)),
        "specular": float(10 ** rng.uniform(1.0, 2.0)), "exponent": float(10 ** rng.uniform(4.0, 5.0)),
    }  # fmt: skip


def _camera(lens: str, rng: np.random.Generator) -> Camera:
    focal = float(rng.uniform(0.55, 0.8) * WIDTH)
    cx, cy = WIDTH / 2 + rng.uniform(-15, 15), HEIGHT / 2 + rng.uniform(-15, 15)
    made = {
        "pinhole": None,
        "brown_conrady": BrownConrady(k1=float(rng.uniform(-0.12, -0.03)), k2=float(rng.uniform(0.0, 0.02)), p1=5e-4),
        "kannala_brandt": KannalaBrandt(k1=float(rng.uniform(-0.05, 0.02)), k2=0.002),
    }[lens]
    return Camera(WIDTH, HEIGHT, focal, focal, float(cx), float(cy), 0.0, made)


def _lights(rng: np.random.Generator, count: int) -> Floats:
    while True:
        if rng.random() < 0.5:
            phase, radius = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 6.0)
            angle = phase + 2 * np.pi * np.arange(count) / count
            lights = np.stack(
                [radius * np.cos(angle), radius * np.sin(angle), np.full(count, rng.normal(0, 1))], axis=1
            )
        else:
            radii, angle = rng.uniform(0.5, 6.0, count), rng.uniform(0, 2 * np.pi, count)
            lights = np.stack([radii * np.cos(angle), radii * np.sin(angle), rng.normal(0, 1, count)], axis=1)
        gaps = np.linalg.norm(lights[:, None] - lights[None], axis=2) + 1e3 * np.eye(count)
        if gaps.min() >= APART_MM:
            return np.asarray(lights)


def _centre(rng: np.random.Generator, camera: Camera, radius: float) -> Floats:
    while True:
        pixel = np.array([rng.uniform(0.15, 0.85) * WIDTH, rng.uniform(0.15, 0.85) * HEIGHT])
        centre = camera.unproject(pixel) * max(rng.uniform(NEAREST_MM, FARTHEST_MM), 2.2 * radius)
        # the whole ball in view
        directions = rng.normal(size=(200, 3))
        border = camera.project(centre + 1.1 * radius * directions / np.linalg.norm(directions, axis=1)[:, None])
        if np.isfinite(border).all() and ((border > 12) & (border < [WIDTH - 12, HEIGHT - 12])).all():
            return np.asarray(centre)
