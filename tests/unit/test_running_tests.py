"""How the tests themselves are run: long files first, marks of single cases, and nothing waits for the disk."""

import os

import pytest

from tests.conftest import largest_first
from tests.marked import marked


def test_large_files_come_first(tmp_path):
    files = [tmp_path / name for name in ("small", "large", "as large")]
    for file in files:
        file.write_text("#" * (100 if "large" in file.name else 10))
    assert [file.name for file in largest_first(files)] == ["large", "as large", "small"]


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
