"""The manual's names of the last release still work, warn, and mean the new things."""

import importlib
import subprocess
import sys

import pytest

import simtest
from simtest._renamed import MODULES, NAMES
from simtest.calibration import Normal, exactly

DOCUMENTED = {
    "simtest.colour": ("detect_in_picture", "reconstruct_colour"),
    "simtest.engines": ("make_engine",),
    "simtest.estimators.base": ("Estimate", "FittedIsophote"),
    "simtest.gate.records": ("COMPARISONS", "FIGURES", "Verdict"),
    "simtest.imaging.depth": ("depth_points", "read_depth"),
    "simtest.learn": ("Crops", "read_crops"),
    "simtest.report.nightly": ("write_nightly_page",),
}


@pytest.mark.parametrize("module", DOCUMENTED)
def test_old_modules_lead_to_the_new_ones(module):
    sys.modules.pop(module, None)
    with pytest.warns(DeprecationWarning, match=r"the old name goes in 0\.3\.0"):
        old = importlib.import_module(module)
    new = importlib.import_module(old.__spec__.origin)
    for name in DOCUMENTED[module]:
        assert getattr(old, name) is getattr(new, name)


def test_every_new_name_exists():
    for name in MODULES.values():
        importlib.import_module(name)
    for name in NAMES.values():
        module, _, attribute = name.rpartition(".")
        assert hasattr(importlib.import_module(module), attribute)


def test_old_names_that_went_elsewhere():
    with pytest.warns(DeprecationWarning, match="isophote_fit"):
        from simtest.estimators.base import fit_isophotes
    assert fit_isophotes is importlib.import_module("simtest.estimators.isophote_fit").fit_isophotes
    with pytest.warns(DeprecationWarning, match="NightlyRun"):
        from simtest.gate.records import Night
    assert Night is importlib.import_module("simtest.nightly.records").NightlyRun


def test_old_names_in_modules_that_stayed():
    with pytest.warns(DeprecationWarning, match=r"Known is now simtest.calibration.Priors"):
        from simtest.calibration import Known
    told = Known(((1.0, 0.0, 0.0),), 10.0, 0.5, 200.0)
    assert told == simtest.calibration.Priors(((1.0, 0.0, 0.0),), Normal(10.0, 0.5), exactly(200.0))
    with pytest.raises(ImportError, match="cannot import name 'Unknown'"):
        from simtest.calibration import Unknown  # noqa: F401


def test_names_that_never_were_are_errors():
    with pytest.raises(ModuleNotFoundError, match=r"simtest\.kidney"):
        importlib.import_module("simtest.kidney")
    with pytest.raises(ModuleNotFoundError, match=r"simtest\.colour\.kidney"):
        importlib.import_module("simtest.colour.kidney")
    with pytest.raises(ImportError, match="kidney"):
        from simtest.colour import kidney  # noqa: F401


def test_the_package_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "simtest", "--version"], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip(), done.stderr) == (0, simtest.__version__, "")
