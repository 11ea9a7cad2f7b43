"""How the tests themselves are run: long files first, marks of single cases, and nothing waits for the disk."""

import os
from pathlib import Path

import pytest

from tests.conftest import LONGEST
from tests.marked import marked

TESTS = Path(__file__).resolve().parents[1]


def test_long_files_are_there_and_named_once():
    assert sorted(LONGEST) == sorted(set(LONGEST))
    assert set(LONGEST) <= {path.stem for path in TESTS.rglob("test_*.py")}


def test_cases_bear_the_marks_under_which_they_are_listed():
    cases = marked(["a", ("b", 1), "c"], ci=["a", ("b", 1)], slow=iter([("b", 1)]))
    assert [case.values for case in cases] == [("a",), ("b", 1), ("c",)]
    assert [[mark.name for mark in case.marks] for case in cases] == [["ci"], ["ci", "slow"], []]
    with pytest.raises(AssertionError, match="d"):
        marked(["a"], ci=["d"])


def test_a_closed_file_cannot_be_flushed_to_the_disk(tmp_path):
    with (tmp_path / "file").open("wb") as file:
        os.fsync(file)
        os.fsync(file.fileno())
        closed = os.dup(file.fileno())
    os.close(closed)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fsync(closed)
