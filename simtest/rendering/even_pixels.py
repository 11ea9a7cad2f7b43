"""Pixels whose mean radiance follows from the rays through the centres of the pixels around: no samples are needed.

Where the radiance f is smooth, its mean over a pixel is f + (f_xx + f_yy) / 24 at the centre, up to fourth derivatives;
second differences give the second derivatives. This errs far less than samples do, whose error is a share of the
gradient. All else, the edges of anything, narrow lobes and what may hide between centres, is left to samples.

The choice rests on the rays through the centres alone, and none of them is averaged with the samples: it does not
depend on the samples, so they stay without bias.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from simtest.geometry.camera import Camera
from simtest.rendering.hits import Hit
from simtest.rendering.rays import Rays
from simtest.rendering.relief_kernel import ReliefKernel
from simtest.rendering.shape_labels import ShapeLabels
from simtest.runtime.arrays import Array, Image, Mask

ALLOWED = 0.1
"""Bound on the rule's error, as a share of the change over a pixel. Most errors are far smaller."""

ROUNDING = 3e-7
"""Error of single precision, as a share of the whole radiance; what is less does not count."""

LEAST_SCALE_PX = 4.0
"""The light's own scale, px on the surface, below which it may change within a pixel."""

BORDER_PX = 2
"""Pixels along the frame's border, whose neighbours are not all known."""

_CURVE = np.array([[1, -2, 1]], dtype=np.float32)
_SLOPE = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
_AROUND = np.ones((3, 3), np.uint8)


def mean_of_pixel(centres: Image) -> Image:
    """Return the mean over each pixel of a smooth function, from its values at the centres, shape (H, W)."""
    across, down = _curves(centres)
    return np.asarray(centres + (across + down) * np.float32(1 / 24))


def uneven(centres: Image, whole: Image) -> Mask:
    """Return where `mean_of_pixel` of a part of the radiance may err by more than samples do, shape (H, W).

    A kink of the slope errs by up to a twelfth of what it changes second differences by between neighbours; with both
    directions and both signs a 24th of their spread among the pixels around.
    """
    spread = sum(cv2.dilate(curve, _AROUND) - cv2.erode(curve, _AROUND) for curve in _curves(centres))
    slopes = (cv2.filter2D(centres, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (_SLOPE, _SLOPE.T))
    change = cv2.blur(cv2.magnitude(*slopes), (3, 3))
    return np.asarray(spread > 24 * (ALLOWED * change + ROUNDING * whole))


def _curves(centres: Image) -> tuple[Image, Image]:
    """Return second differences along x and y."""
    across, down = (cv2.filter2D(centres, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (_CURVE, _CURVE.T))
    return across, down


def pixels_per_rad(camera: Camera) -> float:
    """Return the fewest pixels per rad of sightlines over a frame."""
    x, y = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    points = np.stack([x, y], axis=-1)
    rays = camera.unproject(points)
    steps = [np.linalg.norm(camera.unproject(points + step) - rays, axis=-1) for step in np.eye(2)]
    return float(1 / np.nanmax(steps))


@dataclass(frozen=True)
class Clues:
    """What the rays through the centres tell beside the radiance, in the same kernel.

    Parameters
    ----------
    mi : module
        mitsuba with the variant set.
    labels : ShapeLabels
        Of the shape; they come first.
    lights : ndarray, shape (L, 3)
        Camera frame, mm.
    beams : list of float
        Angle, rad, within which each light's emission may change; 1 where it is alike in all directions.
    px_per_rad : float
        See `pixels_per_rad`.
    """

    mi: Any
    labels: ShapeLabels
    lights: Array
    beams: list[float]
    px_per_rad: float

    def trace(self, preliminary: Any, hit: Hit, rays: Rays, rotation: Any, relief: ReliefKernel | None) -> list[Any]:
        """Compute the labels' channels, the gaps of all lights and the least scale, px, of any light.

        The gap is the normal minus the bisector of the directions to light and camera, three channels for each light.
        """
        import drjit as dr

        mi = self.mi
        channels = self.labels.trace(preliminary, hit, rays, rotation, relief)
        seats = [(mi.Vector3f(*light.tolist()), mi.Float(beam)) for light, beam in
                 zip(self.lights, self.beams, strict=True)]  # fmt: skip
        sharpness = mi.Float(self.px_per_rad)
        dr.make_opaque(seats, sharpness)
        position, normal = rays.sightline * hit.base.t, rotation @ mi.Vector3f(hit.fine.sh_frame.n)
        # Pixels per mm of the surface, along the direction in which it is seen shortest.
        facing = dr.abs(dr.dot(rotation @ mi.Vector3f(hit.base.sh_frame.n), rays.sightline))
        per_mm, scale = facing * sharpness / hit.base.t, mi.Float(dr.inf)
        for light, beam in seats:
            towards = light - position
            distance = dr.norm(towards)
            bisector = dr.normalize(towards / distance - rays.sightline)
            channels += [dr.select(hit.base.is_valid(), gap, dr.nan) for gap in normal - bisector]
            scale = dr.minimum(scale, beam * distance * per_mm)
        return [*channels, scale]

    def split(self, channels: list[Image]) -> tuple[list[Image], list[Image], Image]:
        """Return the labels' channels, the gaps and the scale, of what `trace` computed."""
        gaps = 3 * len(self.lights)
        return channels[: -gaps - 1], channels[-gaps - 1 : -1], channels[-1]


def choose(parts: list[Image], depth: Image, gaps: list[Image], scale: Image, half_width: float) -> Mask:
    """Return the pixels that need samples, shape (H, W), by the rays through the centres.

    Parameters
    ----------
    parts : list of ndarray, shape (H, W)
        Channels of the radiance.
    depth : ndarray, shape (H, W)
        mm; NaN where there is no surface.
    gaps, scale
        See `Clues.trace`.
    half_width : float
        Turn of the normal, rad, at which the lobe falls to half: one that turns more from pixel to pixel may hide.
    """
    seen = np.isfinite(depth).astype(np.uint8)
    chosen = cv2.dilate(seen, _AROUND) != cv2.erode(seen, _AROUND)
    whole = np.sum(parts, axis=0) * np.float32(2 / len(parts))
    for part in parts:
        chosen |= uneven(part, whole)
    with np.errstate(invalid="ignore"):
        chosen |= scale < LEAST_SCALE_PX
        for first in range(0, len(gaps), 3):
            own = np.stack(gaps[first : first + 3])
            # From each pixel to the next; the pixels around follow below.
            chosen[:, 1:] |= np.square(np.diff(own, axis=2)).sum(axis=0) > half_width**2
            chosen[1:] |= np.square(np.diff(own, axis=1)).sum(axis=0) > half_width**2
    chosen = cv2.dilate(chosen.astype(np.uint8), _AROUND) > 0
    chosen[:BORDER_PX] = chosen[-BORDER_PX:] = True
    chosen[:, :BORDER_PX] = chosen[:, -BORDER_PX:] = True
    return chosen
