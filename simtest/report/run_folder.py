"""Reads a run folder: results.parquet, summary.json and the gallery."""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import polars as pl
from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from simtest.conventions import ON_INSTRUMENT
from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.pages.style import degrees
from simtest.runtime.arrays import Array, Image
from simtest.spec.camera import CameraSpec
from simtest.spec.recipes import PaperSetting
from simtest.validation.guide import Guide, guide_of
from simtest.validation.run_summary import fault_sentence

MAX_GALLERY = 24  # gallery items that a page shows; of a longer gallery, evenly spaced ones
_TEXT = ("experiment", "surface", "reflectance", "setting", "label", "estimator", "status")
_WHOLE = ("realisation", "specularity", "true_id")
_FLOAT = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "kd_min", "kd_max", "eps_over_d", "isovalue",
    "axis_ratio", "axis_ratio_law", "noise_sigma", "peak_snr", "distance_mm",
)  # fmt: skip

_NO_HIGHLIGHT = {
    "false": "false detection", "in_spot": "in a spot of several glints or of none", ON_INSTRUMENT: "on an instrument",
}  # fmt: skip
"""Kinds of detections that are of no true highlight, in words."""

# What a run leaves out is null; it reads as empty.
Text = Annotated[str, BeforeValidator(lambda value: value or "")]
Pixel = tuple[float, float]
Vector = tuple[float, float, float]


def _listed(value: object) -> object:
    return value or ()


def _table(value: object) -> object:
    return value or {}


class KeptTruth(BaseModel):
    """A true highlight of a kept frame: BP, px, normal and position, camera frame, and curvatures times distance."""

    id: int | None = None
    bp_px: Pixel | None = None
    normal: Vector | None = None
    position: Vector | None = None
    kd_min: float | None = None
    kd_max: float | None = None
    isolated: bool = True


class KeptIsophote(BaseModel):
    """An isophote as it was traced, px."""

    t: float
    points: list[Pixel]


class KeptEstimate(BaseModel):
    """An estimate of a kept frame; without a normal where it failed."""

    estimator: str
    status: str  # "ok" or the failure's reason
    kind: str = "ok"  # what its row of results counts as
    specularity: int | None = None  # which detection
    true_id: int | None = None  # the true highlight that it was matched to
    bp_px: Pixel | None = None  # brightest point that was found
    normal: Vector | None = None
    candidates: Annotated[tuple[Vector, ...], BeforeValidator(_listed)] = ()
    isophotes: Annotated[tuple[KeptIsophote, ...], BeforeValidator(_listed)] = ()
    curves: Annotated[tuple[list[Pixel], ...], BeforeValidator(_listed)] = ()  # fitted ellipses, px
    error_deg: float | None = None
    error_oracle_deg: float | None = None

    @property
    def result(self) -> str:
        """What the estimate came to: an error, a failure's reason, or that it is of no true highlight."""
        ok, value, better = self.status == "ok", degrees(self.error_deg), degrees(self.error_oracle_deg)
        if self.kind in _NO_HIGHLIGHT:
            return _NO_HIGHLIGHT[self.kind] if ok else f"{self.status} ({_NO_HIGHLIGHT[self.kind]})"
        told = len(self.normals) > 1 and better not in ("–", value)
        return self.status if not ok else f"{value} (better candidate {better})" if told else value

    @property
    def normals(self) -> list[Array]:
        """The candidates, or the single normal."""
        single = () if self.normal is None else (self.normal,)
        return [np.array(normal) for normal in self.candidates or single]


class GalleryMeta(BaseModel):
    """What a gallery item holds beside its pictures."""

    camera: CameraSpec
    truth: tuple[KeptTruth, ...] = ()
    estimates: tuple[KeptEstimate, ...] = ()
    surface: Text = ""
    label: Text = ""
    setting: Text = ""
    sigma: float | None = None  # noise, share of full scale
    command: Text = ""  # makes the frame again
    length_unit: str = "mm"
    lights: list[Vector] = []  # positions, camera frame
    paper: PaperSetting | None = None  # of the published protocol, as all that follows
    outer: tuple[int, int, int, int] = (0, 0, 0, 0)  # column, row, width and height of the picture's used part, px
    peak_value: float | None = None  # of the smoothed picture; None where the realisation failed


@dataclass(frozen=True)
class GalleryItem:
    """One frame of the gallery with its truth and estimates."""

    name: str
    frame: Image  # share of full scale, shape (H, W) or (H, W, 3)
    position: Image  # downsampled truth, camera frame, shape (h, w, 3); NaN without a surface
    normal: Image
    camera: Camera
    meta: GalleryMeta
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


class EstimatorFigures(BaseModel):
    """Figures of one setting and estimator in summary.json, with their headings; errors in deg."""

    n: int | None = Field(None, title="true highlights")
    n_ok: int | None = Field(None, title="ok")
    n_failed_by_reason: Annotated[dict[str, int], BeforeValidator(lambda v: v or {})] = Field({}, title="failed")
    n_missed: int | None = Field(None, title="missed")
    n_false: int | None = Field(None, title="false")
    n_in_spot: int | None = Field(None, title="in spots")
    n_instrument: int | None = Field(None, title="on instruments")
    mean_deg: float | None = Field(None, title="mean\u00a0°")
    mean_oracle_deg: float | None = Field(None, title="mean, better candidate\u00a0°")
    rms_deg: float | None = Field(None, title="RMS\u00a0°")
    std_deg: float | None = Field(None, title="std\u00a0°")
    median_deg: float | None = Field(None, title="median\u00a0°")
    p95_deg: float | None = Field(None, title="95th pct\u00a0°")
    max_deg: float | None = Field(None, title="max\u00a0°")
    mean_penalised_deg: float | None = Field(None, title="mean, failures as\u00a090°")
    ci95_deg: tuple[float | None, float | None] | None = Field(None, title="95\u00a0% interval\u00a0°")
    coverage95: float | None = Field(None, title="coverage 95\u00a0%")


class SceneRealism(BaseModel):
    """For which realism some scenes of an experiment stand; `scenes` are the labels of their curves."""

    scenes: tuple[str, ...] = ()
    sentence: Text = ""


class JudgedMesh(BaseModel):
    """A mesh file, and what `simtest mesh check` says of it."""

    file: Text = ""
    usable: bool = True
    verdict: Text = ""


class Fault(BaseModel):
    """An error of an estimator or a core, with the number of its rows (`simtest.validation.run_summary`)."""

    estimator: Text = ""
    reason: Text = ""
    text: Text = ""
    count: int = 1

    def __str__(self) -> str:
        return fault_sentence(self.estimator, self.reason, self.text, self.count)


class ExperimentSummary(BaseModel):
    """An experiment of summary.json: figures by setting and estimator."""

    title: Text = ""
    description: Text = ""
    meshes: Annotated[tuple[JudgedMesh, ...], BeforeValidator(_listed)] = ()
    realism: Annotated[tuple[SceneRealism, ...], BeforeValidator(_listed)] = ()
    frames: int | None = None  # of all settings, with or without a highlight
    faults: Annotated[tuple[Fault, ...], BeforeValidator(_listed)] = ()
    estimators: Annotated[dict[str, Text], BeforeValidator(_table)] = {}  # what each does, in one line
    conditions: Annotated[dict[str, dict[str, Any]], BeforeValidator(_table)] = {}  # by setting
    settings: dict[str, dict[str, EstimatorFigures | None] | None] | None = None

    @property
    def rows(self) -> list[tuple[str, str, EstimatorFigures]]:
        """Setting, estimator and figures."""
        return [
            (setting, estimator, figures or EstimatorFigures())
            for setting, by_estimator in (self.settings or {}).items()
            for estimator, figures in (by_estimator or {}).items()
        ]


class Summary(BaseModel):
    """summary.json; `run` is the provenance."""

    run: dict[str, Any] | None = None
    experiments: dict[str, ExperimentSummary] | None = None


@dataclass(frozen=True)
class Run:
    """A run folder in memory."""

    path: Path
    results: pl.DataFrame  # with every column the report uses; numbers that are not finite are null
    experiments: Mapping[str, ExperimentSummary] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    gallery: tuple[GalleryItem, ...] = ()  # at most `MAX_GALLERY` items
    gallery_total: int = 0  # items in the folder

    @property
    def experiment(self) -> str:
        """Name of the run's experiment."""
        names = [*self.results["experiment"].drop_nulls().unique(maintain_order=True), *self.experiments]
        return str(names[0]) if names else "run"

    @property
    def summary(self) -> ExperimentSummary:
        """Its entry in summary.json."""
        return self.experiments.get(self.experiment) or ExperimentSummary()

    @cached_property
    def guide(self) -> Guide:
        """Which method to use, and where it breaks."""
        return guide_of(self.results, self.summary.conditions)

    @property
    def estimators(self) -> list[str]:
        """Estimator names in order of first appearance, from all three sources."""
        names = [str(n) for n in self.results["estimator"].drop_nulls().unique(maintain_order=True)]
        names += [estimator for experiment in self.experiments.values() for _, estimator, _ in experiment.rows]
        names += [estimate.estimator for item in self.gallery for estimate in item.meta.estimates]
        return list(dict.fromkeys(names))

    @property
    def swept(self) -> list[str]:
        """Numeric swept parameters, by key path, that take more than one value."""
        return [
            name
            for name, dtype in self.results.schema.items()
            if "." in name and dtype.is_numeric() and self.results[name].drop_nulls().n_unique() > 1
        ]


def read_run(path: Path) -> Run:
    """Read a run folder: results.parquet, summary.json and, if there is one, gallery/*.npz.

    Raises `InputError` if a file is missing or malformed; the message names it.
    """
    path = Path(path)
    files = sorted((path / "gallery").glob("[!.]*.npz"))
    count = min(len(files), MAX_GALLERY)
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, count).round().astype(int))] if count else []
    results, summary = _read_results(path / "results.parquet"), _read_summary(path / "summary.json")
    gallery = varied([read_item(file) for file in chosen])
    return Run(path, results, summary.experiments or {}, flattened(summary.run or {}), gallery, len(files))


def varied(items: list[GalleryItem]) -> tuple[GalleryItem, ...]:
    """Order frames so that the first ones show every label once: of each label the middle one, then the others."""
    by_label: dict[str, list[GalleryItem]] = {}
    for item in items:
        by_label.setdefault(item.meta.label, []).append(item)
    turns: list[tuple[int, int, GalleryItem]] = []
    for index, group in enumerate(by_label.values()):
        group.insert(0, group.pop(len(group) // 2))
        turns += [(turn, index, item) for turn, item in enumerate(group)]
    return tuple(item for _, _, item in sorted(turns, key=lambda entry: entry[:2]))


def _read_results(path: Path) -> pl.DataFrame:
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has results.parquet and summary.json")
    try:
        frame = pl.read_parquet(path)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]})") from error
    return completed(frame)


def completed(frame: pl.DataFrame) -> pl.DataFrame:
    """Add the columns that the report uses and that are missing; numbers that are not finite become null."""
    columns: list[pl.Expr] = []
    types: tuple[tuple[tuple[str, ...], pl.DataType], ...] = (
        (_TEXT, pl.String()), (_WHOLE, pl.Int64()), (_FLOAT, pl.Float64()),
    )  # fmt: skip
    for names, dtype in types:
        for name in names:
            present = pl.col(name).cast(dtype, strict=False) if name in frame.columns else pl.lit(None, dtype)
            columns.append(present.alias(name))
    frame = frame.with_columns(columns)
    floats = [name for name, dtype in frame.schema.items() if dtype.is_float()]
    frame = frame.with_columns(pl.when(pl.col(n).is_finite()).then(pl.col(n)).alias(n) for n in floats)
    return frame.with_columns(
        pl.coalesce("label", "surface", pl.lit("all")).alias("label"),
        pl.coalesce("error_oracle_deg", "error_deg").alias("error_oracle_deg"),
        pl.col("setting").fill_null("all"),
        pl.col("surface").fill_null("unnamed"),
        pl.col("estimator").fill_null("unnamed"),
    )


def _read_summary(path: Path) -> Summary:
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has results.parquet and summary.json")
    try:
        return Summary.model_validate_json(path.read_bytes())
    except ValidationError as error:
        what = error.errors()[0]
        where = ".".join(str(part) for part in what["loc"])
        raise InputError(
            f"{path}: not readable JSON of a run ({where + ': ' if where else ''}{what['msg']})"
        ) from error


def flattened(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of a table, and of tables within it, as text by name."""
    made: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            made |= {f"{key}: {name}": str(entry) for name, entry in value.items()}
        elif isinstance(value, list | tuple):
            made[str(key)] = " ".join(str(entry) for entry in value)
        else:
            made[str(key)] = "–" if value is None else str(value)
    return made


def read_item(path: Path) -> GalleryItem:
    """Read one gallery item; raises `InputError` where the file is none."""
    try:
        with np.load(path, allow_pickle=False) as data:
            meta = GalleryMeta.model_validate_json(str(data["meta"][()]))
            pictures = {name: np.asarray(data[name], np.float32) for name in data.files if name != "meta"}
        frame, position, normal = (pictures.pop(name) for name in ("frame", "position", "normal"))
        return GalleryItem(path.stem, frame, position, normal, meta.camera.model(), meta, pictures)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a gallery file ({error})") from error
