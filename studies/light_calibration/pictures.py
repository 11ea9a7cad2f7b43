"""Pictures of a glossy ball before a matt wall, by ray casting: exact geometry, shadows, blur, noise, coding.

Nothing of the code that is tested is used but the camera's sightlines. Light is blurred before the pixels collect it:
around the ball's outline and its highlights each pixel has several rays, elsewhere one.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from simtest.geometry.camera import Camera

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

NARROWEST_PX = 0.3
"""Least standard deviation of a highlight before the blur."""

SAMPLES = 4
"""Rays a pixel along each axis where the light changes fast."""

EDGE_PX = 2.0
"""Pixels so far from the outline have several rays."""

ROOM_PX = 8
"""Pixels around the ball that are blurred finely."""

FAINT = 1e-4
"""Share of the brightest highlight below which one ray a pixel is enough."""

WHITE = 0.45
"""Linear value of the wall's brightest pixel."""


@dataclass(frozen=True)
class Look:
    """How ball, wall and sensor look.

    `diffuse`, `specular`: of the ball: Lambertian albedo relative to the wall's, and peak of the lobe; `exponent`:
    phong's, about the mirror direction; `mirrored`: light of the room that the ball reflects, as a share of the
    wall's: 0 of a ball that is no mirror; `wall_mm`: distance of the wall behind the ball's centre; `wall_albedo`:
    relative; 0: the lights of the scope do not show the wall; `room`: share of the wall's light that is the room's:
    0: the scope alone lights it; `blur_px`, `noise`: standard deviations of the point spread, and of the noise,
    share of full scale; `gamma`, `bits`: of the coding.
    """

    diffuse: float = 0.2
    specular: float = 2.0
    exponent: float = 1000.0
    mirrored: float = 0.0
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
    linear = ball_light(camera, centre, radius, lights, look)
    seen = linear + rng.normal(0.0, look.noise, linear.shape)
    steps = 2**look.bits - 1
    return np.asarray(np.rint(steps * np.clip(seen, 0, 1) ** (1 / look.gamma)) / steps, dtype=np.float32)


def ball_light(camera: Camera, centre: Floats, radius: float, lights: Floats, look: Look) -> Floats:
    """Return the linear light of each pixel without noise, shape (H, W)."""
    scene = _Scene(centre, radius, lights, look)
    corners = _corner_rays(camera)
    coarse = scene.wall(_unit(corners[:-1, :-1] + corners[1:, 1:]))
    room = look.room / max(1 - look.room, 1e-3) * max(float(np.quantile(coarse, 0.5)), 1e-9)
    low, high, radius_px = _window(camera, centre, radius)
    # A lobe that is narrower than the rays lie apart would be sampled by chance; lenses blur it more.
    scene.look = replace(look, exponent=min(look.exponent, (radius_px / NARROWEST_PX) ** 2 / 4))
    fine, ball = _fine(scene, corners[low[1] : high[1] + 1, low[0] : high[0] + 1], room)
    bright = coarse + room if look.wall_albedo > 0 else ball
    blurred = gaussian_filter(coarse + room, look.blur_px)
    size = high - low
    seen = gaussian_filter(fine, look.blur_px * SAMPLES).reshape(size[1], SAMPLES, size[0], SAMPLES).mean(axis=(1, 3))
    # The window's own border is blurred with what its edge repeats.
    inner = np.s_[4:-4, 4:-4]
    blurred[low[1] : high[1], low[0] : high[0]][inner] = seen[inner]
    return np.asarray(blurred * (WHITE / max(float(np.quantile(bright, 0.5)), 1e-12)))


_KEPT: dict[str, Floats] = {}


def _corner_rays(camera: Camera) -> Floats:
    """Return the sightlines of the pixels' corners, shape (H + 1, W + 1, 3)."""
    key = repr(camera)
    if key not in _KEPT:
        _KEPT.clear()
        x, y = np.arange(camera.width + 1.0), np.arange(camera.height + 1.0)
        _KEPT[key] = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1))
    return _KEPT[key]


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _window(camera: Camera, centre: Floats, radius: float) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], float]:
    """Return the first and last column and row around the ball, and the ball's radius, px."""
    distance = float(np.linalg.norm(centre))
    towards = centre / distance
    across = np.linalg.svd(towards[None])[2][1:]
    phase = np.linspace(0, 2 * np.pi, 180)
    sine = radius / distance
    ring = np.cos(phase)[:, None] * across[0] + np.sin(phase)[:, None] * across[1]
    border = camera.project(np.sqrt(1 - sine**2) * towards + sine * ring)
    low = np.maximum(np.floor(border.min(axis=0) - ROOM_PX).astype(int), 0)
    high = np.minimum(np.ceil(border.max(axis=0) + ROOM_PX).astype(int), [camera.width, camera.height])
    return low, high, float(np.mean(high - low) / 2 - ROOM_PX)


def _fine(scene: "_Scene", corners: Floats, room: float) -> tuple[Floats, Floats]:
    """Return the light of a window with `SAMPLES` rays a pixel along each axis, and the ball's pixels."""
    middle = _unit(corners[:-1, :-1] + corners[1:, 1:])
    light, on_ball, spot = scene.seen(middle, room)
    pixel = np.arccos(np.clip(np.sum(middle[:-1, :-1] * middle[1:, 1:], axis=-1), -1, 1)) / np.sqrt(2)
    pixel = np.pad(pixel, ((0, 1), (0, 1)), mode="edge")
    sine = np.linalg.norm(np.cross(middle, scene.towards), axis=-1)
    from_edge = np.abs(np.arcsin(np.clip(sine, 0, 1)) - np.arcsin(scene.radius / scene.distance)) / pixel
    fast = (from_edge < EDGE_PX) | (spot > FAINT * max(float(spot.max()), 1e-12))
    total = np.repeat(np.repeat(light, SAMPLES, axis=0), SAMPLES, axis=1)
    rows, columns = np.nonzero(fast)
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    v, u = (each[None, ..., None] for each in np.meshgrid(share, share, indexing="ij"))
    a, b, c, d = (corners[rows + i, columns + j][:, None, None] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    rays = _unit((1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d))
    values, _, _ = scene.seen(rays, room)
    parts = total.reshape(light.shape[0], SAMPLES, light.shape[1], SAMPLES)
    parts[rows, :, columns, :] = values
    return total, light[on_ball]


class _Scene:
    """A ball, a wall and lights."""

    def __init__(self, centre: Floats, radius: float, lights: Floats, look: Look) -> None:
        self.centre, self.radius, self.lights, self.look = centre, radius, lights, look
        self.distance = float(np.linalg.norm(centre))
        self.towards = centre / self.distance

    def seen(self, rays: Floats, room: float) -> tuple[Floats, Mask, Floats]:
        """Return the light along rays, which of them meet the ball, and the highlights' part."""
        along = rays @ self.centre
        hit = (along**2 > self.distance**2 - self.radius**2) & (along > 0)
        light, spot = np.empty(hit.shape), np.zeros(hit.shape)
        light[~hit] = self.wall(rays[~hit]) + room
        matt, spot[hit] = self.ball(rays[hit], room)
        light[hit] = matt + spot[hit]
        return light, hit, spot

    def ball(self, rays: Floats, room: float) -> tuple[Floats, Floats]:
        """Return the matt part and the highlights of rays that meet the ball."""
        along = rays @ self.centre
        depth = along - np.sqrt(np.maximum(along**2 - self.distance**2 + self.radius**2, 0))
        points = depth[:, None] * rays
        normals = (points - self.centre) / self.radius
        mirrored = rays - 2 * np.sum(rays * normals, axis=-1, keepdims=True) * normals
        # The room is brighter on one side, and darkest where the ball shows the scope.
        matt = self.look.mirrored * room * (1 + 0.3 * mirrored[:, 0] + 0.4 * mirrored[:, 2])
        spot = np.zeros(len(rays))
        for light in self.lights:
            towards = light - points
            square = np.sum(towards**2, axis=-1)
            towards /= np.sqrt(square)[:, None]
            facing = np.maximum(np.sum(normals * towards, axis=-1), 0)
            lobe = np.maximum(np.sum(mirrored * towards, axis=-1), 0) ** self.look.exponent
            matt += self.look.diffuse * facing / square
            spot += self.look.specular * lobe * (facing > 0) / square
        return matt, spot

    def wall(self, rays: Floats) -> Floats:
        """Return the lights' part of the wall's light along rays, with the ball's shadows."""
        depth = (self.centre[2] + self.look.wall_mm) / np.maximum(rays[..., 2], 0.05)
        points = depth[..., None] * rays
        total = np.zeros(rays.shape[:-1])
        for light in self.lights:
            towards = light - points
            distance = np.linalg.norm(towards, axis=-1)
            towards /= distance[..., None]
            nearest = np.sum((self.centre - points) * towards, axis=-1)
            miss = np.sum((self.centre - points) ** 2, axis=-1) - nearest**2
            lit = (miss > self.radius**2) | (nearest < 0) | (nearest > distance)
            total += self.look.wall_albedo * np.maximum(-towards[..., 2], 0) / distance**2 * lit
        return total
