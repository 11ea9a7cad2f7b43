"""Random fields of glints: the gradient of a Gaussian height over a curved base, through a Gaussian lobe.

The light is at the camera, so that a point shines by its slope to the sightline. Nothing is rendered: the slope and its
derivatives are sums of waves, and the glints, where the slope is 0, are found to rounding.
"""

import math
from dataclasses import dataclass

import numpy as np

from simtest.geometry import Array, Image
from simtest.runtime.seeds import Stage, generator

WIDTH, HEIGHT = 320, 240
WAVES = 60

LOBES_DEG, SLOPES_DEG, LENGTHS_PX, REACHES_PX = (0.6, 3.0), (0.2, 4.0), (12.0, 50.0), (5.0, 30.0)
"""Ranges of the lobe's width, of the relief's slope an axis, of its length of correlation, and of the width that the
highlight would have on the base alone; the logarithms are uniform."""

DIFFUSE = 0.3
"""Diffuse light over the lobe's peak."""

TISSUE = np.array([0.85, 0.45, 0.40], dtype=np.float32)
"""Colour of the diffuse light, mean about 0.57; the lobe is white."""


@dataclass(frozen=True)
class Field:
    """A field of glints.

    `lobe`: standard deviation of the lobe over the slope, rad; `base` (shape (2, 2)): derivative of the base's
    slope by position, rad / px; `centre` (shape (2,)): where the base's slope is 0, px; `waves` (shape (W, 2)):
    wave vectors, 1 / px; `phases`, `amplitudes` (shape (W,)): of the relief's height, px: the sum of amplitude
    cos(wave . x + phase).
    """

    lobe: float
    base: Array
    centre: Array
    waves: Array
    phases: Array
    amplitudes: Array

    def slope(self, points: Array) -> Array:
        """Return the slope at points, shape (N, 2), rad."""
        turned = np.sin(points @ self.waves.T + self.phases) * -self.amplitudes
        return np.asarray((points - self.centre) @ self.base + turned @ self.waves)

    def bend(self, points: Array) -> Array:
        """Return the derivative of the slope by position at points, shape (N, 2, 2), rad / px."""
        weights = -np.cos(points @ self.waves.T + self.phases) * self.amplitudes
        return np.asarray(self.base + np.einsum("nw,wi,wj->nij", weights, self.waves, self.waves))

    def radiance(self) -> Image:
        """Return the picture's light, shape (H, W, 3), the lobe's peak 1."""
        x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        slope = self.slope(np.array([x.ravel(), y.ravel()]).T)
        shine = np.exp(-np.sum(slope**2, axis=1) / (2 * self.lobe**2)).reshape(HEIGHT, WIDTH, 1)
        return (shine + DIFFUSE * TISSUE).astype(np.float32)

    def glints(self, inside: Array) -> Array:
        """Return the points of slope 0 among pixels, shape (N, 2), px: Newton's method from each pixel's centre."""
        points = inside.copy()
        for _ in range(12):
            step = np.linalg.solve(self.bend(points) + 1e-12 * np.eye(2), self.slope(points)[:, :, None])[:, :, 0]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            points = points - step * np.minimum(1.0, 1.0 / np.maximum(length, 1e-12))
        found = points[np.linalg.norm(self.slope(points), axis=1) < 1e-9]
        # those that lie in one of the pixels, each once
        near = np.abs(found[:, None] - inside[None]).max(axis=2).min(axis=1) <= 0.5 if len(found) else np.zeros(0, bool)
        return np.unique(np.round(found[near], 5), axis=0)


def draw(number: int) -> Field:
    """Draw a field from its number."""
    rng = generator(19, "ripples", "field", number, Stage.SWEEP)
    lobe, slope = (math.radians(_between(rng, *of)) for of in (LOBES_DEG, SLOPES_DEG))
    length, reach = _between(rng, *LENGTHS_PX), _between(rng, *REACHES_PX)
    # a curved base: highlight of width `reach` along one axis, up to three times as long along the other
    spin = rng.uniform(0, math.pi)
    turn = np.array([[math.cos(spin), -math.sin(spin)], [math.sin(spin), math.cos(spin)]])
    base = turn @ np.diag([lobe / reach, lobe / reach / rng.uniform(1, 3)]) @ turn.T
    centre = np.array([WIDTH, HEIGHT]) * rng.uniform(0.35, 0.65, 2)
    # Gaussian correlation of the height: normal wave vectors; the slopes' variance an axis is sum (a k)^2 / 4
    waves = rng.standard_normal((WAVES, 2)) / length
    amplitudes = slope * np.full(WAVES, 2 / math.sqrt(float(np.sum(waves**2))))
    return Field(lobe, base, centre, waves, rng.uniform(0, 2 * math.pi, WAVES), amplitudes)


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
