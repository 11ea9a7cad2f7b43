"""Checks that camera and lights stand in free space."""

import numpy as np

from simtest.errors import InputError
from simtest.runtime.arrays import Array
from simtest.spec.rig import Rig
from simtest.spec.scene import Scene
from simtest.surfaces import SurfaceModel

RIM_COPIES = (1.0, 0.75, 0.5, 0.25)
"""Scales of a source's rim at which its clearance is asked for."""


def check_camera(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where the camera lies in the wall."""
    clearance = float(surface.clearance(surface.model_from_camera[None, :3, 3])[0])
    if not clearance > 0:
        raise InputError(
            f"scene {scene.name}: surface: the camera lies {-clearance:.3g} mm inside the wall; it must be in free "
            "space: change surface.distance_mm, surface.tilt_deg or the curvature"
        )


def check_lights(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where a light lies inside a body, or a source of finite size touches tissue.

    Beyond the wall of a shell a point is merely unseen. A source of finite size is a body itself: its rim must be in
    free space there too.
    """
    positions = scene.rig.true_mm()
    _check_rims(scene, surface, positions)
    if not surface.solid:
        return
    clearances = _clearances(surface, positions)
    for i in np.flatnonzero(~(clearances > 0)):
        position = ", ".join(f"{value:.4g}" for value in positions[i])
        raise InputError(
            f"scene {scene.name}: rig.lights.{i} at ({position}) mm: lies {-clearances[i]:.3g} mm inside the "
            f"{scene.surface.label}; a light must be in free space{_advice(scene.rig, surface, int(i))}"
        )


def _check_rims(scene: Scene, surface: SurfaceModel, positions: Array) -> None:
    """Raise `InputError` where the rim of a source, or what it encloses, touches tissue."""
    for i, light in enumerate(scene.rig.lights):
        if light.source is None:
            continue
        # The rim about the centroid, and smaller copies of it: a fold may rise through a disc.
        rim = light.source.rim() - light.source.centroid_mm
        points = np.concatenate([share * rim for share in RIM_COPIES]) @ light.across + positions[i]
        clearances = _clearances(surface, points)
        worst = int(np.argmin(clearances))
        if not clearances[worst] > 0:
            position = ", ".join(f"{value:.4g}" for value in points[worst])
            raise InputError(
                f"scene {scene.name}: rig.lights.{i}.source: its {light.source.type} of radius_mm = "
                f"{light.source.radius_mm:g} touches the {scene.surface.label}: at ({position}) mm its clearance is "
                f"{clearances[worst]:.3g} mm, must be above 0; move it away or make it smaller"
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
