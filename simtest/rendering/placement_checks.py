"""Checks that camera and lights stand in free space."""

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.spec.rig import Rig
from simtest.spec.scene import Scene
from simtest.surfaces import SurfaceModel


def check_camera(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where the camera lies in the wall."""
    clearance = float(surface.clearance(surface.model_from_camera[None, :3, 3])[0])
    if not clearance > 0:
        raise InputError(
            f"scene {scene.name}: surface: the camera lies {-clearance:.3g} mm inside the wall; it must be in free "
            "space: change surface.distance_mm, surface.tilt_deg or the curvature"
        )


def check_lights(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where a light lies inside a body; beyond the wall of a shell it is merely unseen."""
    if not surface.solid:
        return
    positions = scene.rig.true_mm()
    clearances = _clearances(surface, positions)
    for i in np.flatnonzero(~(clearances > 0)):
        position = ", ".join(f"{value:.4g}" for value in positions[i])
        raise InputError(
            f"scene {scene.name}: rig.lights.{i} at ({position}) mm: lies {-clearances[i]:.3g} mm inside the "
            f"{scene.surface.label}; a light must be in free space{_advice(scene.rig, surface, int(i))}"
        )


def _clearances(surface: SurfaceModel, positions: Array) -> Array:
    """Compute the clearances, mm, of positions in the camera frame, shape (N, 3), mm."""
    pose = surface.model_from_camera
    return surface.clearance(positions @ pose[:3, :3].T + pose[:3, 3])


def _advice(rig: Rig, surface: SurfaceModel, light: int) -> str:
    """Name what to change where a light's nominal position is free and only the drawn one lies in the body."""
    # No advice on the draw where the nominal position itself lies in the body.
    deviation = rig.lights[light].position_error_mm
    if deviation == 0 or not _clearances(surface, rig.nominal_mm())[light] > 0:
        return ""
    return f": its position_error_mm = {deviation:g} drew that place with rig.seed = {rig.seed}; make it smaller"
