"""Figures of a run's rows by cell, and the hash of each cell's results."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import polars as pl

from simtest.conventions import MOTION_COLUMNS, ON_INSTRUMENT
from simtest.nightly.gate.quantities import COVERED, IS_TRUE, RATIO_OFF
from simtest.nightly.records import CELL, Cell, Figure, figure_table
from simtest.runtime.statistics import mean_interval, share_interval
from simtest.validation.columns import SCHEMA
from simtest.validation.statistics import figures, units

DIGEST_KEYS = ("realisation", "true_id", "specularity", "seed")
"""Order of the rows within a cell."""

DIGEST_NUMBERS = tuple(
    name for name, dtype in SCHEMA.items() if dtype != pl.String() and name not in ("realisation", *DIGEST_KEYS)
)
"""Result columns that are hashed, in this order, beside keys and status: all numbers."""

DIGEST_NAMES = ("status", "laws", "target", "isovalues", "reflectance")
"""Columns of names that are hashed. Flags are hashed of answers: those of failures are messages."""

PLAIN_FIGURES = ("rms_deg", "std_deg", "median_deg", "p95_deg", "max_deg", "mean_oracle_deg", "mean_base_deg")
"""Figures of `simtest.validation.statistics.Figures` that are published as they are."""


Frames = Mapping[tuple[str, str], int]
"""Number of frames by experiment and setting, those without a row included."""


def setting_figures(rows: pl.DataFrame, frames: Frames | None = None) -> pl.DataFrame:
    """Compute the figures of a run's rows by cell.

    Parameters
    ----------
    rows : polars.DataFrame
        Columns of `simtest.validation.columns.SCHEMA`.
    frames : mapping, optional
        How many frames were taken. Without it frames without a row, in which nothing is found and nothing is isolated,
        are not known, and false detections are divided by those that have one.

    Returns
    -------
    polars.DataFrame
        Columns `FIGURES`, in the order of the rows: of each cell `frames`, `n` (true highlights),
        `n_ok`, `failed`, `missed`, `unanswered` (shares of n), `false` (detections a frame), `mean_deg`, `rms_deg`,
        `std_deg`, `median_deg`, `p95_deg`, `max_deg`, `mean_oracle_deg`, `mean_base_deg`, `mean_penalised_deg`,
        `coverage95`, `axis_ratio` (mean deviation from the law over the law, at most 1 a row) and `axis_ratio_median`.
        Unknown figures are left out.
    """
    # Where surfaces share a setting's name, each has some of its frames.
    shared = rows.group_by("experiment", "setting").agg(pl.col("surface").n_unique()).filter(pl.col("surface") > 1)
    several = set(shared.select("experiment", "setting").iter_rows())
    known = {key: count for key, count in (frames or {}).items() if key not in several}
    cells, hashes = rows.group_by(CELL, maintain_order=True), digests_of(rows)
    return figure_table(
        figure
        for cell, own in ((Cell(*names), own) for names, own in cells)
        for figure in _cell_figures(cell, own, known.get((cell.experiment or "", cell.setting or ""), 0), hashes[cell])
    )


def _cell_figures(cell: Cell, rows: pl.DataFrame, taken: int, hashed: str) -> Iterator[Figure]:
    """Yield the known figures of one cell, of which so many frames are known to have been taken."""

    def figure(
        quantity: str, unit: str, value: float | None, n: int,
        interval: tuple[float | None, float | None] = (None, None),
    ) -> Iterator[Figure]:  # fmt: skip
        # A result that is no number makes a figure of its cell unknown.
        value, low, high = (float(v) if v is not None and np.isfinite(v) else None for v in (value, *interval))
        if value is not None:
            yield Figure(cell, quantity, unit, value, low, high, n, hashed)

    def share(quantity: str, of: pl.DataFrame, hits: pl.Expr) -> Iterator[Figure]:
        held = of.select(hits.fill_null(False).alias("hit"))["hit"].to_numpy()
        count, n = int(held.sum()), len(held)
        return figure(quantity, "", count / n, n, share_interval(held, *units(of)))

    # Counts and shares
    found, frames = figures(rows), max(taken, rows["realisation"].n_unique())
    n, n_ok = found.n, found.n_ok
    yield from figure("frames", "", frames, frames)
    yield from figure("n", "", n, n)
    yield from figure("n_ok", "", n_ok, n)
    if n:
        true, missed = rows.filter(IS_TRUE), pl.col("status") == "missed"
        yield from share("failed", true, ~missed & (pl.col("status") != "ok"))
        yield from share("missed", true, missed)
        yield from share("unanswered", true, pl.col("status") != "ok")
    yield from figure("false", "a frame", found.n_false / frames, frames)
    # Errors
    yield from figure("mean_deg", "deg", found.mean_deg, n_ok, found.ci95_deg)
    for name in PLAIN_FIGURES:
        yield from figure(name, "deg", getattr(found, name), n_ok)
    yield from figure("mean_penalised_deg", "deg", found.mean_penalised_deg, n)
    if found.n_instrument is not None:
        yield from figure("n_instrument", "", found.n_instrument, rows.height)
    if found.coverage95 is not None:
        with_region = rows.filter(IS_TRUE & (pl.col("status") == "ok") & pl.col("mahalanobis2").is_not_null())
        yield from share("coverage95", with_region, pl.col("mahalanobis2") <= COVERED)
    # Axis ratios against their law
    known = rows.with_columns(off=RATIO_OFF).drop_nulls("off")
    if known.height:
        off = known["off"].to_numpy()
        yield from figure("axis_ratio", "", float(np.mean(off)), len(off), mean_interval(off, *units(known)))
        yield from figure("axis_ratio_median", "", float(np.median(off)), len(off))


def digest(rows: pl.DataFrame) -> str:
    """Hash the results of one cell; see `digests_of`."""
    nameless = rows.with_columns(pl.lit("").alias(name) for name in CELL)
    return digests_of(nameless).get(Cell(), "")


def digests_of(rows: pl.DataFrame) -> dict[Cell, str]:
    """Hash each cell's results, rows in any order: equal for two runs exactly where all numbers are the same bytes.

    SHA-256, hexadecimal, over the cell's rows sorted by `DIGEST_KEYS`: which entries are null, the keys as int64, the
    numbers as float64, little-endian, the names, and the flags of answers. A column that is absent counts as null. What
    motion told is hashed in the cells that have it, and which detections show an instrument where one does.
    """
    held = rows.sort(*CELL, *DIGEST_KEYS, nulls_last=True)
    parts: list[np.ndarray] = []
    for names, kind, dtype in ((DIGEST_KEYS, pl.Int64, "<i8"), (DIGEST_NUMBERS, pl.Float64, "<f8")):
        parts += _nulls_and_values(held, names, kind, dtype)
    of_motion = _nulls_and_values(held, MOTION_COLUMNS, pl.Float64, "<f8")
    on_instrument = _nulls_and_values(held, (ON_INSTRUMENT,), pl.Int64, "<i8")[1]
    flags = pl.when(pl.col("status") == "ok").then(_column(held, "flags")).alias("flags")
    texts = held.select(*(_column(held, name).alias(name) for name in DIGEST_NAMES), flags).fill_null("").rows()
    cells = held.with_row_index("row").group_by(CELL, maintain_order=True).agg(first="row").rows()
    made = {}
    for *cell, index in cells:
        own = slice(index[0], index[-1] + 1)
        found = hashlib.sha256(f"{len(index)} {DIGEST_KEYS} {DIGEST_NUMBERS} {DIGEST_NAMES}".encode())
        optional = [*(() if of_motion[0][own].all() else of_motion)]
        optional += [on_instrument] if on_instrument[own].any() else []
        for part in (*parts, *optional):
            found.update(part[own].tobytes())
        found.update(repr(texts[own]).encode())
        made[Cell(*cell)] = found.hexdigest()
    return made


def _nulls_and_values(
    table: pl.DataFrame, names: Sequence[str], kind: type[pl.DataType], dtype: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return which entries of some columns are null, and the values, as arrays of shape (rows, columns)."""
    chosen = table.select(_column(table, name).cast(kind).alias(name) for name in names)
    nulls = np.ascontiguousarray(chosen.select(pl.all().is_null()).to_numpy())
    return nulls, np.ascontiguousarray(chosen.fill_null(0).to_numpy(), dtype=dtype)


def _column(table: pl.DataFrame, name: str) -> pl.Expr:
    return pl.col(name) if name in table.columns else pl.lit(None)
