"""Reads a run folder: results.parquet, summary.json and the gallery."""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.pages.style import Array
from simtest.spec.camera_spec import CameraSpec
from simtest.spec.paper import PaperSetting

MAX_GALLERY = 24
"""Gallery items that a page shows; of a longer gallery, evenly spaced ones."""

_TEXT = ("experiment", "surface", "reflectance", "setting", "label", "estimator", "status")
_WHOLE = ("realisation", "specularity", "true_id")
_FLOAT = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "kd_min", "kd_max", "eps_over_d", "isovalue",
    "axis_ratio", "axis_ratio_law", "noise_sigma", "peak_snr", "distance_mm",
)  # fmt: skip


@dataclass(frozen=True)
class KeptTruth:
    """A true highlight of a kept frame: BP in px, position and normal in the camera frame, curvatures times distance.

    What the run did not write, or is not finite, is None.
    """

    id: int | None
    bp_px: Array | None
    normal: Array | None
    position: Array | None
    kd: tuple[float, ...]
    isolated: bool


@dataclass(frozen=True)
class KeptIsophote:
    """An isophote as it was traced: its isovalue and points, px, shape (n, 2)."""

    t: float
    points: Array


@dataclass(frozen=True)
class KeptEstimate:
    """An estimate of a kept frame.

    Parameters
    ----------
    estimator, status : str
        Name, and "ok" or the failure's reason.
    specularity, true_id : int or None
        Which detection, and the true highlight that it was matched to.
    bp_px : ndarray, shape (2,), or None
        Brightest point that was found.
    normals : tuple of ndarray, shape (3,)
        The candidates, the proposed one first; empty where it failed.
    isophotes, curves : tuple
        Isophotes, and fitted ellipses as points, px, shape (n, 2).
    error_deg, error_oracle_deg : float or None
        Errors of the proposed normal and of the better candidate.
    """

    estimator: str
    status: str
    specularity: int | None
    true_id: int | None
    bp_px: Array | None
    normals: tuple[Array, ...]
    isophotes: tuple[KeptIsophote, ...]
    curves: tuple[Array, ...]
    error_deg: float | None
    error_oracle_deg: float | None


@dataclass(frozen=True)
class KeptProtocol:
    """What a realisation of the published protocol keeps beside its frame.

    `outer` is column, row, width and height of the part of the picture that is used, px; `peak_value` that of the
    smoothed picture, None where the realisation failed.
    """

    setting: PaperSetting
    outer: tuple[int, int, int, int]
    peak_value: float | None


@dataclass(frozen=True)
class GalleryItem:
    """One frame of the gallery with its truth and estimates.

    Parameters
    ----------
    frame : ndarray, shape (H, W) or (H, W, 3)
        Share of full scale.
    position, normal : ndarray, shape (h, w, 3)
        Downsampled truth, camera frame, in `length_unit` and unit; NaN where there is no surface.
    camera : Camera
        Calibration of the frame.
    truth, estimates : tuple
        True highlights, and estimates, one a specularity and estimator.
    label, title, setting : str
        Group of settings, heading and setting; empty where the run names none.
    sigma : float or None
        Noise, share of full scale.
    command, why : str
        What makes the frame again, and why it is shown.
    length_unit : str
        Unit of the positions.
    lights : ndarray, shape (L, 3)
        Light positions.
    protocol : KeptProtocol or None
        Of the published protocol.
    pictures : mapping
        Further pictures by name.
    """

    name: str
    frame: npt.NDArray[np.float32]
    position: npt.NDArray[np.float32]
    normal: npt.NDArray[np.float32]
    camera: Camera
    truth: tuple[KeptTruth, ...]
    estimates: tuple[KeptEstimate, ...]
    label: str
    title: str
    setting: str
    sigma: float | None
    command: str
    why: str
    length_unit: str
    lights: Array
    protocol: KeptProtocol | None
    pictures: Mapping[str, npt.NDArray[np.float32]]

    def true_highlight(self, estimate: KeptEstimate) -> KeptTruth | None:
        """Return the true highlight that an estimate was matched to, if any."""
        return next((t for t in self.truth if t.id == estimate.true_id is not None), None)


@dataclass(frozen=True)
class SummaryRow:
    """Figures of one setting and estimator in summary.json; `figures` by key, `reasons` counts failures by reason."""

    setting: str
    estimator: str
    figures: Mapping[str, float | None]
    ci95_deg: tuple[float | None, float | None]
    reasons: Mapping[str, int]


@dataclass(frozen=True)
class ExperimentSummary:
    """An experiment of summary.json; title and description may be empty."""

    title: str = ""
    description: str = ""
    rows: tuple[SummaryRow, ...] = ()


@dataclass(frozen=True)
class Run:
    """A run folder in memory.

    Parameters
    ----------
    path : pathlib.Path
        The folder.
    results : polars.DataFrame
        results.parquet with every column the report uses; numbers that are not finite are null.
    experiments : mapping of str to ExperimentSummary
        Those of summary.json by name.
    provenance : mapping of str to str
        What made the run, flattened.
    gallery : tuple of GalleryItem
        At most `MAX_GALLERY` items.
    gallery_total : int
        Items in the folder.
    """

    path: Path
    results: pl.DataFrame
    experiments: Mapping[str, ExperimentSummary] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    gallery: tuple[GalleryItem, ...] = ()
    gallery_total: int = 0

    @property
    def experiment(self) -> str:
        """Name of the run's experiment."""
        names = [*self.results["experiment"].drop_nulls().unique(maintain_order=True), *self.experiments]
        return str(names[0]) if names else "run"

    @property
    def estimators(self) -> list[str]:
        """Estimator names in order of first appearance, from all three sources."""
        names = [str(n) for n in self.results["estimator"].drop_nulls().unique(maintain_order=True)]
        names += [row.estimator for experiment in self.experiments.values() for row in experiment.rows]
        names += [estimate.estimator for item in self.gallery for estimate in item.estimates]
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
    """Read a run folder.

    Parameters
    ----------
    path : pathlib.Path
        Folder with results.parquet, summary.json and, if there is one, gallery/*.npz.

    Returns
    -------
    Run

    Raises
    ------
    InputError
        If a file is missing or malformed; the message names it.
    """
    path = Path(path)
    files = sorted((path / "gallery").glob("[!.]*.npz"))
    count = min(len(files), MAX_GALLERY)
    chosen = [files[i] for i in np.unique(np.linspace(0, len(files) - 1, count).round().astype(int))] if count else []
    results = _read_results(path / "results.parquet")
    experiments, provenance = _read_summary(path / "summary.json")
    return Run(path, results, experiments, provenance, varied([read_item(file) for file in chosen]), len(files))


def varied(items: list[GalleryItem]) -> tuple[GalleryItem, ...]:
    """Order frames so that the first ones show every label once: of each label the middle one, then the others."""
    by_label: dict[str, list[GalleryItem]] = {}
    for item in items:
        by_label.setdefault(item.label, []).append(item)
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


def _read_summary(path: Path) -> tuple[dict[str, ExperimentSummary], dict[str, str]]:
    """Read summary.json: the experiments and the provenance."""
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has results.parquet and summary.json")
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not readable JSON ({error})") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: holds a {type(summary).__name__}; must be an object with run and experiments")
    experiments = {
        str(name): ExperimentSummary(
            content.get("title") or "", content.get("description") or "",
            tuple(
                _summary_row(setting, estimator, figures or {})
                for setting, by_estimator in (content.get("settings") or {}).items()
                for estimator, figures in (by_estimator or {}).items()
            ),
        )
        for name, content in (summary.get("experiments") or {}).items()
    }  # fmt: skip
    return experiments, flattened(summary.get("run") or {})


def _summary_row(setting: str, estimator: str, content: Mapping[str, Any]) -> SummaryRow:
    reasons = {name: count for name, count in (content.get("n_failed_by_reason") or {}).items() if count}
    low, high = [*(content.get("ci95_deg") or ()), None, None][:2]
    numbers = {name: value for name, value in content.items() if isinstance(value, int | float)}
    return SummaryRow(setting, estimator, numbers | {"n_failed": sum(reasons.values())}, (low, high), reasons)


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
            meta = json.loads(str(data["meta"][()]))
            pictures = {name: np.asarray(data[name], np.float32) for name in data.files if name != "meta"}
        frame, position, normal = (pictures.pop(name) for name in ("frame", "position", "normal"))
        camera = CameraSpec(**meta["camera"]).model()
        label, surface = meta.get("label") or "", meta.get("surface") or ""
        return GalleryItem(
            name=path.stem, frame=frame, position=position, normal=normal, camera=camera,
            truth=tuple(_truth(entry) for entry in meta.get("truth") or ()),
            estimates=tuple(_estimate(entry) for entry in meta.get("estimates") or ()),
            label=label, title=label or surface or path.stem, setting=meta.get("setting") or "",
            sigma=meta.get("sigma"), command=meta.get("command") or "", why=str(meta.get("why") or ""),
            length_unit=str(meta.get("length_unit") or "mm"),
            lights=np.asarray(meta.get("lights") or [], dtype=float).reshape(-1, 3),
            protocol=_protocol(meta) if meta.get("paper") else None, pictures=pictures,
        )  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a gallery file ({error})") from error


def _truth(entry: Mapping[str, Any]) -> KeptTruth:
    sizes = (entry.get("kd_min"), entry.get("kd_max"))
    return KeptTruth(
        entry.get("id"), _vector(entry.get("bp_px"), 2), _vector(entry.get("normal"), 3),
        _vector(entry.get("position"), 3), tuple(float(size) for size in sizes if size is not None),
        bool(entry.get("isolated", True)),
    )  # fmt: skip


def _estimate(entry: Mapping[str, Any]) -> KeptEstimate:
    candidates, single = entry.get("candidates") or (), [entry.get("normal")]
    found, alone = (
        [v for v in (_vector(value, 3) for value in values) if v is not None] for values in (candidates, single)
    )
    isophotes = [(part.get("t"), _points(part.get("points"))) for part in entry.get("isophotes") or ()]
    curves = [_points(curve) for curve in entry.get("curves") or ()]
    return KeptEstimate(
        estimator=str(entry.get("estimator")), status=str(entry.get("status")),
        specularity=entry.get("specularity"), true_id=entry.get("true_id"), bp_px=_vector(entry.get("bp_px"), 2),
        normals=tuple(found or alone),
        isophotes=tuple(KeptIsophote(float(t), points) for t, points in isophotes if t is not None and len(points)),
        curves=tuple(points for points in curves if len(points)),
        error_deg=entry.get("error_deg"), error_oracle_deg=entry.get("error_oracle_deg"),
    )  # fmt: skip


def _protocol(meta: Mapping[str, Any]) -> KeptProtocol:
    x, y, width, height = (int(v) for v in meta["outer"])
    return KeptProtocol(PaperSetting(**meta["paper"]), (x, y, width, height), meta.get("peak_value"))


def _vector(value: object, size: int) -> Array | None:
    """Return a list of numbers of a given length as an array; None where it is missing or not finite."""
    if value is None:
        return None
    try:
        data = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
    return data if data.shape == (size,) and np.isfinite(data).all() else None


def _points(value: object) -> Array:
    """Return a list of points as an array, shape (n, 2); empty where it is none."""
    data = np.asarray(value or [], dtype=float)
    return data if data.ndim == 2 and data.shape[1] == 2 else np.empty((0, 2))
