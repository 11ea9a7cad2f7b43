"""Crops of matched highlights with their true normals and axis ratios, and what the classical estimators made of them.

A crop is resampled to twice the detection's box, so that a network sees the shape whatever the size; the size, the
sightline and the light's place go beside it. The normal is asked for as the rotation from the direction to the camera,
two numbers, since at a highlight the two are nearly the same.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import srgb_decode
from simtest.dataset.reader import Record, read
from simtest.geometry import Camera
from simtest.geometry.vectors import tangent_basis, tangent_coordinates
from simtest.spec.camera_spec import CameraSpec
from simtest.spec.sensor import Sensor

Array = npt.NDArray[Any]

SIDE = 32
"""Of a crop, px."""

EXTRAS = ("log of the crop's angle", "light, first", "light, second", "light, towards", "sightline x", "sightline y")
"""The light's place in mm, in the tangent basis of the direction to the camera and along that direction."""


@dataclass(frozen=True)
class Crops:
    """Crops and what is known of them, N in all.

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
        True unit normal, camera frame.
    axis_ratio : ndarray of float32, shape (N,)
        abs(1 + d k) of the smaller over that of the larger, at the true BP.
    index : ndarray of int64, shape (N,)
        Sample.
    classical : dict
        By estimator: error_deg and axis_ratio, shape (N,) each; NaN where it gave none.
    """

    images: Array
    extras: Array
    towards: Array
    rotation: Array
    normal: Array
    axis_ratio: Array
    index: Array
    classical: dict[str, tuple[Array, Array]]

    def __len__(self) -> int:
        return len(self.images)


def read_crops(folder: str | Path, split: str) -> Crops:
    """Read the matched highlights of a split.

    Parameters
    ----------
    folder : str or Path
        The dataset's.
    split : str
        train, validation or test.

    Returns
    -------
    Crops

    Raises
    ------
    InputError
        As `simtest.dataset.read`.
    """
    rows = [row for record in read(folder, split, ["image"]) for row in _rows(record)]
    names = sorted({name for row in rows for name in row["classical"]})
    nothing = (float("nan"), float("nan"))
    classical = {}
    for name in names:
        pairs = np.array([row["classical"].get(name, nothing) for row in rows], dtype=float)
        classical[name] = (pairs[:, 0], pairs[:, 1])

    def stacked(key: str, dtype: Any) -> Array:
        return np.array([row[key] for row in rows], dtype=dtype)

    return Crops(
        stacked("image", np.float32).reshape(-1, SIDE, SIDE),
        stacked("extras", np.float32).reshape(-1, len(EXTRAS)),
        stacked("towards", float).reshape(-1, 3),
        stacked("rotation", np.float32).reshape(-1, 2),
        stacked("normal", float).reshape(-1, 3),
        stacked("axis_ratio", np.float32),
        stacked("index", np.int64),
        classical,
    )


def _rows(record: Record) -> Iterator[dict[str, Any]]:
    meta = record["meta"]
    camera = CameraSpec.model_validate(meta["scene"]["camera"]).model()
    sensor = Sensor.model_validate(meta["scene"]["sensor"])
    # As simtest.dataset.sample writes it: what the sensor itself encoded, or else sRGB.
    decode = sensor.response.model().decode if sensor.encodes else srgb_decode
    linear = decode(record["image"].astype(np.float32) / 255).mean(axis=2, dtype=np.float32)
    by_detection: dict[int, dict[str, Any]] = {}
    for row in meta["estimates"]:
        if "specularity" in row and "true_id" in row:
            by_detection.setdefault(row["specularity"], {})[row["estimator"]] = row
    for number, estimates in by_detection.items():
        detection = meta["detections"][number]
        if detection["peak_px"] is None:
            continue
        truth = meta["highlights"][next(iter(estimates.values()))["true_id"]]
        yield {"index": meta["index"], **_crop(linear, camera, detection, meta), **_target(camera, detection, truth),
               "classical": {name: _errors(row) for name, row in estimates.items()}}  # fmt: skip


def _crop(linear: Array, camera: Camera, detection: dict[str, Any], meta: dict[str, Any]) -> dict[str, Any]:
    x, y = detection["peak_px"]
    _, _, width, height = detection["box_px"]
    step = max(width, height) / SIDE
    corner = -(SIDE - 1) / 2 * step
    # warpAffine has the centre of pixel (0, 0) at the origin.
    image_from_crop = np.array([[step, 0, x - 0.5 + corner], [0, step, y - 0.5 + corner]])
    crop = cv2.warpAffine(
        linear, image_from_crop, (SIDE, SIDE), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    ray = camera.unproject(detection["peak_px"])
    angle = SIDE * step / camera.fx
    first, second = (basis[0] for basis in tangent_basis(-ray[None]))
    light = np.array(meta["lights_mm"][0])
    beside = [first @ light, second @ light, -ray @ light]
    return {"image": crop / max(float(crop.max()), 1e-6), "extras": [np.log(angle), *beside, ray[0], ray[1]]}


def _target(camera: Camera, detection: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    towards, normal = -camera.unproject(detection["peak_px"]), np.array(truth["normal"])
    gains = sorted(abs(1 + truth[key]) for key in ("kd_min", "kd_max"))
    return {
        "towards": towards,
        "normal": normal,
        "rotation": tangent_coordinates(towards, normal),
        "axis_ratio": gains[0] / gains[1],
    }


def _errors(row: dict[str, Any]) -> tuple[float, float]:
    return float(row.get("error_deg", "nan")), float(row.get("axis_ratio", "nan"))
