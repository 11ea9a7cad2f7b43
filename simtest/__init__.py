"""simtest: a rendering-validated simulation testbed for reconstruction from specular highlights in endoscopy.

From a picture to normals:

1. read: a picture, folder or video becomes values as encoded (reconstruction.images)
2. linear light: response, vignetting and emission are undone, as far as they are known (calibration)
3. detect: regions of interest, by local maxima or by the tissue's colour, and their smoothed patches (detection)
4. estimate: normals, with covariances, from the isophotes of each patch (estimators, inverse; on geometry)
5. describe and write: normals.json, tables, overlay, page (reconstruction, pages)

From a description to validated figures:

1. describe: a scene, experiment or dataset in TOML becomes a frozen model (spec)
2. build and render: surface, reflectance and lights become radiance (surfaces, rendering)
3. label: camera and sensor make a frame of it; its true highlights are solved on the smooth surface (simulation)
4. reconstruct the frame as above, without its truth (reconstruction)
5. judge: match with the truth, measure errors, compare with closed-form laws (validation)
6. report: a run's figures and page (report), labelled datasets (dataset), the regression gate (nightly)

Everything stands on runtime (files, seeds, processes). The commands are in cli, the functions behind them in api.
Public names are loaded at first use; importing the package loads neither the renderer nor the viewers.
"""

from typing import TYPE_CHECKING, Any

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.api import LabelledFrame, RunResults, export, render, validate
    from simtest.calibration import Calibration
    from simtest.errors import BackendError, Failure, InputError, Reason, SimtestError
    from simtest.estimators import Estimate
    from simtest.geometry import BrownConrady, Camera, KannalaBrandt, Patch, Scaramuzza, ViewMask
    from simtest.reconstruction import Specularity, reconstruct
    from simtest.spec import (
        Experiment,
        Scene,
        load_calibration,
        load_camera,
        load_experiment,
        load_scene,
        save_calibration,
        save_camera,
    )

_named, _names, _ = lazy_names(__name__)

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
    "RunResults",
    "Scaramuzza",
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
    "save_calibration",
    "save_camera",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from simtest.runtime.provenance import version

        return version()
    return _named(name)


def __dir__() -> list[str]:
    return [*_names(), "__version__"]
