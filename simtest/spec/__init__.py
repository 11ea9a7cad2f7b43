"""What to simulate: frozen, validated models read from TOML, and their JSON schema.

`scene` gathers surface, reflectance, rig, camera and sensor; `experiment`, `dataset_recipe` and `profile` say which
scenes are rendered; `calibration_file` (with `calibration_spec`) and `camera_spec` read cameras, with `camera_formats`
for files of others.
`spec_model` is the base of all models, `toml_files` reads and writes TOML.

Names are loaded at first use: a command needs few of the models, and making one takes milliseconds.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.spec.calibration_file import load_calibration, save_calibration
    from simtest.spec.calibration_spec import CalibrationSpec
    from simtest.spec.calibration_tables import calibration_toml
    from simtest.spec.camera_spec import CameraSpec, load_camera, save_camera
    from simtest.spec.camera_tables import camera_table, camera_toml, describe_camera
    from simtest.spec.dataset_recipe import Dataset, load_dataset
    from simtest.spec.experiment import Experiment, Group, Uniform, load_experiment
    from simtest.spec.profile import Profile, ProfileEntry, experiments_of, load_profile
    from simtest.spec.rig import Emission, LightSpec, Rig
    from simtest.spec.scene import Scene, load_scene, scene_from_dict
    from simtest.spec.surface import (
        AnatomySurface,
        CylinderSurface,
        PlaneSurface,
        QuadricSurface,
        SphereSurface,
        Surface,
    )
    from simtest.spec.toml_files import apply_settings, parse_settings, read_toml

__getattr__, __dir__, __all__ = lazy_names(__name__)
