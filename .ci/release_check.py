"""Build the sdist and the wheel, install the wheel in fresh environments outside the checkout, and use it there.

python .ci/release_check.py [--pythons all|this] [--realisations N] [--out dist] [--skip-offline]

The wheel is built from the sdist, so that both are complete. Each Python gets a fresh environment with the pinned
packages and an empty folder, in which the command, the entry points, the scenes, the recipes of meshes and the overview
page must be found. Exit 1 at the first thing that fails. The files and their SHA-256 stay in OUT. With --skip-offline,
nothing is checked where pip reaches no package registry; a line says so, and the exit code is 0.
"""

import argparse
import hashlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import tomllib
import venv
import zipfile
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
OLDEST = (3, 11)
LARGEST_WHEEL_MB = 3.0
BUILD = "build>=1.2"

LONG = 200
"""Arguments from this length on are code and data, and are not shown."""

USE = """
import json, pathlib, sys
import simtest
from simtest.detection.detector import DETECTORS
from simtest.estimators.names import ESTIMATORS
from simtest.runtime.resources import find
from simtest.spec import load_experiment

told = json.loads(sys.argv[1])
home = pathlib.Path(simtest.__file__).resolve()
assert home.is_relative_to(pathlib.Path(sys.prefix).resolve()), f"simtest comes from {home}"
assert simtest.__version__ == told["version"], simtest.__version__
for group in (ESTIMATORS, DETECTORS):
    assert sorted(group.names()) == told[group.group], (group.group, sorted(group.names()))
for name in told["experiments"]:
    load_experiment(name)
for kind in ("scenes", "meshes"):
    for name in told[kind]:
        assert find(name, kind).is_relative_to(home.parent), find(name, kind)
"""


class CheckError(Exception):
    """What failed, in one line."""


def main() -> int:
    """Run the checks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--pythons", choices=("all", "this"), default="all", help="every Python from 3.11 on, or this")
    parser.add_argument("--realisations", type=int, help="of the overview's page; default those of the experiment")
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the files that are built")
    parser.add_argument("--skip-offline", action="store_true", help="check nothing where no registry is reached")
    options = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory(prefix="simtest-release-") as scratch:
            if options.skip_offline and (reason := offline(Path(scratch))):
                print(f"release check: skipped, since pip reaches no package registry: {reason}")
                return 0
            wheel = build(Path(scratch), options.out.resolve())
            found = pythons() if options.pythons == "all" else [Path(sys.executable)]
            for number, python in enumerate(found):
                check_install(python, wheel, Path(scratch) / str(number), options.realisations)
    except CheckError as error:
        print(f"release check: {error}", file=sys.stderr)
        return 1
    seconds = sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    tried = f"{len(found)} environment{'s' * (len(found) > 1)}"
    print(f"release check: {wheel.name} works in {tried}; {seconds:.0f} s of processor time")
    return 0


def tools(scratch: Path) -> Path:
    """Return the Python of the environment, made once, that holds what builds the files: no other is made for each."""
    folder = scratch / "tools"
    python = folder / "bin" / "python"
    if not folder.exists():
        wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["build-system"]["requires"]
        environment(Path(sys.executable), folder)
        # One attempt: without a network, those of pip would take a minute.
        run([python, *PIP, "--retries", "0", "--timeout", "20", BUILD, *wanted], scratch)
    return python


def offline(scratch: Path) -> str:
    """Return why the tools that build the files cannot be had here; an empty text where they can."""
    try:
        tools(scratch)
    except CheckError as error:
        return str(error).partition(": ")[2]
    return ""


def build(scratch: Path, out: Path) -> Path:
    """Build the sdist, and the wheel from it; return the wheel."""
    python = tools(scratch)
    made = scratch / "dist"
    run([python, "-m", "build", "--no-isolation", "--outdir", made, ROOT], scratch)
    version = project()["version"]
    expected = {f"simtest-{version}-py3-none-any.whl", f"simtest-{version}.tar.gz"}
    if {file.name for file in made.iterdir()} != expected:
        raise CheckError(f"built {sorted(file.name for file in made.iterdir())}: must be {sorted(expected)}")
    out.mkdir(parents=True, exist_ok=True)
    sums = []
    for file in sorted(made.iterdir()):
        data = file.read_bytes()
        (out / file.name).write_bytes(data)
        sums.append(f"{hashlib.sha256(data).hexdigest()}  {file.name}\n")
        print(f"release check: {file.name}: {len(data) / 1e6:.2f} MB")
    (out / "SHA256SUMS").write_text("".join(sums), encoding="ascii")
    wheel = next(out.glob(f"simtest-{version}-*.whl"))
    check_wheel(wheel)
    return wheel


def check_wheel(wheel: Path) -> None:
    """Raise `CheckError` where the wheel is too large or holds what does not belong into it."""
    size = wheel.stat().st_size / 1e6
    if size > LARGEST_WHEEL_MB:
        raise CheckError(f"{wheel.name}: {size:.2f} MB, must be at most {LARGEST_WHEEL_MB:g} MB")
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    allowed = {"simtest", f"simtest-{project()['version']}.dist-info"}
    if tops != allowed:
        raise CheckError(f"{wheel.name} holds {sorted(tops - allowed)}: must hold the package alone")


def check_install(base: Path, wheel: Path, scratch: Path, realisations: int | None) -> None:
    """Install the wheel in a fresh environment and use it from an empty folder."""
    version = run([base, "-c", "import platform; print(platform.python_version())"], ROOT).strip()
    python = environment(base, scratch / "venv")
    run([python, *PIP, "--no-compile", "-c", ROOT / "constraints.txt", wheel], scratch)
    run([python, "-m", "pip", "check"], scratch)
    empty = scratch / "empty"
    empty.mkdir()
    run([python, "-c", USE, json.dumps(told())], empty)
    command = python.with_name("simtest")
    if run([command, "--version"], empty).strip() != project()["version"]:
        raise CheckError(f"Python {version}: simtest --version is not {project()['version']}")
    run([command, "doctor"], empty)
    fewer = [] if realisations is None else ["--realisations", str(realisations)]
    run([command, "validate", "overview", *fewer], empty)
    page = empty / "reports" / "runs" / "overview" / "index.html"
    if not page.is_file():
        raise CheckError(f"Python {version}: simtest validate overview made no {page.relative_to(empty)}")
    print(f"release check: Python {version}: installed, pip check clean, page of {page.stat().st_size / 1e6:.2f} MB")


def pythons() -> list[Path]:
    """Return each Python of the machine from 3.11 on: this one, those of pyenv, and those of the system."""
    versions = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [
        Path(sys.base_prefix) / "bin" / "python3",
        *sorted(versions.glob("3.*/bin/python3")),
        *sorted(Path("/usr/local/bin").glob("python3.[0-9]*")),
        *sorted(Path("/usr/bin").glob("python3.[0-9]*")),
    ]
    found: dict[Path, Path] = {}
    for place in places:
        if place.name.rpartition(".")[2].isdecimal() or place.name == "python3":
            found.setdefault(place.resolve(), place)
    return [place for place in found.values() if _is_new_enough(place)]


def _is_new_enough(python: Path) -> bool:
    # ensurepip: Debian packs it apart, and without it there are no fresh environments.
    code = f"import ensurepip, sys; sys.exit(sys.version_info < {OLDEST})"
    return subprocess.run([python, "-c", code], capture_output=True, check=False).returncode == 0


def environment(base: Path, folder: Path) -> Path:
    """Make a fresh virtual environment of a Python; return its interpreter."""
    if base.resolve() == Path(sys.executable).resolve():
        venv.create(folder, with_pip=True)
    else:
        run([base, "-m", "venv", folder], folder.parent.parent)
    return folder / "bin" / "python"


PIP = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check")


def project() -> dict[str, str]:
    """Return the table `project` of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def told() -> dict[str, object]:
    """Return what an installation must have: its version, entry points, and the names of its data."""
    table = project()
    groups = {group: sorted(names) for group, names in table["entry-points"].items()}  # type: ignore[attr-defined]
    names = {
        kind: sorted(file.stem for file in (ROOT / folder).glob("*.toml"))
        for kind, folder in (("scenes", "scenes"), ("experiments", "scenes/experiments"), ("meshes", "meshes"))
    }
    return {"version": table["version"], **groups, **names}


def run(command: Sequence[object], folder: Path) -> str:
    """Run a command in a folder and return its output; raise `CheckError` where it fails."""
    folder.mkdir(parents=True, exist_ok=True)
    own = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=folder, env=own, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip()).splitlines() or ["nothing said"]
        shown = " ".join(word for word in words if len(word) < LONG)
        raise CheckError(f"{shown}: exit {done.returncode}: {said[-1]}")
    return done.stdout


if __name__ == "__main__":
    sys.exit(main())
