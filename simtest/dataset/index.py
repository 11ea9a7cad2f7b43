"""Tables beside the shards: samples, highlights and estimates, all made from the metadata in the shards.

That of the samples is one file. The others have too many rows to be joined: they are folders of a file a shard.
"""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path

import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.dataset.metadata import HighlightMeta, SampleMeta
from simtest.dataset.plan import Plan, Shard
from simtest.dataset.reader import read_table
from simtest.dataset.shard import PART, samples
from simtest.runtime.files import make_folder, write_parquet
from simtest.simulation.highlights import NO_HIGHLIGHT, REMEDIES
from simtest.validation.columns import COLUMNS, NUMBER, TEXT, WHOLE, YES_NO, Column, Row, Value

SAMPLES, HIGHLIGHTS, ESTIMATES = "index.parquet", "highlights.parquet", "estimates.parquet"
TABLES = (SAMPLES, HIGHLIGHTS, ESTIMATES)
FOLDERS = (HIGHLIGHTS, ESTIMATES)

SAMPLE_COLUMNS = {
    "index": Column(WHOLE, "number of the sample, its key in the shard, and the split that it belongs to"),
    "key": Column(TEXT),
    "split": Column(TEXT),
    "shard": Column(TEXT, "file of the shard, and where in it the sample's members start and how long they are, bytes"),
    "offset": Column(WHOLE),
    "bytes": Column(WHOLE),
    "family": Column(WHOLE, "number of the recipe's family, kind of surface, number of the anatomy, and its seed"),
    "surface": Column(TEXT),
    "anatomy": Column(WHOLE),
    "anatomy_seed": Column(WHOLE),
    "attempt": Column(WHOLE, "which draw was taken, from 0"),
    "width": Column(WHOLE, "of the frame, px"),
    "height": Column(WHOLE),
    "full_scale": Column(NUMBER, "radiance of the picture's largest value"),
    "depth_scale_mm": Column(NUMBER, "unit of the stored depth, mm"),
    "n_highlights": Column(WHOLE, "true highlights, isolated ones of these, and detections"),
    "n_isolated": Column(WHOLE),
    "n_detections": Column(WHOLE),
    "drawn": Column(TEXT, "the drawn values by key path, as JSON"),
    "instrument_share": Column(NUMBER, "share of the pixels that show an instrument; null where the scene lists none"),
}
"""Columns of index.parquet: a row a sample."""

HIGHLIGHT_COLUMNS = {
    "index": Column(WHOLE, "the sample, and its split"),
    "split": Column(TEXT),
    "highlight": Column(WHOLE, "number of the highlight in the sample, and of the light that makes it"),
    "light": Column(WHOLE),
    "isolated": Column(YES_NO, "whether it is isolated, and the first condition that fails where it is not"),
    "why_not": Column(TEXT),
    "bp_x_px": Column(NUMBER, "its brightest point, px"),
    "bp_y_px": Column(NUMBER),
    "x_mm": Column(NUMBER, "its point on the surface, camera frame, mm"),
    "y_mm": Column(NUMBER),
    "z_mm": Column(NUMBER),
    "normal_x": Column(NUMBER, "unit normal of the fine surface there, camera frame"),
    "normal_y": Column(NUMBER),
    "normal_z": Column(NUMBER),
    "distance_mm": Column(NUMBER, "distance of that point from the camera, mm"),
    "kd_min": Column(NUMBER, "distance times principal curvature of the fine surface"),
    "kd_max": Column(NUMBER),
    "peak_snr": Column(NUMBER, "peak above its surroundings over the noise there; null without noise"),
    "normal_base_x": Column(NUMBER, "unit normal of the base, without the relief, camera frame"),
    "normal_base_y": Column(NUMBER),
    "normal_base_z": Column(NUMBER),
    "kd_min_base": Column(NUMBER, "distance times principal curvature of the base"),
    "kd_max_base": Column(NUMBER),
    "pool": Column(YES_NO, "whether the point lies in a pool of the film"),
}
"""Columns of highlights.parquet: a row a true highlight of a sample."""

ESTIMATE_COLUMNS = {"index": Column(WHOLE), "split": Column(TEXT)} | {
    name: column
    for name, column in COLUMNS.items()
    # constant here
    if name not in ("experiment", "label", "setting", "realisation")
}
"""Columns of estimates.parquet: a row of results."""


def _sample_row(meta: SampleMeta, shard: str, offset: int, size: int) -> tuple[Value, ...]:
    anatomy, camera, highlights = meta["anatomy"], meta["camera"], meta["highlights"]
    isolated = sum(highlight["isolated"] for highlight in highlights)
    return (
        meta["index"], meta["key"], meta["split"], shard, offset, size,
        anatomy["family"], anatomy["surface"], anatomy["number"], anatomy["seed"], meta["attempt"],
        camera["width"], camera["height"], meta["full_scale"], meta["depth_scale_mm"],
        len(highlights), isolated, len(meta["detections"]), json.dumps(meta["drawn"], sort_keys=True),
        meta.get("instrument_share"),
    )  # fmt: skip


def _highlight_row(meta: SampleMeta, number: int, truth: HighlightMeta) -> tuple[Value, ...]:
    return (
        meta["index"], meta["split"], number, truth["light"], truth["isolated"], truth["why_not"],
        *truth["bp_px"], *truth["position_mm"], *truth["normal"],
        truth["distance_mm"], truth["kd_min"], truth["kd_max"], truth["peak_snr"],
        *truth["normal_base"], truth["kd_min_base"], truth["kd_max_base"], truth["pool"],
    )  # fmt: skip


def table_file(shard: Shard, name: str) -> str:
    """Return the file of a shard's rows of a table: final in the table's folder, or waiting for `write_index`."""
    return f"{name}/{Path(shard.name).stem}.parquet" if name in FOLDERS else f"{shard.name}.{name}{PART}"


def shard_files(shard: Shard) -> tuple[str, ...]:
    """Return the files that stay of a shard: its own, and those of its rows."""
    return (shard.name, *(table_file(shard, name) for name in FOLDERS))


def make_tables(plan: Plan, folder: Path) -> Iterator[tuple[str, pl.DataFrame]]:
    """Make the tables of a finished dataset from its shards, one file after the other."""
    rows = []
    for shard in plan.shards:
        tables = shard_tables(plan, folder, shard)
        rows.append(tables[SAMPLES])
        yield from ((table_file(shard, name), tables[name]) for name in FOLDERS)
    yield SAMPLES, pl.concat(rows).sort("index")


def shard_tables(plan: Plan, folder: Path, shard: Shard) -> dict[str, pl.DataFrame]:
    """Make the rows of one shard, from its metadata."""
    rows: dict[str, list[Row]] = {name: [] for name in TABLES}
    begin = 0
    with (folder / shard.name).open("rb") as file:
        for sample in samples(file, check=False):
            meta = sample.meta
            values = _sample_row(meta, shard.name, begin, sample.end - begin)
            rows[SAMPLES].append(dict(zip(SAMPLE_COLUMNS, values, strict=True)))
            for number, truth in enumerate(meta["highlights"]):
                values = _highlight_row(meta, number, truth)
                rows[HIGHLIGHTS].append(dict(zip(HIGHLIGHT_COLUMNS, values, strict=True)))
            rows[ESTIMATES] += [{**row, "index": meta["index"], "split": meta["split"]} for row in meta["estimates"]]
            begin = sample.end
    columns = {SAMPLES: dict(SAMPLE_COLUMNS), HIGHLIGHTS: HIGHLIGHT_COLUMNS, ESTIMATES: dict(ESTIMATE_COLUMNS)}
    if plan.has_instruments:
        columns[ESTIMATES][ON_INSTRUMENT] = Column(YES_NO)
    else:
        del columns[SAMPLES]["instrument_share"]
    return {name: _table(rows[name], of) for name, of in columns.items()}


def _table(rows: list[Row], columns: Mapping[str, Column]) -> pl.DataFrame:
    schema = {name: column.dtype for name, column in columns.items()}
    return pl.DataFrame({name: [row.get(name) for row in rows] for name in columns}, schema=schema, strict=False)


def write_shard_tables(plan: Plan, folder: Path, shard: Shard) -> None:
    """Write the rows of a finished shard; done by the worker that made the shard."""
    for name, table in shard_tables(plan, folder, shard).items():
        path = folder / table_file(shard, name)
        make_folder(path.parent)
        write_parquet(path, table)


def write_index(plan: Plan, folder: Path) -> None:
    """Write the table of the samples, in their order, from the rows that workers have written or else the shards."""
    rows = (_read_rows(plan, folder, shard, SAMPLES) for shard in plan.shards)
    write_parquet(folder / SAMPLES, pl.concat(rows).sort("index").rechunk())


def _read_rows(plan: Plan, folder: Path, shard: Shard, name: str, columns: list[str] | None = None) -> pl.DataFrame:
    """Read a shard's rows of a table; make them anew where they are missing or cannot be read."""
    try:
        return pl.read_parquet(folder / table_file(shard, name), columns=columns)
    except (OSError, pl.exceptions.PolarsError):
        return shard_tables(plan, folder, shard)[name]


def shortfall(plan: Plan, folder: Path) -> str:
    """Return how many samples show too few isolated highlights, why, and what to change; empty where none does.

    A recipe that takes every frame is told where most show no highlight at all.
    """
    samples = read_table(folder / SAMPLES, ["index", "shard", "n_highlights", "n_isolated"])
    dataset = plan.dataset
    few = samples.filter(
        pl.col("n_isolated") < dataset.highlights if dataset.highlights else pl.col("n_highlights") == 0
    )
    if few.is_empty() or (not dataset.highlights and few.height <= samples.height / 2):
        return ""
    # Shard after shard: all highlights together are more than memory holds.
    lacking, others = set(few["shard"]), []
    for shard in (shard for shard in plan.shards if shard.name in lacking):
        rows = _read_rows(plan, folder, shard, HIGHLIGHTS, ["index", "isolated", "why_not", "peak_snr"])
        # That of the highlight which stands out most, as in `simtest views`.
        rows = rows.filter(~pl.col("isolated")).sort("peak_snr", descending=True, nulls_last=True)
        others.append(rows.unique("index", keep="first", maintain_order=True).select("index", "why_not"))
    reasons = few.join(pl.concat(others), on="index", how="left")["why_not"].fill_null(NO_HIGHLIGHT)
    counts = reasons.value_counts().sort("count", "why_not", descending=[True, False])
    text = f"{few.height} of {samples.height} samples show "
    if dataset.highlights:
        text += f"fewer isolated highlights than highlights = {dataset.highlights} asks for; the last of "
        text += f"tries = {dataset.tries} draws was taken"
    else:
        text += "no highlight"
    text += f" ({', '.join(f'{count}: {reason}' for reason, count in counts.iter_rows())})"
    if remedy := REMEDIES.get(counts["why_not"][0]):
        text += f"; {remedy}"
    if meshes := [path.name for path in plan.inputs if path.suffix != ".toml"]:
        text += f"; `simtest mesh check` says whether {', '.join(meshes)} is fine enough"
    return text
