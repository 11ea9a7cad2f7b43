"""Figures against rows: each published figure is computed anew from a run's own rows, by plain polars.

The code that makes the figures is not asked: a mean that became a median shows here on any night.
"""

import polars as pl

from simtest.nightly.gate.figures import digests_of
from simtest.nightly.gate.quantities import ANSWERED, COVERED, IS_TRUE, RATIO_OFF, is_false
from simtest.nightly.records import CELL
from simtest.validation.statistics import PENALTY_DEG

PUBLISHED = "published "
"""Begins the names of these comparisons."""

SAME = 1e-9
"""Two figures that differ by a smaller share are the same: sums may be taken in another order."""

FLOOR = 1e-2
"""Figures below it, such as a deviation of equal errors, are held to as much as this one."""

_SHARES = ("failed", "missed", "unanswered", "coverage95")
_SHA = r"^[0-9a-f]{64}$"


def unlike_rows(figures: pl.DataFrame, rows: pl.DataFrame) -> pl.DataFrame:
    """Compare a run's published figures with those that its rows give, as comparisons; equal ones are left out.

    `baseline` of a comparison is what the rows give, its method "rows". A figure that is not published is told where
    any other figure of its cell is. Hashes are compared too, as the quantity `published digest`.
    """
    own = figures.filter(pl.col("kind") == "setting", pl.col("value").is_not_null() | (pl.col("quantity") != "n"))
    if own.is_empty() or rows.is_empty():
        return pl.DataFrame()
    found = own.select(*CELL, "quantity", "unit", "n", "value")
    frames = found.filter(pl.col("quantity") == "frames").select(*CELL, frames="value")
    anew = _anew(rows, frames).join(found.select(CELL).unique(), on=CELL, how="semi", nulls_equal=True)
    key = (*CELL, "quantity")
    both = anew.join(
        found, on=key, how="full", coalesce=True, nulls_equal=True, suffix="_2", maintain_order="left_right"
    )
    both = both.filter(~pl.col("quantity").is_in(["frames", "n_instrument"]))
    unlike = both.filter(_differs(pl.col("value"), pl.col("value_2"))).with_columns(
        baseline=pl.col("value"), tonight=pl.col("value_2"), quantity=pl.concat_str(pl.lit(PUBLISHED), "quantity")
    )
    made = [unlike.select(*CELL, "quantity", pl.col("unit").fill_null(""), "n", "baseline", "tonight")]
    made.append(_other_digests(own, rows))
    return pl.concat(made, how="diagonal").with_columns(
        method=pl.lit("rows"), difference=pl.col("tonight") - pl.col("baseline"), margin=pl.lit(0.0),
        outcome=pl.lit("worse"),
    )  # fmt: skip


def _differs(was: pl.Expr, now: pl.Expr) -> pl.Expr:
    """Return where two numbers differ by more than rounding, or one of them is missing."""
    apart = (was - now).abs() > SAME * pl.max_horizontal(was.abs(), now.abs(), pl.lit(FLOOR))
    return apart.fill_null(False) | (was.is_null() != now.is_null())


def _other_digests(own: pl.DataFrame, rows: pl.DataFrame) -> pl.DataFrame:
    """Return the cells whose hash is not that of their rows."""
    stated = own.filter(pl.col("digest").str.contains(_SHA)).select(*CELL, "digest").unique(CELL)
    held = dict(zip(stated.select(CELL).iter_rows(), stated["digest"], strict=True))
    other = [cell for cell, found in digests_of(rows).items() if held.get(cell, found) != found]
    names = pl.DataFrame(other, schema=dict.fromkeys(CELL, pl.String), orient="row")
    return names.with_columns(quantity=pl.lit(f"{PUBLISHED}digest"), unit=pl.lit(""))


def _anew(rows: pl.DataFrame, frames: pl.DataFrame) -> pl.DataFrame:
    """Compute figures from rows: `CELL`, `quantity`, `value`; those without a number are left out."""
    true, failed = IS_TRUE, ~pl.col("status").is_in(["ok", "missed"])
    ok, missed = true & (pl.col("status") == "ok"), true & (pl.col("status") == "missed")
    error, distance = pl.col("error_deg").filter(ok), pl.col("mahalanobis2").filter(ok).drop_nulls()
    ratio = RATIO_OFF.drop_nulls()
    table = rows.group_by(CELL, maintain_order=True).agg(
        n=true.sum(), n_ok=ok.sum(), failed=(true & failed).sum(), missed=missed.sum(), unanswered=(true & ~ok).sum(),
        false=is_false(rows).sum(), with_rows=pl.col("realisation").n_unique(),
        mean_deg=error.mean(), rms_deg=(error**2).mean().sqrt(), std_deg=error.std(),
        median_deg=error.median(), p95_deg=error.quantile(0.95, "linear"), max_deg=error.max(),
        mean_oracle_deg=pl.col("error_oracle_deg").filter(ok).mean(),
        mean_base_deg=pl.col("error_base_deg").filter(ok).drop_nulls().mean(), regions=distance.len(),
        mean_penalised_deg=(error.sum() + PENALTY_DEG * (true.sum() - ok.sum())) / true.sum(),
        coverage95=(distance <= COVERED).sum(), axis_ratio=ratio.mean(),
        axis_ratio_median=ratio.median(), broken=(ok & ~ANSWERED).any(),
    )  # fmt: skip
    table = table.join(frames, on=CELL, how="left", nulls_equal=True, maintain_order="left")
    table = table.with_columns(
        false=pl.col("false") / pl.max_horizontal(pl.col("frames").fill_null(0), "with_rows"),
    )
    made = [table.select(*CELL, quantity=pl.lit(name), value=pl.col(name).cast(pl.Float64)) for name in _PLAIN]
    # An error that is no number makes those figures unknown that hold it.
    made = [_known(one, table) for one in made]
    made += [_share(table, name, "regions" if name == "coverage95" else "n") for name in _SHARES]
    return pl.concat(made, how="diagonal").filter(pl.col("value").is_finite())


_PLAIN = (
    "n", "n_ok", "false", "mean_deg", "rms_deg", "std_deg", "median_deg", "p95_deg", "max_deg", "mean_oracle_deg",
    "mean_base_deg", "mean_penalised_deg", "axis_ratio", "axis_ratio_median",
)  # fmt: skip


_OF_ERRORS = ("rms_deg", "std_deg", "median_deg", "p95_deg", "max_deg", "mean_penalised_deg")


def _known(figures: pl.DataFrame, table: pl.DataFrame) -> pl.DataFrame:
    """Return figures, of which those of errors are null where an error of their cell is no number."""
    if figures["quantity"].is_in(_OF_ERRORS).any():
        return figures.with_columns(value=pl.when(~table["broken"]).then("value"))
    return figures


def _share(table: pl.DataFrame, name: str, of: str) -> pl.DataFrame:
    return table.select(*CELL, quantity=pl.lit(name), value=pl.col(name) / pl.col(of))
