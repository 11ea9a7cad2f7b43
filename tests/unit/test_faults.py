"""Errors inside estimators, as summary.json and the terminal tell them."""

import polars as pl

from simtest.validation.run_summary import MOST_TEXTS, faults_of


def rows(estimator, status, text, count=1):
    return [{"estimator": estimator, "status": status, "flags": text}] * count


def test_each_distinct_text_is_told_once_with_its_count():
    table = pl.DataFrame([
        *rows("moment", "ok", ""), *rows("moment", "estimator_error", "TypeError: other"),
        *rows("moment", "estimator_error", "ValueError: my\n  bug (my_core.py:11)", 29),
        *rows("core", "core_timeout", "no answer within 2 s"), *rows("cone_axis", "no_peak", "peak 0", 3),
    ])  # fmt: skip
    assert list(map(str, faults_of(table))) == [
        "moment: ValueError: my bug (my_core.py:11), 29 times",
        "moment: TypeError: other, once",
        "core: core_timeout: no answer within 2 s, once",
    ]


def test_texts_that_differ_at_every_highlight_are_cut():
    table = pl.DataFrame([row for i in range(MOST_TEXTS + 3) for row in rows("a", "estimator_error", f"E: {i}", 2)])
    found = list(map(str, faults_of(table)))
    assert len(found) == MOST_TEXTS + 1
    assert found[-1] == "a: 3 other texts; column flags of results.parquet holds them, 6 times"


def test_results_without_a_fault_have_none():
    assert faults_of(pl.DataFrame({"status": ["ok", "missed"], "estimator": ["a", "a"], "flags": ["", None]})) == []
    assert faults_of(pl.DataFrame({"status": ["ok"]})) == []
