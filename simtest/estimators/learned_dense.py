"""`learned_dense`: a trained network's normals and distances all over a frame, run by ONNX Runtime, without PyTorch.

It sees planes on a coarse grid, of light, colour, sightlines and lights. The frame lies in the middle of a grid of 4:3,
whole; a frame of another aspect leaves cells empty, as a view mask does. Directions are in the tangent basis of the
direction to the camera that is aligned with the frame (`simtest.estimators.learned.image_basis`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np

from simtest.calibration import Calibration, Frame
from simtest.errors import Failure, Reason
from simtest.estimators.learned import (
    LIGHT_SCALE_MM,
    LOG_RANGE,
    LearnedNormals,
    TaughtNetwork,
    image_basis,
    inflation,
    log_deviation,
    median_of_lit,
    reflection_distances,
    stated_normals,
)
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array, Camera, Mask
from simtest.runtime.arrays import Image

GRID = (96, 128)  # rows and columns of the planes
STRIDE = 2  # cells of the planes, along each axis, for one cell of the outputs
CELLS = (GRID[0] // STRIDE, GRID[1] // STRIDE)  # rows and columns of the outputs
DARKEST = 0.02  # share of the lit pixels' median light that is added before the logarithm
LEAST_LIT = 0.1  # cells with less light than this share of the view's median have no colour of their own
LEAST_SEEN = 0.02  # a cell of which a smaller share is seen is empty

PLANES = (
    "logarithm of the light over its median", "logarithm of the mean light over that mean",
    "logarithm of red over green", "logarithm of blue over green", "share seen",
    "sightline, x", "sightline, y", "mean light, first", "mean light, second", "mean light, towards",
)  # fmt: skip
"""Planes of light and colour are 0 where nothing is seen."""

CAMERA = (
    "log of the focal length along x over the grid", "log of the focal length along y over the grid",
    "principal point off the middle, x", "principal point off the middle, y",
    "mean light, x", "mean light, y", "mean light, z", "lights' spread",
)  # fmt: skip
"""What a network answers for a limited range of; lights in units of `LIGHT_SCALE_MM`."""

VIEWED = PLANES[:5]  # the planes that change from frame to frame of one camera

# What a network returns

OUTPUTS = ("rotation, first", "rotation, second", "logarithm of L11", "L21", "logarithm of L22",
           "logarithm of the distance", "logarithm of that one's deviation")  # fmt: skip
"""In each cell. L is the Cholesky factor of the rotation's covariance, in units of `ROTATION_SCALE`."""

ROTATION_SCALE = 0.5  # rotation, rad, for an output of 1

DISTANCE_MM, DISTANCE_SCALE = 30.0, 0.5
"""A distance of `DISTANCE_MM` along the ray is an output of 0; an output of 1 is a logarithm of `DISTANCE_SCALE`."""


@dataclass(frozen=True)
class Layout:
    """Where a frame lies on the grid."""

    # columns, rows: of the grid that the frame covers.
    columns: int
    rows: int
    # left, top: cells before it.
    left: int
    top: int

    @classmethod
    def of(cls, width: int, height: int) -> "Layout":
        """Return the layout of a frame of a size, px."""
        share = min(GRID[1] / width, GRID[0] / height)
        columns, rows = max(1, round(width * share)), max(1, round(height * share))
        return cls(columns, rows, (GRID[1] - columns) // 2, (GRID[0] - rows) // 2)

    def to_pixels(self, cells: Array, camera: Camera) -> Array:
        """Return the positions, px, of points of the grid, shape (..., 2): x, y, in cells of the planes."""
        offset, count = np.array([self.left, self.top]), np.array([self.columns, self.rows])
        return np.asarray((cells - offset) * [camera.width, camera.height] / count)

    def to_cells(self, points_px: Array, camera: Camera) -> Array:
        """Return the points of the grid at pixel positions, shape (..., 2): the inverse of `to_pixels`."""
        offset, count = np.array([self.left, self.top]), np.array([self.columns, self.rows])
        return np.asarray(points_px * count / [camera.width, camera.height] + offset)


def output_centres(camera: Camera) -> Array:
    """Return the pixel positions of the outputs' centres, shape (rows, columns, 2); some may lie off the frame."""
    x, y = (STRIDE * (np.arange(count) + 0.5) for count in reversed(CELLS))
    return Layout.of(camera.width, camera.height).to_pixels(np.stack(np.meshgrid(x, y), axis=-1), camera)


def camera_values(frame: Frame) -> Array:
    """Return what a network's range is checked by, in the order of `CAMERA`; the lights must be told."""
    camera, lights = frame.camera, frame.calibration.priors.lights / LIGHT_SCALE_MM
    layout = Layout.of(camera.width, camera.height)
    share = np.array([layout.columns / camera.width, layout.rows / camera.height])
    focal = np.log(share * [camera.fx, camera.fy] / GRID[1])
    off_centre = np.array([camera.cx / camera.width, camera.cy / camera.height]) - 0.5
    spread = np.sqrt(((lights - lights.mean(axis=0)) ** 2).sum(axis=1).mean())
    return np.array([*focal, *off_centre, *lights.mean(axis=0), spread])


def dense_inputs(frame: Frame) -> Image:
    """Return the planes of a frame, whose lights must be told and whose lens has no distortion, shape (10, 96, 128)."""
    camera = frame.camera
    layout = Layout.of(camera.width, camera.height)
    where = (slice(layout.top, layout.top + layout.rows), slice(layout.left, layout.left + layout.columns))
    planes = np.zeros((len(PLANES), *GRID), dtype=np.float32)
    planes[(slice(0, len(VIEWED)), *where)] = _viewed(frame, (layout.columns, layout.rows))
    x, y = (np.arange(count) + 0.5 for count in reversed(GRID))
    rays = camera.unproject(layout.to_pixels(np.stack(np.meshgrid(x, y), axis=-1), camera)).reshape(-1, 3)
    mean = frame.calibration.priors.lights.mean(axis=0) / LIGHT_SCALE_MM
    of_camera = [rays[:, 0], rays[:, 1], *(image_basis(rays) @ mean).T, -rays @ mean]
    planes[len(VIEWED) :] = np.reshape(of_camera, (-1, *GRID))
    return planes


def _viewed(frame: Frame, size: tuple[int, int]) -> Image:
    """Return the planes of light and colour on a grid of columns and rows, shape (5, rows, columns)."""
    channels = frame.channels if frame.channels.ndim == 3 else np.repeat(frame.channels[..., None], 3, axis=2)
    gain = frame.corrected.gain
    light = channels.mean(axis=2, dtype=np.float32) * (1 if gain is None else gain)
    seen = np.ones(light.shape, dtype=bool) if frame.seen is None else frame.seen
    weight = seen.astype(np.float32)
    share = _averaged(weight, size)
    known = share > LEAST_SEEN
    whole = np.where(known, share, 1.0)

    def mean(values: Image) -> Image:
        return np.asarray(_averaged(values * weight, size) / whole, dtype=np.float32)

    median = median_of_lit(light[seen])
    light = light / np.float32(median)
    logarithm = mean(np.log(light + DARKEST, dtype=np.float32))
    whole_light = mean(light)
    spread = np.log(whole_light + DARKEST) - logarithm
    lit = known & (whole_light > LEAST_LIT)
    red, green, blue = (mean(channels[..., k]) / median + DARKEST for k in range(3))
    colours = [_centred(np.log(other / green), lit) for other in (red, blue)]
    return np.asarray(np.stack([logarithm, spread, *colours, share]) * known, dtype=np.float32)


def _averaged(values: Image, size: tuple[int, int]) -> Image:
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _centred(values: Image, lit: Mask) -> Image:
    """Return values less those of the lit cells' median: albedo and white balance are no part of the shape."""
    return np.asarray(values - np.median(values[lit])) if lit.any() else values


FORMAT = "simtest dense_normals, version 2"

ASPECTS = (1.0, 1.9)  # width over height: what the training's cut views cover
CELL_PX = (1.5, 20.0)  # pixels of a cell along x: resampling covers these

LEAST_HIGHLIGHTS, REFLECTION_LIMIT = 4, 2.0
"""From so many highlights a frame's normals are checked against the law of reflection, and refused beyond the limit.

`python -m studies.learned DATA --dense MODEL --split validation` prints how far the validation split's frames go.
"""

HIGHLIGHT_LIMIT = 9.21
"""Squared Mahalanobis distance from the law of reflection beyond which one highlight is refused: one in 100 goes so
far where both states hold."""


@dataclass(frozen=True)
class DenseMaps:
    """What a network states of each pixel of a frame, in float32; NaN out of view."""

    normal: Image  # (H, W, 3): unit normal of the base surface, camera frame
    covariance: Image  # (H, W, 2, 2): of it in the basis `simtest.geometry.vectors.tangent_basis(normal)`, rad^2
    distance_mm: Image  # (H, W): along the ray
    deviation_mm: Image  # (H, W): standard deviation of the distance, to first order


class DenseNetwork(TaughtNetwork):
    """A network of whole frames."""

    form, core, inputs = FORMAT, "learned_dense", CAMERA
    scaled: ClassVar = {"scales": ("base", "distance")}

    def run(self, frame: Frame) -> tuple[Array, float] | Failure:
        """Return the outputs of a frame, shape (7, 48, 64), and the covariances' factor, or why it is refused."""
        told = dict(zip(CAMERA, camera_values(frame).tolist(), strict=True))
        if refused := self._range.refusal(told):
            return refused
        shapes = {"outputs": (1, len(OUTPUTS), *CELLS), "features": (1, len(self._range.mean))}
        outputs, features = self._model.run({"planes": dense_inputs(frame)[None]}, shapes)
        distances = self._range.distances(features)
        (refused,) = self._range.refusals(features)
        return refused or (np.asarray(outputs[0], dtype=float), float(inflation(distances, self._usual)[0]))


@dataclass(frozen=True)
class LearnedDense(LearnedNormals):
    """A network that states normals all over a frame (`studies.networks.dense`) as an estimator.

    It sees the whole frame on a coarse grid, the sightlines and the lights. It states the base's normal and the
    distance everywhere (`maps`); as an estimator it answers for each detection. It refuses with ``no_estimate`` what
    lies outside the range that it was taught: another lens or other lights, a frame without colour, of an unusual
    aspect or too small, and frames whose features lie far from those of the train split. Short of that, what it states
    grows less certain with the features' distance (`simtest.estimators.learned.inflation`). At highlights it is
    checked against the law of reflection (`simtest.estimators.learned`): a frame, and a highlight alone, where
    its normals contradict that law is refused.

    Parameters
    ----------
    model : str or Path, optional
        The file model.onnx. Default: the shipped network.
    """

    shipped: ClassVar[str] = "learned_dense.onnx"
    network: ClassVar = DenseNetwork

    @property
    def description(self) -> str:
        """What the estimator is, in one line for a reader who chooses one."""
        network = str(self.model or self.shipped)
        return f"The normal of the base surface at each highlight, by the network {network} of the whole frame."

    def maps(
        self, values: Image, calibration: Calibration, highlights_px: Array | None = None, seen: Mask | None = None
    ) -> DenseMaps | Failure:
        """Compute the normals and distances of a frame, or say why there are none.

        Parameters
        ----------
        values : ndarray of float32, shape (H, W, 3)
            The frame as encoded, in [0, 1].
        calibration : Calibration
            Camera, lights, response and falloff; without a response the values count as linear light.
        highlights_px : ndarray, shape (N, 2), optional
            Peaks of detected highlights. Where they are four or more, the frame is checked against the law of
            reflection. `simtest.reconstruction.learned_maps.learned_maps` detects them.
        seen : ndarray of bool, shape (H, W), optional
            The pixels in view; default the camera's view mask.
        """
        frame = Frame(values, calibration, 0.0, seen)
        outputs = self._outputs(frame)
        if isinstance(outputs, Failure):
            return outputs
        camera = frame.camera
        if highlights_px is not None and len(highlights_px):
            squared = _contradictions(self._stated(*outputs, camera, highlights_px), frame, highlights_px)
            if refused := _contradicts(squared):
                return refused
        shape = (camera.height, camera.width)
        shown_px = np.ones(shape, dtype=bool) if frame.seen is None else frame.seen
        stated = self._stated(*outputs, camera, camera.pixel_centres()[shown_px])
        made = []
        for part in stated:
            whole = np.full((*shape, *part.shape[1:]), np.nan, dtype=np.float32)
            whole[shown_px] = part
            made.append(whole)
        return DenseMaps(*made)

    def stated(self, frame: Frame, points_px: Array) -> tuple[Array, Array, Array, Array] | Failure:
        """Return normals, covariances, distances, mm, and their deviations, mm, at pixel positions, shape (N, 2)."""
        outputs = self._outputs(frame)
        return outputs if isinstance(outputs, Failure) else self._stated(*outputs, frame.camera, points_px)

    def contradictions(self, frame: Frame, points_px: Array) -> Array | Failure:
        """Return how far the normals at highlights are from the law of reflection (`reflection_distances`)."""
        made = self.stated(frame, points_px)
        return made if isinstance(made, Failure) else _contradictions(made, frame, points_px)

    def _at(self, frame: Frame, peaks: Array) -> Sequence[Estimate | Failure] | Failure:
        outputs = self._outputs(frame)
        if isinstance(outputs, Failure):
            return outputs
        stated = self._stated(*outputs, frame.camera, peaks)
        squared = _contradictions(stated, frame, peaks)
        if refused := _contradicts(squared):
            return refused
        return [
            _refused_highlight(off)
            or Estimate(normal=normal, candidates=normal[None], look_px=point, covariance=covariance, target="base")
            for normal, covariance, point, off in zip(*stated[:2], peaks, squared.tolist(), strict=True)
        ]

    def _outputs(self, frame: Frame) -> tuple[Array, float] | Failure:
        """Return the network's outputs, shape (7, 48, 64), and the covariances' factor, or why the frame is refused."""
        if not frame.calibration.priors.lights_mm:
            return Failure(Reason.NOT_KNOWN, "needs the lights' positions")
        return _unfit(frame) or self._network.run(frame)

    def _stated(
        self, outputs: Array, inflated: float, camera: Camera, points_px: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Return normals, covariances, distances, mm, and their deviations, mm, at pixel positions, shape (N, 2)."""
        layout, scales = Layout.of(camera.width, camera.height), self._network.scales
        made = interpolated(outputs, layout.to_cells(points_px, camera) / STRIDE - 0.5).T
        factors = inflated * scales["base"].at(log_deviation(made))
        normals, covariances = stated_normals(camera.unproject(points_px), made, ROTATION_SCALE, factors)
        distance = DISTANCE_MM * np.exp(DISTANCE_SCALE * made[:, 5])
        logarithm = np.clip(made[:, 6], *LOG_RANGE)
        share = DISTANCE_SCALE * np.exp(logarithm) * np.sqrt(inflated * scales["distance"].at(logarithm))
        return normals, covariances, distance, share * distance


def _contradictions(stated: tuple[Array, Array, Array, Array], frame: Frame, points_px: Array) -> Array:
    """Return how far what is stated at highlights is from the law of reflection."""
    normals, covariances, distance, deviation = stated
    rays, lights = frame.camera.unproject(points_px), frame.calibration.priors.lights
    return reflection_distances(normals, covariances, rays, distance, deviation / distance, lights)


def _contradicts(squared: Array) -> Failure | None:
    """Return why a frame is refused by its highlights' distances from the law of reflection, or None."""
    off = float(np.mean(squared)) / 2
    if len(squared) < LEAST_HIGHLIGHTS or off <= REFLECTION_LIMIT:
        return None
    told = f"contradicts the law of reflection at {len(squared)} highlights: {off:.3g}, limit {REFLECTION_LIMIT:g}"
    return Failure(Reason.NO_ESTIMATE, told)


def _refused_highlight(squared: float) -> Failure | None:
    """Return why one highlight is refused by its distance from the law of reflection, or None."""
    if squared <= HIGHLIGHT_LIMIT:
        return None
    told = f"contradicts the law of reflection: squared distance {squared:.3g}, limit {HIGHLIGHT_LIMIT:g}"
    return Failure(Reason.NO_ESTIMATE, told)


def interpolated(outputs: Array, points: Array) -> Array:
    """Return planes, shape (C, rows, columns), between their cells' centres, which stand at integers, shape (C, N)."""
    last = np.array([outputs.shape[2] - 1, outputs.shape[1] - 1])
    points = np.clip(points, 0, last)
    corner = np.minimum(points.astype(int), last - 1)
    (x, y), (u, v) = corner.T, (points - corner).T
    above = outputs[:, y, x] * (1 - u) + outputs[:, y, x + 1] * u
    below = outputs[:, y + 1, x] * (1 - u) + outputs[:, y + 1, x + 1] * u
    return np.asarray(above * (1 - v) + below * v)


def _unfit(frame: Frame) -> Failure | None:
    """Return why no network of this kind can take a frame, or None."""
    camera, told = frame.camera, None
    aspect = camera.width / camera.height
    if camera.distortion is not None:
        told = "a lens with distortion"
    elif frame.encoded.ndim != 3:
        told = "a frame of one channel"
    elif not ASPECTS[0] <= aspect <= ASPECTS[1]:
        told = f"width over height is {aspect:.3g}, may be {ASPECTS[0]:g} to {ASPECTS[1]:g}"
    else:
        cell = camera.width / Layout.of(camera.width, camera.height).columns
        if not CELL_PX[0] <= cell <= CELL_PX[1]:
            told = f"a cell has {cell:.3g} px, may have {CELL_PX[0]:g} to {CELL_PX[1]:g}"
    return Failure(Reason.NO_ESTIMATE, f"outside the network's training: {told}") if told else None


learned_dense = LearnedDense()  # the shipped network; it is read at its first use
