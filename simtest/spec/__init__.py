"""What to simulate: frozen, validated models read from TOML, and their JSON schema.

`scene` gathers surfaces, reflectance, lights, camera and sensor; `recipes` says which scenes are rendered for
experiments, datasets and profiles. `calibration_file` (with `calibration_spec`) and `camera` read cameras, with
`camera_formats` for files of others. `spec_model` is the base of all models, `keys` sets values at key paths,
`toml_files` reads and writes TOML.

Names are loaded at first use: a command needs few of the models, and making one takes milliseconds.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.spec.calibration_file import load_calibration, save_calibration
    from simtest.spec.calibration_spec import CalibrationSpec, calibration_toml
    from simtest.spec.camera import CameraSpec, load_camera, save_camera
    from simtest.spec.camera_tables import camera_table, camera_toml, describe_camera
    from simtest.spec.lights import LightSpec
    from simtest.spec.recipes import (
        Dataset,
        Experiment,
        Group,
        Profile,
        Uniform,
        experiments_of,
        load_dataset,
        load_experiment,
        load_profile,
    )
    from simtest.spec.scene import Scene, load_scene, scene_from_dict
    from simtest.spec.surfaces import AnatomySurface
    from simtest.spec.toml_files import apply_settings, parse_settings, read_toml

_HOMES = {
    "simtest.spec.calibration_file": ("load_calibration", "save_calibration"),
    "simtest.spec.calibration_spec": ("CalibrationSpec", "calibration_toml"),
    "simtest.spec.camera": ("CameraSpec", "load_camera", "save_camera"),
    "simtest.spec.camera_tables": ("camera_table", "camera_toml", "describe_camera"),
    "simtest.spec.lights": ("LightSpec",),
    "simtest.spec.recipes": (
        "Dataset", "Experiment", "Group", "Profile", "Uniform", "experiments_of", "load_dataset",
        "load_experiment", "load_profile",
    ),
    "simtest.spec.scene": ("Scene", "load_scene", "scene_from_dict"),
    "simtest.spec.surfaces": ("AnatomySurface",),
    "simtest.spec.toml_files": ("apply_settings", "parse_settings", "read_toml"),
}  # fmt: skip

__all__ = [
    "AnatomySurface", "CalibrationSpec", "CameraSpec", "Dataset", "Experiment", "Group", "LightSpec", "Profile",
    "Scene", "Uniform", "apply_settings", "calibration_toml", "camera_table", "camera_toml", "describe_camera",
    "experiments_of", "load_calibration", "load_camera", "load_dataset", "load_experiment", "load_profile",
    "load_scene", "parse_settings", "read_toml", "save_calibration", "save_camera", "scene_from_dict",
]  # fmt: skip

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
