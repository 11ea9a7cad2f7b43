"""Frames of a dataset as examples of the task `dense_normals`: planes, and the base's true normals and distances."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from simtest.calibration import Frame
from simtest.dataset.fields import INSTRUMENT
from simtest.dataset.learn.spots import sample_frame
from simtest.dataset.reader import read_samples, sample_positions
from simtest.dataset.sample import Sample
from simtest.estimators.dense_inputs import CAMERA, CELLS, GRID, PLANES, camera_values, dense_inputs, output_centres
from simtest.estimators.spot_inputs import rotation_of
from simtest.geometry import Camera
from simtest.runtime.arrays import AnyArray, Array
from simtest.validation.runner import Progress

FIELDS_READ = ("image", "depth", "normal_base", INSTRUMENT)


@dataclass(frozen=True)
class DenseFrames:
    """N frames; NaN where a truth is not known.

    Parameters
    ----------
    planes : ndarray of float32, shape (N, 10, 96, 128)
        Inputs (`simtest.estimators.dense_inputs`).
    rotation : ndarray of float32, shape (N, 2, 48, 64)
        From the direction to the camera to the base's normal at the cell's centre, rad.
    distance : ndarray of float32, shape (N, 48, 64)
        Along the ray there, mm.
    camera : ndarray of float32, shape (N, 8)
        Lens and lights (`simtest.estimators.dense_inputs.camera_values`).
    index, family, anatomy : ndarray of int64, shape (N,)
        Sample, and family and number of its anatomy.
    """

    planes: AnyArray
    rotation: AnyArray
    distance: AnyArray
    camera: AnyArray
    index: AnyArray
    family: AnyArray
    anatomy: AnyArray

    def __len__(self) -> int:
        return len(self.planes)

    def chosen(self, which: AnyArray) -> "DenseFrames":
        """Return some of the frames."""
        return DenseFrames(*(getattr(self, field.name)[which] for field in fields(self)))


def read_dense_frames(folder: str | Path, split: str, progress: Progress | None = None) -> DenseFrames:
    """Read the frames of a split; raise errors as `simtest.dataset.read`."""
    total = len(sample_positions(folder, split))
    made = DenseFrames(
        np.zeros((total, len(PLANES), *GRID), dtype=np.float32), np.zeros((total, 2, *CELLS), dtype=np.float32),
        np.zeros((total, *CELLS), dtype=np.float32), np.zeros((total, len(CAMERA)), dtype=np.float32),
        *(np.zeros(total, dtype=np.int64) for _ in range(3)),
    )  # fmt: skip
    for number, sample in enumerate(read_samples(folder, split, FIELDS_READ)):
        frame, anatomy = sample_frame(sample), sample.meta["anatomy"]
        made.planes[number] = dense_inputs(frame)
        made.rotation[number], made.distance[number] = cell_truth(sample, frame)
        made.camera[number] = camera_values(frame)
        made.index[number], made.family[number] = sample.index, anatomy["family"]
        made.anatomy[number] = anatomy["number"]
        if progress:
            progress(number + 1, total + 1, f"{split} split: frames read")
    return made


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
