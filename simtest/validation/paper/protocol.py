"""The published protocol [MB, section 3.1]: a slanted view without noise, and its pipeline on one realisation.

Choices that the article does not state: the plane's centre lies at distance V_Z from the imaging camera; one texture
sample is one length unit; the tilt is about the image's x axis; the texture's centre maps to (M/2, M/2) with pixel
centres at + 0.5; the camera has f = M.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_array

from simtest.calibration import estimate_noise
from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators import Estimate, Estimator
from simtest.estimators.circle_pose import CirclePoseEstimator
from simtest.estimators.dispatch import run_each
from simtest.geometry import Patch
from simtest.runtime.arrays import Array
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.isocurves import brightest_point

Box = tuple[int, int, int, int]
"""Column, row, width, height, px."""


def draw_light(setting: PaperSetting, rng: np.random.Generator) -> Array:
    """Draw the light L = V + eps (cos a, sin a, b), a ~ U[0, 2 pi), b ~ U[-0.5, 0.5], shape (3,)."""
    a, b = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5)
    return np.array([0.0, 0.0, setting.height]) + setting.eps * np.array([np.cos(a), np.sin(a), b])


def plane_from_image(setting: PaperSetting) -> Array:
    """Return the homography from pixels to plane coordinates about the window's centre, shape (3, 3), texture units.

    The plane's point x (1, 0, 0) + y (0, cos theta, sin theta) + (0, 0, V_Z), times K, is its pixel.
    """
    theta = np.radians(setting.theta_deg)
    camera_from_plane = np.array([[1, 0, 0], [0, np.cos(theta), 0], [0, np.sin(theta), setting.height]])
    return np.asarray(np.linalg.inv(setting.camera.K @ camera_from_plane))


def texture(setting: PaperSetting, light: Array) -> Array:
    """Compute the texture, shape (M, M), of the specular term max(0, cos beta)^n; its largest sample is at most 1.

    `light` is L, shape (3,), texture units, with the camera's foot at the origin.
    """
    side = np.arange(setting.size) + PIXEL_CENTRE - setting.size / 2
    centre = window_centre(setting, light)
    x, powers = side + centre[0], []
    # By bands of rows and in place: fresh arrays of the whole size cost more than the arithmetic.
    for y in np.array_split((side + centre[1])[:, None], 8):
        # `isocurves.cosine_beta` for V over the origin: every factor is a sum of one in x and one in y.
        cosine2 = np.maximum(x * (light[0] - x) + (y * (light[1] - y) + light[2] * setting.height), 0)
        np.square(cosine2, out=cosine2)
        cosine2 /= (light[0] - x) ** 2 + ((light[1] - y) ** 2 + light[2] ** 2)
        cosine2 /= x**2 + (y**2 + setting.height**2)
        powers.append(np.power(cosine2, setting.exponent / 2, out=cosine2))
    return np.concatenate(powers)


def window_centre(setting: PaperSetting, light: Array) -> Array:
    """Return the plane point at the texture's centre, shape (2,)."""
    camera = np.array([0.0, 0.0, setting.height])
    return brightest_point(light, camera) if setting.recentre else np.zeros(2)


def sample_positions(setting: PaperSetting, box: Box) -> Array:
    """Compute where each pixel in a box of the picture reads the texture: rows and columns, shape (2, h, w)."""
    x0, y0, width, height = box
    x, y = np.meshgrid(np.arange(x0, x0 + width) + PIXEL_CENTRE, np.arange(y0, y0 + height) + PIXEL_CENTRE)
    plane = np.stack([x, y, np.ones_like(x)], axis=-1) @ plane_from_image(setting).T
    # The plane behind the camera is not seen: such pixels read outside the texture.
    scale = np.where(plane[..., 2] > 0, plane[..., 2], np.nan)
    samples = plane[..., :2] / scale[..., None] + setting.size / 2 - PIXEL_CENTRE
    return np.asarray(np.nan_to_num(np.moveaxis(samples[..., ::-1], -1, 0), nan=-2.0))


def warp(setting: PaperSetting, box: Box) -> csr_array:
    """Return the matrix from the texture's samples to a box of the picture, row by row: bilinear, 0 outside."""
    size = setting.size
    positions = sample_positions(setting, box).reshape(2, -1)
    row, column = first = np.clip(np.floor(positions), 0, size - 2).astype(np.intp)
    down, right = positions - first
    weights = np.array([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right])
    weights *= ((positions >= 0) & (positions <= size - 1)).all(axis=0)
    samples = row * size + column + np.array([[0], [1], [size], [size + 1]])
    ends = np.arange(0, weights.size + 1, 4)
    return csr_array((weights.T.ravel(), samples.T.ravel(), ends), shape=(len(row), size**2))


def picture(setting: PaperSetting, light: Array, box: Box | None = None, warped: csr_array | None = None) -> Array:
    """Warp the texture into a box of the slanted view, default all of it: the noise-free picture, 0 outside the window.

    `warped` is the box's `warp`, where it is known.
    """
    box = box or (0, 0, setting.size, setting.size)
    matrix = warp(setting, box) if warped is None else warped
    return np.asarray((matrix @ texture(setting, light).ravel()).reshape(box[3], box[2]))


def region_of_interest(setting: PaperSetting) -> Box:
    """Return the bounding box of the texture's window in the picture.

    Outside it the picture is black; the published method's region of interest is its part inside the frame.
    """
    half = setting.size / 2
    corners = np.array([[x, y, 1.0] for x in (-half, half) for y in (-half, half)])
    seen = corners @ np.linalg.inv(plane_from_image(setting)).T
    # A corner behind the camera is not seen: then the window fills the frame towards it.
    points = seen[:, :2] / np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)
    low = np.nan_to_num(np.floor(points.min(axis=0)), nan=0.0)
    high = np.nan_to_num(np.ceil(points.max(axis=0)), nan=float(setting.size))
    x0, y0 = (int(v) for v in np.clip(low, 0, setting.size - 1))
    x1, y1 = (int(v) for v in np.clip(high, 1, setting.size))
    return x0, y0, x1 - x0, y1 - y0


KERNEL_SIGMAS = 4.0
"""Half-width of the smoothing kernel over its standard deviation."""

NOISE_SIDE_PX = 48
"""Side of the square that the noise is estimated in."""


@dataclass(frozen=True)
class Stages:
    """The pictures of one realisation on the way to its isophote, within the pipeline's outer region, shape (h, w).

    Parameters
    ----------
    light : ndarray, shape (3,)
        L, texture units, the camera's foot at the origin.
    clean, noisy, smoothed : ndarray, shape (h, w)
        Slanted view without noise, with it, and smoothed; not normalised.
    """

    light: Array
    clean: Array
    noisy: Array
    smoothed: Array


class Pipeline:
    """The published pipeline at one setting; what all realisations share is computed once.

    Only the region of interest, the texture's window in the picture, is computed and smoothed. A margin of the kernel's
    half-width makes its values equal those of the whole picture.

    Parameters
    ----------
    setting : PaperSetting
        The setting.
    estimators : mapping, optional
        Estimator by name; default circle pose at the setting's isovalue.
    """

    def __init__(self, setting: PaperSetting, estimators: Mapping[str, Estimator] | None = None) -> None:
        self.setting = setting
        published = {"circle_pose": CirclePoseEstimator(setting.isovalue, with_region=False)}
        self.estimators: dict[str, Estimator] = dict(estimators or published)
        self.region = region_of_interest(setting)
        self.outer = _grown(self.region, kernel_radius(setting), setting.size)
        self._overhead = np.array([0.0, 0.0, setting.height])
        self._warp = warp(setting, self.outer)
        self._fixed = picture(setting, self._overhead, self.outer, self._warp) if setting.eps == 0 else None

    def realise(self, generators: Iterable[np.random.Generator]) -> dict[str, list[Estimate | Failure]]:
        """Make a realisation with each generator; return the Estimate or Failure of each by estimator name.

        A generator draws the light, where it is offset, then the noise of the outer region row by row.
        """
        return self.reconstruct([self.patch(rng) for rng in generators])

    def reconstruct(self, patches: Sequence[Patch | Failure]) -> dict[str, list[Estimate | Failure]]:
        """Return the Estimate or Failure of each region of interest by estimator name."""
        return {name: run_each(each, patches, self.setting.camera) for name, each in self.estimators.items()}

    def patch(self, rng: np.random.Generator) -> Patch | Failure:
        """Make the smoothed region of interest of one realisation (see `realise`)."""
        return self.cut(self.stages(rng))

    def stages(self, rng: np.random.Generator) -> Stages:
        """Make the pictures of one realisation (see `realise`)."""
        setting = self.setting
        # Slanted view: the same for all realisations unless the light is drawn.
        light, clean = self._overhead, self._fixed
        if clean is None:
            light = draw_light(setting, rng)
            clean = picture(setting, light, self.outer, self._warp)
        # Noise; smoothed in double precision, since in single precision the normal moves by up to 2e-5 deg.
        noisy = smoothed = clean + setting.sigma * rng.standard_normal(clean.shape, dtype=np.float32)
        if setting.smoothing_px > 0:
            side = 2 * kernel_radius(setting) + 1
            smoothed = cv2.GaussianBlur(noisy, (side, side), setting.smoothing_px, borderType=cv2.BORDER_REFLECT)
        return Stages(light, clean, noisy, smoothed)

    def cut(self, stages: Stages) -> Patch | Failure:
        """Cut the region of interest out of the outer region, with its noise."""
        x, y, width, height = self.region
        box = (x - self.outer[0], y - self.outer[1], width, height)
        return Patch.cut(
            stages.smoothed, box, origin_px=self.outer[:2], raw=stages.noisy, noise=frame_noise(stages.noisy),
            smoothing_px=self.setting.smoothing_px, others_px=(),
        )  # fmt: skip


def frame_noise(noisy: Array) -> float:
    """Estimate the noise of a picture from its middle: enough for white noise, and many times faster."""
    rows, columns = (max(size - NOISE_SIDE_PX, 0) // 2 for size in noisy.shape)
    return estimate_noise(noisy[rows : rows + NOISE_SIDE_PX, columns : columns + NOISE_SIDE_PX])


def kernel_radius(setting: PaperSetting) -> int:
    """Return the half-width of the smoothing kernel, px."""
    return math.ceil(KERNEL_SIGMAS * setting.smoothing_px)


def _grown(box: Box, margin: int, size: int) -> Box:
    x0, y0 = max(box[0] - margin, 0), max(box[1] - margin, 0)
    x1, y1 = min(box[0] + box[2] + margin, size), min(box[1] + box[3] + margin, size)
    return x0, y0, x1 - x0, y1 - y0
