"""What studies and benchmarks share: timing, and what is kept."""

from types import SimpleNamespace

import polars as pl
import pytest

from benchmarks.timing import in_turns, times_in_turns
from studies import kept
from studies.gate import bank


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
