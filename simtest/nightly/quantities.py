"""What rows tell: the quantities that the gate tests, each a number of a row, and the figures and hash of a cell."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from simtest.conventions import MOTION, MOTION_COLUMNS, ON_INSTRUMENT
from simtest.nightly.records import CELL, FIGURES, Cell
from simtest.runtime import chi_squared
from simtest.runtime.statistics import CONFIDENCE, mean_interval, share_interval
from simtest.validation.columns import BUDGET_COLUMNS, SCHEMA
from simtest.validation.statistics import PENALTY_DEG, figures, is_false, units

COVERED = chi_squared.quantile(CONFIDENCE, 2)
"""Squared Mahalanobis distance of the border of a 95 % region."""

WORST_RATIO = 1.0
"""A larger relative deviation of an axis ratio or a gain counts as this: near a true value of 0 the ratio of the two
means nothing."""

OLDEST_COLUMNS = (
    "specularity", "true_id", "seed", "status", "error_deg", "mahalanobis2", "axis_ratio", "axis_ratio_law",
)  # fmt: skip
"""Columns that every baseline has, beside those that name a row: cell and realisation."""

RESULT_COLUMNS = (
    *OLDEST_COLUMNS, "flags", "target", "visible_id", "error_oracle_deg", "error_base_deg", "error_look_deg",
    "error_law_deg", "cov_11", "cov_22", "gain_error", "gain_oracle_error", "direction_error_deg", "eps_over_d",
    "peak_snr", "distance_mm", "kd_min", "kd_max", "normal_x", "normal_y", "normal_z", *BUDGET_COLUMNS,
)  # fmt: skip
"""Columns that `compare` reads, beside those that name a row: cell and realisation."""

OPTIONAL_COLUMNS: dict[str, pl.DataType] = {
    ON_INSTRUMENT: pl.Boolean(),
    **{f"motion_{kind}_{i}": pl.Float64() for kind in ("sign", "gain") for i in (1, 2)},
}
"""Columns that `compare` reads too, by type: results have them only where a scene has instruments, or further views."""

PENALISED = "mean_penalised_deg"
"""Mean error with `PENALTY_DEG` for unanswered highlights."""

IS_TRUE = pl.col("true_id").is_not_null()

ANSWERED = IS_TRUE & (pl.col("status") == "ok") & pl.col("error_deg").is_finite().fill_null(False)
"""Rows of true highlights with a normal; a result whose error is no number counts as unanswered."""

RATIO_OFF = (
    pl.when(
        ANSWERED
        & pl.all_horizontal(pl.col("axis_ratio", "axis_ratio_law").is_finite())
        & (pl.col("axis_ratio_law") > 0)
    )
    .then((pl.col("axis_ratio") / pl.col("axis_ratio_law") - 1).abs().clip(upper_bound=WORST_RATIO))
    .otherwise(None)
)
"""Relative deviation of a result's axis ratio from the law."""

REGION_DEG = (pl.col("cov_11") + pl.col("cov_22")).sqrt().degrees()
"""Size of the stated uncertainty: the square root of the covariance's trace, deg."""


def _of_answers(of: str | pl.Expr) -> pl.Expr:
    value = pl.col(of) if isinstance(of, str) else of
    return pl.when(ANSWERED & value.is_finite()).then(value)


def _of_true(name: str) -> pl.Expr:
    return pl.when(IS_TRUE & pl.col(name).is_finite()).then(pl.col(name))


_SIGNS = [pl.col(f"motion_sign_{i}").fill_null(0) for i in (1, 2)]
_TOLD = sum(((sign != 0).cast(pl.Float64) for sign in _SIGNS), pl.lit(0.0))
_WRONG = sum(
    ((sign * pl.col(f"motion_gain_{i}") < 0).fill_null(False).cast(pl.Float64) for i, sign in enumerate(_SIGNS, 1)),
    pl.lit(0.0),
)


@dataclass(frozen=True)
class Quantity:
    """A compared quantity.

    `span` is the range of a row's harm, where most rows are at one of its ends: two invented units then keep
    small samples, which may all be alike by chance, from showing no variance. It is 0 where rows differ by nature.
    """

    unit: str
    relative: float  # margin as a share of the baseline
    absolute: float  # margin in the unit; the larger of the two counts
    words: str = ""  # names it in a sentence
    value: pl.Expr | None = None  # harm or level of a row; null where it has none; None: counted by frames
    span: float = 0.0
    falls: bool = False  # whether the figure shown is 1 less the harm: coverage is worse where it falls
    level: bool = False  # whether neither side is better: a change either way has to be explained
    same_as: str = ""  # quantity that it is in most cells, where it would be tested twice
    mixed: bool = False  # whether it counts what some results have and others lack: compared where both occur

    @property
    def scale_floor(self) -> float:
        """Baseline at which both margins are equal; 0 where there is no relative one."""
        return self.absolute / self.relative if self.relative else 0.0


def _error(words: str, value: pl.Expr, **more: Any) -> Quantity:
    """Return an angle, of which 2 % and 0.002 deg do no harm."""
    return Quantity("deg", 0.02, 0.002, words, value, **more)


def _ratio(words: str, value: pl.Expr, absolute: float = 0.002, **more: Any) -> Quantity:
    """Return a ratio, of which 2 % and so much do no harm."""
    return Quantity("", 0.02, absolute, words, value, **more)


def _share(words: str, value: pl.Expr, **more: Any) -> Quantity:
    """Return a share of highlights, of which 0.02 do no harm."""
    return Quantity("", 0.0, 0.02, words, value.cast(pl.Float64), **{"span": 1.0, **more})


_ERROR = pl.when(ANSWERED).then(pl.col("error_deg"))
_DISTANCE = pl.col("mahalanobis2")

QUANTITIES = {
    "mean_deg": _error("the mean error", _ERROR),
    # Every true highlight has a value.
    PENALISED: _error("the mean error, 90 deg for each unanswered highlight,",
                      pl.when(ANSWERED).then(pl.col("error_deg")).when(IS_TRUE).then(PENALTY_DEG),
                      span=PENALTY_DEG, same_as="mean_deg"),
    "oracle_deg": _error("the mean error of the better candidate", _of_answers("error_oracle_deg"), same_as="mean_deg"),
    "base_deg": _error("the mean error against the base's normal", _of_answers("error_base_deg"), same_as="mean_deg"),
    "look_deg": _error("the mean error where the estimate looks", _of_answers("error_look_deg"), same_as="mean_deg"),
    "law_deg": _error("the error that the law predicts", _of_answers("error_law_deg"), level=True),
    "axis_ratio": _ratio("the axis ratio's deviation from its law", RATIO_OFF),
    "axis_ratio_level": _ratio("the mean axis ratio", _of_answers("axis_ratio"), level=True),
    "gain_error": _ratio("the error of the gains 1 + d k", _of_answers("gain_error").clip(upper_bound=WORST_RATIO)),
    "gain_oracle_error": _ratio("the error of the better gains 1 + d k",
                                _of_answers("gain_oracle_error").clip(upper_bound=WORST_RATIO), same_as="gain_error"),
    "direction_deg": _error("the error of the curvature's direction", _of_answers("direction_error_deg")),
    "eps_over_d": _ratio("the light's distance over the surface's", _of_true("eps_over_d"), 1e-4, level=True),
    "peak_snr": _ratio("the highlights' peak over the noise", _of_true("peak_snr"), 0.1, level=True),
    "region_deg": _error("the size of the reported regions", _of_answers(REGION_DEG), level=True),
    "noise_part_deg": _error("the noise's part of the reported uncertainty", _of_answers("budget_noise_deg"),
                             level=True),
    # Uniform over 0 to 1 where regions are right; near 1 where they are too wide, near 0 where they are too narrow.
    "truth_in_region": _share("the truth's place in the reported regions (0.5 where they are right, 1 where too wide)",
                              _of_answers((-_DISTANCE / 2).exp()), span=0.0, level=True),
    "unanswered": _share("the share of unanswered highlights", pl.when(IS_TRUE).then(~ANSWERED)),
    "missed": _share("the share of missed highlights", pl.when(IS_TRUE).then(pl.col("status") == "missed"), level=True,
                     same_as="unanswered"),
    "false": Quantity("a frame", 0.0, 0.02, "the number of false detections a frame", span=1.0),
    # Outside too: a distance that is no number or infinite, as in `simtest.validation.statistics.figures`.
    "coverage95": _share("the share of true normals inside the 95 % region",
                         pl.when(ANSWERED & _DISTANCE.is_not_null()).then(
                             ~(_DISTANCE.is_finite() & (_DISTANCE <= COVERED))), falls=True),
    "no_region": _share("the share of answers without a region", pl.when(ANSWERED).then(_DISTANCE.is_null()),
                        mixed=True),
    "no_axis_ratio": _share("the share of answers without an axis ratio to judge",
                            pl.when(ANSWERED).then(RATIO_OFF.is_null()), mixed=True),
    "no_law": _share("the share of answers without a law",
                     pl.when(ANSWERED).then(~pl.col("error_law_deg").is_finite().fill_null(False)), mixed=True),
    "flagged": _share("the share of answers with a flag", pl.when(ANSWERED).then(pl.col("flags").fill_null("") != ""),
                      level=True, mixed=True),
    # Signs of curvatures that motion tells of a highlight: the wrong ones among them.
    "wrong_sign": _share("the share of wrong signs among those that motion told",
                         pl.when(IS_TRUE & (pl.col("estimator") == MOTION) & (_TOLD > 0)).then(_WRONG / _TOLD)),
}  # fmt: skip
"""The compared quantities by name, with the differences that do no harm."""

HARMS = {name: quantity.value for name, quantity in QUANTITIES.items() if quantity.value is not None}
MIXED = [name for name, quantity in QUANTITIES.items() if quantity.mixed]
SAME_AS = {name: quantity.same_as for name, quantity in QUANTITIES.items() if quantity.same_as}

TWICE = 1e-6
"""Values of two quantities that differ by a smaller share are the same: a baseline keeps some in single precision."""

KEY = (*CELL, "realisation", "true_id", "seed")
"""Columns that name the row of a true highlight in two runs."""


def harms(rows: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Compute the values in some cells: `cell`, `realisation`, `true_id`, `seed`, `quantity`, `value`.

    A row for each true highlight and quantity, and one for each frame's false detections, with a null `true_id`.
    `cells` numbers the names of the cells as `cell`; rows of others are left out.
    """
    own = with_optional(rows).join(cells, on=CELL, how="inner", maintain_order="left")
    index = ["cell", "realisation", "true_id", "seed"]
    true = own.filter(IS_TRUE).select(*index, **HARMS)
    true = true.unpivot(list(HARMS), index=index, variable_name="quantity").drop_nulls("value")
    count = is_false(own).sum().cast(pl.Float64)
    false = own.group_by("cell", "realisation", "seed", maintain_order=True).agg(
        pl.lit(None, own.schema["true_id"]).alias("true_id"), quantity=pl.lit("false"), value=count
    )
    return pl.concat([true, false.select(true.columns)])


def with_optional(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows with the columns of `OPTIONAL_COLUMNS` that they lack, as null."""
    return rows.with_columns(
        pl.lit(None, dtype).alias(name) for name, dtype in OPTIONAL_COLUMNS.items() if name not in rows.columns
    )


def told_twice(rows: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return the quantities of `SAME_AS` that are the other one in all rows of a cell: `cell`, `quantity`."""
    own = with_optional(rows).join(cells, on=CELL, how="inner").filter(IS_TRUE).select("cell", **HARMS)
    same = [
        ((pl.col(name) - pl.col(other)).abs().fill_null(0.0) <= TWICE * (1 + pl.col(other).abs().fill_null(0.0))).all()
        .and_((pl.col(name).is_null() == pl.col(other).is_null()).all()).alias(name)
        for name, other in SAME_AS.items()
    ]  # fmt: skip
    found = own.group_by("cell").agg(same).unpivot(list(SAME_AS), index="cell", variable_name="quantity")
    return found.filter("value").select("cell", "quantity")


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
    """Compute the figures of a run's rows by cell, with the columns `FIGURES`; unknown ones are left out.

    `frames` says how many frames were taken. Without it frames without a row, in which nothing is found and nothing is
    isolated, are not known, and false detections are divided by those that have one.
    """
    # Where surfaces share a setting's name, each has some of its frames.
    shared = rows.group_by("experiment", "setting").agg(pl.col("surface").n_unique()).filter(pl.col("surface") > 1)
    several = set(shared.select("experiment", "setting").iter_rows())
    known = {key: count for key, count in (frames or {}).items() if key not in several}
    cells, hashes = rows.group_by(CELL, maintain_order=True), digests_of(rows)
    made: list[tuple[Any, ...]] = []
    for names, own in cells:
        cell = Cell(*names)
        taken = known.get((cell.experiment or "", cell.setting or ""), 0)
        made += ((*cell, *figure, hashes[cell]) for figure in _cell_figures(own, taken))
    return pl.DataFrame(made, schema=FIGURES, orient="row")


Figure = tuple[str, str, float, float | None, float | None, int]
"""Quantity, unit, value, both ends of its interval, and the number that it is of."""


def _cell_figures(rows: pl.DataFrame, taken: int) -> Iterator[Figure]:
    """Yield the known figures of one cell, of which so many frames are known to have been taken."""

    def figure(
        quantity: str, unit: str, value: float | None, n: int,
        interval: tuple[float | None, float | None] = (None, None),
    ) -> Iterator[Figure]:  # fmt: skip
        # A result that is no number makes a figure of its cell unknown.
        value, low, high = (float(v) if v is not None and np.isfinite(v) else None for v in (value, *interval))
        if value is not None:
            yield quantity, unit, value, low, high, n

    def shares(of: pl.DataFrame, **hits: pl.Expr) -> Iterator[Figure]:
        groups = units(of)
        for hit in of.select(is_hit.fill_null(False).alias(quantity) for quantity, is_hit in hits.items()):
            held = hit.to_numpy()
            count, n = int(held.sum()), len(held)
            yield from figure(hit.name, "", count / n, n, share_interval(held, *groups))

    found, frames = figures(rows), max(taken, rows["realisation"].n_unique())
    n, n_ok = found.n, found.n_ok
    # Counts and shares
    yield from figure("frames", "", frames, frames)
    yield from figure("n", "", n, n)
    yield from figure("n_ok", "", n_ok, n)
    if n:
        true, missed = rows.filter(IS_TRUE), pl.col("status") == "missed"
        unanswered = pl.col("status") != "ok"
        yield from shares(true, failed=~missed & unanswered, missed=missed, unanswered=unanswered)
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
        yield from shares(with_region, coverage95=pl.col("mahalanobis2") <= COVERED)
    # Axis ratios against their law
    known = rows.with_columns(off=RATIO_OFF).drop_nulls("off")
    if known.height:
        off = known["off"].to_numpy()
        yield from figure("axis_ratio", "", float(np.mean(off)), len(off), mean_interval(off, *units(known)))
        yield from figure("axis_ratio_median", "", float(np.median(off)), len(off))


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
