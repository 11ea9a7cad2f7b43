"""A frame for the eye: the lit surface under its highlights, as an endoscope's automatic exposure would show it.

The sensor's frame is data: its exposure puts the brightest highlight at full scale, and a surface without a diffuse
part is black beside it. The preview is no data. It exposes for the surface and lets highlights clip.
"""

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, Image, Mask
from simtest.simulation.labelled_frame import LabelledFrame
from simtest.simulation.sensor import to_uint8

TISSUE = np.array([0.55, 0.27, 0.22], dtype=np.float32)
"""Colour of a surface that has none of its own, linear."""

SURFACE_LEVEL, BRIGHT_QUANTILE = 0.3, 0.9
"""Where the surface's light at this quantile lies, share of full scale."""

LEAST_SHARE = 1e-3
"""With less diffuse light than this share of the brightest highlight a surface counts as black."""


def preview(frame: LabelledFrame) -> npt.NDArray[np.uint8]:
    """Return a frame for the eye, sRGB of 8 bits, shape (H, W, 3) (see `expose`)."""
    radiance, truth = frame.radiance, frame.truth
    matt = matt_light(truth.position, truth.normal_base, np.asarray(frame.scene.rig.true_mm(), dtype=float))
    own = coloured(radiance.diffuse + radiance.indirect)
    return to_uint8(expose(coloured(radiance.specular), own, matt, truth.mask))


def expose(specular: Image, own: Image, matt: Image, mask: Mask) -> Image:
    """Return linear light for the eye, in which the surface is lit.

    A surface with diffuse or bounced light is exposed as a whole. One without gets the light of a matt surface of
    `TISSUE`, to which the specular light is added, with its brightest point at full scale.

    Parameters
    ----------
    specular, own : ndarray, shape (..., 3)
        Specular light, and diffuse and bounced light.
    matt : ndarray, shape (...)
        Light of a white matt surface there (`matt_light`).
    mask : ndarray of bool, shape (...)
        Where there is a surface.
    """
    peak = float(specular.max())
    is_black = float(own.max()) <= LEAST_SHARE * peak
    surface = matt[..., None] * TISSUE if is_black else own
    lit = surface.mean(axis=-1)[mask]
    level = float(np.quantile(lit, BRIGHT_QUANTILE)) if lit.size else 0.0
    exposure = SURFACE_LEVEL / level if level > 0 else 1.0
    return np.asarray(exposure * surface + specular * (1 / max(peak, 1e-30) if is_black else exposure), np.float32)


def matt_light(position: Array, normal: Array, lights: Array) -> Image:
    """Return the light of a white matt surface under lights, shape (L, 3), mm: relative, shape (...).

    It is Lambert's cosine over the squared distance; 0 where there is no surface.
    """
    total = np.zeros(position.shape[:-1])
    with np.errstate(invalid="ignore", divide="ignore"):
        for light in lights:
            way = light - position
            total += np.maximum((normal * way).sum(axis=-1), 0) / np.linalg.norm(way, axis=-1) ** 3
    return np.nan_to_num(total).astype(np.float32)


def coloured(values: Image) -> Image:
    """Return light with three channels, shape (H, W, 3)."""
    return np.repeat(values[:, :, None], 3, axis=2) if values.ndim == 2 else values
