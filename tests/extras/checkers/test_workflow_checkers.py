"""GitHub's workflows and systemd's units pass their checkers."""

import os
import shutil
import subprocess

import pytest
from test_nightly_schedule import UNITS, WORKFLOWS, parsed

from tests.extras.needs import program


@pytest.mark.parametrize(
    "command", [["zizmor", "--offline", "--pedantic"], ["check-jsonschema", "--builtin-schema=vendor.github-workflows"]]
)
def test_workflows_pass_their_checkers(command):
    whole = [program(command[0]), *command[1:], *map(str, WORKFLOWS)]
    subprocess.run(whole, check=True, capture_output=True, timeout=60)


def test_systemd_takes_the_units(tmp_path):
    tmp_path.chmod(0o700)
    units = [shutil.copy(path, tmp_path) for path in sorted(UNITS.glob("simtest-nightly.*"))]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    command = ["systemd-analyze", "verify", "--user", "--man=no", *units]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_systemd_refuses_a_broken_unit(tmp_path):
    """The check above can fail."""
    tmp_path.chmod(0o700)
    broken = tmp_path / "simtest-nightly.service"
    text = (UNITS / broken.name).read_text()
    broken.write_text(text.replace("ExecStart=/usr/bin/env", "ExecStart=/no/such/program"))
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    command = ["systemd-analyze", "verify", "--user", "--man=no", str(broken)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode != 0


def test_systemd_reads_the_time():
    when = parsed("simtest-nightly.timer")["Timer"]["OnCalendar"]
    subprocess.run(["systemd-analyze", "calendar", when], check=True, capture_output=True, timeout=30)
