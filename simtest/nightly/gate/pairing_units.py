"""Sums over resampling units: realisations, each a scene or a pose, whatever number of highlights it shows."""

import operator
from collections.abc import Sequence
from itertools import combinations_with_replacement

import polars as pl

GROUP = ("cell", "quantity")
"""Number of the cell and name of the quantity: a test each."""

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
        n (the unit's rows): `d`, `x`, `dd`, `dx`, `dn`, `xx`, `xn`, `nn`, `ddd`, `ddn`, `dnn`, `nnn`; `largest`: the
        largest abs(d) of a row.
    """
    d = pl.col("tonight") - pl.col("baseline")
    return _sums(values, (d.alias("d"), pl.col("baseline").alias("x")), d.abs())


def sums(values: pl.DataFrame) -> pl.DataFrame:
    """Add up one run's values (`UNIT`, `value`) as `paired_sums` does, without d; `largest` is the largest value."""
    return _sums(values, (pl.col("value").alias("x"),), pl.col("value"))


def _sums(values: pl.DataFrame, terms: Sequence[pl.Expr], size: pl.Expr) -> pl.DataFrame:
    # The order of the units is kept, so that equal inputs have equal sums to the last bit.
    units = values.group_by(UNIT, maintain_order=True).agg(
        *(term.sum() for term in terms), n=pl.len().cast(pl.Float64), largest=size.max()
    )
    names = [term.meta.output_name() for term in terms]
    factors = [
        *combinations_with_replacement((*names, "n"), 2),
        *combinations_with_replacement((names[0], "n"), 3),
    ]
    products = [pl.reduce(operator.mul, [pl.col(name) for name in own]).sum().alias("".join(own)) for own in factors]
    return units.group_by(GROUP, maintain_order=True).agg(
        pl.len().alias("units"), pl.col("n").sum().alias("rows"), pl.col(names).sum(), *products,
        pl.col("largest").max(),
    )  # fmt: skip
