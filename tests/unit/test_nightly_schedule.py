"""What runs the nightly by itself: workflows and systemd units."""

import configparser
import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
UNITS = ROOT / "deploy"


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflows_trust_little(path):
    text = path.read_text()
    used = re.findall(r"^\s*(?:- )?uses: (\S+)(.*)$", text, re.MULTILINE)
    assert used
    for action, comment in used:
        assert re.fullmatch(r"actions/[\w/-]+@[0-9a-f]{40}", action)
        assert re.fullmatch(r" # v\d+\.\d+\.\d+", comment)
    assert "\npermissions:\n  contents: read\n" in text
    assert not re.search(r":\s*write\b", text)
    assert text.count("persist-credentials: false") == sum("checkout@" in action for action, _ in used)
    assert "secrets." not in text
    # What is run holds no text of a stranger's, such as a branch's name.
    runs = re.findall(r"run: (.*)", text)
    assert runs
    assert not [line for line in runs if "${{" in line]
    assert text.count("timeout-minutes:") == text.count("runs-on:")


def test_no_fork_runs_what_is_scheduled():
    scheduled = [text for path in WORKFLOWS if "\n  schedule:\n" in (text := path.read_text())]
    assert scheduled
    guard = "if: ${{ github.event_name != 'schedule' || !github.event.repository.fork }}"
    for text in scheduled:
        assert text.count(f"    {guard}\n    runs-on:") == text.count("runs-on:")


def test_one_action_has_one_version():
    pins = {}
    for path in WORKFLOWS:
        for name, pin in re.findall(r"uses: (actions/[\w-]+)\S*@(\S+ # \S+)", path.read_text()):
            pins.setdefault(name, set()).add(pin)
    assert {name: len(found) for name, found in pins.items()} == dict.fromkeys(pins, 1)


@pytest.mark.parametrize("kept", ["11", "12", None])
def test_the_history_outlasts_a_lost_cache(tmp_path, kept):
    """The step's own script, with a command `gh` of ours: of nights 13, 12, 11 some have an artifact with a history."""
    text = (ROOT / ".github" / "workflows" / "nightly.yml").read_text()
    step = text[text.index("- name: Take up the history that an earlier night kept") :]
    assert "cache-matched-key == ''" in step
    script = re.search(r"run: \|\n((?: {10}.*\n)+)", step)[1]
    gh = tmp_path / "bin" / "gh"
    gh.parent.mkdir()
    gh.write_text(f"""#!/bin/sh
if [ "$2" = list ]; then echo 13; echo 12; echo 11; exit; fi
[ "$3" = 13 ] && mkdir -p earlier/nightly && exit
[ "$3" = "{kept}" ] || exit 1
mkdir -p earlier/history/full && echo "$3" > earlier/history/full/night
""")
    gh.chmod(0o755)
    path = f"{gh.parent}:{os.environ['PATH']}"
    subprocess.run(["/bin/bash", "-e", "-c", script], cwd=tmp_path, env={"PATH": path}, check=True, capture_output=True)
    found = tmp_path / "reports" / "history" / "full" / "night"
    assert (found.read_text().strip() if found.exists() else None) == kept
    assert not (tmp_path / "earlier").exists()


def parsed(name):
    # A unit's keys may come twice and are case-sensitive.
    parser = configparser.RawConfigParser(strict=False, comment_prefixes=("#", ";"), delimiters=("=",))
    parser.optionxform = str
    parser.read_string((UNITS / name).read_text())
    return parser


def test_the_units_belong_together():
    service, timer = parsed("simtest-nightly.service"), parsed("simtest-nightly.timer")
    command = service["Service"]["ExecStart"]
    assert command.startswith("/")
    assert command.endswith("simtest nightly --profile full")
    assert service["Service"]["Type"] == "oneshot"
    # A timer starts the service of its own name.
    assert timer["Install"]["WantedBy"] == "timers.target"
    assert "Unit" not in timer["Timer"]
    assert timer["Timer"]["Persistent"] == "true"
