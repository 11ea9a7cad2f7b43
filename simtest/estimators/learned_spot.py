"""`learned_spot`: a trained network's normals at single highlights, run by ONNX Runtime, without PyTorch.

It sees crops around a highlight's peak, the lights and the optical axis. The three crops have fixed sizes in pixels, so
they do not depend on the detector. All directions are in the tangent basis of the direction to the camera that is
aligned with the crops' axes (`image_basis`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.learned import (
    LIGHT_SCALE_MM,
    LOG_RANGE,
    LearnedNormals,
    TaughtNetwork,
    image_basis,
    inflation,
    log_deviation,
    median_of_lit,
    stated_normals,
)
from simtest.estimators.protocol import Estimate, Target
from simtest.geometry import Array
from simtest.runtime.arrays import Image
from simtest.runtime.fitted import fitted_number

SIDE = 32  # side of a crop, px of the crop
STEPS = (1, 3, 9)  # pixels of the frame for one of each crop: the highlight, its neighbours, the shading around

DARKEST = 0.02
"""Share of the frame's median light that is added before the logarithm; what lies outside the view is this dark."""

EXTRAS = (
    "log of the focal length over 300 px",
    "optical axis, first", "optical axis, second",
    "mean light, first", "mean light, second", "mean light, towards",
    "lights' spread, first", "lights' spread, mixed", "lights' spread, second",
    "peak over the median light, logarithm", "clipped pixels",
)  # fmt: skip

# What a network returns

ROTATION_SCALE = 0.1  # rotation, rad, for an output of 1

SURFACES = ("base", "fine")

OUTPUTS = ("rotation, first", "rotation, second", "logarithm of L11", "L21", "logarithm of L22", "axis ratio, logit",
           "logarithm of the axis ratio's deviation")  # fmt: skip
"""Of each surface. L is the Cholesky factor of the rotation's covariance, both in units of `ROTATION_SCALE`."""

RATIO, RATIO_DEVIATION = 5, 6  # columns of the axis ratio and of its deviation


def spot_inputs(frame: Frame, peaks_px: Sequence[Array] | Array) -> tuple[Image, Image]:
    """Return the inputs of a network at peaks of a frame.

    `frame`: encoded values and calibration, whose lights must be told; `peaks_px`, (N, 2): positions, px. Returns
    `crops`, (N, 3, 32, 32): logarithm of the linear light over the median of the frame's lit pixels, the smallest step
    first; `extras`, (N, 11): see `EXTRAS`.
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


def _extras(frame: Frame, peaks: Array, crops: Image) -> Image:
    camera, lights = frame.calibration.camera, frame.calibration.priors.lights
    rays = camera.unproject(peaks)
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


def _clipped_near(frame: Frame, peak: Array) -> int:
    """Return the number of clipped pixels of the smallest crop."""
    x, y = (int(v) for v in peak)
    half = SIDE // 2
    return int(frame.clipped[max(y - half, 0) : y + half, max(x - half, 0) : x + half].sum())


CUT_PX, CUT_FACTOR = fitted_number("cut_spot.px"), fitted_number("cut_spot.factor")

FORMAT = "simtest spot_normals, version 3"

_CHECKED = tuple(EXTRAS[:1]) + tuple(EXTRAS[3:9])
"""Extras whose range is checked: focal length and lights. The others differ from frame to frame."""


class SpotNetwork(TaughtNetwork):
    """A network of single highlights."""

    form, core, inputs = FORMAT, "learned_spot", EXTRAS
    scaled: ClassVar = {"scales": SURFACES, "ratio_scales": SURFACES}

    def run(self, crops: Image, extras: Image) -> tuple[Array, Array, list[Failure | None]]:
        """Return outputs, shape (N, 2, 7), factors of the covariances, and for each row why it is refused, or None."""
        shapes = {"outputs": (None, len(SURFACES), len(OUTPUTS)), "features": (None, len(self._range.mean))}
        outputs, features = self._model.run({"crops": crops, "extras": extras}, shapes)
        checked = ({name: float(row[EXTRAS.index(name)]) for name in _CHECKED} for row in extras)
        refusals = [
            self._range.refusal(values) or unlike
            for values, unlike in zip(checked, self._range.refusals(features), strict=True)
        ]
        inflated = inflation(self._range.distances(features), self._usual)
        return np.asarray(outputs, dtype=float), inflated, refusals


@dataclass(frozen=True)
class LearnedSpot(LearnedNormals):
    """A network that states the normal at one highlight (`studies.networks.spots`) as an estimator.

    It sees three crops around each highlight and the lights' positions, and answers for each detection on its own. It
    refuses with ``no_estimate`` what lies outside the range that it was taught: another focal length, a lens with
    distortion, other lights, or crops whose features lie far from those of the train split.

    Parameters
    ----------
    model : str or Path, optional
        The file model.onnx. Default: the shipped network.
    target : {"base", "fine"}
        Which surface's normals are stated.
    """

    target: Target = "base"
    shipped: ClassVar[str] = "learned_spot.onnx"
    network: ClassVar = SpotNetwork

    def __post_init__(self) -> None:
        if self.target not in SURFACES:
            raise InputError(f"target = {self.target}: must be base or fine")

    @property
    def description(self) -> str:
        """What the estimator is, in one line for a reader who chooses one."""
        network = str(self.model or self.shipped)
        return f"The normal of the {self.target} surface at each highlight, by the network {network}."

    def _at(self, frame: Frame, peaks: Array) -> Sequence[Estimate | Failure] | Failure:
        if frame.camera.distortion is not None:
            # Checked before the network is loaded: it would not help.
            return Failure(Reason.NO_ESTIMATE, "outside the network's training: a lens with distortion")
        crops, extras = spot_inputs(frame, peaks)
        outputs, inflated, refusals = self._network.run(crops, extras)
        made = outputs[:, SURFACES.index(self.target)]
        scales, ratio_scales = self._network.scales[self.target], self._network.ratio_scales[self.target]
        factors = scales.at(log_deviation(made)) * inflated
        # A spot that the border cuts shows the network half of what it was taught.
        size = frame.camera.width, frame.camera.height
        factors = factors * np.where(np.minimum(peaks, size - peaks).min(axis=1) < CUT_PX, CUT_FACTOR**2, 1.0)
        normals, covariances = stated_normals(frame.camera.unproject(peaks), made, ROTATION_SCALE, factors)
        sure = np.clip(made[:, RATIO_DEVIATION], *LOG_RANGE)
        deviations = np.exp(sure) * np.sqrt(ratio_scales.at(sure) * inflated)
        return [
            refusal
            or Estimate(
                normal=normal, candidates=normal[None], look_px=peak, axis_ratio=float(1 / (1 + np.exp(-ratio))),
                covariance=covariance, target=self.target, axis_ratio_deviation=float(deviation),
            )
            for refusal, normal, covariance, peak, ratio, deviation in zip(
                refusals, normals, covariances, peaks, made[:, RATIO], deviations, strict=True
            )
        ]  # fmt: skip


learned_spot = LearnedSpot()  # the shipped network; it is read at its first use
