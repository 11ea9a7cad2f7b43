"""What the shipped networks learn from, read from a dataset: highlights, and whole frames. Needs no PyTorch."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.sample_calibration import calibration_of
from simtest.dataset.shard import Sample
from simtest.detection.detector import load_detector, run_detector
from simtest.errors import Failure, InputError
from simtest.estimators.learned import rotation_of
from simtest.estimators.learned_dense import camera_values, dense_inputs, output_centres
from simtest.estimators.learned_spot import spot_inputs
from simtest.geometry import Camera
from simtest.runtime.arrays import AnyArray, Array, Image
from simtest.validation.runner import Progress

Examples = dict[str, AnyArray]
"""Arrays by name; the first axis numbers the examples."""

MOST_OF_A_FRAME = 64
"""Highlights of a frame, drawn where it shows more: so that a few frames do not outweigh all others."""

NEAR_PX = 1.5
"""A detection is a visible highlight whose peak is at most so far from its own."""

SMOOTHING_PX = 1.0

SPOT_FIELDS = ("image", "depth", "normal_base", "curvature_base", INSTRUMENT)

DENSE_FIELDS = ("image", "depth", "normal_base", INSTRUMENT)


def read_spots(folder: Path, split: str, most: int = MOST_OF_A_FRAME, progress: Progress | None = None) -> Examples:
    """Read the highlights of a split, as detected by colour.

    They are crops and extras (`simtest.estimators.learned_spot`), rays, peaks_px; base and fine, the rotation from the
    direction to the camera to the true normal, rad: of the base at the peak's pixel, of the fine surface at the only
    glint of the visible highlight that the detection shows; base_ratio and fine_ratio, abs(1 + d k) of the smaller over
    that of the larger; index, family and anatomy of the sample. NaN where a truth is not known. Raises errors as
    `simtest.dataset.read`, and `InputError` where there is no highlight.
    """
    rows, total = [], len(sample_positions(folder, split))
    for number, sample in enumerate(read_samples(folder, split, SPOT_FIELDS)):
        rows.append(_spots(sample, most))
        if progress:
            progress(number + 1, total + 1, f"{split} split: frames read")
    return _joined(rows, folder, split)


def sample_frame(sample: Sample) -> Frame:
    """Return a sample's picture as the estimators see it."""
    picture: Image = sample.images["image"].astype(np.float32) / np.float32(255)
    return Frame(picture, calibration_of(sample.meta), SMOOTHING_PX)


def _spots(sample: Sample, most: int) -> Examples:
    """Return the highlights of a sample."""
    frame = sample_frame(sample)
    found = run_detector(load_detector("colour"), frame)
    patches = [found.frame.patch(region.box, region.peak) for region in found.regions]
    peaks = np.array([p.peak_px for p in patches if not isinstance(p, Failure)], dtype=float).reshape(-1, 2)
    # Drawn by the sample's key alone, so that the same dataset gives the same examples.
    order = np.random.default_rng(zlib.crc32(sample.key.encode())).permutation(len(peaks))
    peaks = peaks[np.sort(order[:most])]
    rows, columns = peaks[:, 1].astype(int), peaks[:, 0].astype(int)
    depth, instrument = sample.images["depth"], sample.images[INSTRUMENT]
    inside = (rows >= 0) & (rows < depth.shape[0]) & (columns >= 0) & (columns < depth.shape[1])
    peaks, rows, columns = peaks[inside], rows[inside], columns[inside]
    known = np.isfinite(depth[rows, columns]) & (instrument[rows, columns] == 0)
    known &= np.isfinite(sample.images["curvature_base"][rows, columns]).all(axis=1)
    peaks, rows, columns = peaks[known], rows[known], columns[known]
    crops, extras = spot_inputs(frame, peaks)
    rays = frame.camera.unproject(peaks)
    gains = np.abs(1 + depth[rows, columns, None] * sample.images["curvature_base"][rows, columns])
    fine, fine_ratio = _fine(sample, peaks, rays)
    anatomy = sample.meta["anatomy"]
    constants = {"index": sample.index, "family": anatomy["family"], "anatomy": anatomy["number"]}
    return {
        "crops": crops, "extras": extras, "rays": rays, "peaks_px": peaks, "fine": fine, "fine_ratio": fine_ratio,
        "base": rotation_of(rays, sample.images["normal_base"][rows, columns].astype(float)).astype(np.float32),
        "base_ratio": (gains.min(axis=1) / gains.max(axis=1)).astype(np.float32),
        **{name: np.full(len(peaks), value, dtype=np.int64) for name, value in constants.items()},
    }  # fmt: skip


def _fine(sample: Sample, peaks: Array, rays: Array) -> tuple[AnyArray, AnyArray]:
    """Return rotation and axis ratio of the fine surface at the detections that show one glint alone."""
    rotation = np.full((len(peaks), 2), np.nan, dtype=np.float32)
    ratio = np.full(len(peaks), np.nan, dtype=np.float32)
    for number, glint in only_glints(sample, peaks):
        truth = sample.meta["highlights"][glint]
        gains = sorted((abs(1 + truth["kd_min"]), abs(1 + truth["kd_max"])))
        rotation[number] = rotation_of(rays[number : number + 1], np.array([truth["normal"]]))[0]
        ratio[number] = gains[0] / gains[1] if gains[1] > 0 else np.nan
    return rotation, ratio


def only_glints(sample: Sample, peaks: Array) -> Iterator[tuple[int, int]]:
    """Yield the detections that show a visible highlight of one glint, with the glint's number."""
    visible = sample.meta.get("visible_highlights", [])
    positions = np.array([spot["peak_px"] for spot in visible], dtype=float).reshape(-1, 2)
    for number, peak in enumerate(peaks):
        gaps = np.hypot(*(positions - peak).T)
        if len(gaps) and gaps.min() <= NEAR_PX:
            glints = visible[int(gaps.argmin())]["glints"]
            if isinstance(glints, list) and len(glints) == 1:
                yield number, int(str(glints[0]))


def read_dense_frames(folder: Path, split: str, progress: Progress | None = None) -> Examples:
    """Read the frames of a split.

    They are planes (`simtest.estimators.learned_dense`); rotation, from the direction to the camera to the base's
    normal at each cell's centre, rad; distance along the ray there, mm; camera, lens and lights. NaN where a truth
    is not known. Raises errors as `simtest.dataset.read`, and `InputError` where there is no frame.
    """
    rows, total = [], len(sample_positions(folder, split))
    for number, sample in enumerate(read_samples(folder, split, DENSE_FIELDS)):
        frame = sample_frame(sample)
        rotation, distance = cell_truth(sample, frame)
        parts = {"planes": dense_inputs(frame), "rotation": rotation, "distance": distance}
        parts["camera"] = camera_values(frame)
        rows.append({name: np.asarray(values, dtype=np.float32)[None] for name, values in parts.items()})
        if progress:
            progress(number + 1, total + 1, f"{split} split: frames read")
    return _joined(rows, folder, split)


def cell_truth(sample: Sample, frame: Frame) -> tuple[Array, Array]:
    """Return rotations, shape (2, 48, 64), and distances of the base at the outputs' centres; NaN off the tissue."""
    return truth_at(sample, frame.camera, output_centres(frame.camera))


def truth_at(sample: Sample, camera: Camera, points_px: Array) -> tuple[Array, Array]:
    """Return rotations, shape (2, ...), and distances, mm, of the base in the pixels of points, shape (..., 2).

    NaN where the point is off the frame or out of view, and where its pixel shows an instrument or no surface.
    """
    height, width = sample.images["depth"].shape
    columns, rows = (np.floor(points_px[..., k]).astype(int) for k in (0, 1))
    known = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    rows, columns = np.where(known, rows, 0), np.where(known, columns, 0)
    normal = sample.images["normal_base"][rows, columns].astype(float)
    distance = sample.images["depth"][rows, columns].astype(float)
    known &= np.isfinite(distance) & np.isfinite(normal).all(axis=-1) & (sample.images[INSTRUMENT][rows, columns] == 0)
    if camera.seen is not None:
        known &= camera.seen[rows, columns]
    rotation = np.full((*known.shape, 2), np.nan)
    rays = camera.unproject(np.stack([columns, rows], axis=-1)[known] + 0.5)
    rotation[known] = rotation_of(rays, normal[known])
    return np.moveaxis(rotation, -1, 0), np.where(known, distance, np.nan)


def _joined(rows: list[Examples], folder: Path, split: str) -> Examples:
    """Return the examples of frames as one; raise `InputError` where there are none."""
    if not any(len(next(iter(row.values()))) for row in rows):
        raise InputError(f"{folder}: split {split} holds no example")
    return {name: np.concatenate([row[name] for row in rows]) for name in rows[0]}
