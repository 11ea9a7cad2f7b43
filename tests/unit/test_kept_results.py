"""What studies keep: results of other code are never read."""

from types import SimpleNamespace

import polars as pl
import pytest

from studies import kept
from studies.gate import bank


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
