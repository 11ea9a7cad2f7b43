"""An estimator of another package, built and installed for real, is found and run by name."""

import json
import os
import subprocess
import sys
import zipfile

import pytest

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "other-core"
version = "3.1"

[project.entry-points."simtest.estimators"]
other_axis = "other_core:axis"
other_raises = "other_core:raises"
other_garbage = "other_core:garbage"
other_crooked = "other_core:crooked"
other_refuses = "other_core:refuses"
other_missing = "other_core:nothing_of_that_name"
other_constant = "other_core:CONSTANT"

[tool.hatch.build.targets.wheel]
packages = ["other_core"]
"""

MODULE = """
import numpy as np
from simtest import Camera, Estimate, Failure, Patch, Reason

CONSTANT = 3


def axis(patch: Patch, camera: Camera) -> Estimate:
    normal = -camera.unproject(patch.peak_px)
    return Estimate(normal=normal, candidates=normal[None], look_px=patch.peak_px, flags=("from outside",))


def raises(patch, camera):
    raise KeyError("a fault of the other package")


def garbage(patch, camera):
    return "north"


def crooked(patch, camera):
    return Estimate(np.array([0.0, 0.0, -2.0]), np.array([[0.0, 0.0, -2.0]]), patch.peak_px)


def refuses(patch, camera):
    return Failure(Reason.NOT_AN_ELLIPSE, "not today")
"""

CHILD = """
import json
import numpy as np
import simtest
from simtest.estimators.registry import available, load_estimators

camera = simtest.Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
frame = np.exp(-((x - 70) ** 2 + (y - 40) ** 2) / 72)
names = ["other_axis", "brightest_point", "other_raises", "other_garbage", "other_crooked", "other_refuses"]
(found,) = simtest.reconstruct(frame, camera, names)
said = {}
for name, result in found.estimates.items():
    failed = isinstance(result, simtest.Failure)
    said[name] = [str(result.reason), result.detail] if failed else ["ok", result.normal.tolist(), list(result.flags)]
refused = {}
for name in ("other_missing", "other_constant", "nobody"):
    try:
        load_estimators([name])
    except simtest.InputError as error:
        refused[name] = str(error)
print(json.dumps({"available": available(), "said": said, "refused": refused}))
"""


@pytest.fixture(scope="module")
def answer(tmp_path_factory):
    """Build the wheel, unpack it as an installer does, and reconstruct in a child process that sees it."""
    folder = tmp_path_factory.mktemp("other")
    source, target = folder / "source", folder / "site"
    (source / "other_core").mkdir(parents=True)
    (source / "pyproject.toml").write_text(PROJECT)
    (source / "other_core" / "__init__.py").write_text(MODULE)
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=source, check=True, capture_output=True, text=True, timeout=60)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    path = os.pathsep.join(filter(None, [str(target), os.environ.get("PYTHONPATH", "")]))
    child = subprocess.run(
        [sys.executable, "-W", "error", "-c", CHILD],
        env={**os.environ, "PYTHONPATH": path},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert child.returncode == 0, child.stderr
    assert child.stderr == ""
    return json.loads(child.stdout)


def test_it_is_found_beside_those_of_simtest(answer):
    assert {"other_axis", "other_raises", "circle_pose", "brightest_point", "cone_axis"} <= set(answer["available"])
    assert answer["available"] == sorted(answer["available"])


def test_it_runs_by_name_on_the_same_patch(answer):
    status, normal, flags = answer["said"]["other_axis"]
    assert status == "ok"
    assert flags == ["from outside"]
    assert normal == pytest.approx(answer["said"]["brightest_point"][1])
    # The peak at (70, 40) of a camera with c = (60, 45) and f = 100.
    assert [-normal[0] / normal[2], -normal[1] / normal[2]] == pytest.approx([-0.1, 0.05], abs=1e-3)


def test_what_it_raises_or_gives_in_the_wrong_form_is_a_failure(answer):
    said = answer["said"]
    assert said["other_raises"][0] == "estimator_error"
    assert "KeyError" in said["other_raises"][1]
    assert "a fault of the other package" in said["other_raises"][1]
    assert said["other_garbage"][0] == "estimator_error"
    assert "str" in said["other_garbage"][1]
    assert said["other_crooked"][0] == "estimator_error"
    assert said["other_refuses"] == ["not_an_ellipse", "not today"]


def test_a_broken_registration_is_refused_with_one_line(answer):
    refused = answer["refused"]
    assert set(refused) == {"other_missing", "other_constant", "nobody"}
    assert "cannot be imported" in refused["other_missing"]
    assert "not callable" in refused["other_constant"]
    assert "other_axis" in refused["nobody"]
    assert all("\n" not in message for message in refused.values())
