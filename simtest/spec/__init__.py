"""What to simulate: frozen, validated models read from TOML, and their JSON schema."""

from simtest.spec.experiment import Experiment, Group, Uniform, load_experiment
from simtest.spec.reading import apply_settings, parse_settings, read_toml
from simtest.spec.scene import (
    AnatomySurface,
    CameraSpec,
    CylinderSurface,
    LightSpec,
    PlaneSurface,
    QuadricSurface,
    Scene,
    SphereSurface,
    Surface,
    load_camera,
    load_scene,
    scene_from_dict,
)

__all__ = [
    "AnatomySurface",
    "CameraSpec",
    "CylinderSurface",
    "Experiment",
    "Group",
    "LightSpec",
    "PlaneSurface",
    "QuadricSurface",
    "Scene",
    "SphereSurface",
    "Surface",
    "Uniform",
    "apply_settings",
    "load_camera",
    "load_experiment",
    "load_scene",
    "parse_settings",
    "read_toml",
    "scene_from_dict",
]
