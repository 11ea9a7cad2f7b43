"""Where camera and lights must not be."""

import numpy as np

from simtest.errors import InputError
from simtest.rendering.frames import Array
from simtest.spec.rig import Rig
from simtest.spec.scene import Scene
from simtest.surfaces import SurfaceModel


def check_camera(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where the camera lies in the wall."""
    room = float(surface.clearance(surface.model_from_camera[None, :3, 3])[0])
    if not room > 0:
        raise InputError(
            f"scene {scene.name}: surface: the camera lies {-room:.3g} mm inside the wall; it must be in free space: "
            "change surface.distance_mm, surface.tilt_deg or the curvature"
        )


def check_lights(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where a light lies inside a body; beyond the wall of a shell it is merely in the dark."""
    if not surface.solid:
        return
    places = scene.rig.true_mm()
    rooms = _rooms(surface, places)
    for i in np.flatnonzero(~(rooms > 0)):
        place = ", ".join(f"{value:.4g}" for value in places[i])
        raise InputError(
            f"scene {scene.name}: rig.lights.{i} at ({place}) mm: lies {-rooms[i]:.3g} mm inside the "
            f"{scene.surface.label}; a light must be in free space{_advice(scene.rig, surface, int(i))}"
        )


def _rooms(surface: SurfaceModel, places: Array) -> Array:
    """Give the clearances of places of the camera frame, shape (N, 3), mm."""
    pose = surface.model_from_camera
    return surface.clearance(places @ pose[:3, :3].T + pose[:3, 3])


def _advice(rig: Rig, surface: SurfaceModel, light: int) -> str:
    """Say what to change where it is the draw that put a light into the body, not its given place."""
    deviation = rig.lights[light].position_error_mm
    if deviation == 0 or not _rooms(surface, rig.nominal_mm())[light] > 0:
        return ""
    return f": its position_error_mm = {deviation:g} drew that place with rig.seed = {rig.seed}; make it smaller"
