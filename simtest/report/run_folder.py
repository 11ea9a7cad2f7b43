"""Reads a run directory: results.parquet, summary.json and the gallery."""

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
from simtest.spec.camera_spec import CameraSpec

MAX_GALLERY = 24
"""Gallery items that a page shows; of a longer gallery, evenly spaced ones."""

_TEXT = ("experiment", "surface", "reflectance", "setting", "label", "estimator", "status")
_WHOLE = ("realisation", "specularity", "true_id")
_FLOAT = (
    "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "kd_min", "kd_max", "eps_over_d", "isovalue",
    "axis_ratio", "axis_ratio_law", "noise_sigma", "peak_snr", "distance_mm",
)  # fmt: skip


@dataclass(frozen=True)
class GalleryItem:
    """One frame of the gallery with its truth and estimates.

    Parameters
    ----------
    name : str
        Stem of the file.
    frame : ndarray, shape (H, W) or (H, W, 3)
        Share of full scale.
    position, normal : ndarray, shape (h, w, 3)
        Downsampled truth, camera frame, mm and unit; NaN where there is no surface.
    camera : Camera
        Calibration of the frame.
    meta : mapping
        The rest, as written by the run.
    pictures : mapping
        Further pictures by name: of the published protocol its stages.
    """

    name: str
    frame: npt.NDArray[np.float32]
    position: npt.NDArray[np.float32]
    normal: npt.NDArray[np.float32]
    camera: Camera
    meta: Mapping[str, Any]
    pictures: Mapping[str, npt.NDArray[np.float32]] = field(default_factory=dict)

    @property
    def length_unit(self) -> str:
        """Unit of the positions."""
        return str(self.meta.get("length_unit") or "mm")

    @property
    def truth(self) -> list[dict[str, Any]]:
        """True highlights."""
        return list(self.meta.get("truth") or [])

    @property
    def estimates(self) -> list[dict[str, Any]]:
        """Estimates, one a specularity and estimator."""
        return list(self.meta.get("estimates") or [])

    def true_highlight(self, estimate: Mapping[str, Any]) -> dict[str, Any] | None:
        """Give the true highlight that an estimate was matched to, if any."""
        return next((t for t in self.truth if t.get("id") == estimate.get("true_id") is not None), None)


@dataclass(frozen=True)
class Run:
    """A run directory in memory.

    Parameters
    ----------
    path : pathlib.Path
        The directory.
    results : polars.DataFrame
        results.parquet with every column the report uses; numbers that are not finite are null.
    summary : dict
        summary.json.
    gallery : tuple of GalleryItem
        At most `MAX_GALLERY` items.
    gallery_total : int
        Items in the directory.
    """

    path: Path
    results: pl.DataFrame
    summary: dict[str, Any]
    gallery: tuple[GalleryItem, ...]
    gallery_total: int

    @property
    def experiment(self) -> str:
        """Name of the run's experiment."""
        names = [*self.results["experiment"].drop_nulls().unique(maintain_order=True), *self.experiments]
        return str(names[0]) if names else "run"

    @property
    def experiments(self) -> dict[str, dict[str, Any]]:
        """Experiments of summary.json by name."""
        return dict(self.summary.get("experiments") or {})

    @property
    def estimators(self) -> list[str]:
        """Estimator names in order of first appearance, from all three sources."""
        names = [str(n) for n in self.results["estimator"].drop_nulls().unique(maintain_order=True)]
        for experiment in self.experiments.values():
            for by_estimator in (experiment.get("settings") or {}).values():
                names += list(by_estimator or {})
        names += [str(e.get("estimator")) for item in self.gallery for e in item.estimates]
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
    """Read a run directory.

    Parameters
    ----------
    path : pathlib.Path
        Directory with results.parquet, summary.json and, if there is one, gallery/*.npz.

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
    items = varied([read_item(file) for file in chosen])
    return Run(path, _read_results(path / "results.parquet"), _read_summary(path / "summary.json"), items, len(files))


def varied(items: list[GalleryItem]) -> tuple[GalleryItem, ...]:
    """Order frames so that the first ones show every label once: of each label the middle one, then the others."""
    by_label: dict[str, list[GalleryItem]] = {}
    for item in items:
        by_label.setdefault(str(item.meta.get("label")), []).append(item)
    turns: list[tuple[int, int, GalleryItem]] = []
    for place, group in enumerate(by_label.values()):
        group.insert(0, group.pop(len(group) // 2))
        turns += [(turn, place, item) for turn, item in enumerate(group)]
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
    """Give rows of results with every column the report uses; numbers that are not finite become null."""
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


def _read_summary(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has results.parquet and summary.json")
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: not readable JSON ({error})") from error
    if not isinstance(summary, dict):
        raise InputError(f"{path}: holds a {type(summary).__name__}; must be an object with run and experiments")
    return summary


def read_item(path: Path) -> GalleryItem:
    """Read one gallery item; raises `InputError` where the file is none."""
    try:
        with np.load(path, allow_pickle=False) as data:
            meta = json.loads(str(data["meta"][()]))
            pictures = {name: np.asarray(data[name], np.float32) for name in data.files if name != "meta"}
        frame, position, normal = (pictures.pop(name) for name in ("frame", "position", "normal"))
        camera = CameraSpec(**meta["camera"]).model()
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a gallery file ({error})") from error
    return GalleryItem(path.stem, frame, position, normal, camera, meta, pictures)
