"""Tables beside the shards: samples, highlights and estimates, all made from the metadata in the shards."""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_type_hints

import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.dataset.metadata import EstimateMeta, SampleMeta
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.shard import PART, samples
from simtest.runtime.files import write_atomically
from simtest.validation.columns import SCHEMA

SAMPLES, HIGHLIGHTS, ESTIMATES = "index.parquet", "highlights.parquet", "estimates.parquet"
TABLES = (SAMPLES, HIGHLIGHTS, ESTIMATES)

_KINDS = {int: pl.Int64(), float: pl.Float64(), str: pl.String(), bool: pl.Boolean()}
_LEFT_OUT = ("experiment", "label", "setting", "realisation")
"""Columns of an experiment's results that are constant here."""

_ESTIMATE_SCHEMA = {
    "index": pl.Int64(),
    "split": pl.String(),
    **{name: kind for name, kind in SCHEMA.items() if name not in _LEFT_OUT},
}


@dataclass(frozen=True)
class SampleRow:
    """Row of index.parquet: a sample, and its bytes in the shard.

    Parameters
    ----------
    index, key, split : int, str, str
        Number of the sample, its key in the shard, and the split that it belongs to.
    shard, offset, bytes : str, int, int
        File of the shard, and where in it the sample's members start and how long they are, bytes.
    family, surface, anatomy, anatomy_seed : int, str, int, int or None
        Number of the recipe's family, kind of surface, number of the anatomy, and its seed.
    attempt : int
        Which draw was taken, from 0.
    width, height : int
        Of the frame, px.
    full_scale : float
        Radiance of the picture's largest value.
    depth_scale_mm : float
        Unit of the stored depth, mm.
    n_highlights, n_isolated, n_detections : int
        True highlights, isolated ones of these, and detections.
    drawn : str
        The drawn values by key path, as JSON.
    instrument_share : float or None
        Share of the pixels that show an instrument; None where the scene lists none.
    """

    index: int
    key: str
    split: str
    shard: str
    offset: int
    bytes: int
    family: int
    surface: str
    anatomy: int
    anatomy_seed: int | None
    attempt: int
    width: int
    height: int
    full_scale: float
    depth_scale_mm: float
    n_highlights: int
    n_isolated: int
    n_detections: int
    drawn: str
    instrument_share: float | None

    @classmethod
    def of(cls, meta: SampleMeta, shard: str, offset: int, size: int) -> "SampleRow":
        """Return the row of a sample."""
        anatomy, camera, highlights = meta["anatomy"], meta["camera"], meta["highlights"]
        isolated = sum(highlight["isolated"] for highlight in highlights)
        return cls(
            meta["index"], meta["key"], meta["split"], shard, offset, size,
            anatomy["family"], anatomy["surface"], anatomy["number"], anatomy["seed"], meta["attempt"],
            camera["width"], camera["height"], meta["full_scale"], meta["depth_scale_mm"],
            len(highlights), isolated, len(meta["detections"]), json.dumps(meta["drawn"], sort_keys=True),
            meta.get("instrument_share"),
        )  # fmt: skip


@dataclass(frozen=True)
class HighlightRow:
    """Row of highlights.parquet: a true highlight of a sample; camera frame.

    Parameters
    ----------
    index, split : int, str
        The sample, and its split.
    highlight, light : int
        Number of the highlight in the sample, and of the light that makes it.
    isolated, why_not : bool, str or None
        Whether it is isolated, and the first condition that fails where it is not.
    bp_x_px, bp_y_px : float
        Its brightest point, px.
    x_mm, y_mm, z_mm : float
        Its point on the surface, mm.
    normal_x, normal_y, normal_z : float
        Unit normal of the fine surface there.
    distance_mm : float
        Distance of that point from the camera, mm.
    kd_min, kd_max : float
        Distance times principal curvature of the fine surface.
    peak_snr : float or None
        Peak above its surroundings over the noise there; None without noise.
    normal_base_x, normal_base_y, normal_base_z : float
        Unit normal of the base, without the relief.
    kd_min_base, kd_max_base : float
        Distance times principal curvature of the base.
    pool : bool
        Whether the point lies in a pool of the film.
    """

    index: int
    split: str
    highlight: int
    light: int
    isolated: bool
    why_not: str | None
    bp_x_px: float
    bp_y_px: float
    x_mm: float
    y_mm: float
    z_mm: float
    normal_x: float
    normal_y: float
    normal_z: float
    distance_mm: float
    kd_min: float
    kd_max: float
    peak_snr: float | None
    normal_base_x: float
    normal_base_y: float
    normal_base_z: float
    kd_min_base: float
    kd_max_base: float
    pool: bool

    @classmethod
    def of(cls, meta: SampleMeta) -> "Iterator[HighlightRow]":
        """Yield the rows of a sample."""
        for number, found in enumerate(meta["highlights"]):
            (bp_x, bp_y), (x, y, z), normal = found["bp_px"], found["position_mm"], found["normal"]
            base = found["normal_base"]
            yield cls(
                meta["index"], meta["split"], number, found["light"], found["isolated"], found["why_not"],
                bp_x, bp_y, x, y, z, normal[0], normal[1], normal[2],
                found["distance_mm"], found["kd_min"], found["kd_max"], found["peak_snr"],
                base[0], base[1], base[2], found["kd_min_base"], found["kd_max_base"], found["pool"],
            )  # fmt: skip


def make_tables(plan: Plan, folder: Path) -> dict[str, pl.DataFrame]:
    """Make the tables from the shards; rows in the order of the samples."""
    return _joined(shard_tables(plan, folder, shard) for shard in plan.shards)


def shard_tables(plan: Plan, folder: Path, shard: Shard) -> dict[str, pl.DataFrame]:
    """Make the rows of one shard, from its metadata."""
    rows: list[SampleRow] = []
    highlights: list[HighlightRow] = []
    estimates: list[EstimateMeta] = []
    for meta, offset, size in _stored(folder / shard.name):
        rows.append(SampleRow.of(meta, shard.name, offset, size))
        highlights += HighlightRow.of(meta)
        estimates += [{**row, "index": meta["index"], "split": meta["split"]} for row in meta["estimates"]]
    content: dict[str, Iterable[Mapping[str, Any]]] = {
        SAMPLES: map(vars, rows),
        HIGHLIGHTS: map(vars, highlights),
        ESTIMATES: estimates,
    }
    return {name: _table(content[name], schema) for name, schema in _schemas(plan).items()}


def _schemas(plan: Plan) -> dict[str, dict[str, pl.DataType]]:
    """Return the columns of each table of a dataset."""
    of_samples, of_estimates = _schema(SampleRow), dict(_ESTIMATE_SCHEMA)
    if plan.has_instruments:
        of_estimates[ON_INSTRUMENT] = pl.Boolean()
    else:
        del of_samples["instrument_share"]
    return {SAMPLES: of_samples, HIGHLIGHTS: _schema(HighlightRow), ESTIMATES: of_estimates}


def _stored(path: Path) -> Iterator[tuple[SampleMeta, int, int]]:
    """Yield the metadata of a shard's samples, each with offset and size."""
    with path.open("rb") as file:
        begin = 0
        for sample in samples(file, check=False):
            yield sample.meta, begin, sample.end - begin
            begin = sample.end


def _schema(record: type) -> dict[str, pl.DataType]:
    """Return a table's columns from the fields of its rows; each is of one type, and may be missing."""
    kinds = {name: get_args(kind) or (kind,) for name, kind in get_type_hints(record).items()}
    return {name: _KINDS[next(kind for kind in found if kind is not NoneType)] for name, found in kinds.items()}


def _table(rows: Iterable[Mapping[str, Any]], schema: Mapping[str, pl.DataType]) -> pl.DataFrame:
    rows = list(rows)
    columns = {name: [row.get(name) for row in rows] for name in schema}
    return pl.DataFrame(columns, schema=schema, strict=False)


def _joined(parts: Iterable[Mapping[str, pl.DataFrame]]) -> dict[str, pl.DataFrame]:
    """Join the rows of all shards, in the order of the samples."""
    of_shards = list(parts)
    # Stable: rows of one sample stay in their order.
    return {
        name: pl.concat([part[name] for part in of_shards]).sort("index", maintain_order=True).rechunk()
        for name in TABLES
    }


def write_shard_tables(plan: Plan, folder: Path, shard: Shard) -> None:
    """Write the rows of a finished shard beside it, for `write_tables`; done by the worker that made the shard."""
    for name, table in shard_tables(plan, folder, shard).items():
        write_atomically(_part(folder, shard, name), table.write_parquet)


def write_tables(plan: Plan, folder: Path) -> None:
    """Write the tables, from the rows that workers have written or else from the shards."""
    for name, table in _joined(_written(plan, folder, shard) for shard in plan.shards).items():
        write_atomically(folder / name, table.write_parquet)


def _written(plan: Plan, folder: Path, shard: Shard) -> dict[str, pl.DataFrame]:
    """Read the rows of a shard; make them anew where they are missing or cannot be read."""
    try:
        return {name: pl.read_parquet(_part(folder, shard, name)) for name in TABLES}
    except (OSError, pl.exceptions.PolarsError):
        return shard_tables(plan, folder, shard)


def _part(folder: Path, shard: Shard, name: str) -> Path:
    return folder / f"{shard.name}.{name}{PART}"
