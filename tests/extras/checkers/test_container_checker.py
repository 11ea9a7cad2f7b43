"""hadolint finds nothing in the Dockerfile."""

import subprocess

from test_container import FILE

from tests.extras.needs import program


def test_hadolint_finds_nothing():
    done = subprocess.run([program("hadolint"), str(FILE)], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "")
