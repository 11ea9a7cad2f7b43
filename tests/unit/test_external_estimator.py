"""Estimators and detectors of other packages, built and installed for real, are found and run by name."""

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
other_plain = "other_core:plain"
other_missing = "other_core:nothing_of_that_name"
other_constant = "other_core:CONSTANT"
cone_axis = "other_core:axis"

[project.entry-points."simtest.detectors"]
other_middle = "other_core:middle"
other_constant = "other_core:CONSTANT"

[tool.hatch.build.targets.wheel]
packages = ["other_core"]
"""

MODULE = """
import numpy as np
from simtest import Camera, Estimate, Failure, Patch, Reason
from simtest.detection import Detection, Region

CONSTANT = 3


class Axis:
    def estimate(self, patch, camera, priors):
        normal = -camera.unproject(patch.peak_px)
        return Estimate(normal=normal, candidates=normal[None], look_px=patch.peak_px, flags=("from outside",))


class Raises:
    def estimate(self, patch, camera, priors):
        raise KeyError("a fault of the other package")


class Garbage:
    def estimate(self, patch, camera, priors):
        return "north"


class Crooked:
    def estimate(self, patch, camera, priors):
        return Estimate(np.array([0.0, 0.0, -2.0]), np.array([[0.0, 0.0, -2.0]]), patch.peak_px)


class Refuses:
    def estimate(self, patch, camera, priors):
        return Failure(Reason.NOT_AN_ELLIPSE, "not today")


class Middle:
    def detect(self, frame, camera, priors):
        box = (camera.width // 4, camera.height // 4, camera.width // 2, camera.height // 2)
        return Detection((Region(box, (camera.width // 2, camera.height // 2), 1.0),), frame)


def plain(patch: Patch, camera: Camera) -> Estimate:
    return axis.estimate(patch, camera, None)


axis, raises, garbage, crooked, refuses, middle = Axis(), Raises(), Garbage(), Crooked(), Refuses(), Middle()
"""

CHILD = """
import json
import warnings
import numpy as np
import simtest
from simtest.calibration import Calibration, Frame, Priors
from simtest.detection import load_detector
from simtest.detection.detector import DETECTORS
from simtest.estimators.names import ESTIMATORS, load_estimators
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import reconstruct_values

camera = simtest.Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
frame = np.exp(-((x - 70) ** 2 + (y - 40) ** 2) / 72).astype(np.float32)
names = ["other_axis", "brightest_point", "other_raises", "other_garbage", "other_crooked", "other_refuses",
         "simtest:cone_axis", "Other_Core:cone_axis"]
(found,) = simtest.reconstruct(frame, camera, names)
said = {}
for name, result in found.estimates.items():
    failed = isinstance(result, simtest.Failure)
    said[name] = [str(result.reason), result.detail] if failed else ["ok", result.normal.tolist(), list(result.flags)]
refused = {}
for name in ("other_missing", "other_constant", "other_plain", "nobody", "cone_axis", "nobody:cone_axis"):
    try:
        load_estimators([name])
    except simtest.InputError as error:
        refused[name] = str(error)
for name in ("nobody", "other_constant"):
    try:
        load_detector(name)
    except simtest.InputError as error:
        refused["detector " + name] = str(error)
seen = Frame(frame, Calibration(camera), 2.0)
asked = Options(fov_deg=60.0, detector="other_middle", estimators=("brightest_point",))
taken = reconstruct_values("frame", frame, Calibration(camera), asked)
try:
    Options(fov_deg=60.0, detector="nobody")
except simtest.InputError as error:
    refused["--detector nobody"] = str(error)
print(json.dumps({
    "available": ESTIMATORS.names(), "detectors": DETECTORS.names(), "said": said, "refused": refused,
    "distributions": ESTIMATORS.distributions(["other_axis", "Other-Core:cone_axis", "nobody"]),
    "taken": [taken.choices.detector, [list(spot.region.box) for spot in taken]],
    "middle": list(load_detector("other_middle").detect(seen, camera, Priors()).regions[0].box),
}))
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
    assert {"other_axis", "other_raises", "circle_pose", "brightest_point"} <= set(answer["available"])
    assert answer["available"] == sorted(answer["available"])
    assert {"other_middle", "peaks", "colour"} <= set(answer["detectors"])
    assert answer["middle"] == [30, 22, 60, 45]
    assert answer["taken"] == ["other_middle", [[30, 22, 60, 45]]]
    found = {"estimator other_axis": "other-core 3.1", "estimator Other-Core:cone_axis": "other-core 3.1"}
    assert answer["distributions"] == found


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


def test_a_name_of_two_packages_is_refused_unless_the_package_is_named(answer):
    assert {"simtest:cone_axis", "other-core:cone_axis"} <= set(answer["available"])
    assert "cone_axis" not in answer["available"]
    refused = answer["refused"]["cone_axis"]
    assert refused == (
        "estimator 'cone_axis': registered by 2 packages; name one of them: other-core:cone_axis or simtest:cone_axis"
    )
    assert answer["said"]["simtest:cone_axis"][2] == []
    assert answer["said"]["Other_Core:cone_axis"][2] == ["from outside"]


def test_a_broken_registration_is_refused_with_one_line(answer):
    refused = answer["refused"]
    assert set(refused) == {"other_missing", "other_constant", "other_plain", "nobody", "cone_axis", "nobody:cone_axis",
                            "--detector nobody", "detector nobody", "detector other_constant"}  # fmt: skip
    assert "cannot be imported" in refused["other_missing"]
    for name in ("other_constant", "other_plain"):
        assert f"estimator '{name}': " in refused[name]
        assert "has neither estimate(patch, camera, priors) nor estimate_frame(" in refused[name]
    assert "other_axis" in refused["nobody"]
    assert "not installed" in refused["nobody:cone_axis"]
    assert "peaks" in refused["detector nobody"]
    assert "detector 'nobody': not installed; allowed: colour, " in refused["--detector nobody"]
    assert "other_constant, other_middle, peaks" in refused["--detector nobody"]
    assert "no object with a method detect" in refused["detector other_constant"]
    assert all("\n" not in message for message in refused.values())
