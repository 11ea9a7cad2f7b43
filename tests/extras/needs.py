"""What each folder of tests/extras needs beside the extra `test`: Python packages, programs, libraries."""

import ctypes.util
import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

NEEDS = {
    "browser": ("test-extras and Chromium", ("playwright", "axe_playwright_python", "chromium")),
    "checkers": ("test-extras and systemd", ("hadolint", "zizmor", "check-jsonschema", "systemd-analyze")),
    "cores": ("Octave and a C++ compiler", ("octave-cli", "g++")),
    "docs": ("docs", ("sphinx",)),
    "exchange": ("test-extras", ("datasets", "webdataset", "ray", "pycolmap")),
    "git": ("git", ("git",)),
    "learn": ("learn", ("torch", "onnx", "onnxruntime")),
    "video": ("video", ("av",)),
    "viewer": ("libEGL", ("EGL",)),
}
"""By folder: the extra or the programs, in words, and the names of packages, programs and libraries."""


def program(name: str) -> str | None:
    """Return the path of a program, which may lie beside this Python; None: it is not there."""
    return shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]))


def _is_there(name: str) -> bool:
    # A folder of that name, as tests/extras/git, is no package: it has no origin.
    spec = find_spec(name) if name.isidentifier() else None
    if spec is not None and spec.origin is not None:
        return True
    return program(name) is not None or ctypes.util.find_library(name) is not None


def missing() -> dict[str, str]:
    """Return a line for each folder whose needs are not met."""
    lines = {}
    for folder, (extra, names) in NEEDS.items():
        if absent := [name for name in names if not _is_there(name)]:
            lines[folder] = f"tests/extras/{folder}: skipped, needs {extra} (not here: {', '.join(absent)})"
    return lines
