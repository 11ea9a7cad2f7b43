"""Origin of the numbers: commit, versions, processor, and hashes of the inputs."""

import hashlib
import importlib.metadata
import platform
import subprocess
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import TypedDict

from simtest.runtime.files import require_plain

PACKAGES = (
    "mitsuba", "drjit", "numpy", "scipy", "scikit-image", "opencv-python-headless", "trimesh", "libigl", "polars",
)  # fmt: skip
_ROOT = Path(__file__).resolve().parents[1]


class Environment(TypedDict):
    """What each report and JSON file states of its origin."""

    commit: str | None
    version: str
    versions: dict[str, str]
    python: str
    processor: str
    system: str


def version() -> str:
    """Return simtest's version."""
    return importlib.metadata.version("simtest")


def commit() -> str | None:
    """Return the commit of simtest's checkout, with "+" if files are changed; None outside a checkout."""
    try:
        # One call for both: lines of the branch begin with #, and any other line is a change.
        told = _git("status", "--porcelain=v2", "--branch").splitlines()
        head = next(line for line in told if line.startswith("# branch.oid ")).split()[2]
        if head == "(initial)":
            return None
        return head + ("+" if any(not line.startswith("#") for line in told) else "")
    except (OSError, subprocess.SubprocessError, StopIteration):
        return None


def _git(*arguments: str) -> str:
    # The package's own folder, not the caller's: the commit of a user's repository means nothing here.
    if not (_ROOT.parent / ".git").exists():
        raise OSError("not a checkout")
    return subprocess.run(
        ["git", "-C", str(_ROOT.parent), *arguments], capture_output=True, text=True, timeout=10, check=True
    ).stdout.strip()


def versions() -> dict[str, str]:
    """Return the versions of the packages that numbers depend on."""
    return {"simtest": version()} | package_versions(PACKAGES)


def package_versions(names: Iterable[str]) -> dict[str, str]:
    """Return the versions of packages; "missing" of those that are not installed."""
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def processor() -> str:
    """Return the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


@cache
def source_hash() -> str:
    """Return a hash of simtest's own source and fitted numbers: two runs are the same run only under the same code."""
    digest = hashlib.sha256()
    for path in sorted([*_ROOT.rglob("*.py"), _ROOT / "fitted.toml"]):
        digest.update(str(path.relative_to(_ROOT)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with require_plain(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def environment() -> Environment:
    """Return commit, versions, processor and system of this run."""
    return {
        "commit": commit(),
        "version": version(),
        "versions": versions(),
        "python": platform.python_version(),
        "processor": processor(),
        "system": platform.platform(),
    }
