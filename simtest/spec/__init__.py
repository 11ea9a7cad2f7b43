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

__getattr__, __dir__, __all__ = lazy_names(__name__)
