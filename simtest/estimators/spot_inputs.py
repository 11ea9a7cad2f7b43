"""What a network sees of a highlight, and returns: crops around its peak, the lights and the optical axis go in.

The three crops have fixed sizes in pixels, so they do not depend on the detector. All directions are in the tangent
basis of the direction to the camera that is aligned with the crops' axes (`image_basis`).
"""

from collections.abc import Sequence

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.geometry import Array, Camera
from simtest.runtime.arrays import Image

SIDE = 32
"""Side of a crop, px of the crop."""

STEPS = (1, 3, 9)
"""Pixels of the frame for one of each crop: the highlight, its neighbours, the shading around."""

DARKEST = 0.02
"""Share of the frame's median light that is added before the logarithm; what lies outside the view is this dark."""

LEAST_LIT, BRIGHT_PERCENT = 0.05, 95.0
"""Pixels with less than this share of the light at this percentile count as unlit (`median_of_lit`)."""

LIGHT_SCALE_MM = 5.0
"""Position of a light, mm, for an input of 1."""

EXTRAS = (
    "log of the focal length over 300 px",
    "optical axis, first", "optical axis, second",
    "mean light, first", "mean light, second", "mean light, towards",
    "lights' spread, first", "lights' spread, mixed", "lights' spread, second",
    "peak over the median light, logarithm", "clipped pixels",
)  # fmt: skip

# What a network returns

ROTATION_SCALE = 0.1
"""Rotation, rad, for an output of 1."""

SURFACES = ("base", "fine")

OUTPUTS = ("rotation, first", "rotation, second", "logarithm of L11", "L21", "logarithm of L22", "axis ratio, logit",
           "logarithm of the axis ratio's deviation")  # fmt: skip
"""Of each surface. L is the Cholesky factor of the rotation's covariance, both in units of `ROTATION_SCALE`."""

RATIO, RATIO_DEVIATION = 5, 6
"""Columns of the axis ratio and of its deviation."""

LOG_RANGE = (-5.0, 2.0)
"""Of the logarithms of deviations: outside it they are clipped, so that no example decides the fit."""


def image_basis(rays: Array) -> Array:
    """Return two unit vectors across each ray, along the image's x and nearly along its y, shape (N, 2, 3).

    The third vector of the right-handed frame is the ray itself.
    """
    first = np.array([1.0, 0.0, 0.0]) - rays[:, :1] * rays
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(rays, first)], axis=1)


def rotation_of(rays: Array, normals: Array) -> Array:
    """Return the rotation from the direction to the camera, -ray, to a unit normal, rad in `image_basis`, (N, 2)."""
    across = np.einsum("nij,nj->ni", image_basis(rays), normals)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, -np.sum(rays * normals, axis=1))
    return across * (angle / np.maximum(sine, 1e-12))[:, None]


def normal_of(rays: Array, rotation: Array) -> Array:
    """Return the unit normals at rotations from the direction to the camera: the exponential map, (N, 3)."""
    along = np.einsum("nij,ni->nj", image_basis(rays), rotation)
    angle = np.linalg.norm(along, axis=1, keepdims=True)
    return -np.cos(angle) * rays + np.sinc(angle / np.pi) * along


def spot_inputs(frame: Frame, peaks_px: Sequence[Array] | Array) -> tuple[Image, Image]:
    """Return the inputs of a network at peaks of a frame.

    Parameters
    ----------
    frame : Frame
        Encoded values and calibration, whose lights must be told.
    peaks_px : array_like, shape (N, 2)
        Positions, px.

    Returns
    -------
    crops : ndarray of float32, shape (N, 3, 32, 32)
        Logarithm of the linear light over the median of the frame's lit pixels, the smallest step first.
    extras : ndarray of float32, shape (N, 11)
        See `EXTRAS`.
    """
    peaks = np.asarray(peaks_px, dtype=float).reshape(-1, 2)
    light = frame.channels if frame.channels.ndim == 2 else frame.channels.mean(axis=2, dtype=np.float32)
    seen = np.ones(light.shape, dtype=bool) if frame.seen is None else frame.seen
    logarithm = np.log(np.where(seen, light / median_of_lit(light[seen]), 0.0) + DARKEST, dtype=np.float32)
    # A coarse crop averages what one of its pixels covers.
    layers = [logarithm if step == 1 else cv2.blur(logarithm, (step, step)) for step in STEPS]
    outside = float(np.log(DARKEST))
    crops = np.empty((len(peaks), len(STEPS), SIDE, SIDE), dtype=np.float32)
    for n, peak in enumerate(peaks):
        for k, (layer, step) in enumerate(zip(layers, STEPS, strict=True)):
            corner = peak - 0.5 - (SIDE - 1) / 2 * step  # warpAffine has the centre of pixel (0, 0) at the origin
            frame_from_crop = np.array([[step, 0, corner[0]], [0, step, corner[1]]])
            cv2.warpAffine(
                layer, frame_from_crop, (SIDE, SIDE), dst=crops[n, k], flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
                borderMode=cv2.BORDER_CONSTANT, borderValue=outside,
            )  # fmt: skip
    return crops, _extras(frame, peaks, crops)


def median_of_lit(light: Image) -> float:
    """Return the median light of a frame's lit pixels, 1 where there are none.

    An organ before a dark background may cover less than half of the picture, whose median then is no tissue's.
    """
    if light.size == 0:
        return 1.0
    lit = light[light > LEAST_LIT * np.percentile(light, BRIGHT_PERCENT)]
    return max(float(np.median(lit)), 1e-6) if lit.size else 1.0


def _extras(frame: Frame, peaks: Array, crops: Image) -> Image:
    camera, lights = frame.calibration.camera, frame.calibration.priors.lights
    rays = rays_of(camera, peaks)
    basis = image_basis(rays)
    mean, offsets = lights.mean(axis=0) / LIGHT_SCALE_MM, (lights - lights.mean(axis=0)) / LIGHT_SCALE_MM
    spread = np.einsum("nij,jk,nlk->nil", basis, offsets.T @ offsets / len(lights), basis)
    clipped = [_clipped_near(frame, peak) for peak in peaks]
    columns = [
        np.full(len(peaks), np.log(camera.fx / 300.0)),
        *basis[:, :, 2].T,
        *(basis @ mean).T, -rays @ mean,
        spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1],
        crops[:, 0, SIDE // 2 - 2 : SIDE // 2 + 2, SIDE // 2 - 2 : SIDE // 2 + 2].max(axis=(1, 2)),
        np.log1p(clipped),
    ]  # fmt: skip
    return np.stack(columns, axis=1).astype(np.float32)


def rays_of(camera: Camera, peaks: Array) -> Array:
    """Return the unit sightlines through pixels, shape (N, 3)."""
    return np.array([camera.unproject(peak) for peak in peaks]).reshape(-1, 3)


def _clipped_near(frame: Frame, peak: Array) -> int:
    """Return the number of clipped pixels of the smallest crop."""
    x, y = (int(v) for v in peak)
    half = SIDE // 2
    return int(frame.clipped[max(y - half, 0) : y + half, max(x - half, 0) : x + half].sum())
