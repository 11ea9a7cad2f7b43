"""The public names: what is promised, where it comes from, their examples, and what each command and package loads."""

import doctest
import importlib
import inspect
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import simtest
from simtest import Camera, load_calibration, save_camera
from simtest.spec import CalibrationSpec

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


def test_public_names():
    assert simtest.__all__ == sorted(PUBLIC)
    assert set(PUBLIC) | {"__version__"} == set(dir(simtest))


def test_each_comes_from_its_home():
    assert {name: getattr(simtest, name).__module__ for name in PUBLIC} == PUBLIC


def test_version_is_that_of_the_project():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert simtest.__version__ == project["version"]


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
    modules = loaded(f"import sys\nsys.argv = {arguments!r}\n{COMMAND}")
    assert {"numpy", "cv2"} <= modules
    assert not SLOW & modules
    assert ("pydantic" in modules) == (known == "camera")
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


PACKAGES = ("simtest", "simtest.calibration", "simtest.detection", "simtest.estimators", "simtest.geometry",
            "simtest.reconstruction", "simtest.rendering", "simtest.spec", "simtest.surfaces")  # fmt: skip
COMMAND = """
import contextlib
from simtest.cli.main import main
with contextlib.suppress(SystemExit): main()
"""
EXPERIMENT = """
realisations = 1
estimators = ["brightest_point"]
[[groups]]
scene = "sphere"
[groups.set]
"camera.width" = 64
"camera.height" = 48
"camera.fx" = 48.0
"camera.fy" = 48.0
"""


def loaded(code, *arguments, folder=None):
    """Names of the modules that are loaded once a child process has run `code`."""
    script = f"{code}\nimport sys; print('LOADED', *sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script, *map(str, arguments)], cwd=folder, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split("LOADED ")[1].split())


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_found_once(package):
    module = importlib.import_module(package)
    for name in module.__all__:
        assert getattr(module, name) is getattr(module, name)
    # The second time without the lookup.
    assert set(module.__all__) <= set(vars(module)) & set(dir(module))
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'nothing'"):
        module.nothing  # noqa: B018


def test_a_name_comes_from_the_module_that_is_stated(tmp_path, monkeypatch):
    (tmp_path / "lazy_package.py").write_text(
        "from typing import TYPE_CHECKING\nfrom simtest.runtime.lazy_names import lazy_names\n"
        "if TYPE_CHECKING:\n    from decimal import Decimal\n    from fractions import (\n        Fraction,\n    )\n"
        "from os import path\n__getattr__, __dir__, __all__ = lazy_names(__name__)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    package = importlib.import_module("lazy_package")
    assert package.__all__ == dir(package) == ["Decimal", "Fraction"]
    assert package.Fraction.__module__ == "fractions"
    with pytest.raises(AttributeError, match="'Ratio'"):
        package.Ratio  # noqa: B018


HEAVY = {"mitsuba", "drjit", "vtk", "vtkmodules", "torch", "pyvista", "polars", "matplotlib", "vl_convert"}


@pytest.mark.parametrize("line", ["--help", "render --help", "schema scene"])
def test_light_commands_load_nothing_heavy(line):
    assert not HEAVY & loaded(f"import sys\nsys.argv = ['simtest', *{line.split()!r}]\n{COMMAND}")


def test_names_and_descriptions_load_no_library():
    libraries = HEAVY | {"numpy", "scipy", "pydantic", "cv2"}
    assert not libraries & loaded(
        "import simtest\ndir(simtest), simtest.__version__, simtest.InputError, simtest.Failure"
    )
    described = "from simtest.cli.scenes import names_of\nassert 'inverse_rendering' in names_of('estimators')"
    assert not {"numpy", "scipy", "mitsuba", "cv2"} & loaded(described)


def test_a_name_loads_its_own_module_alone():
    modules = loaded("from simtest.geometry import Camera, Array\nfrom simtest.calibration import Response")
    assert "simtest.geometry.camera" in modules
    assert not modules & {"cv2", "skimage", "simtest.geometry.patch", "simtest.calibration.frame", "scipy", "pydantic"}
    # Negative control: the names that need them load them.
    assert {"cv2", "skimage"} <= loaded("from simtest.geometry import Patch")


@pytest.mark.render
def test_a_finished_run_is_recognised_without_what_made_it(tmp_path):
    (tmp_path / "small.toml").write_text(EXPERIMENT)
    page = simtest.validate(tmp_path / "small.toml", tmp_path / "run").page
    before = page.stat().st_mtime_ns
    code = f"import sys\nsys.argv = ['simtest', 'validate', *sys.argv[1:]]\n{COMMAND}"
    slow = {
        "polars",
        "cv2",
        "skimage",
        "scipy",
        "mitsuba",
        "jinja2",
        "rich.progress",
        "PIL",
        "simtest.surfaces.factory",
    }
    arguments = (tmp_path / "small.toml", "--out", tmp_path / "run")
    assert not loaded(code, *arguments) & slow
    assert page.stat().st_mtime_ns == before
    # Negative control: results that are not as they were written are made again.
    results = tmp_path / "run" / "results.parquet"
    whole = results.read_bytes()
    results.write_bytes(whole[:-1] + b"?")
    simtest.validate(tmp_path / "small.toml", tmp_path / "run")
    assert results.read_bytes() == whole


def test_a_camera_alone_loads_no_models_of_sensor_and_lobe(tmp_path):
    camera = Camera.from_fov(60.0, 120, 90)
    save_camera(camera, tmp_path / "camera.toml")
    (tmp_path / "calibration.toml").write_text((tmp_path / "camera.toml").read_text() + "[sensor]\nbits = 8\n")
    code = "import sys; from simtest.spec import load_calibration; load_calibration(sys.argv[1])"
    models = {"simtest.spec.sensor", "simtest.spec.reflectance", "numpy.random", "cv2"}
    assert not loaded(code, tmp_path / "camera.toml") & models
    # Negative control, and the same calibration by both ways.
    assert "simtest.spec.sensor" in loaded(code, tmp_path / "calibration.toml")
    assert load_calibration(tmp_path / "camera.toml") == CalibrationSpec(camera={}).calibration(camera)
    assert load_calibration(tmp_path / "calibration.toml").noise.bits == 8


def test_a_page_is_loaded_with_neither_scipy_nor_pillow_s_other_formats(tmp_path):
    code = (
        "import numpy as np\nfrom simtest.pages.pixels import data_address\n"
        "from simtest.report.page import draw_page\nfrom simtest.runtime.statistics import mean_interval\n"
        "data_address(np.zeros((8, 8, 3), np.uint8))"
    )
    modules = loaded(code)
    assert "PIL.AvifImagePlugin" in modules
    unused = {"scipy", "scipy.special", "PIL.PdfImagePlugin", "PIL.WebPImagePlugin", "vl_convert", "trimesh"}
    assert not modules & unused
    # An interval takes two functions of SciPy, and not its distributions, which take three times as long to load.
    modules = loaded(code + "\nassert mean_interval(np.arange(5.0))[1] > 2")
    assert "scipy.special" in modules
    assert "scipy.stats" not in modules


def test_a_picture_is_reconstructed_without_scipy_and_masked_arrays():
    code = (
        "import numpy as np\nimport simtest\ny, x = np.mgrid[:96, :128]\n"
        "spot = 0.4 * np.exp(-((x - 60) ** 2 + (y - 50) ** 2) / 40)\n"
        "picture = np.rint(255 * (spot[..., None] + np.array([0.5, 0.3, 0.25]))).astype(np.uint8)\n"
        "assert simtest.reconstruct(picture, 60.0)"
    )
    assert not loaded(code) & {"scipy", "numpy.ma", "jinja2", "rich"}


MARKS = {
    "LabelledFrame": [pytest.mark.render],
    "export": [pytest.mark.render],
    "render": [pytest.mark.render],
    "validate": [pytest.mark.render, pytest.mark.slow],
}


def examples_of(name):
    text = inspect.getdoc(getattr(simtest, name))
    return doctest.DocTestParser().get_doctest(text, {}, name, None, 0)


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in PUBLIC])
def test_examples_run_as_written(name, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert examples_of(name).examples
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    outcome = runner.run(examples_of(name), out=said.append, clear_globs=True)
    assert outcome.failed == 0, "".join(said)


def test_a_wrong_example_is_noticed():
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert doctest.DocTestRunner().run(wrong, out=lambda text: None).failed == 1
