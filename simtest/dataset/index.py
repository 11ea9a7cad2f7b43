"""The tables beside the shards: samples, highlights, estimates; all made from the shards' own metadata."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import polars as pl

from simtest.dataset.plan import Plan
from simtest.dataset.shard import samples
from simtest.runtime.files import write_atomically
from simtest.validation.results_table import SCHEMA

SAMPLES, HIGHLIGHTS, ESTIMATES = "index.parquet", "highlights.parquet", "estimates.parquet"
TABLES = (SAMPLES, HIGHLIGHTS, ESTIMATES)

_SAMPLE_SCHEMA = {
    "index": pl.Int64(), "key": pl.String(), "split": pl.String(), "shard": pl.String(), "offset": pl.Int64(),
    "bytes": pl.Int64(), "family": pl.Int64(), "surface": pl.String(), "anatomy": pl.Int64(),
    "anatomy_seed": pl.Int64(), "attempt": pl.Int64(), "width": pl.Int64(), "height": pl.Int64(),
    "full_scale": pl.Float64(), "depth_scale_mm": pl.Float64(), "n_highlights": pl.Int64(),
    "n_isolated": pl.Int64(), "n_detections": pl.Int64(), "drawn": pl.String(),
}  # fmt: skip

_HIGHLIGHT_SCHEMA = {
    "index": pl.Int64(), "split": pl.String(), "highlight": pl.Int64(), "light": pl.Int64(),
    "isolated": pl.Boolean(), "why_not": pl.String(), "bp_x_px": pl.Float64(), "bp_y_px": pl.Float64(),
    "x_mm": pl.Float64(), "y_mm": pl.Float64(), "z_mm": pl.Float64(), "normal_x": pl.Float64(),
    "normal_y": pl.Float64(), "normal_z": pl.Float64(), "distance_mm": pl.Float64(), "kd_min": pl.Float64(),
    "kd_max": pl.Float64(), "peak_snr": pl.Float64(),
}  # fmt: skip

_ESTIMATE_SCHEMA = {"index": pl.Int64(), "split": pl.String(), **SCHEMA}
_LEFT_OUT = ("experiment", "label", "setting", "realisation")
"""Columns of an experiment's results that say nothing here."""


def shard_metadata(folder: Path, name: str) -> Iterator[tuple[dict[str, Any], int, int]]:
    """Give the metadata of a shard's samples, with offset and size."""
    with (folder / name).open("rb") as file:
        begin = 0
        for sample in samples(file, check=False):
            yield sample.meta, begin, sample.end - begin
            begin = sample.end


def make_tables(plan: Plan, folder: Path) -> dict[str, pl.DataFrame]:
    """Make the tables from the shards; rows in the order of the samples."""
    made: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    for shard in plan.shards:
        for meta, offset, size in shard_metadata(folder, shard.name):
            made[SAMPLES].append(_sample(meta, shard.name, offset, size))
            made[HIGHLIGHTS] += _highlights(meta)
            made[ESTIMATES] += [{**row, "index": meta["index"], "split": meta["split"]} for row in meta["estimates"]]
    schemas = {
        SAMPLES: _SAMPLE_SCHEMA,
        HIGHLIGHTS: _HIGHLIGHT_SCHEMA,
        ESTIMATES: {key: kind for key, kind in _ESTIMATE_SCHEMA.items() if key not in _LEFT_OUT},
    }
    return {name: _frame(rows, schemas[name]) for name, rows in made.items()}


def _frame(rows: list[dict[str, Any]], schema: dict[str, Any]) -> pl.DataFrame:
    columns = {key: [row.get(key) for row in rows] for key in schema}
    # Stable: rows of one sample stay in their order.
    return pl.DataFrame(columns, schema=schema, strict=False).sort("index", maintain_order=True)


def write_tables(plan: Plan, folder: Path) -> None:
    """Write the tables."""
    for name, table in make_tables(plan, folder).items():
        write_atomically(folder / name, table.write_parquet)


def _sample(meta: dict[str, Any], shard: str, offset: int, size: int) -> dict[str, Any]:
    anatomy = meta["anatomy"]
    return {
        **{key: meta[key] for key in ("index", "key", "split", "attempt", "full_scale", "depth_scale_mm")},
        "shard": shard,
        "offset": offset,
        "bytes": size,
        "family": anatomy["family"],
        "surface": anatomy["surface"],
        "anatomy": anatomy["number"],
        "anatomy_seed": anatomy["seed"],
        "width": meta["camera"]["width"],
        "height": meta["camera"]["height"],
        "n_highlights": len(meta["highlights"]),
        "n_isolated": sum(highlight["isolated"] for highlight in meta["highlights"]),
        "n_detections": len(meta["detections"]),
        "drawn": json.dumps(meta["drawn"], sort_keys=True),
    }


def _highlights(meta: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for number, highlight in enumerate(meta["highlights"]):
        yield {
            "index": meta["index"],
            "split": meta["split"],
            "highlight": number,
            **{key: highlight[key] for key in ("light", "isolated", "why_not", "distance_mm", "kd_min", "kd_max")},
            "peak_snr": highlight["peak_snr"],
            **dict(zip(("bp_x_px", "bp_y_px"), highlight["bp_px"], strict=True)),
            **dict(zip(("x_mm", "y_mm", "z_mm"), highlight["position_mm"], strict=True)),
            **dict(zip(("normal_x", "normal_y", "normal_z"), highlight["normal"], strict=True)),
        }
