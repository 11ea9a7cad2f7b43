"""What the audit and the hashed constraints make of the tools' reports, and what the release check refuses."""

import importlib.util
import os
import re
import sys
import zipfile
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
        "download_info": {"url": "b.whl", "archive_info": {"hashes": {"sha256": "0" * 64}}},
    }
    other = {
        "metadata": {"name": "a", "version": "2"},
        "download_info": {"url": "a.whl", "archive_info": {"hash": "sha256=" + "1" * 64}},
    }
    text = loaded("hashed_constraints").hashed({"install": [item, other]}, "# head")
    assert text == f"# head\na==2 --hash=sha256:{'1' * 64}\nB==1.0 --hash=sha256:{'0' * 64}\n"
    del item["download_info"]["archive_info"]
    with pytest.raises(SystemExit, match=r"B 1\.0: pip reports no hash"):
        loaded("hashed_constraints").hashed({"install": [item]}, "")


def test_constraints_hold_names_and_versions_alone():
    lines = (CI.parent / "constraints.txt").read_text(encoding="ascii").split("\n")[:-1]
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[A-Za-z0-9_.!+-]+", line) for line in lines)


def made_wheel(folder, *names):
    wheel = folder / "simtest-0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in names:
            archive.writestr(name, "")
    return wheel


def test_a_wheel_that_holds_more_than_the_package_or_is_too_large_is_refused(tmp_path, monkeypatch):
    check = loaded("release_check")
    own = f"simtest-{check.project()['version']}.dist-info/METADATA"
    check.check_wheel(made_wheel(tmp_path, "simtest/api.py", own))
    with pytest.raises(check.CheckError, match=r"holds \['tests'\]: must hold the package alone"):
        check.check_wheel(made_wheel(tmp_path, "simtest/api.py", own, "tests/a.py"))
    monkeypatch.setattr(check, "LARGEST_WHEEL_MB", 1e-5)
    with pytest.raises(check.CheckError, match="must be at most 1e-05 MB"):
        check.check_wheel(made_wheel(tmp_path, "simtest/api.py", own))


def test_an_installation_must_have_all_entry_points_and_data():
    told = loaded("release_check").told()
    assert {"cone_axis", "circle_pose"} <= set(told["simtest.estimators"])
    assert {"peaks", "colour"} == set(told["simtest.detectors"])
    assert {"cylinder", "published"} <= set(told["scenes"])
    assert {"overview", "laws"} <= set(told["experiments"])
    assert {"colon", "liver"} == set(told["meshes"])


def test_a_step_that_fails_is_told_in_one_line(tmp_path):
    check = loaded("release_check")
    code = "import sys; print('first'); print('worst', file=sys.stderr); sys.exit(3)"
    with pytest.raises(check.CheckError, match=r"exit 3: worst$"):
        check.run([sys.executable, "-c", code], tmp_path)


@pytest.mark.slow
def test_without_a_registry_the_release_check_is_skipped_with_the_reason(tmp_path, monkeypatch, capsys):
    check = loaded("release_check")
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    for name in ("PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(
        sys, "argv", ["release_check.py", "--pythons", "this", "--out", str(tmp_path), "--skip-offline"]
    )
    assert check.main() == 0
    (said,) = capsys.readouterr().out.splitlines()
    assert said.startswith("release check: skipped, since pip reaches no package registry: ")
    assert len(said) > 80
    assert not list(tmp_path.iterdir())


def test_only_a_registry_out_of_reach_skips_the_release_check(monkeypatch, capsys):
    check = loaded("release_check")

    def failing(*_):
        raise check.CheckError("pip check: exit 1: a requires b")

    monkeypatch.setattr(check, "build", failing)
    monkeypatch.setattr(check, "offline", lambda _: "")
    for flags in ([], ["--skip-offline"]):
        monkeypatch.setattr(sys, "argv", ["release_check.py", "--pythons", "this", *flags])
        assert check.main() == 1
        assert "a requires b" in capsys.readouterr().err
    # Who does not ask for it gets no skip.
    monkeypatch.setattr(check, "offline", lambda _: "no network")
    monkeypatch.setattr(sys, "argv", ["release_check.py", "--pythons", "this"])
    assert check.main() == 1


def test_the_release_check_asks_pythons_that_are_new_enough(monkeypatch):
    check = loaded("release_check")
    assert any(python.resolve() == Path(sys.executable).resolve() for python in check.pythons())
    monkeypatch.setattr(check, "OLDEST", (9, 0))
    assert check.pythons() == []


def test_version_changelog_and_citation_agree():
    version = loaded("release_check").project()["version"]
    changes = (CI.parent / "CHANGELOG.md").read_text(encoding="utf-8")
    # What is not released yet may stand above.
    headings = re.findall(r"^## (\S+)", changes, re.MULTILINE)
    assert next(heading for heading in headings if heading != "Unreleased") == version
    assert "Unreleased" not in headings[1:]
    assert f"\nversion: {version}\n" in (CI.parent / "CITATION.cff").read_text(encoding="utf-8")
