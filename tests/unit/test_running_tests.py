"""How the tests themselves are run: long files first, marks of single cases, and nothing waits for the disk."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import simtest
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


def test_children_run_the_checkout_whose_tests_these_are(tmp_path):
    checkout = Path(__file__).resolve().parents[2]
    assert Path(simtest.__file__).parents[1] == checkout
    # An installed package of that name lies behind the checkout, whatever is installed here.
    (tmp_path / "simtest").mkdir()
    (tmp_path / "simtest" / "__init__.py").write_text("", encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": f"{os.environ['PYTHONPATH']}{os.pathsep}{tmp_path}"}
    command = [sys.executable, "-c", "import simtest; print(simtest.__file__)"]
    for own in (None, environment):
        done = subprocess.run(command, env=own, cwd="/", capture_output=True, text=True, timeout=60, check=True)
        assert Path(done.stdout.strip()).parents[1] == checkout
