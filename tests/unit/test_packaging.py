"""The wheel holds the scenes, experiments and recipes, and they are found by name from any folder."""

import importlib
import importlib.metadata
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import yaml

from benchmarks.__main__ import NAMES

ROOT = Path(__file__).resolve().parents[2]

FIND = """
from simtest.runtime.resources import find
from simtest.spec import load_experiment, load_scene
import simtest
assert "site" in simtest.__file__, simtest.__file__
load_scene("cylinder"); load_experiment("overview")
print(find("colon", "meshes"))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def test_wheel_holds_data_and_marker(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    shipped = [*ROOT.glob("scenes/**/*.toml"), *ROOT.glob("meshes/*.toml")]
    assert len(shipped) >= 10
    for file in shipped:
        assert f"simtest/_data/{file.relative_to(ROOT)}" in names
    assert {"simtest/py.typed", "simtest/fitted.toml", "simtest/report/run.html.j2"} <= names
    assert "simtest/pages/templates/parts.html.j2" in names
    assert not [name for name in names if name.startswith(("tests/", "docs/"))]


def test_data_are_found_by_name_from_another_folder(wheel, tmp_path):
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)
    child = subprocess.run(
        [sys.executable, "-c", FIND], cwd=tmp_path, env={"PYTHONPATH": str(site)}, capture_output=True, text=True
    )
    assert child.returncode == 0, child.stderr
    assert str(site) in child.stdout


def test_benchmarks_fit_the_package():
    assert [name for name in NAMES if not callable(importlib.import_module(f"benchmarks.{name}").figures)] == []


@pytest.mark.skipif(not (ROOT / ".github").is_dir(), reason="the checkout's workflows are not there")
def test_every_file_of_a_release_has_its_sum(tmp_path):
    workflow = yaml.safe_load((ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8"))
    (step,) = [step for step in workflow["jobs"]["build"]["steps"] if "constraints" in step.get("run", "")]
    # What `make release-check` and `make hashed-constraints` leave behind.
    (tmp_path / "dist").mkdir()
    (tmp_path / "dist/a.whl").write_text("wheel")
    subprocess.run("cd dist && sha256sum a.whl > SHA256SUMS", shell=True, cwd=tmp_path, check=True)
    (tmp_path / "constraints-cp311.txt").write_text("pinned")
    commands = step["run"].replace("make hashed-constraints", "true")
    subprocess.run(["/bin/sh", "-e", "-c", commands], cwd=tmp_path, check=True)
    subprocess.run("sha256sum --check SHA256SUMS", shell=True, cwd=tmp_path / "dist", check=True, capture_output=True)
    listed = {line.split()[1] for line in (tmp_path / "dist/SHA256SUMS").read_text().splitlines()}
    assert listed == {"a.whl", "constraints-cp311.txt"}
