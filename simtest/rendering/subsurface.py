"""Translucency: light spreads below the surface, over millimetres, wider in red. An approximation in the image.

The diffuse reflectance of a half-space under a sinusoidal illumination has a closed form in the diffusion approximation
(Cuccia et al. 2009, J. Biomed. Opt. 14(2) 024012, after Svaasand et al. 1999). Its share of that under uniform light,
with the light that is scattered once, is the modulation transfer function of the tissue. A sum of Gaussians is fitted
to it, whose widths, in mm on the surface, become px by the size of each pixel's patch of the surface. The frame is
blurred at dyadic widths, and blended.

The surface is taken as locally flat, and lit and seen diffusely; light does not cross steps of the depth, edges of the
surface and folds. The albedo stays that of the reflectance: the spread is normalised. See docs/concepts/tissue.md.
"""

from functools import lru_cache

import cv2
import numpy as np

from simtest.geometry import Camera
from simtest.runtime.arrays import Array, Image, kept
from simtest.spec.reflectance import Translucency

LEVELS_PX = tuple(2.0**i for i in range(8))
"""Standard deviations of the blurred levels, px; what is narrower stays sharp, what is wider takes the last."""

SCALES_PER_OCTAVE = 4
"""Scales at which the weights of the levels are fitted, for each doubling of px per mm."""

SUBSTEPS = 8
"""Entries of the table of weights between two fitted scales."""

LEAST_WEIGHT = 3e-3
"""Levels whose weight stays below are left out; the others take their share."""

DEPTH_STEP = 0.35
"""Layers of the logarithm of the depth: light hardly crosses a step of this, and not at all one twice as high."""

UNLAYERED_PX = 2.0
"""Blurs of up to this standard deviation cross steps of the depth: hardly more than a lens does."""

MAX_LAYERS = 7
"""Of depth; a deeper scene gets wider ones."""

LEAST_COSINE = 0.1
"""Patches seen more aslant than this are taken as if seen so."""

GRID_PX = 16
"""Pixels between those whose solid angle is computed; it varies slowly."""


def transfer(wave: Array, scattering: float, absorption: float, index: float) -> Array:
    """Return the diffuse reflectance of a half-space at spatial frequencies over that under uniform light.

    `wave` is in rad/mm, reduced scattering and absorption in 1/mm; `index` is that of refraction over that outside.
    Light that is scattered once returns where it entered, with light and camera side by side; the rest diffuses.
    """
    share = once_scattered(scattering, absorption, index)
    diffused = reflectance(wave, scattering, absorption, index) / reflectance(0.0, scattering, absorption, index)
    return np.asarray(share + (1 - share) * diffused)


def reflectance(wave: Array | float, scattering: float, absorption: float, index: float) -> Array:
    """Return the reflectance of a half-space in the diffusion approximation; see `transfer`."""
    total = scattering + absorption
    inside = 0.0636 * index + 0.668 + 0.710 / index - 1.440 / index**2 if index > 1 else 0.0
    boundary = 3 * (1 - inside) / (2 * (1 + inside))
    decay = np.sqrt(3 * absorption * total + np.square(wave)) / total
    return np.asarray(boundary * scattering / total / ((decay + 1) * (decay + boundary)))


def once_scattered(scattering: float, absorption: float, index: float) -> float:
    """Return the share of the light straight back that was scattered once.

    Without internal reflection it is 1/H(1)^2, with Chandrasekhar's function of isotropic scattering in Hapke's form
    H(1) = 3 / (1 + 2 sqrt(1 - albedo)). An index lowers the once scattered radiance by its square, and what diffuses
    as `reflectance` says.
    """
    matched = ((1 + 2 * np.sqrt(absorption / (scattering + absorption))) / 3) ** 2
    diffused = [float(reflectance(0.0, scattering, absorption, n)) for n in (1.0, index)]
    return float(min(1.0, matched * diffused[0] / diffused[1] / index**2))


def spread(image: Image, depth: Array | Image, normal: Array | Image, camera: Camera, spec: Translucency) -> Image:
    """Return diffuse radiance, shape (H, W) or (H, W, 3), after its spread below the surface, before the lens.

    One channel spreads as the mean of three. Nothing spreads from or to where `depth`, the distance along the rays,
    shape (H, W), mm, is NaN. `normal`, shape (H, W, 3), is the base's unit normal in the camera frame.
    """
    mask = np.isfinite(depth)
    if not mask.any():
        return image
    channels = image.reshape(*mask.shape, -1)
    whole = bool(mask.all())
    seen = channels if whole else np.where(mask[:, :, None], channels, np.float32(0))
    # All is done at half the frame's size, the finest level is no sharper; shape of every second pixel.
    near = np.asarray(depth[::2, ::2], dtype=np.float32)
    scale = pixels_per_mm(near, normal[::2, ::2], camera)
    weights = _weights(scale, spec, channels.shape[2])
    # Light counts by the area that it comes from.
    patch = np.where(np.isfinite(near), 1 / np.square(scale), 0).astype(np.float32)
    half, full = near.shape[::-1], mask.shape[::-1]
    light = cv2.resize(seen, half, interpolation=cv2.INTER_AREA).reshape(*near.shape, -1)
    share = patch if whole else patch * cv2.resize(mask.astype(np.float32), half, interpolation=cv2.INTER_AREA)
    mean = _blend(np.dstack([light * patch[:, :, None], share]), near, weights[1:])
    # What is narrower than the finest level stays sharp.
    sharp, blurred = (
        cv2.resize(part, full, interpolation=cv2.INTER_LINEAR).reshape(channels.shape) for part in (weights[0], mean)
    )
    mixed = blurred + sharp * (channels - blurred)
    result = mixed if whole else np.where(mask[:, :, None], mixed, channels)
    return np.asarray(result.reshape(image.shape), dtype=np.float32)


def pixels_per_mm(depth: Array | Image, normal: Array | Image, camera: Camera) -> Image:
    """Return the square root of the camera's pixels per mm^2 of the surface; 1 where there is none.

    A pixel of solid angle w sees the area w depth^2 / cos of the angle between ray and normal. The maps, of shape
    (h, w) and (h, w, 3), cover the frame and may have fewer pixels than it.
    """
    # Rays and solid angles on a coarse grid.
    rows, columns = (np.linspace(0, n, max(2, n // GRID_PX) + 1) for n in (camera.height, camera.width))
    x, y = np.meshgrid((columns[1:] + columns[:-1]) / 2, (rows[1:] + rows[:-1]) / 2)
    points = np.stack([x, y], axis=-1)
    rays, right, down = (camera.unproject(points + np.array(step)) for step in ((0, 0), (0.5, 0), (0, 0.5)))
    solid = 4 * np.linalg.norm(np.cross(right - rays, down - rays), axis=-1)
    # A lens may see nothing in the corners.
    solid = np.where(np.isfinite(solid), solid, np.nanmedian(solid))
    grid = np.dstack([np.nan_to_num(rays), solid]).astype(np.float32)
    fine = cv2.resize(grid, depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    # Patches of the surface.
    cosine = -np.einsum("hwc,hwc->hw", fine[:, :, :3], np.asarray(normal, dtype=np.float32))
    with np.errstate(invalid="ignore"):
        scale = np.sqrt(np.maximum(cosine, LEAST_COSINE) / fine[:, :, 3]) / np.asarray(depth, dtype=np.float32)
    return np.where(np.isfinite(scale), scale, 1).astype(np.float32)


# Weights of the levels -------------------------------------------------------------------------------------------


@lru_cache(maxsize=8)
def _fitted(spec: Translucency, channels: int, first: int, last: int) -> Array:
    """Fit Gaussians of the levels' widths to the transfer function.

    Returns the weights of the sharp image and of each level, of sum 1, shape (scales, 1 + levels, channels), at the
    scales 2^(i / `SCALES_PER_OCTAVE`) px/mm, i from `first` to `last`.
    """
    key = f"{spec!r} {channels} {first} {last}"
    return kept("translucency", key, lambda: {"weights": _fit(spec, channels, first, last)})["weights"]


def _fit(spec: Translucency, channels: int, first: int, last: int) -> Array:
    from scipy.optimize import nnls

    waves = np.geomspace(0.02, 40, 80)
    properties = zip(spec.scattering_per_mm, spec.absorption_per_mm, strict=True)
    wanted = [transfer(waves, scattering, absorption, spec.index) for scattering, absorption in properties]
    if channels == 1:
        wanted = [np.mean(wanted, axis=0)]
    fits = []
    for step in range(first, last + 1):
        widths = np.array([0.0, *LEVELS_PX]) / 2 ** (step / SCALES_PER_OCTAVE)
        gaussians = np.exp(-np.square(waves[:, None] * widths) / 2)
        # Long waves, which tell the width, fall little: they count as much as what falls.
        rows = [1 / np.sqrt(1e-3 + 1 - curve) for curve in wanted]
        by_channel = [nnls(gaussians * row[:, None], curve * row)[0] for curve, row in zip(wanted, rows, strict=True)]
        fits.append(np.stack(by_channel, axis=1))
    weights = np.array(fits)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float32)


def _weights(scale: Image, spec: Translucency, channels: int) -> list[Image]:
    """Return the weights of the sharp image and of each level at pixels of a scale, px/mm, shape (h, w, C) each."""
    steps = SCALES_PER_OCTAVE * np.log2(scale)
    first, last = int(np.floor(steps.min())), int(np.ceil(steps.max()))
    table = _fitted(spec, channels, first, max(last, first + 1))
    # Finer than the fit's scales, so that the nearest entry will do.
    entries = np.arange(0, len(table) - 1 + 1e-6, 1 / SUBSTEPS)
    lower = np.minimum(entries.astype(int), len(table) - 2)
    share = (entries - lower)[:, None, None]
    dense = (table[lower] * (1 - share) + table[lower + 1] * share).astype(np.float32)
    index = np.rint((steps - first) * SUBSTEPS).astype(np.int32)
    return [np.take(np.ascontiguousarray(dense[:, level]), index, axis=0) for level in range(dense.shape[1])]


# Blurred levels --------------------------------------------------------------------------------------------------


def _blend(packed: Image, depth: Image, weights: list[Image]) -> Image:
    """Return the mean of the levels of `packed`, light times area and area, by weights, shape (h, w, C)."""
    shares = [cv2.merge([share] * packed.shape[2]) for share in _layers(depth)]
    layers = [(share, packed * share, _box(share[:, :, 0])) for share in shares]
    # Plane by plane: arithmetic over short last axes is slow.
    count = packed.shape[2] - 1
    light = [np.zeros(depth.shape, dtype=np.float32) for _ in range(count)]
    area = [np.full(depth.shape, 1e-12, dtype=np.float32) for _ in range(count)]
    for level, weight in enumerate(weights):
        if weight.max() <= LEAST_WEIGHT:
            continue
        if LEVELS_PX[level] <= UNLAYERED_PX:
            blurred = _level(packed, level)
        else:
            # Each pixel sees its own layers of depth.
            blurred = np.zeros_like(packed)
            for share, layer, box in layers:
                blurred[box] += share[box] * _level(layer, level)[box]
        *lights, areas = cv2.split(blurred)
        for c, part in enumerate(cv2.split(weight)):
            light[c] += part * lights[c]
            area[c] += part * areas
    return np.dstack([some / whole for some, whole in zip(light, area, strict=True)])


def _box(share: Image) -> tuple[slice, slice]:
    """Return the rows and columns that hold all that is not 0."""
    spans = (np.flatnonzero(share.any(axis=axis)) for axis in (1, 0))
    return tuple(slice(filled[0], filled[-1] + 1) if len(filled) else slice(0) for filled in spans)  # type: ignore[return-value]


def _layers(depth: Image) -> list[Image]:
    """Return the share of each pixel in each layer of depth: hats over its logarithm that add up to 1; 0 at NaN."""
    low, high = float(np.log(np.nanmin(depth))), float(np.log(np.nanmax(depth)))
    count = int(np.clip(np.ceil((high - low) / DEPTH_STEP), 0, MAX_LAYERS - 1)) + 1
    position = (np.log(depth) - low) * ((count - 1) / max(high - low, 1e-6))
    known = np.isfinite(depth)
    return [np.where(known, np.maximum(0, 1 - np.abs(position - i)), 0).astype(np.float32) for i in range(count)]


def _level(half: Image, level: int) -> Image:
    """Blur an image of half the frame's size to a level's width, by way of a smaller one.

    Shrinking by the factor F adds the variance F^2/12 px^2, and enlarging bilinearly F^2/6.
    """
    factor = max(2.0, LEVELS_PX[level] / 2)
    height, width = half.shape[:2]
    size = (max(1, round(2 * width / factor)), max(1, round(2 * height / factor)))
    small = half if factor == 2 else cv2.resize(half, size, interpolation=cv2.INTER_AREA)
    added = factor**2 / 4 + (4 / 6 if factor > 2 else 0)
    variance = (LEVELS_PX[level] ** 2 - added) / factor**2
    if variance > 1e-3:
        small = cv2.GaussianBlur(small, (0, 0), variance**0.5, borderType=cv2.BORDER_CONSTANT)
    large = small if factor == 2 else cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large.reshape(half.shape))
