"""What commands load: packages load their modules at first use, and a finished run none of what made it."""

import importlib
import subprocess
import sys

import pytest

import simtest
from simtest import Camera, load_calibration, save_camera
from simtest.spec import CalibrationSpec

PACKAGES = ("simtest", "simtest.calibration", "simtest.detection", "simtest.estimators", "simtest.geometry",
            "simtest.reconstruction", "simtest.rendering", "simtest.spec", "simtest.surfaces")  # fmt: skip

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
        assert name in vars(module)
    assert set(module.__all__) <= set(dir(module))
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
    code = (
        "import contextlib, sys\nsys.argv = ['simtest', 'validate', *sys.argv[1:]]\n"
        "from simtest.cli.main import main\nwith contextlib.suppress(SystemExit): main()"
    )
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
