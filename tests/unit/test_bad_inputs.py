"""A fast part of the corpus of bad inputs (`python -m studies.bad_inputs`), through the commands themselves."""

import re
import subprocess
import sys

import pytest

PARTS = ("picture .png", "camera .yaml", "nested", "--out, nothing", "mesh check: .obj", "FIFO")


@pytest.mark.slow
@pytest.mark.parametrize("part", PARTS)
def test_bad_inputs_are_refused_in_one_line(part):
    command = [sys.executable, "-m", "studies.bad_inputs", "--only", part]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert int(re.search(r"(\d+) cases", done.stdout)[1]) >= 6
    assert done.returncode == 0, done.stdout
