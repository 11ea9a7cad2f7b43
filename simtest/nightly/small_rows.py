"""The rows of a baseline as they lie in git: single precision where only margins count, and errors as differences."""

from pathlib import Path

import numpy as np
import polars as pl

from simtest.errors import InputError
from simtest.nightly.gate.quantities import OLDEST_COLUMNS, OPTIONAL_COLUMNS, RESULT_COLUMNS
from simtest.runtime.resources import shown
from simtest.validation.columns import SCHEMA

_TYPES = {name: SCHEMA[name] for name in RESULT_COLUMNS if name not in OLDEST_COLUMNS} | OPTIONAL_COLUMNS

SINGLE_PRECISION = tuple(name for name, dtype in _TYPES.items() if dtype == pl.Float64())
"""Columns that a baseline keeps in single precision, for it lies in git: they are compared with margins."""

REFERENCE = "error_deg"
NEAR_REFERENCE = ("error_oracle_deg", "error_base_deg", "error_look_deg")
"""Errors that equal `REFERENCE` in most rows. Each is kept as the bits in which the two differ, so most are 0 and
compress well; no value changes."""

_BITS = "_bits"
"""Ends the name of a column of such bits."""


def small(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows as a baseline keeps them; `whole` undoes everything but the rounding to single precision."""
    made = rows.with_columns(pl.col(name).cast(pl.Float32) for name in SINGLE_PRECISION if name in rows.columns)
    if REFERENCE not in rows.columns:
        return made
    reference = _bits(rows[REFERENCE])
    for name in (name for name in NEAR_REFERENCE if name in rows.columns):
        kept = pl.Series(name + _BITS, _bits(made[name]) ^ reference)
        kept = pl.select(pl.when(made[name].is_not_null()).then(kept)).to_series()
        # At the column's own position.
        made = made.with_columns(kept.alias(name)).rename({name: name + _BITS})
    return made


def whole(rows: pl.DataFrame, path: Path) -> pl.DataFrame:
    """Return the rows of a baseline in double precision, errors restored; `path` is their file, for messages.

    Baselines of older versions, which hold the errors themselves, are read too.

    Raises
    ------
    InputError
        If a column is of another type than `small` gives it.
    """
    for name in NEAR_REFERENCE:
        held = name + _BITS
        if held not in rows.columns:
            continue
        types = {column: rows.schema.get(column) for column in (held, REFERENCE)}
        if types != {held: pl.UInt32(), REFERENCE: pl.Float64()}:
            told = ", ".join(f"column {column} is of type {kind}" for column, kind in types.items())
            raise InputError(f"{shown(path)}: damaged ({told}; must be UInt32 and Float64)")
        bits = rows[held].fill_null(0).to_numpy() ^ _bits(rows[REFERENCE])
        restored = pl.Series(name, bits.view(np.float32))
        restored = pl.select(pl.when(rows[held].is_not_null()).then(restored)).to_series()
        rows = rows.with_columns(restored.alias(held)).rename({held: name})
    return rows.with_columns(pl.col(name).cast(pl.Float64) for name in SINGLE_PRECISION if name in rows.columns)


def _bits(values: pl.Series) -> "np.ndarray[tuple[int], np.dtype[np.uint32]]":
    """Return the bits of values in single precision; null counts as 0."""
    return np.ascontiguousarray(values.cast(pl.Float32).fill_null(0.0).to_numpy()).view(np.uint32)
