"""Pictures of a glossy ball before a matt wall, by ray casting: exact geometry, shadows, blur, noise, coding.

Nothing of the code that is tested is used but the camera's sightlines.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from simtest.geometry.camera import Camera

Floats = npt.NDArray[np.float64]

NARROWEST_PX = 0.45
"""Least standard deviation of a highlight before the blur."""

SAMPLES = 2
"""Rays a pixel along each axis, at the ball."""

WHITE = 0.45
"""Linear value of the wall's brightest pixel."""


@dataclass(frozen=True)
class Look:
    """How ball, wall and sensor look.

    Parameters
    ----------
    diffuse, specular : float
        Of the ball: Lambertian albedo relative to the wall's, and peak of the lobe.
    exponent : float
        Phong's, about the mirror direction.
    wall_mm : float
        Distance of the wall behind the ball's centre.
    wall_albedo : float
        Relative; 0: the lights of the scope do not show the wall.
    room : float
        Share of the wall's light that is the room's: 0: the scope alone lights it. The ball reflects none of it.
    blur_px, noise : float
        Standard deviations of the point spread, and of the noise, share of full scale.
    gamma, bits : float, int
        Of the coding.
    """

    diffuse: float = 0.2
    specular: float = 2.0
    exponent: float = 1000.0
    wall_mm: float = 25.0
    wall_albedo: float = 1.0
    room: float = 0.8
    blur_px: float = 0.7
    noise: float = 0.005
    gamma: float = 2.2
    bits: int = 8


def picture_of_ball(
    camera: Camera, centre: Floats, radius: float, lights: Floats, look: Look, rng: np.random.Generator
) -> npt.NDArray[np.float32]:
    """Return the encoded picture, shape (H, W), in [0, 1]; lengths in mm, camera frame."""
    linear = _wall(_rays(camera), centre, radius, lights, look)
    room = look.room / max(1 - look.room, 1e-3) * max(float(np.quantile(linear, 0.5)), 1e-9)
    linear += room
    # the ball's part again, with several rays a pixel
    middle = camera.project(centre)
    radius_px = radius / np.linalg.norm(centre) * max(camera.fx, camera.fy)
    # A lobe that is narrower than the rays lie apart would be sampled by chance; lenses blur it more.
    look = replace(look, exponent=min(look.exponent, (radius_px / NARROWEST_PX) ** 2 / 4))
    reach = (
        1.3 * radius / np.linalg.norm(centre) * max(camera.fx, camera.fy) / max(centre[2] / np.linalg.norm(centre), 0.3)
    )
    low = np.maximum(np.floor(middle - reach - 8).astype(int), 0)
    high = np.minimum(np.ceil(middle + reach + 8).astype(int), [camera.width, camera.height])
    x, y = (np.arange(a * SAMPLES, b * SAMPLES) / SAMPLES + 0.5 / SAMPLES for a, b in zip(low, high, strict=True))
    rays = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    fine = np.where(_hits(rays, centre, radius), _ball(rays, centre, radius, lights, look), 0.0)
    fine = np.where(_hits(rays, centre, radius), fine, room + _wall(rays, centre, radius, lights, look))
    size = high - low
    linear[low[1] : high[1], low[0] : high[0]] = fine.reshape(size[1], SAMPLES, size[0], SAMPLES).mean(axis=(1, 3))
    bright = linear if look.wall_albedo > 0 else fine[fine > 0]
    linear *= WHITE / max(float(np.quantile(bright, 0.5)), 1e-12)
    seen = gaussian_filter(linear, look.blur_px) + rng.normal(0.0, look.noise, linear.shape)
    steps = 2**look.bits - 1
    return np.asarray(np.rint(steps * np.clip(seen, 0, 1) ** (1 / look.gamma)) / steps, dtype=np.float32)


_KEPT: dict[int, Floats] = {}


def _rays(camera: Camera) -> Floats:
    key = hash((camera.width, camera.height, camera.fx, camera.cx, camera.distortion))
    if key not in _KEPT:
        _KEPT.clear()
        _KEPT[key] = camera.unproject(camera.pixel_centres())
    return _KEPT[key]


def _hits(rays: Floats, centre: Floats, radius: float) -> npt.NDArray[np.bool_]:
    along = rays @ centre
    return np.asarray((along**2 > centre @ centre - radius**2) & (along > 0))


def _ball(rays: Floats, centre: Floats, radius: float, lights: Floats, look: Look) -> Floats:
    along = rays @ centre
    depth = along - np.sqrt(np.maximum(along**2 - centre @ centre + radius**2, 0))
    points = depth[..., None] * rays
    normals = (points - centre) / radius
    total = np.zeros(rays.shape[:-1])
    for light in lights:
        towards = light - points
        distance = np.linalg.norm(towards, axis=-1)
        towards /= distance[..., None]
        facing = np.maximum(np.sum(normals * towards, axis=-1), 0)
        mirrored = rays - 2 * np.sum(rays * normals, axis=-1, keepdims=True) * normals
        lobe = np.maximum(np.sum(mirrored * towards, axis=-1), 0) ** look.exponent
        total += (look.diffuse * facing + look.specular * lobe * (facing > 0)) / distance**2
    return total


def _wall(rays: Floats, centre: Floats, radius: float, lights: Floats, look: Look) -> Floats:
    depth = (centre[2] + look.wall_mm) / np.maximum(rays[..., 2], 0.05)
    points = depth[..., None] * rays
    total = np.zeros(rays.shape[:-1])
    for light in lights:
        towards = light - points
        distance = np.linalg.norm(towards, axis=-1)
        towards /= distance[..., None]
        nearest = np.sum((centre - points) * towards, axis=-1)
        miss = np.sum((centre - points) ** 2, axis=-1) - nearest**2
        lit = (miss > radius**2) | (nearest < 0) | (nearest > distance)
        total += look.wall_albedo * np.maximum(-towards[..., 2], 0) / distance**2 * lit
    return total
