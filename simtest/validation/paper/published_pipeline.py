"""The published pipeline on one realisation: noise, smoothing, reconstruction [MB, section 3.1]."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from simtest.calibration import estimate_noise
from simtest.errors import Failure
from simtest.estimators import Estimate, Estimator
from simtest.estimators.circle_pose import CirclePoseEstimator
from simtest.estimators.dispatch import run_each
from simtest.geometry import Patch
from simtest.runtime.arrays import Array
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.slanted_view import Box, draw_light, picture, region_of_interest, sample_positions

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
        self.positions = sample_positions(setting, self.outer)
        self._fixed = picture(setting, self._overhead, self.positions) if setting.eps == 0 else None

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
            clean = picture(setting, light, self.positions)
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
