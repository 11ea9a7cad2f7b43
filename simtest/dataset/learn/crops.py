"""Crops of matched highlights with true normals and axis ratios, and with the errors of the classical estimators.

A crop is resampled to twice the detection's box, so that a network sees the shape whatever its size; size, sightline
and light position are extra inputs. The target is the rotation from the direction to the camera to the normal, two
numbers, since at a highlight the two directions are nearly the same.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from simtest.calibration import srgb_decode
from simtest.dataset.metadata import EstimateMeta
from simtest.dataset.reader import read_samples
from simtest.dataset.sample import Sample
from simtest.geometry.vectors import tangent_basis, tangent_coordinates
from simtest.runtime.arrays import AnyArray, Array, Image, IntArray
from simtest.spec.camera import SceneCamera
from simtest.spec.sensor import Sensor

SIDE = 32
"""Side of a crop, px."""

EXTRAS = ("log of the crop's angle", "light, first", "light, second", "light, towards", "sightline x", "sightline y")
"""Light position in mm: in the tangent basis of the direction to the camera, and along that direction."""


@dataclass(frozen=True)
class Crops:
    """N crops with their inputs and targets.

    Parameters
    ----------
    images : ndarray of float32, shape (N, 32, 32)
        Linear intensity over the crop's largest.
    extras : ndarray of float32, shape (N, 6)
        See `EXTRAS`; camera frame.
    towards : ndarray, shape (N, 3)
        Unit direction from the peak's sightline back to the camera.
    rotation : ndarray of float32, shape (N, 2)
        True normal as a vector of the tangent basis of `towards`, rad.
    normal : ndarray, shape (N, 3)
        True unit normal of the fine surface, camera frame.
    axis_ratio : ndarray of float32, shape (N,)
        abs(1 + d k) of the smaller over that of the larger, at the true BP.
    index : ndarray of int64, shape (N,)
        Sample.
    classical : dict
        By estimator: error_deg and axis_ratio, shape (N,) each; NaN if it failed.
    """

    images: Image
    extras: Image
    towards: Array
    rotation: Image
    normal: Array
    axis_ratio: Image
    index: IntArray
    classical: dict[str, tuple[Array, Array]]

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class _Crop:
    """One of `Crops`."""

    image: AnyArray
    extras: AnyArray
    towards: Array
    rotation: Array
    normal: Array
    axis_ratio: float
    index: int
    classical: dict[str, tuple[float, float]]


def read_crops(folder: str | Path, split: str) -> Crops:
    """Read the matched highlights of a split: train, validation or test; raise errors as `simtest.dataset.read`."""
    crops = [crop for sample in read_samples(folder, split, ["image"]) for crop in _crops(sample)]
    nothing = (float("nan"), float("nan"))
    classical = {}
    for name in sorted({name for crop in crops for name in crop.classical}):
        pairs = np.array([crop.classical.get(name, nothing) for crop in crops], dtype=float)
        classical[name] = (pairs[:, 0], pairs[:, 1])
    # Shapes are stated, since a split may hold no highlight at all.
    return Crops(
        np.array([crop.image for crop in crops], dtype=np.float32).reshape(-1, SIDE, SIDE),
        np.array([crop.extras for crop in crops], dtype=np.float32).reshape(-1, len(EXTRAS)),
        np.array([crop.towards for crop in crops], dtype=float).reshape(-1, 3),
        np.array([crop.rotation for crop in crops], dtype=np.float32).reshape(-1, 2),
        np.array([crop.normal for crop in crops], dtype=float).reshape(-1, 3),
        np.array([crop.axis_ratio for crop in crops], dtype=np.float32),
        np.array([crop.index for crop in crops], dtype=np.int64),
        classical,
    )


def _crops(sample: Sample) -> Iterator[_Crop]:
    """Yield the crops of a sample: one for each detection that matches a true highlight."""
    meta = sample.meta
    camera = SceneCamera.model_validate(meta["scene"]["camera"]).model()
    sensor = Sensor.model_validate(meta["scene"]["sensor"])
    # As simtest.dataset.maker writes it: what the sensor itself encoded, or else sRGB.
    decode = sensor.response.model().decode if sensor.encodes else srgb_decode
    linear = decode(sample.images["image"].astype(np.float32) / 255).mean(axis=2, dtype=np.float32)
    by_detection: dict[int, list[EstimateMeta]] = {}
    for row in meta["estimates"]:
        if "specularity" in row and "true_id" in row:
            by_detection.setdefault(int(row["specularity"]), []).append(row)
    for number, rows in by_detection.items():
        detection = meta["detections"][number]
        peak = detection["peak_px"]
        if peak is None:
            continue
        truth = meta["highlights"][int(rows[0]["true_id"])]
        ray, normal = camera.unproject(peak), np.array(truth["normal"])
        crop, step = _resample(linear, detection["box_px"], peak)
        # inputs: the crop, its angle, the light and the sightline
        first, second = (basis[0] for basis in tangent_basis(-ray[None]))
        light = np.array(meta["lights_mm"][0])
        angle = SIDE * step / camera.fx
        extras = [np.log(angle), first @ light, second @ light, -ray @ light, ray[0], ray[1]]
        # targets: rotation from the direction to the camera to the normal, and axis ratio
        gains = sorted((abs(1 + truth["kd_min"]), abs(1 + truth["kd_max"])))
        yield _Crop(
            crop, np.array(extras), -ray, tangent_coordinates(-ray, normal), normal, gains[0] / gains[1],
            meta["index"], {str(row["estimator"]): _errors(row) for row in rows},
        )  # fmt: skip


def _resample(linear: AnyArray, box: list[int], peak: list[float]) -> tuple[AnyArray, float]:
    """Return a crop around a peak over its largest value, and its step, px."""
    (x, y), (_, _, width, height) = peak, box
    step = max(width, height) / SIDE
    corner = -(SIDE - 1) / 2 * step
    # warpAffine has the centre of pixel (0, 0) at the origin.
    image_from_crop = np.array([[step, 0, x - 0.5 + corner], [0, step, y - 0.5 + corner]])
    crop = cv2.warpAffine(
        linear, image_from_crop, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return crop / max(float(crop.max()), 1e-6), step


def _errors(row: EstimateMeta) -> tuple[float, float]:
    return float(row.get("error_deg", "nan")), float(row.get("axis_ratio", "nan"))
