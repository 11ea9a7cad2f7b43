"""Wrong signs of motion: the gate's quantity and the digest see them."""

import numpy as np
import polars as pl
import pytest
from gate_nights import night, rows

from simtest.conventions import MOTION, MOTION_COLUMNS
from simtest.nightly.compare import compare
from simtest.nightly.quantities import digests_of

SETTINGS = tuple("abcdefghijkl")


def with_signs(wrong=0.0, told=1.0, seed=0, count=20):
    """Return rows of `motion` with true gains of both signs; a share of the told signs is wrong."""
    table = rows(count=count, settings=SETTINGS, estimators=("cone_axis", MOTION))
    rng = np.random.default_rng(seed)
    gains = np.random.default_rng(3).choice([-0.5, 1.5], (table.height, 2))
    signs = np.sign(gains) * np.where(rng.random(gains.shape) < wrong, -1, 1)
    signs = np.where(np.random.default_rng(4).random(gains.shape) < told, signs, 0.0)
    values = dict.fromkeys(MOTION_COLUMNS, np.full(table.height, 1.0))
    for i in (0, 1):
        values |= {f"motion_sign_{i + 1}": signs[:, i], f"motion_gain_{i + 1}": gains[:, i]}
    mine = pl.col("estimator") == MOTION
    return table.with_columns(pl.Series(name, value) for name, value in values.items()).with_columns(
        pl.when(mine).then(pl.col(name)) for name in MOTION_COLUMNS
    )


def outcomes(tonight, baseline):
    found = compare(night(tonight), night(baseline)).comparisons.filter(quantity="wrong_sign")
    return dict(found.group_by("outcome").len().iter_rows()), found


def test_more_wrong_signs_are_a_regression_and_fewer_must_be_explained():
    few, many = with_signs(), with_signs(wrong=0.2)
    worse, found = outcomes(many, few)
    assert worse["worse"] >= 1
    # The share is that of the told signs.
    assert found.filter(setting="all")["tonight"].mean() == pytest.approx(0.2, abs=0.04)
    assert outcomes(few, many)[0]["better"] >= 1
    verdict = compare(night(many), night(few))
    assert verdict.state == "regression"
    assert any("the share of wrong signs among those that motion told" in cause for cause in verdict.causes)


@pytest.mark.ci  # meanwhile: test_more_wrong_signs_are_a_regression_and_fewer_must_be_explained
def test_equal_signs_are_equal_and_one_wrong_sign_is_no_finding():
    assert compare(night(with_signs(told=0.5)), night(with_signs(told=0.5))).bit_equal
    verdict = compare(night(with_signs(wrong=0.002)), night(with_signs()))
    assert verdict.comparisons.filter(quantity="wrong_sign", outcome="worse").is_empty()


def test_signs_alone_change_the_hash_of_their_cells_and_of_no_other():
    first, second = (digests_of(table) for table in (with_signs(), with_signs(wrong=0.9)))
    changed = {cell.estimator for cell in first if first[cell] != second[cell]}
    assert changed == {MOTION}
    plain = digests_of(rows(settings=SETTINGS))
    without = digests_of(with_signs().filter(pl.col("estimator") != MOTION))
    assert plain == without


def test_a_baseline_without_signs_is_compared():
    """What it lacks is judged from the next accepted baseline on, as for any other column."""
    verdict = compare(night(with_signs(wrong=1.0)), night(with_signs().drop(MOTION_COLUMNS)))
    assert verdict.state == "fine"
    assert verdict.comparisons.filter(quantity="wrong_sign").is_empty()
