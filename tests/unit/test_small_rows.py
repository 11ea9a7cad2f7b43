"""A baseline's rows in git: nothing but the last digits of single precision is lost."""

import io
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from simtest.errors import InputError
from simtest.nightly.store import NEAR_REFERENCE, SINGLE_PRECISION, small, whole
from tests.unit.nightly_samples import make_rows

FILE = Path("baseline/quick/night.parquet")
ODD = [0.0, -0.0, 1.5, np.nan, np.inf, -np.inf, 1e-45, 3.4e38, 1 / 3, None]


def odd_rows():
    """Return rows with each pair of odd values of an error and its reference."""
    errors, reference = zip(*[(a, b) for a in ODD for b in ODD], strict=True)
    values = {"error_deg": reference, "status": "ok", **dict.fromkeys(NEAR_REFERENCE, errors), "peak_snr": errors}
    types = dict.fromkeys(("error_deg", *NEAR_REFERENCE, "peak_snr"), pl.Float64())
    return pl.DataFrame(values, schema_overrides=types)


def rounded(rows):
    names = [name for name in SINGLE_PRECISION if name in rows.columns]
    return rows.with_columns(pl.col(names).cast(pl.Float32).cast(pl.Float64))


def bits(rows):
    """Return the columns as bits, since NaN and -0.0 compare as equal to others, and which values are null."""
    floats = [name for name in rows.columns if rows.schema[name] == pl.Float64()]
    return [(rows[name].fill_null(7.0).to_numpy().view(np.uint64).tolist(), rows[name].is_null().to_list())
            for name in floats]  # fmt: skip


@pytest.mark.parametrize("make", [odd_rows, make_rows])
def test_rows_come_back_bit_for_bit(make):
    rows = make()
    stored = small(rows)
    assert not set(NEAR_REFERENCE) & set(stored.columns)
    found = whole(stored, FILE)
    assert found.columns == rows.columns
    assert found.schema == rows.schema
    assert bits(found) == bits(rounded(rows))


def test_one_changed_bit_is_seen():
    """Negative control of the comparison above."""
    rows = odd_rows()
    stored = small(rows)
    name = "error_base_deg_bits"
    changed = stored.with_columns(pl.Series(name, [None if v is None else v ^ 1 for v in stored[name]], pl.UInt32()))
    assert bits(whole(changed, FILE)) != bits(rounded(rows))


def test_equal_errors_take_almost_no_space():
    rng = np.random.default_rng(5)
    error = rng.random(5000)
    rows = pl.DataFrame({"error_deg": error, "error_base_deg": np.where(rng.random(5000) < 0.02, 1.0, error)})
    plain = rows.select(pl.col("error_base_deg").cast(pl.Float32))
    sizes = []
    for table in (plain, small(rows).select("error_base_deg_bits")):
        table.write_parquet(file := io.BytesIO(), compression="brotli", compression_level=11)
        sizes.append(len(file.getvalue()))
    assert sizes[1] < sizes[0] / 10


def test_rows_of_older_baselines_are_read():
    rows = make_rows()
    assert whole(rounded(rows).with_columns(pl.col("error_base_deg").cast(pl.Float32)), FILE).equals(rounded(rows))


@pytest.mark.parametrize(
    "change",
    [
        lambda rows: rows.drop("error_deg"),
        lambda rows: rows.with_columns(pl.col("error_deg").cast(pl.String)),
        lambda rows: rows.with_columns(pl.col("error_look_deg_bits").cast(pl.Float64)),
        lambda rows: rows.with_columns(pl.col("error_oracle_deg_bits").cast(pl.Int64)),
    ],
)
def test_damaged_columns_are_refused_in_one_line(change):
    with pytest.raises(InputError, match=r"night.parquet: damaged \(column .* must be UInt32 and Float64\)") as refusal:
        whole(change(small(make_rows())), FILE)
    assert "\n" not in str(refusal.value)
