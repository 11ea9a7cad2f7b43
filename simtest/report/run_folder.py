"""A run folder in memory: results.parquet, summary.json and the gallery."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from simtest.errors import InputError
from simtest.validation.columns import SCHEMA
from simtest.validation.guide import Guide, guide_of
from simtest.validation.kept_frames import KeptItem, read_item
from simtest.validation.run_folder import RESULTS, SUMMARY
from simtest.validation.run_summary import ExperimentSummary, read_summary

MAX_GALLERY = 24  # gallery items that a page shows; of a longer gallery, evenly spaced ones

_NEEDED = (
    "experiment", "surface", "reflectance", "setting", "label", "estimator", "status", "realisation", "specularity",
    "true_id", "error_deg", "error_oracle_deg", "error_look_deg", "error_law_deg", "kd_min", "kd_max", "eps_over_d",
    "isovalue", "axis_ratio", "axis_ratio_law", "noise_sigma", "peak_snr", "distance_mm",
)  # fmt: skip
"""Columns that the report reads without a look whether they are there."""


@dataclass(frozen=True)
class Run:
    """A run folder in memory."""

    path: Path
    results: pl.DataFrame  # with every column the report uses; numbers that are not finite are null
    experiments: Mapping[str, ExperimentSummary] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    gallery: tuple[KeptItem, ...] = ()  # at most `MAX_GALLERY` items
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
    results, summary = _read_results(path / RESULTS), read_summary(path)
    gallery = varied([read_item(file) for file in chosen])
    return Run(path, results, summary.experiments, flattened(summary.run), gallery, len(files))


def varied(items: list[KeptItem]) -> tuple[KeptItem, ...]:
    """Order frames so that the first ones show every label once: of each label the middle one, then the others."""
    by_label: dict[str, list[KeptItem]] = {}
    for item in items:
        by_label.setdefault(item.meta.label, []).append(item)
    turns: list[tuple[int, int, KeptItem]] = []
    for index, group in enumerate(by_label.values()):
        group.insert(0, group.pop(len(group) // 2))
        turns += [(turn, index, item) for turn, item in enumerate(group)]
    return tuple(item for _, _, item in sorted(turns, key=lambda entry: entry[:2]))


def _read_results(path: Path) -> pl.DataFrame:
    if not path.is_file():
        raise InputError(f"{path}: no such file; a run directory has {RESULTS} and {SUMMARY}")
    try:
        frame = pl.read_parquet(path)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file ({str(error).splitlines()[0]})") from error
    return completed(frame)


def completed(frame: pl.DataFrame) -> pl.DataFrame:
    """Add the columns that the report uses and that are missing; numbers that are not finite become null."""
    frame = frame.with_columns(
        (pl.col(name).cast(SCHEMA[name], strict=False) if name in frame.columns else pl.lit(None, SCHEMA[name])).alias(
            name
        )
        for name in _NEEDED
    )
    floats = [name for name, dtype in frame.schema.items() if dtype.is_float()]
    frame = frame.with_columns(pl.when(pl.col(n).is_finite()).then(pl.col(n)).alias(n) for n in floats)
    return frame.with_columns(
        pl.coalesce("label", "surface", pl.lit("all")).alias("label"),
        pl.coalesce("error_oracle_deg", "error_deg").alias("error_oracle_deg"),
        pl.col("setting").fill_null("all"),
        pl.col("surface").fill_null("unnamed"),
        pl.col("estimator").fill_null("unnamed"),
    )


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
