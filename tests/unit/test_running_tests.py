"""How the tests themselves are run: long files first, slow cases left out, and nothing waits for the disk."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import simtest
from tests.conftest import COLLECTED, LONGEST, SHARED, is_slow, matches
from tests.slow_cases import MESHES, ONE_OF_A_KIND, SLOW

TESTS = Path(__file__).resolve().parents[1]
OF_SHARED_MESHES = ("[colon_*", "[liver*")


def test_long_files_are_there_and_named_once():
    assert sorted(LONGEST) == sorted(set(LONGEST))
    assert set(LONGEST) <= {path.stem for path in TESTS.rglob("test_*.py")}


def test_slow_cases_are_tests_of_their_files():
    files = {path.stem: path.read_text() for path in TESTS.rglob("test_*.py")}
    for stem, groups in SLOW.items():
        assert all(covered and names for covered, names in groups.items()), stem
        for name in (name for names in groups.values() for name in names):
            function = re.match(r"\w+", name).group()
            ending = r"\w*" if name == f"{function}*" else ""
            assert re.search(rf"^def {function}{ending}\(", files[stem], re.MULTILINE), name


def test_every_slow_case_names_a_test_that_was_collected(request):
    """Of the files of this run: all in `make test`."""
    if any("::" in argument for argument in request.config.args):
        pytest.skip("single tests of a file were asked for")
    for stem in COLLECTED.keys() & SLOW.keys():
        for covered, one in ((covered, one) for covered, names in SLOW[stem].items() for one in names):
            if SHARED.is_dir() or not one.endswith(OF_SHARED_MESHES):
                assert any(matches(one, name) for name in COLLECTED[stem]), (stem, one)
            if covered in (ONE_OF_A_KIND, MESHES):
                cases = f"{one.partition('[')[0]}["
                assert [name for name, slow in COLLECTED[stem].items() if name.startswith(cases) and not slow], (
                    stem,
                    one,
                )


def test_a_slow_case_is_told_by_its_name_or_by_how_it_begins():
    assert is_slow("test_stopping", "test_an_output_that_is_full_is_told[schema scene]")
    assert not is_slow("test_stopping", "test_an_output_that_is_full_is_told[list scenes]")
    assert is_slow("test_gate", "test_without_exact_pairs_the_test_is_unpaired[more]")
    assert not is_slow("test_gate", "test_without_exact_pairs_the_test_is_unpaired[more and more]")
    assert not is_slow("test_running_tests", "test_without_exact_pairs_the_test_is_unpaired[more]")


def test_a_closed_file_cannot_be_flushed_to_the_disk(tmp_path):
    with (tmp_path / "file").open("wb") as file:
        os.fsync(file)
        os.fsync(file.fileno())
        closed = os.dup(file.fileno())
    os.close(closed)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fsync(closed)


def test_children_run_the_checkout_whose_tests_these_are(tmp_path):
    checkout = TESTS.parent
    assert Path(simtest.__file__).parents[1] == checkout
    # An installed package of that name lies behind the checkout, whatever is installed here.
    (tmp_path / "simtest").mkdir()
    (tmp_path / "simtest" / "__init__.py").write_text("", encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": f"{os.environ['PYTHONPATH']}{os.pathsep}{tmp_path}"}
    command = [sys.executable, "-c", "import simtest; print(simtest.__file__)"]
    for own in (None, environment):
        done = subprocess.run(command, env=own, cwd="/", capture_output=True, text=True, timeout=60, check=True)
        assert Path(done.stdout.strip()).parents[1] == checkout
