"""Highlights of a dataset's frames as examples: what a network sees of each, and the truth of both surfaces there."""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.sample import Sample
from simtest.dataset.sample_calibration import calibration_of
from simtest.detection.detector import load_detector, run_detector
from simtest.errors import Failure
from simtest.estimators.spot_inputs import rays_of, rotation_of, spot_inputs
from simtest.runtime.arrays import AnyArray, Array, Image
from simtest.validation.runner import Progress

MOST_OF_A_FRAME = 64
"""Highlights of a frame, drawn where it shows more: so that a few frames do not outweigh all others."""

NEAR_PX = 1.5
"""A detection is a visible highlight whose peak is at most so far from its own."""

SMOOTHING_PX = 1.0

FIELDS_READ = ("image", "depth", "normal_base", "curvature_base", INSTRUMENT)


@dataclass(frozen=True)
class Spots:
    """N highlights; NaN where a truth is not known.

    Parameters
    ----------
    crops, extras : ndarray of float32, shapes (N, 3, 32, 32) and (N, 11)
        Inputs (`simtest.estimators.spot_inputs`).
    rays : ndarray, shape (N, 3)
        Sightlines of the peaks.
    base, fine : ndarray of float32, shape (N, 2)
        Rotation from the direction to the camera to the true normal, rad: of the base at the peak's pixel; of the fine
        surface at the only glint of the visible highlight that the detection shows.
    base_ratio, fine_ratio : ndarray of float32, shape (N,)
        abs(1 + d k) of the smaller over that of the larger.
    peaks_px : ndarray, shape (N, 2)
        Peaks.
    index, family, anatomy : ndarray of int64, shape (N,)
        Sample, and family and number of its anatomy.
    """

    crops: AnyArray
    extras: AnyArray
    rays: Array
    base: AnyArray
    fine: AnyArray
    base_ratio: AnyArray
    fine_ratio: AnyArray
    peaks_px: Array
    index: AnyArray
    family: AnyArray
    anatomy: AnyArray

    def __len__(self) -> int:
        return len(self.crops)

    def chosen(self, which: AnyArray) -> "Spots":
        """Return some of the highlights."""
        return Spots(*(getattr(self, field.name)[which] for field in fields(self)))


def read_spots(folder: str | Path, split: str, most: int = MOST_OF_A_FRAME, progress: Progress | None = None) -> Spots:
    """Read the highlights of a split, as detected by colour; raise errors as `simtest.dataset.read`."""
    parts: list[Spots] = []
    total = len(sample_positions(folder, split))
    for number, sample in enumerate(read_samples(folder, split, FIELDS_READ)):
        parts.append(_spots(sample, most))
        if progress:
            progress(number + 1, total + 1, f"{split} split: frames read")
    if not parts:
        return Spots(*(np.empty(shape) for shape in _SHAPES))
    return Spots(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Spots)))


_SHAPES = ((0, 3, 32, 32), (0, 11), (0, 3), (0, 2), (0, 2), (0,), (0,), (0, 2), (0,), (0,), (0,))


def sample_frame(sample: Sample) -> Frame:
    """Return a sample's picture as the estimators see it."""
    picture: Image = sample.images["image"].astype(np.float32) / np.float32(255)
    return Frame(picture, calibration_of(sample.meta), SMOOTHING_PX)


def _spots(sample: Sample, most: int) -> Spots:
    """Return the highlights of a sample."""
    frame = sample_frame(sample)
    found = run_detector(load_detector("colour"), frame)
    patches = [found.frame.patch(region.box, region.peak) for region in found.regions]
    peaks = np.array([p.peak_px for p in patches if not isinstance(p, Failure)], dtype=float).reshape(-1, 2)
    # Drawn by the sample's key alone, so that the same dataset gives the same examples.
    order = np.random.default_rng(zlib.crc32(sample.key.encode())).permutation(len(peaks))
    peaks = peaks[np.sort(order[:most])]
    rows, columns = peaks[:, 1].astype(int), peaks[:, 0].astype(int)
    height, width = sample.images["depth"].shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    peaks, rows, columns = peaks[inside], rows[inside], columns[inside]
    known = np.isfinite(sample.images["depth"][rows, columns]) & (sample.images[INSTRUMENT][rows, columns] == 0)
    known &= np.isfinite(sample.images["curvature_base"][rows, columns]).all(axis=1)
    peaks, rows, columns = peaks[known], rows[known], columns[known]
    crops, extras = spot_inputs(frame, peaks)
    rays = rays_of(frame.camera, peaks)
    normal = sample.images["normal_base"][rows, columns].astype(float)
    gains = np.abs(1 + sample.images["depth"][rows, columns, None] * sample.images["curvature_base"][rows, columns])
    fine, fine_ratio = _fine(sample, peaks, rays)
    anatomy = sample.meta["anatomy"]
    constants = (sample.index, anatomy["family"], anatomy["number"])
    return Spots(
        crops, extras, rays, rotation_of(rays, normal).astype(np.float32), fine,
        (gains.min(axis=1) / gains.max(axis=1)).astype(np.float32), fine_ratio, peaks,
        *(np.full(len(peaks), value, dtype=np.int64) for value in constants),
    )  # fmt: skip


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
