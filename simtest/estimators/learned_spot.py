"""`learned_spot`: a trained network's normals at single highlights, run by ONNX Runtime, without PyTorch."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from simtest.calibration import Frame, Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import Estimate, Target
from simtest.estimators.spot_inputs import (
    EXTRAS,
    LOG_RANGE,
    OUTPUTS,
    ROTATION_SCALE,
    SURFACES,
    normal_of,
    rays_of,
    spot_inputs,
)
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.vectors import basis_across
from simtest.runtime.arrays import Image
from simtest.runtime.files import require_plain
from simtest.runtime.resources import data_root, shown

METADATA, FORMAT = "simtest", "simtest spot_normals, version 2"

_CHECKED = tuple(EXTRAS[:1]) + tuple(EXTRAS[3:9])
"""Extras whose range is checked: focal length and lights. The others differ from frame to frame."""

MARGIN = 0.05
"""Share of a range, and absolute part, by which an input may leave it."""

STEP = 1e-5
"""Step of the differences of the normal, rad."""

LARGEST_MODEL_BYTES = 256 * 2**20

SHIPPED = ("learning", "weights", "learned_spot.onnx")
"""Below the shipped scenes; its card lies beside it."""


@dataclass(frozen=True)
class CovarianceScale:
    """Factor of a covariance, as it hangs on how sure the network states to be of the highlight.

    Parameters
    ----------
    log_deviation : tuple of float
        Mean logarithm of the two stated deviations (`log_deviation`), ascending; constant beyond the ends.
    factor : tuple of float
        Factor of the covariance there; its logarithm is interpolated.
    """

    log_deviation: tuple[float, ...]
    factor: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.log_deviation) == len(self.factor) >= 1:
            raise ValueError("scales need as many factors as deviations, 1 or more")
        if not np.isfinite(self.log_deviation).all() or (np.diff(self.log_deviation) <= 0).any():
            raise ValueError("deviations of scales must ascend")
        if not np.isfinite(self.factor).all() or min(self.factor) <= 0:
            raise ValueError("scales must be above 0")

    def at(self, log_deviation: Array | float) -> Array:
        """Return the factors at stated deviations."""
        return np.asarray(np.exp(np.interp(log_deviation, self.log_deviation, np.log(self.factor))))


def log_deviation(outputs: Array) -> Array:
    """Return the mean logarithm of the two stated deviations for the outputs of one surface, shape (..., 7)."""
    return np.asarray(np.clip(outputs[..., [2, 4]], *LOG_RANGE).mean(axis=-1))


@dataclass(frozen=True)
class LearnedSpot:
    """A network of the task ``spot_normals`` (`simtest train`) as an estimator.

    It sees three crops around each highlight and the lights' positions, and answers for each detection on its own. It
    refuses with ``no_estimate`` what lies outside the range that it was taught: another focal length, a lens with
    distortion, other lights, or crops whose features lie far from those of the train split.

    Parameters
    ----------
    model : str or Path, optional
        The file model.onnx. Default: the shipped network.
    target : {"base", "fine"}
        Which surface's normals are stated.

    Raises
    ------
    InputError
        If the target is neither; at the first use, if ONNX Runtime (extra ``onnx``) is missing, or the file is no such
        network.
    """

    model: str | Path | None = None
    target: Target = "base"

    def __post_init__(self) -> None:
        if self.target not in SURFACES:
            raise InputError(f"target = {shown(self.target)}: must be base or fine")

    def check(self) -> None:
        """Load the network; raise `InputError` where it cannot be used."""
        _ = self._network

    @cached_property
    def _network(self) -> "_Network":
        return _Network(Path(self.model) if self.model else data_root("scenes").joinpath(*SHIPPED))

    def estimate_frame(self, frame: Frame, camera: Camera, priors: Priors, /) -> Sequence[Estimate] | Failure:
        """Return a failure: which highlights there are is the detector's to say (see `estimate_regions`)."""
        return Failure(Reason.NO_ESTIMATE, "answers for detected highlights alone")

    def estimate_regions(
        self, frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return an estimate or a failure for each patch (see `simtest.estimators.protocol.RegionEstimator`)."""
        if not frame.calibration.priors.lights_mm:
            missing = Failure(Reason.NOT_KNOWN, "needs the lights' positions")
            return [patch if isinstance(patch, Failure) else missing for patch in patches], []
        peaks = [patch.peak_px for patch in patches if not isinstance(patch, Failure)]
        made = iter(self._at(frame, peaks))
        return [patch if isinstance(patch, Failure) else next(made) for patch in patches], []

    def _at(self, frame: Frame, peaks: Sequence[Array]) -> list[Estimate | Failure]:
        """Return an estimate or a failure for each peak of a frame whose lights are told."""
        if not peaks:
            return []
        if frame.camera.distortion is not None:
            # Checked before the network is loaded: it would not help.
            refused = Failure(Reason.NO_ESTIMATE, "outside the network's training: a lens with distortion")
            return [refused] * len(peaks)
        crops, extras = spot_inputs(frame, peaks)
        outputs, refusals = self._network.run(crops, extras)
        rays, number = rays_of(frame.camera, np.asarray(peaks)), SURFACES.index(self.target)
        rows = zip(rays, peaks, outputs[:, number], refusals, strict=True)
        return [refusal or self._estimate(ray, peak, made) for ray, peak, made, refusal in rows]

    def _estimate(self, ray: Array, peak: Array, made: Array) -> Estimate:
        """Return the estimate of one row of outputs."""
        turn = made[:2] * ROTATION_SCALE
        steps = turn + STEP * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        normals = normal_of(np.repeat(ray[None], 3, axis=0), steps)
        jacobian = basis_across(normals[0]) @ (normals[1:] - normals[0]).T / STEP
        first, second = np.exp(np.clip(made[[2, 4]], *LOG_RANGE))
        factor = ROTATION_SCALE * np.array([[first, 0.0], [made[3], second]])
        covariance = (
            jacobian @ factor @ factor.T @ jacobian.T * self._network.scales[self.target].at(log_deviation(made))
        )
        return Estimate(
            normal=normals[0], candidates=normals[:1], look_px=np.asarray(peak, dtype=float),
            axis_ratio=float(1 / (1 + np.exp(-made[5]))), covariance=covariance, target=self.target,
        )  # fmt: skip


class _Network:
    """A network in ONNX Runtime, with the range that it was taught."""

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise InputError("learned_spot needs the package onnxruntime: install the extra onnx") from None
        try:
            data = require_plain(path).read_bytes()
        except OSError as error:
            raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from None
        if len(data) > LARGEST_MODEL_BYTES:
            raise InputError(f"{shown(path)}: has {len(data)} bytes; may have {LARGEST_MODEL_BYTES}")
        options = onnxruntime.SessionOptions()
        # The harness divides the cores among its workers.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            text = self._session.get_modelmeta().custom_metadata_map.get(METADATA, "")
        except Exception as error:  # its exceptions share no base but this
            reason = " ".join(str(error).split())
            raise InputError(f"{shown(path)}: is no ONNX model ({shown(reason, 100)})") from None
        self._path = path
        self._read(path, text)

    def _read(self, path: Path, text: str) -> None:
        """Take scales and ranges from the metadata."""
        try:
            content: dict[str, Any] = json.loads(text)
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']!r}")
            self.scales = {surface: _scale(content["scales"][surface]) for surface in SURFACES}
            self._low = {name: float(content["low"][name]) for name in EXTRAS}
            self._high = {name: float(content["high"][name]) for name in EXTRAS}
            self._mean = np.array(content["feature_mean"], dtype=float)
            self._precision = _symmetric(np.array(content["feature_precision"], dtype=float), len(self._mean))
            self._limit = float(content["feature_limit"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{shown(path)}: is no network of simtest train ({type(error).__name__}: {shown(error, 80)}); "
                f"its metadata must hold {METADATA!r} of the form {FORMAT!r}"
            ) from None

    def run(self, crops: Image, extras: Image) -> tuple[Array, list[Failure | None]]:
        """Return outputs, shape (N, 2, 7), and for each row why it is refused, or None."""
        try:
            made = self._session.run(None, {"crops": crops, "extras": extras})
            outputs, features = (np.asarray(each, dtype=float) for each in made)
            if outputs.shape[1:] != (len(SURFACES), len(OUTPUTS)) or features.shape[1:] != self._mean.shape:
                raise ValueError(f"outputs {outputs.shape}, features {features.shape}")
        except Exception as error:  # of ONNX Runtime, as above
            reason = " ".join(str(error).split())
            raise InputError(f"{shown(self._path)}: cannot be run ({shown(reason, 120)})") from None
        off = features - self._mean
        distances = np.einsum("ni,ij,nj->n", off, self._precision, off)
        return outputs, [self._refusal(row, distance) for row, distance in zip(extras, distances, strict=True)]

    def _refusal(self, extras: Image, distance: float) -> Failure | None:
        for name, value in zip(EXTRAS, extras.tolist(), strict=True):
            low, high = self._low[name], self._high[name]
            margin = MARGIN * (1 + high - low)
            if name in _CHECKED and not low - margin <= value <= high + margin:
                return Failure(
                    Reason.NO_ESTIMATE,
                    f"outside the network's training: {name} is {value:.3g}, was {low:.3g} to {high:.3g}",
                )
        if not distance <= self._limit:
            return Failure(
                Reason.NO_ESTIMATE,
                f"unlike the network's training: features at {distance:.3g}, limit {self._limit:.3g}",
            )
        return None


def _scale(content: dict[str, list[float]]) -> CovarianceScale:
    return CovarianceScale(*(tuple(float(v) for v in content[key]) for key in ("log_deviation", "factor")))


def _symmetric(upper: Array, size: int) -> Array:
    """Return a symmetric matrix from its upper triangle, row by row; raise `ValueError` for another length."""
    if upper.shape != (size * (size + 1) // 2,):
        raise ValueError("feature_precision does not fit feature_mean")
    whole = np.zeros((size, size))
    rows, columns = np.triu_indices(size)
    whole[rows, columns] = whole[columns, rows] = upper
    return whole


learned_spot = LearnedSpot()
"""The shipped network; it is read at its first use."""
