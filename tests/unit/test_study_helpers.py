"""What studies and benchmarks share: timing, memory, and what is kept."""

import subprocess
import sys
import time
from types import SimpleNamespace

import polars as pl
import pytest

from benchmarks.timing import PeakMemory, in_turns, memory_of_tree_mib, times_in_turns
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


def test_memory_of_all_processes_is_seen():
    """Of a process that holds little and its child that holds much; the peak outlasts both.

    Pages that are shared count by shares, which change with what else runs: this process's own memory is no measure.
    """
    size_mib = 120
    holder = f"held = bytearray({size_mib} << 20); held[::4096] = b'x' * len(held[::4096]); print(flush=True); input()"
    starter = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {holder!r}])"
    process = subprocess.Popen(
        [sys.executable, "-c", starter], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with PeakMemory(process.pid, step_s=0.01) as memory:
        process.stdout.readline()
        together = memory_of_tree_mib(process.pid)
        # A busy machine may run the watching thread late: the memory is held until it has been seen, or for a minute.
        deadline = time.monotonic() + 60
        while (memory.peak_mib or 0) < size_mib and time.monotonic() < deadline:
            time.sleep(0.01)
        process.communicate("\n")
    assert size_mib < together < 3 * size_mib
    assert size_mib < memory.peak_mib < 3 * size_mib
    assert memory_of_tree_mib(process.pid) is None


def test_the_memory_of_no_process_is_unknown():
    assert memory_of_tree_mib(2**22 + 1) is None


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
