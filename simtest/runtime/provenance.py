"""Where numbers come from: commit, versions, processor, and hashes of the inputs."""

import hashlib
import importlib.metadata
import platform
import subprocess
from functools import cache
from pathlib import Path

PACKAGES = (
    "mitsuba",
    "drjit",
    "numpy",
    "scipy",
    "scikit-image",
    "opencv-python-headless",
    "trimesh",
    "libigl",
    "polars",
)
_ROOT = Path(__file__).resolve().parents[1]


def version() -> str:
    """Give simtest's version."""
    return importlib.metadata.version("simtest")


def commit() -> str | None:
    """Give the commit of the checkout that simtest runs from, with "+" where it is changed; None outside one."""
    try:
        head = _git("rev-parse", "HEAD")
        return head + ("+" if _git("status", "--porcelain") else "")
    except (OSError, subprocess.SubprocessError):
        return None


def _git(*arguments: str) -> str:
    # The package's own folder, not the caller's: a user's repository says nothing about simtest.
    if not (_ROOT.parent / ".git").exists():
        raise OSError("not a checkout")
    return subprocess.run(
        ["git", "-C", str(_ROOT.parent), *arguments], capture_output=True, text=True, timeout=10, check=True
    ).stdout.strip()


def versions() -> dict[str, str]:
    """Give the versions of the packages that numbers depend on."""
    found = {"simtest": version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def processor() -> str:
    """Give the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


@cache
def source_hash() -> str:
    """Give a hash of simtest's own source: two runs are the same run only under the same code."""
    digest = hashlib.sha256()
    for path in sorted(_ROOT.rglob("*.py")):
        digest.update(str(path.relative_to(_ROOT)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def file_hash(path: Path) -> str:
    """Give the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def environment() -> dict[str, str | dict[str, str] | None]:
    """Give what a report prints of its origin."""
    return {
        "commit": commit(),
        "version": version(),
        "versions": versions(),
        "python": platform.python_version(),
        "processor": processor(),
        "system": platform.platform(),
    }
