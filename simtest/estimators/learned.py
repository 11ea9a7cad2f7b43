"""What the networks that state normals share: their files, the range that they were taught, and what they state.

A network is an ONNX file with metadata, run by ONNX Runtime; the package onnxruntime (extra ``onnx``) is imported when
one is loaded, not before. It refuses what lies outside its range. What it states are rotations from the direction to
the camera with covariances, which are scaled by what a validation split showed. `reflection_distances` says whether
normals at highlights agree with the law of reflection: a test of a method that needs no truth.
"""

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from simtest.calibration import Frame
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import Estimate
from simtest.geometry import Patch
from simtest.geometry.vectors import bisect, tangent_basis
from simtest.runtime.arrays import AnyArray, Array, Image
from simtest.runtime.files import JsonObject, require_plain
from simtest.runtime.fitted import fitted_number
from simtest.runtime.resources import data_root

LEAST_LIT, BRIGHT_PERCENT = 0.05, 95.0
"""Pixels with less than this share of the light at this percentile count as unlit (`median_of_lit`)."""

LIGHT_SCALE_MM = 5.0  # position of a light, mm, for an input of 1

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
    return _across(image_basis(rays), -rays, normals)


def normal_of(rays: Array, rotation: Array) -> Array:
    """Return the unit normals at rotations from the direction to the camera: the exponential map, (N, 3)."""
    along = np.einsum("nij,ni->nj", image_basis(rays), rotation)
    angle = np.linalg.norm(along, axis=1, keepdims=True)
    return -np.cos(angle) * rays + np.sinc(angle / np.pi) * along


def median_of_lit(light: Image) -> float:
    """Return the median light of a frame's lit pixels, 1 where there are none.

    An organ before a dark background may cover less than half of the picture, whose median then is no tissue's.
    """
    if light.size == 0:
        return 1.0
    lit = light[light > LEAST_LIT * np.percentile(light, BRIGHT_PERCENT)]
    return max(float(np.median(lit)), 1e-6) if lit.size else 1.0


MARGIN = 0.05  # share of a range, and absolute part, by which an input may leave it


@dataclass(frozen=True)
class TrainingRange:
    """Ranges of named inputs on the train split, and the distribution of the network's inner features there."""

    # low, high: smallest and largest value of each input.
    low: dict[str, float]
    high: dict[str, float]
    mean: Array  # (F,): mean of the features
    precision: Array  # (F, F): inverse of their covariance
    limit: float  # squared Mahalanobis distance of features beyond which the network refuses

    @staticmethod
    def read(content: JsonObject, names: Sequence[str]) -> "TrainingRange":
        """Return the range in a network's metadata (`written`).

        Raises `KeyError`, `TypeError`, `ValueError` if it is malformed, or a name is missing.
        """
        low, high = ({name: float(content[key][name]) for name in names} for key in ("low", "high"))
        mean = np.array(content["feature_mean"], dtype=float)
        precision = _symmetric(np.array(content["feature_precision"], dtype=float), len(mean))
        limit = float(content["feature_limit"])
        if not np.isfinite([*low.values(), *high.values(), *mean, *precision.ravel(), limit]).all():
            raise ValueError("its range holds values that are not finite")
        return TrainingRange(low, high, mean, precision, limit)

    def written(self) -> JsonObject:
        """Return the range as it stands in the metadata, features with `DIGITS` digits."""
        upper = self.precision[np.triu_indices(len(self.precision))]
        return {
            "low": self.low, "high": self.high, "feature_mean": rounded(self.mean),
            "feature_precision": rounded(upper), "feature_limit": float(self.limit),
        }  # fmt: skip

    def refusal(self, values: Mapping[str, float]) -> Failure | None:
        """Return why inputs are refused, or None: the first that leaves its range by more than `MARGIN` of it."""
        for name, value in values.items():
            low, high = self.low[name], self.high[name]
            margin = MARGIN * (1 + high - low)
            if not low - margin <= value <= high + margin:
                told = f"outside the network's training: {name} is {value:.3g}, was {low:.3g} to {high:.3g}"
                return Failure(Reason.NO_ESTIMATE, told)
        return None

    def distances(self, features: AnyArray) -> Array:
        """Return the squared Mahalanobis distances of features, shape (N, F), from those of the train split."""
        off = np.asarray(features, dtype=float) - self.mean
        return np.asarray(np.einsum("ni,ij,nj->n", off, self.precision, off))

    def refusals(self, features: AnyArray) -> list[Failure | None]:
        """Return for each row of features why it is refused, or None."""
        told = "unlike the network's training: features at {:.3g}, limit {:.3g}"
        return [
            None if distance <= self.limit else Failure(Reason.NO_ESTIMATE, told.format(distance, self.limit))
            for distance in self.distances(features)
        ]


def inflation(distances: Array, usual: float) -> Array:
    """Return factors of covariances for features at squared distances from those of the train split.

    They are 1 up to the usual distance and proportional to the squared distance beyond: where the features say that a
    highlight or frame differs from those taught, the network is less sure than it states.
    """
    return np.maximum(1.0, distances / usual)


DIGITS = 7  # of the numbers of the metadata: those of the weights have no more


def rounded(values: AnyArray | Sequence[float]) -> list[float]:
    """Return values with `DIGITS` digits."""
    return [float(f"{value:.{DIGITS}g}") for value in values]


def _symmetric(upper: Array, size: int) -> Array:
    """Return a symmetric matrix from its upper triangle, row by row; raise `ValueError` for another length."""
    if upper.shape != (size * (size + 1) // 2,):
        raise ValueError("feature_precision does not fit feature_mean")
    whole = np.zeros((size, size))
    rows, columns = np.triu_indices(size)
    whole[rows, columns] = whole[columns, rows] = upper
    return whole


@dataclass(frozen=True)
class CovarianceScale:
    """Factor of a covariance, as it hangs on how sure the network states to be."""

    log_deviation: tuple[float, ...]  # mean logarithm of the two stated deviations, ascending; constant beyond the ends
    factor: tuple[float, ...]  # factor of the covariance there; its logarithm is interpolated

    def __post_init__(self) -> None:
        if not len(self.log_deviation) == len(self.factor) >= 1:
            raise ValueError("scales need as many factors as deviations, 1 or more")
        if not np.isfinite(self.log_deviation).all() or (np.diff(self.log_deviation) <= 0).any():
            raise ValueError("deviations of scales must ascend")
        if not np.isfinite(self.factor).all() or min(self.factor) <= 0:
            raise ValueError("scales must be above 0")

    @staticmethod
    def read(content: Mapping[str, Sequence[float]]) -> "CovarianceScale":
        """Return the scale in a network's metadata; raise KeyError, TypeError or ValueError if it is malformed."""
        return CovarianceScale(*(tuple(float(v) for v in content[key]) for key in ("log_deviation", "factor")))

    def written(self) -> JsonObject:
        """Return the scale as it stands in the metadata."""
        return {key: rounded(values) for key, values in asdict(self).items()}

    def at(self, log_deviation: Array | float) -> Array:
        """Return the factors at stated deviations."""
        return np.asarray(np.exp(np.interp(log_deviation, self.log_deviation, np.log(self.factor))))


METADATA = "simtest"  # key of the metadata, a JSON object, in the file
WEIGHTS = ("learning", "weights")  # where networks lie below the shipped scenes

LARGEST_MODEL_BYTES = 256 * 2**20


class OnnxModel:
    """A trained network in ONNX Runtime, on one thread of the processor.

    Its metadata, `content`, has the value `form` of the key ``format``, which says what inputs, outputs and metadata it
    has; it is read inside of `reading`. `core` is the name of the core that needs the network, for messages.
    """

    def __init__(self, path: Path, form: str, core: str) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise InputError(f"{core} needs the package onnxruntime: install the extra onnx") from None
        self._path, self._form, self._core = path, form, core
        data = _bytes(path)
        options = onnxruntime.SessionOptions()
        # The harness divides the cores among its workers.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4  # what is wrong is in the exception
        try:
            self._session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
            text = self._session.get_modelmeta().custom_metadata_map.get(METADATA, "")
        except Exception as error:  # its exceptions share no base but this
            reason = " ".join(str(error).split())
            raise InputError(f"{path}: is no ONNX model ({reason!s:.100})") from None
        with self.reading():
            self.content: JsonObject = json.loads(text)
            if self.content["format"] != form:
                raise ValueError(f"format {self.content['format']!r}")

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Turn errors of a block that reads the metadata into an `InputError` that names the file."""
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RecursionError) as error:
            raise InputError(
                f"{self._path}: is no network for {self._core} ({type(error).__name__}: {error!s:.80}); "
                f"its metadata must hold {METADATA!r} of the form {self._form!r}"
            ) from None

    def run(self, inputs: Mapping[str, AnyArray], shapes: Mapping[str, tuple[int | None, ...]]) -> list[AnyArray]:
        """Return outputs of the network by name.

        `inputs`: arrays of float32 by name; `shapes`: names of the wanted outputs with their shapes; None stands for
        any number.
        """
        try:
            made = [np.asarray(each) for each in self._session.run(list(shapes), dict(inputs))]
            for (name, shape), array in zip(shapes.items(), made, strict=True):
                if len(shape) != array.ndim or any(n not in (None, m) for n, m in zip(shape, array.shape, strict=True)):
                    raise ValueError(f"{name} has the shape {array.shape}; must be {_told(shape)}")
                if array.dtype.kind != "f":
                    raise ValueError(f"{name} holds {array.dtype}; must be floating-point numbers")
                if not np.isfinite(array).all():
                    raise ValueError(f"{name} holds values that are not finite")
        except Exception as error:  # of ONNX Runtime, as above
            reason = " ".join(str(error).split())
            raise InputError(f"{self._path}: cannot be run ({reason!s:.120})") from None
        return made


def _told(shape: tuple[int | None, ...]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def _bytes(path: Path) -> bytes:
    """Return a file's content; raise `InputError` if it cannot be read or is too large."""
    try:
        size = require_plain(path).stat().st_size
        if size > LARGEST_MODEL_BYTES:
            raise InputError(f"{path}: has {size} bytes; may have {LARGEST_MODEL_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


STEP = 1e-5  # step of the differences of the normal, rad


def turned_normals(rays: Array, rotation: Array, root: Array) -> tuple[Array, Array]:
    """Return normals and their covariances, to first order.

    `rays`, (N, 3): unit sightlines; `rotation`, (N, 2): from the direction to the camera to the normal, rad in
    `simtest.estimators.learned.image_basis`; `root`, (N, 2, 2): factor L of the rotation's covariance L L^T, rad.
    Returns `normals`, (N, 3): unit, camera frame; `covariances`, (N, 2, 2): rad^2 in
    `simtest.geometry.vectors.tangent_basis` of the normals.
    """
    normals = normal_of(rays, rotation)
    basis = np.stack(tangent_basis(normals), axis=1)
    steps = [(normal_of(rays, rotation + step) - normals) / STEP for step in STEP * np.eye(2)]
    jacobian = basis @ np.stack(steps, axis=2)
    whole = jacobian @ root
    return normals, np.asarray(whole @ whole.transpose(0, 2, 1))


def stated_normals(rays: Array, outputs: Array, unit: float, factors: Array | float) -> tuple[Array, Array]:
    """Return the normals that a network states, and their covariances times factors (`turned_normals`).

    The first five columns of `outputs`, (N, 5 or more), are a rotation, and the Cholesky factor of its covariance with
    the logarithm of its diagonal, both in units of `unit`, rad.
    """
    first, second = (np.exp(np.clip(outputs[:, column], *LOG_RANGE)) for column in (2, 4))
    root = np.zeros((len(outputs), 2, 2))
    root[:, 0, 0], root[:, 1, 0], root[:, 1, 1] = first, outputs[:, 3], second
    root *= unit * np.sqrt(factors)[:, None, None]
    return turned_normals(rays, outputs[:, :2] * unit, root)


RELIEF_RAD = fitted_number("reflection.relief")


def reflection_distances(
    normals: Array, covariances: Array, rays: Array, distance_mm: Array, share: Array, lights_mm: Array
) -> Array:
    """Return how far normals at highlights lie from the bisectors of light and camera, shape (N,).

    A highlight's fine normal bisects the directions to its light and to the camera; the base's lies within the relief's
    slopes of it. The result is the squared Mahalanobis distance between the base's normal and the bisector, of the
    nearest light each: 2 on average where they differ as much as they may.

    `normals`, (N, 3): unit normals of the base; `covariances`, (N, 2, 2): in `simtest.geometry.vectors.tangent_basis`
    of them, rad^2; `rays`, (N, 3): unit sightlines; `distance_mm`, `share`, (N,): distances along them, and deviations
    of their logarithms; `lights_mm`, (L, 3): positions, camera frame.
    """
    basis = np.stack(tangent_basis(normals), axis=1)
    nearest = np.full(len(normals), np.inf)
    for light in lights_mm:
        near, middle, far = (bisect((distance_mm * np.exp(k * share))[:, None] * rays, light) for k in (-1, 0, 1))
        off = _across(basis, normals, middle)
        of_distance = np.einsum("nij,nj->ni", basis, far - near) / 2
        whole = covariances + RELIEF_RAD**2 * np.eye(2) + of_distance[:, :, None] * of_distance[:, None]
        squared = np.einsum("ni,ni->n", off, np.linalg.solve(whole, off[..., None])[..., 0])
        nearest = np.minimum(nearest, squared)
    return nearest


def _across(basis: Array, normals: Array, others: Array) -> Array:
    """Return the rotations from normals to other directions in their tangent bases, rad, shape (N, 2)."""
    across = np.einsum("nij,nj->ni", basis, others)
    sine = np.linalg.norm(across, axis=1)
    angle = np.arctan2(sine, np.sum(normals * others, axis=1))
    return np.asarray(across * (angle / np.maximum(sine, 1e-12))[:, None])


def log_deviation(outputs: Array) -> Array:
    """Return the mean logarithm of the two stated deviations of a rotation, columns 2 and 4 of outputs (..., 7)."""
    return np.asarray(np.clip(outputs[..., [2, 4]], *LOG_RANGE).mean(axis=-1))


class TaughtNetwork:
    """A network in ONNX Runtime, with the range that it was taught and the scales of what it states."""

    form: ClassVar[str]  # of its file
    core: ClassVar[str]  # that needs it
    inputs: ClassVar[tuple[str, ...]]  # whose range is known
    scaled: ClassVar[Mapping[str, tuple[str, ...]]]  # names of the scales of each kind

    def __init__(self, path: Path) -> None:
        self._model = OnnxModel(path, self.form, self.core)
        with self._model.reading():
            content = self._model.content
            scales = {
                kind: {name: CovarianceScale.read(content[kind][name]) for name in names}
                for kind, names in self.scaled.items()
            }
            self.scales, self.ratio_scales = scales["scales"], scales.get("ratio_scales", {})
            self._range = TrainingRange.read(content, self.inputs)
            self._usual = float(content["feature_usual"])  # squared distance of usual features (`inflation`)
            if not 0 < self._usual < np.inf:
                raise ValueError(f"feature_usual = {self._usual}: must be above 0")


@dataclass(frozen=True)
class LearnedNormals(ABC):
    """What networks that state normals share: they answer for each detection, and need the lights told."""

    model: str | Path | None = None  # the file; the shipped one by default
    shipped: ClassVar[str]  # name of the file beside which its card lies
    network: ClassVar[type[TaughtNetwork]]

    def check(self) -> None:
        """Load the network; raise `InputError` where it cannot be used."""
        _ = self._network

    def with_model(self, model: Path) -> Self:
        """Return the estimator with another network, loaded; raise `InputError` where it cannot be used."""
        made = replace(self, model=model)
        made.check()
        return made

    @cached_property
    def _network(self) -> Any:
        return self.network(Path(self.model or data_root("scenes").joinpath(*WEIGHTS, self.shipped)))

    def estimate_regions(
        self, frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return an estimate or a failure for each patch (see `simtest.estimators.protocol.RegionEstimator`)."""
        peaks = np.array([patch.peak_px for patch in patches if not isinstance(patch, Failure)], dtype=float)
        found: Sequence[Estimate | Failure] | Failure = []
        if not frame.calibration.priors.lights_mm:
            found = Failure(Reason.NOT_KNOWN, "needs the lights' positions")
        elif len(peaks):
            found = self._at(frame, peaks)
        made = iter([found] * len(peaks) if isinstance(found, Failure) else found)
        return [patch if isinstance(patch, Failure) else next(made) for patch in patches], []

    @abstractmethod
    def _at(self, frame: Frame, peaks: Array) -> Sequence[Estimate | Failure] | Failure:
        """Return an estimate or a failure for each peak of a frame whose lights are told, or why there is none."""
