"""What the audit and the hashed constraints make of the tools' reports."""

import importlib.util
import re
from pathlib import Path

import pytest

CI = Path(__file__).resolve().parents[2] / ".ci"

pytestmark = pytest.mark.skipif(not CI.is_dir(), reason="the checkout's .ci folder is not there")


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, CI / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_packages_that_could_not_be_looked_up_are_counted():
    faults = [{"id": "CVE-1", "fix_versions": ["3"]}, {"id": "CVE-2", "fix_versions": []}]
    report = {
        "dependencies": [
            {"name": "a", "version": "1", "vulns": []},
            {"name": "b", "version": "2", "vulns": faults},
            {"name": "c", "skip_reason": "not found"},
        ]
    }  # fmt: skip
    found, note = loaded("audit").vulnerabilities(report)
    assert found == ["b 2: CVE-1, mended in 3", "b 2: CVE-2, mended in none"]
    assert note == "; 1 of 3 packages could not be looked up"


def test_risky_calls_name_their_line():
    result = {"filename": "a.py", "line_number": 3, "test_id": "B301", "issue_text": "pickle"}
    found, note = loaded("audit").risky_calls({"results": [result], "errors": []})
    assert (found, note) == (["a.py:3: B301 pickle"], "")


def test_a_tool_that_is_not_there_is_no_failure(monkeypatch, capsys):
    audit = loaded("audit")
    monkeypatch.setattr(audit.sys, "executable", "/nowhere/python")
    assert audit.main() == 0
    said = capsys.readouterr().out.splitlines()
    assert said == [
        f"audit: {name} cannot be run here (FileNotFoundError); left out" for name in ("bandit", "pip-audit")
    ]


def test_hashed_constraints_hold_names_versions_and_hashes_alone():
    item = {
        "metadata": {"name": "B", "version": "1.0"},
        "download_info": {"url": "https://files.example/b.whl", "archive_info": {"hashes": {"sha256": "0" * 64}}},
    }
    other = {
        "metadata": {"name": "a", "version": "2"},
        "download_info": {"url": "https://files.example/a.whl", "archive_info": {"hash": "sha256=" + "1" * 64}},
    }
    text = loaded("hashed_constraints").hashed({"install": [item, other]}, "# head")
    assert text == f"# head\na==2 --hash=sha256:{'1' * 64}\nB==1.0 --hash=sha256:{'0' * 64}\n"
    del item["download_info"]["archive_info"]
    with pytest.raises(SystemExit, match=r"B 1\.0: pip reports no hash"):
        loaded("hashed_constraints").hashed({"install": [item]}, "")


def test_constraints_hold_names_and_versions_alone():
    lines = (CI.parent / "constraints.txt").read_text(encoding="ascii").split("\n")[:-1]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.!+-]+", line) for line in lines)
