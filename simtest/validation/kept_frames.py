"""A few frames of a run, kept with everything that is needed to draw them: truth, isophotes, ellipses, normals."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, field_serializer, field_validator

from simtest.errors import Failure, InputError
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array, Image
from simtest.runtime.files import write_atomically
from simtest.spec import CameraSpec, camera_table
from simtest.spec.recipes import PaperSetting

if TYPE_CHECKING:
    from simtest.estimators import Estimate

MAP_SIDE = 80
"""Truth maps are thinned to about this many samples along the longer side."""

ZIP_LEVEL = 1
"""Six times as fast as zlib's usual 6 on noisy frames, for files 6 % larger."""

CONTOUR_POINTS = 200
"""Contours are thinned to about this many points."""

Pixel = tuple[float, float]
Vector = tuple[float, float, float]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True)


class KeptTruth(_Record):
    """A true highlight: its number, BP, px (None behind the camera), normal and position, camera frame, and d k."""

    id: int
    bp_px: Pixel | None
    normal: Vector
    position: Vector
    kd_min: float
    kd_max: float
    isolated: bool


class KeptIsophote(_Record):
    """A traced isophote: isovalue and thinned points, px."""

    t: float
    points: tuple[Pixel, ...]


class KeptEstimate(_Record):
    """An estimator's answer at one detection; `answered` fills in what follows the row's errors.

    Parameters
    ----------
    specularity, true_id : int
        Index of the detection, and of the true highlight that it was matched to, if any.
    bp_px : tuple of float or None
        The detection's peak, px.
    kind : str
        What its row of results counts as (`simtest.validation.statistics.row_kind`).
    curves : tuple
        Fitted ellipses, px.
    status : str
        "ok", or the Failure's reason.
    """

    specularity: int | None = None
    true_id: int | None = None
    bp_px: Pixel | None = None
    estimator: str
    kind: str = "ok"
    error_deg: float | None = None
    error_oracle_deg: float | None = None
    normal: Vector | None = None
    candidates: tuple[Vector, ...] = ()
    look_px: Pixel | None = None
    isophotes: tuple[KeptIsophote, ...] = ()
    curves: tuple[tuple[Pixel, ...], ...] = ()
    status: str = ""

    @property
    def normals(self) -> list[Array]:
        """The candidates, or the single normal."""
        single = () if self.normal is None else (self.normal,)
        return [np.array(normal) for normal in self.candidates or single]

    def answered(
        self, result: "Estimate | Failure", patch: Patch | Failure, camera: Camera, truth: npt.ArrayLike | None = None
    ) -> "KeptEstimate":
        """Fill in the answer on a patch, and its errors where the true normal, shape (3,), is given."""
        if isinstance(result, Failure):
            return self.model_copy(update={"status": str(result.reason)})
        # Loaded where a frame is kept: who draws one needs no estimator.
        from simtest.reconstruction.records import drawable

        found: dict[str, Any] = {
            "status": "ok",
            "normal": result.normal.tolist(),
            "candidates": result.candidates.tolist(),
            "look_px": result.look_px.tolist() if np.isfinite(result.look_px).all() else None,
            "isophotes": [
                {"t": t, "points": np.round(points[:: max(1, len(points) // CONTOUR_POINTS)], 2).tolist()}
                for t, points in result.contours(patch)
            ],
            "curves": [drawable(isophote.ellipse_px(camera)) for isophote in result.isophotes],
        }
        if truth is not None:
            normal = np.asarray(truth)
            found["error_deg"] = float(angle_deg(result.normal, normal))
            found["error_oracle_deg"] = float(angle_deg(result.candidates, normal).min())
        return KeptEstimate.model_validate(self.model_dump() | found)


class KeptFrame(_Record):
    """What is kept of a frame beside its pictures.

    Parameters
    ----------
    surface, setting, label : str
        Of the case.
    sigma : float
        Noise, share of full scale.
    command : str
        Makes the frame again.
    camera, truth, estimates
        Calibration, the highlights that count, and the answers at each detection.
    lights : tuple
        Positions, camera frame, mm.
    paper, light, seed, outer, peak_value
        Of the published protocol alone: setting, position of the light, seed of the noise, the picture's used part
        (column, row, width, height, px), and the peak of the smoothed picture, None where the realisation failed.
    """

    surface: str
    setting: str
    label: str
    sigma: float
    command: str
    camera: CameraSpec
    truth: tuple[KeptTruth, ...]
    estimates: tuple[KeptEstimate, ...]
    lights: tuple[Vector, ...] = ()
    length_unit: str = "mm"
    paper: PaperSetting | None = None
    light: Vector | None = None
    seed: int | None = None
    outer: tuple[int, int, int, int] = (0, 0, 0, 0)
    peak_value: float | None = None

    @field_validator("camera", mode="before")
    @classmethod
    def _of_camera(cls, value: object) -> object:
        return camera_table(value) if isinstance(value, Camera) else value

    @field_serializer("camera")
    def _as_table(self, camera: CameraSpec) -> dict[str, Any]:
        return camera_table(camera.model())


@dataclass(frozen=True)
class KeptItem:
    """A kept frame with its pictures, as its .npz file holds them."""

    name: str
    frame: Image  # share of full scale, shape (H, W) or (H, W, 3)
    position: Image  # thinned truth, camera frame, shape (h, w, 3); NaN without a surface
    normal: Image
    camera: Camera
    meta: KeptFrame
    pictures: Mapping[str, Image]  # further ones by name

    @property
    def title(self) -> str:
        """Heading of the item."""
        return self.meta.label or self.meta.surface or self.name

    @property
    def missed(self) -> int:
        """True highlights that no detection found."""
        found = {estimate.true_id for estimate in self.meta.estimates}
        return sum(truth.isolated and truth.id not in found for truth in self.meta.truth)

    def true_highlight(self, estimate: KeptEstimate) -> KeptTruth | None:
        """Return the true highlight that an estimate was matched to, if any."""
        return next((t for t in self.meta.truth if t.id == estimate.true_id is not None), None)


def read_item(path: Path) -> KeptItem:
    """Read a kept frame; raises `InputError` where the file is none."""
    try:
        with np.load(path, allow_pickle=False) as data:
            meta = KeptFrame.model_validate_json(str(data["meta"][()]))
            pictures = {name: np.asarray(data[name], np.float32) for name in data.files if name != "meta"}
        frame, position, normal = (pictures.pop(name) for name in ("frame", "position", "normal"))
        return KeptItem(path.stem, frame, position, normal, meta.camera.model(), meta, pictures)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a gallery file ({error})") from error


def write_item(
    path: Path,
    meta: Mapping[str, Any],
    frame: npt.ArrayLike,
    position: npt.ArrayLike,
    normal: npt.ArrayLike,
    **pictures: npt.ArrayLike,
) -> None:
    """Write the .npz file of a kept frame; `meta` holds the fields of `KeptFrame`.

    `frame`, shape (H, W) or (H, W, 3), is a share of full scale; position and normal, shape (h, w, 3), are the thinned
    truth, camera frame, NaN where there is no surface. Further pictures are stored by their names.
    """
    kept = KeptFrame.model_validate(meta)
    text = json.dumps(kept.model_dump(mode="json", include=kept.model_fields_set), allow_nan=False)
    # Half precision is enough to look at; the frame is stored wider, since it is read back as it is.
    content = {"frame": np.asarray(frame).astype(np.float16).astype(np.float32)}
    content |= {"position": np.asarray(position, np.float32), "normal": np.asarray(normal, np.float32)}
    halves = {name: np.asarray(picture).astype(np.float16) for name, picture in pictures.items()}
    write_atomically(path, lambda part: _write_npz(part, {**content, **halves, "meta": np.array(text)}))


def _write_npz(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    """Write arrays by name as `numpy.savez_compressed` does, at a level that NumPy does not let one choose."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=ZIP_LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
