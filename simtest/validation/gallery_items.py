"""Keeps a few frames of a run with everything that is needed to draw them: truth, isophotes, ellipses, normals."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, TypedDict
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry import Camera, Patch
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.records import drawable
from simtest.rendering import Session
from simtest.runtime.files import Json, write_atomically
from simtest.spec import Experiment, camera_table
from simtest.validation.cases import Case, swept_example
from simtest.validation.columns import table
from simtest.validation.realisation import Realisation
from simtest.validation.scoring import peak_px
from simtest.validation.statistics import row_kind

Vector = list[float]

MAP_SIDE = 80
"""Truth maps are thinned to about this many samples along the longer side."""

ZIP_LEVEL = 1
"""Six times as fast as zlib's usual 6 on noisy frames, for files 6 % larger."""

CONTOUR_POINTS = 200
"""Contours are thinned to about this many points."""


class DrawnTruth(NamedTuple):
    """A true highlight: its number, BP, px (None behind the camera), normal and position, camera frame, and d k."""

    id: int
    bp_px: Vector | None
    normal: Vector
    position: Vector
    kd_min: float
    kd_max: float
    isolated: bool


class DrawnIsophote(TypedDict):
    """A traced isophote: isovalue and thinned points, px."""

    t: float
    points: list[Vector]


@dataclass(frozen=True)
class DrawnEstimate:
    """An estimator's answer at one detection; `answered` fills in what follows the estimator's name.

    Parameters
    ----------
    specularity, true_id : int
        Index of the detection, and of the true highlight that it was matched to, if any.
    bp_px : list of float or None
        The detection's peak, px.
    kind : str
        What its row of results counts as (`simtest.validation.statistics`).
    """

    specularity: int
    true_id: int | None
    bp_px: Vector | None
    estimator: str
    kind: str = "ok"
    error_deg: float | None = None
    error_oracle_deg: float | None = None
    normal: Vector | None = None
    candidates: list[Vector] = field(default_factory=list)
    look_px: Vector | None = None
    isophotes: list[DrawnIsophote] = field(default_factory=list)
    curves: list[list[Vector]] = field(default_factory=list)
    status: str = ""

    def answered(
        self, result: Estimate | Failure, patch: Patch | Failure, camera: Camera, truth: npt.ArrayLike | None = None
    ) -> "DrawnEstimate":
        """Fill in the answer on a patch, and its errors where the true normal, shape (3,), is given."""
        if isinstance(result, Failure):
            return replace(self, status=str(result.reason))
        made = replace(
            self,
            status="ok",
            normal=result.normal.tolist(),
            candidates=result.candidates.tolist(),
            look_px=result.look_px.tolist() if np.isfinite(result.look_px).all() else None,
            isophotes=[
                {"t": t, "points": np.round(points[:: max(1, len(points) // CONTOUR_POINTS)], 2).tolist()}
                for t, points in result.contours(patch)
            ],
            curves=[drawable(isophote.ellipse_px(camera)) for isophote in result.isophotes],
        )
        if truth is None:
            return made
        normal = np.asarray(truth)
        oracle = float(angle_deg(result.candidates, normal).min())
        return replace(made, error_deg=float(angle_deg(result.normal, normal)), error_oracle_deg=oracle)


class PublishedDetails(NamedTuple):
    """What an item of the published protocol holds besides: setting, light, seed, outer region, peak of the patch."""

    length_unit: str
    paper: dict[str, Json]
    light: Vector
    seed: int
    outer: list[int]
    peak_value: float | None


@dataclass(frozen=True)
class GalleryMeta:
    """Everything of a gallery item that is no picture.

    Parameters
    ----------
    surface, setting, label : str
        Of the case.
    sigma : float
        Noise, share of full scale.
    command : str
        Reproduces the item.
    camera, truth, estimates
        Calibration, the highlights that count, and the answers at each detection.
    lights : list of list of float, optional
        Positions, camera frame, mm.
    published : PublishedDetails, optional
        For the published protocol.
    """

    surface: str
    setting: str
    label: str
    sigma: float
    command: str
    camera: Camera
    truth: Sequence[DrawnTruth]
    estimates: Sequence[DrawnEstimate]
    lights: list[Vector] | None = None
    published: PublishedDetails | None = None

    def to_json(self) -> dict[str, Json]:
        """Return the item's `meta`."""
        content = {name: value for name, value in vars(self).items() if value is not None and name != "published"}
        return {
            **content,
            "camera": camera_table(self.camera),
            "truth": [true._asdict() for true in self.truth],
            "estimates": [vars(estimate) for estimate in self.estimates],
            **(self.published._asdict() if self.published else {}),
        }


def save(path: Path, session: Session, experiment: Experiment, case: Case, made: Realisation) -> None:
    """Write the gallery item of a realisation, at whose scene the session must be."""
    camera, scene = session.camera, made.view.scene
    # Errors and counts are those of the results: a cloud's truth is the base's, and none of the highlights here.
    held = table(made.rows, swept_example([case]))
    rows = {
        (row["specularity"], row["estimator"]): (row["kind"], row["error_deg"], row["error_oracle_deg"])
        for row in held.with_columns(kind=row_kind(held)).iter_rows(named=True)
    }
    # Thinned maps: enough for arrows and the 3D view.
    truth = session.truth(stride=max(1, max(camera.width, camera.height) // MAP_SIDE))
    meta = GalleryMeta(
        surface=scene.surface.label,
        setting=case.setting if not case.part else f"{case.setting} (part {case.part})",
        label=case.label,
        sigma=scene.sensor.noise_sigma,
        command=case.reproduce_command(experiment, made.number),
        camera=camera,
        truth=[
            DrawnTruth(j, h.bp_px.tolist(), h.normal.tolist(), h.position.tolist(), h.kd_min, h.kd_max, h.isolated)
            for j, h in enumerate(made.truths)
        ],
        estimates=[
            DrawnEstimate(
                i, made.matched.get(i), peak_px(specularity).tolist(), name, *rows.get((i, name), ("failed",))
            ).answered(result, specularity.patch, camera)
            for i, specularity in enumerate(made.specularities)
            for name, result in specularity.estimates.items()
        ],
        lights=scene.rig.true_mm().tolist(),
    )
    # Pictures are encoded once more where they are drawn.
    linear = scene.sensor.response.model().decode(made.frame)
    write_item(path, meta, linear, truth.position, truth.normal, curvature=truth.larger_curvature)


def write_item(
    path: Path,
    meta: GalleryMeta,
    frame: npt.ArrayLike,
    position: npt.ArrayLike,
    normal: npt.ArrayLike,
    **pictures: npt.ArrayLike,
) -> None:
    """Write the .npz file of one gallery item.

    `frame`, shape (H, W) or (H, W, 3), is a share of full scale; position and normal, shape (h, w, 3), are the thinned
    truth, camera frame, NaN where there is no surface. Further pictures are stored by their names.
    """
    # Half precision is enough to look at; the frame is stored wider, since it is read back as it is.
    content = {"frame": np.asarray(frame).astype(np.float16).astype(np.float32)}
    content |= {"position": np.asarray(position, np.float32), "normal": np.asarray(normal, np.float32)}
    halves = {name: np.asarray(picture).astype(np.float16) for name, picture in pictures.items()}
    text = np.array(json.dumps(meta.to_json(), allow_nan=False))
    write_atomically(path, lambda part: _write_npz(part, {**content, **halves, "meta": text}))


def _write_npz(path: Path, arrays: Mapping[str, npt.NDArray[np.generic]]) -> None:
    """Write arrays by name as `numpy.savez_compressed` does, at a level that NumPy does not let one choose."""
    with ZipFile(path, "w", ZIP_DEFLATED, compresslevel=ZIP_LEVEL) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
