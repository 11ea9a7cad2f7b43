"""The public names: what is promised, where it comes from, and what importing it must not load."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import simtest

ROOT = Path(__file__).resolve().parents[2]

PUBLIC = {
    "BackendError": "simtest.errors",
    "BrownConrady": "simtest.geometry.lenses",
    "Calibration": "simtest.calibration.calibration",
    "Camera": "simtest.geometry.camera",
    "Estimate": "simtest.estimators.protocol",
    "Experiment": "simtest.spec.recipes",
    "Failure": "simtest.errors",
    "InputError": "simtest.errors",
    "KannalaBrandt": "simtest.geometry.lenses",
    "Scaramuzza": "simtest.geometry.lenses",
    "LabelledFrame": "simtest.simulation.frame",
    "Patch": "simtest.geometry.patch",
    "Reason": "simtest.errors",
    "RunResults": "simtest.report.run_results",
    "Scene": "simtest.spec.scene",
    "SimtestError": "simtest.errors",
    "Specularity": "simtest.reconstruction.records",
    "ViewMask": "simtest.geometry.camera",
    "export": "simtest.api",
    "load_calibration": "simtest.spec.calibration_file",
    "load_camera": "simtest.spec.camera",
    "load_experiment": "simtest.spec.recipes",
    "load_scene": "simtest.spec.scene",
    "reconstruct": "simtest.reconstruction.pipeline",
    "render": "simtest.api",
    "save_calibration": "simtest.spec.calibration_file",
    "save_camera": "simtest.spec.camera",
    "validate": "simtest.api",
}
"""Public name and the module that defines it. A change here is a change of the interface."""


def child(code):
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def test_public_names():
    assert simtest.__all__ == sorted(PUBLIC)
    assert set(PUBLIC) | {"__version__"} == set(dir(simtest))


@pytest.mark.parametrize("name", PUBLIC)
def test_each_is_loaded_on_demand_from_its_home(name):
    value = getattr(simtest, name)
    assert value.__module__ == PUBLIC[name]
    assert getattr(simtest, name) is value


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="module 'simtest' has no attribute 'nothing'"):
        _ = simtest.nothing


def test_version_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert simtest.__version__ == project["version"]


def test_importing_the_package_loads_no_library():
    heavy = child(
        "import simtest, sys, json; dir(simtest);"
        "print(json.dumps(sorted({m.partition('.')[0] for m in sys.modules}"
        " & {'mitsuba', 'drjit', 'vtk', 'pyvista', 'torch', 'vl_convert', 'matplotlib', 'numpy', 'pydantic', 'cv2'})))"
    )
    assert heavy == []


def test_reconstructing_loads_neither_renderer_nor_viewer():
    loaded = child(
        "import simtest, sys, json; simtest.reconstruct; simtest.Camera; simtest.load_camera;"
        "print(json.dumps(sorted({m.partition('.')[0] for m in sys.modules}"
        " & {'mitsuba', 'drjit', 'vtk', 'pyvista', 'torch', 'vl_convert', 'matplotlib'})))"
    )
    assert loaded == []


SLOW = {"scipy", "polars", "matplotlib", "mitsuba", "drjit", "trimesh", "igl", "pyvista", "vtk", "multiprocessing"}
"""Packages that reconstruction of a picture needs no more than a page of figures."""


@pytest.mark.parametrize("known", ["camera", pytest.param("fov", marks=pytest.mark.ci)])
def test_a_picture_is_reconstructed_without_slow_packages(known, tmp_path):
    y, x = np.mgrid[:90, :120]
    picture = 40 + 180 * np.exp(-((x - 60) ** 2 / 300 + (y - 45) ** 2 / 200))
    cv2.imwrite(str(tmp_path / "picture.png"), picture.astype(np.uint8))
    simtest.save_camera(simtest.Camera.from_fov(60.0, 120, 90), tmp_path / "camera.toml")
    option = ["--camera", str(tmp_path / "camera.toml")] if known == "camera" else ["--fov", "60"]
    arguments = ["simtest", "reconstruct", str(tmp_path / "picture.png"), *option, "--out", str(tmp_path / "out")]
    loaded = child(
        "import contextlib, io, json, sys, warnings\n"
        "warnings.simplefilter('ignore')\n"
        f"sys.argv = {arguments!r}\n"
        "from simtest.cli.main import main\n"
        "with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()): main()\n"
        "print(json.dumps(sorted({m.partition('.')[0] for m in sys.modules})))"
    )
    assert {"numpy", "cv2"} <= set(loaded)
    assert not SLOW & set(loaded)
    assert ("pydantic" in loaded) == (known == "camera")
    records = json.loads((tmp_path / "out" / "normals.json").read_text())["specularities"]
    assert len(records) == 1
    assert set(records[0]["estimates"]) == {"circle_pose", "brightest_point", "cone_axis", "curved"}


def test_estimators_that_are_registered():
    from simtest.detection.detector import DETECTORS
    from simtest.estimators.names import ESTIMATORS
    from simtest.reconstruction.options import DEFAULT_ESTIMATORS

    registered = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    assert {"circle_pose", "brightest_point", "cone_axis"} <= set(registered[ESTIMATORS.group])
    assert {"peaks", "colour"} <= set(registered[DETECTORS.group])
    for group in (ESTIMATORS, DETECTORS):
        assert set(registered[group.group]) <= set(group.names())
    assert DEFAULT_ESTIMATORS == ("circle_pose", "brightest_point", "cone_axis", "curved")
