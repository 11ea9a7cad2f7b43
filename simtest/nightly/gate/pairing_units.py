"""Sums over resampling units: realisations, each a scene or a pose, whatever number of highlights it shows."""

from collections.abc import Iterable

import polars as pl

GROUP = ("place", "quantity")
"""Number of the place and name of the quantity: a test each."""

UNIT = (*GROUP, "realisation")


def paired_sums(values: pl.DataFrame) -> pl.DataFrame:
    """Add up pairs by unit, then over units.

    Parameters
    ----------
    values : polars.DataFrame
        `UNIT`, `baseline`, `tonight`: a row a pair.

    Returns
    -------
    polars.DataFrame
        `GROUP`, `units`, `rows`; sums over units of d (tonight less baseline), x (baseline) and of products of d, x and
        n (the unit's rows): `d`, `x`, `dd`, `xx`, `nn`, `dx`, `dn`, `xn`; `largest`: the largest abs(d) of a row.
    """
    d = pl.col("tonight") - pl.col("baseline")
    units = values.group_by(UNIT).agg(
        d=d.sum(), x=pl.col("baseline").sum(), n=pl.len().cast(pl.Float64), largest=d.abs().max()
    )
    return units.group_by(GROUP).agg(
        pl.len().alias("units"), pl.col("n").sum().alias("rows"), pl.col("d", "x").sum(),
        *_products((("d", "d"), ("x", "x"), ("n", "n"), ("d", "x"), ("d", "n"), ("x", "n"))),
        pl.col("largest").max(),
    )  # fmt: skip


def sums(values: pl.DataFrame) -> pl.DataFrame:
    """Add up one night's values by unit, then over units.

    Parameters
    ----------
    values : polars.DataFrame
        `UNIT`, `value`.

    Returns
    -------
    polars.DataFrame
        `GROUP`, `units`, `rows`; sums over units of `x` and of products of x and n: `xx`, `nn`, `xn`.
    """
    units = values.group_by(UNIT).agg(x=pl.col("value").sum(), n=pl.len().cast(pl.Float64))
    return units.group_by(GROUP).agg(
        pl.len().alias("units"), pl.col("n").sum().alias("rows"), pl.col("x").sum(),
        *_products((("x", "x"), ("n", "n"), ("x", "n"))),
    )  # fmt: skip


def _products(pairs: Iterable[tuple[str, str]]) -> list[pl.Expr]:
    return [(pl.col(first) * pl.col(second)).sum().alias(first + second) for first, second in pairs]
