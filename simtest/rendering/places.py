"""Where camera and lights must not be."""

import numpy as np

from simtest.anatomy import SurfaceModel
from simtest.errors import InputError
from simtest.spec.scene import Scene


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
    pose, places = surface.model_from_camera, scene.rig.true_mm()
    rooms = surface.clearance(places @ pose[:3, :3].T + pose[:3, 3])
    for i in np.flatnonzero(~(rooms > 0)):
        place = ", ".join(f"{value:.4g}" for value in places[i])
        raise InputError(
            f"scene {scene.name}: rig.lights.{i} at ({place}) mm: lies {-rooms[i]:.3g} mm inside the "
            f"{scene.surface.label}; a light must be in free space"
        )
