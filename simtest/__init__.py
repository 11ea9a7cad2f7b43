"""simtest: a rendering-validated simulation testbed for reconstruction from specular highlights in endoscopy.

The public names are loaded when they are first used; importing the package loads neither the renderer nor the
viewers.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtest.api import LabelledFrame, export, render, validate
    from simtest.calibration import Calibration
    from simtest.errors import BackendError, Failure, InputError, Reason, SimtestError
    from simtest.estimators import Estimate
    from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Patch, ViewMask
    from simtest.reconstruction.pipeline import Specularity, reconstruct
    from simtest.spec import (
        Experiment,
        Scene,
        load_calibration,
        load_camera,
        load_experiment,
        load_scene,
        save_camera,
    )

_HOMES = {
    "simtest.api": ("LabelledFrame", "export", "render", "validate"),
    "simtest.calibration": ("Calibration",),
    "simtest.errors": ("BackendError", "Failure", "InputError", "Reason", "SimtestError"),
    "simtest.estimators": ("Estimate",),
    "simtest.geometry": ("BrownConrady", "Camera", "KannalaBrandt", "Patch", "ViewMask"),
    "simtest.reconstruction.pipeline": ("Specularity", "reconstruct"),
    "simtest.spec": (
        "Experiment", "Scene", "load_calibration", "load_camera", "load_experiment", "load_scene", "save_camera",
    ),
}  # fmt: skip
_HOME = {name: module for module, names in _HOMES.items() for name in names}

__all__ = [
    "BackendError",
    "BrownConrady",
    "Calibration",
    "Camera",
    "Estimate",
    "Experiment",
    "Failure",
    "InputError",
    "KannalaBrandt",
    "LabelledFrame",
    "Patch",
    "Reason",
    "Scene",
    "SimtestError",
    "Specularity",
    "ViewMask",
    "export",
    "load_calibration",
    "load_camera",
    "load_experiment",
    "load_scene",
    "reconstruct",
    "render",
    "save_camera",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from simtest.runtime.provenance import version

        return version()
    if name not in _HOME:
        raise AttributeError(f"module 'simtest' has no attribute {name!r}")
    import importlib

    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
