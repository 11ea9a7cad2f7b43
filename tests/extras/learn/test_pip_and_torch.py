"""The extra for learning brings no second PyTorch."""

import importlib
import importlib.metadata
import json
import subprocess
import sys
import tomllib

import pytest
import torch
from packaging.requirements import Requirement
from test_packaging import ROOT


@pytest.mark.slow
def test_pip_adds_nothing_to_a_cpu_build_for_the_extra_for_learning(tmp_path):
    # Without an index pip can add nothing, so its resolver must be content with what is there.
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--no-index", "--no-build-isolation", "--quiet"]
    command += ["--report", str(tmp_path / "report.json"), "-c", str(ROOT / "constraints.txt"), f"{ROOT}[learn]"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert [each["metadata"]["name"] for each in report["install"]] == ["simtest"]


def test_the_extra_for_learning_brings_no_cuda_to_a_cpu_build():
    if torch.version.cuda is not None:
        pytest.skip("this PyTorch was built for CUDA")
    # With PyTorch's CPU build there, everything else that the extra names is satisfied without a GPU's libraries.
    names = {distribution.name.lower() for distribution in importlib.metadata.distributions()}
    assert not [name for name in names if name.startswith(("nvidia-", "triton", "cuda-"))]
    extra = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    (wanted,) = [text for text in extra["learn"] if text.startswith("torch")]
    # pip takes the build that is there: its local version meets the bound and the pinned version.
    requirement = Requirement(wanted)
    pinned = next(line for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("torch=="))
    assert requirement.specifier.contains(torch.__version__)
    assert Requirement(pinned).specifier.contains(torch.__version__)
