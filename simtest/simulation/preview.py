"""A frame for the eye: the lit surface under its highlights, as an endoscope's automatic exposure would show it.

The sensor's frame is data: its exposure puts the brightest highlight at full scale, and a surface without a diffuse
part is black beside it. The preview is no data. It exposes for the surface and lets highlights clip.
"""

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, Image
from simtest.simulation.camera_chain import to_uint8
from simtest.simulation.labelled_frame import LabelledFrame

TISSUE = np.array([0.55, 0.27, 0.22], dtype=np.float32)
"""Colour of a surface that has none of its own, linear."""

SURFACE_LEVEL, BRIGHT_QUANTILE = 0.3, 0.9
"""Where the surface's light at this quantile lies, share of full scale."""

LEAST_SHARE = 1e-3
"""With less diffuse light than this share of the brightest highlight a surface counts as black."""


def preview(frame: LabelledFrame) -> npt.NDArray[np.uint8]:
    """Return a frame for the eye, sRGB of 8 bits, shape (H, W, 3).

    A surface with diffuse or bounced light is exposed as a whole. One without gets the light of a matt surface of
    `TISSUE` under the same lights, to which the specular light is added, with its brightest point at full scale.
    """
    radiance = frame.radiance
    specular, own = _colour(radiance.specular), _colour(radiance.diffuse + radiance.indirect)
    peak = float(specular.max())
    is_black = float(own.max()) <= LEAST_SHARE * peak
    if is_black:
        own = matt_light(frame)[:, :, None] * TISSUE
    lit = own.mean(axis=2)[frame.truth.mask]
    level = float(np.quantile(lit, BRIGHT_QUANTILE)) if lit.size else 0.0
    exposure = SURFACE_LEVEL / level if level > 0 else 1.0
    return to_uint8(exposure * own + specular * (1 / max(peak, 1e-30) if is_black else exposure))


def matt_light(frame: LabelledFrame) -> Image:
    """Return the light of a white matt surface under the frame's lights, relative, shape (H, W)."""
    position, normal = frame.truth.position, frame.truth.normal_base
    total = np.zeros(position.shape[:2])
    with np.errstate(invalid="ignore", divide="ignore"):
        for light in np.asarray(frame.scene.rig.true_mm(), dtype=float):
            total += _from_light(position, normal, light)
    return np.nan_to_num(total).astype(np.float32)


def _from_light(position: Array, normal: Array, light: Array) -> Array:
    """Return Lambert's cosine over the squared distance, 1/mm^2."""
    way = light - position
    distance = np.linalg.norm(way, axis=-1)
    return np.asarray(np.maximum((normal * way).sum(axis=-1), 0) / distance**3)


def _colour(values: Image) -> Image:
    return np.repeat(values[:, :, None], 3, axis=2) if values.ndim == 2 else values
