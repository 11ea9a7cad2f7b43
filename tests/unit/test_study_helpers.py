"""What studies and benchmarks share: timing, the bootstrap over groups, and what is kept."""

from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from benchmarks.timing import in_turns, times_in_turns
from studies import kept
from studies.gate import bank
from studies.resampling import drawn_groups, interval_of_mean


def test_functions_are_timed_in_turns():
    called, now = [], iter(range(100))

    def work(name, ticks):
        def run():
            called.append(name)
            for _ in range(ticks):
                next(now)

        return run

    times = times_in_turns({"a": work("a", 1), "b": work("b", 3)}, 2, clock=lambda: next(now))
    # Once beforehand, then in turns; the clock itself ticks once.
    assert called == ["a", "b"] * 3
    assert times == {"a": [2, 2], "b": [4, 4]}


def test_the_median_is_given():
    durations = iter([5.0, 1.0, 3.0, 9.0])
    clock = [0.0]

    def run():
        clock[0] += next(durations)

    times = times_in_turns({"a": run}, 3, clock=lambda: clock[0])
    assert times == {"a": [1.0, 3.0, 9.0]}
    assert 0 <= in_turns({"a": lambda: None}, 3)["a"] < 1


DRAWS, SEED = 2000, 2026


def test_each_draw_takes_as_many_groups_as_there_are():
    drawn = drawn_groups(5, 400, 1)
    assert drawn.shape == (400, 5)
    assert np.array_equal(np.unique(drawn), np.arange(5))
    assert np.array_equal(drawn, drawn_groups(5, 400, 1))


def test_a_group_is_drawn_with_all_its_values():
    groups = np.array([7, 7, 7, 2, 9, 9])
    values = np.array([1.0, 2.0, 3.0, -4.0, 0.5, 1.5])
    by_hand = [
        np.concatenate([values[groups == np.array([2, 7, 9])[k]] for k in row]).mean()
        for row in np.random.default_rng(SEED).integers(3, size=(DRAWS, 3))
    ]
    assert np.allclose(interval_of_mean(values, groups, DRAWS, SEED), np.percentile(by_hand, [2.5, 97.5]))


def test_the_interval_holds_where_values_of_a_group_are_alike_and_values_taken_alone_do_not():
    rng = np.random.default_rng(3)
    groups = np.repeat(np.arange(40), rng.integers(1, 15, 40))
    held = {"groups": 0, "values": 0}
    for seed in range(200):
        values = rng.normal(size=40)[groups] + 0.1 * rng.normal(size=len(groups))
        for name, own in (("groups", groups), ("values", np.arange(len(groups)))):
            low, high = interval_of_mean(values, own, 300, seed)
            held[name] += low < 0 < high
    # Of 200, 95 % are 190 (deviation 3); few groups and the percentile method cost some 2 %.
    assert held["groups"] >= 176
    assert held["values"] < 140


@pytest.fixture
def other_code(monkeypatch):
    """Return a function after whose call simtest's source is another one."""

    def change():
        monkeypatch.setattr(kept, "source_hash", lambda: "of other code")
        kept.code_hash.cache_clear()

    yield change
    kept.code_hash.cache_clear()


def test_a_bank_of_other_code_is_made_anew(tmp_path, monkeypatch, other_code):
    made = []
    monkeypatch.setattr(bank, "CONTENT", {"overview": 1})
    row = pl.DataFrame({name: [None] for name in bank.COLUMNS})

    def run(_, folder, engine):
        folder.mkdir(parents=True)
        made.append(folder)
        return SimpleNamespace(results=row)

    monkeypatch.setattr(bank, "run_experiment", run)
    for _ in range(2):
        bank.load_bank(tmp_path)
    assert len(made) == 1
    other_code()
    bank.load_bank(tmp_path)
    assert len(set(made)) == 2
