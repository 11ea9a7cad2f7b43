"""The Dockerfile installs what the manual tells users to install, from files that the build can see, as no root."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "Dockerfile"

pytestmark = pytest.mark.skipif(not FILE.is_file(), reason="the checkout's Dockerfile is not there")


def instructions():
    """Return the Dockerfile's instructions: their names and arguments, continued lines joined."""
    lines = [line for line in FILE.read_text(encoding="ascii").splitlines() if not line.lstrip().startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    return [tuple(line.split(maxsplit=1)) for line in joined.splitlines() if line.strip()]


def test_pip_installs_as_the_manual_says():
    commands = " && ".join(value for name, value in instructions() if name == "RUN").split("&&")
    installs = [" ".join(command.split()) for command in commands if "pip install" in command]
    manual = [ROOT / "README.md", *sorted((ROOT / "docs" / "start").glob("*.md"))]
    told = {line.strip().removeprefix("$ ") for page in manual for line in page.read_text("utf-8").splitlines()}
    assert [install.replace("--no-cache-dir ", "") for install in installs] == ["pip install -c constraints.txt ."]
    # A checkout stays editable; a container has none.
    assert "pip install -c constraints.txt -e ." in told


def test_python_is_one_that_the_package_supports():
    ((_, image),) = [each for each in instructions() if each[0] == "FROM"]
    version = tuple(map(int, re.fullmatch(r"python:(\d+)\.(\d+)-slim-\w+", image).groups()))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version >= tuple(map(int, project["requires-python"].removeprefix(">=").split(".")))


def test_the_command_runs_as_a_user():
    names = [name for name, _ in instructions()]
    user = next(value for name, value in instructions() if name == "USER")
    assert int(user) >= 1000
    assert names.index("USER") < names.index("ENTRYPOINT")
    assert ("ENTRYPOINT", '["simtest"]') in instructions()


def test_the_manual_mounts_the_folder_that_the_command_works_in():
    (folder,) = [value for name, value in instructions() if name == "WORKDIR" and value != "/src"]
    for file in (FILE, ROOT / "docs/reference/limits.md"):
        assert re.findall(r'-v "\$PWD:([^"]+)"', file.read_text(encoding="utf-8")) == [folder]


def test_the_build_sees_all_that_the_package_is_built_from():
    seen = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    wheel = project["tool"]["hatch"]["build"]["targets"]["wheel"]
    needed = {*wheel["packages"], *wheel["force-include"], project["project"]["readme"], "pyproject.toml"}
    assert needed | {"LICENSE", "constraints.txt"} == seen
    assert all((ROOT / name).exists() for name in seen)
