"""Checks that camera and lights stand in free space, and instruments in the picture."""

import numpy as np

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.runtime.arrays import Array
from simtest.spec.lights import LightSpec, Rig
from simtest.spec.scene import Scene
from simtest.surfaces import SurfaceModel
from simtest.surfaces.deformation import DeformedSurface, stays_in_free_space
from simtest.surfaces.instrument import RoundCones

RIM_COPIES = (1.0, 0.75, 0.5, 0.25)
"""Scales of a source's rim at which its clearance is asked for."""


def check_camera(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where the camera lies in the wall, or a wall that deforms has passed over it."""
    camera = surface.model_from_camera[:3, 3]
    at_rest = float(surface.at_rest.clearance(camera[None])[0])
    if not at_rest > 0:
        raise InputError(
            f"scene {scene.name}: surface: the camera lies {-at_rest:.3g} mm inside the wall; it must be in free "
            "space: change surface.distance_mm, surface.tilt_deg or the curvature"
        )
    if not isinstance(surface, DeformedSurface):
        return
    moment, advice = f"at time_s = {scene.time_s:g}", "lower amplitude_mm or turn_deg, or move the camera"
    clearance = float(surface.clearance(camera[None])[0])
    if not clearance > 0:
        raise InputError(
            f"scene {scene.name}: deformation: the camera lies {-clearance:.3g} mm inside the wall {moment}; it must "
            f"be in free space: {advice}"
        )
    # Free space beyond a wall is no place that the camera could have come to.
    if not stays_in_free_space(surface.rest, scene.deformation, scene.time_s, camera):
        raise InputError(
            f"scene {scene.name}: deformation: the wall has moved right over the camera {moment}; it must stay in free "
            f"space from rest on: {advice}"
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


def check_instruments(scene: Scene, camera: Camera, cones: RoundCones) -> None:
    """Raise `InputError` where an instrument, camera frame, mm, holds the camera or a light, or ends in the picture."""
    lights = scene.rig.true_mm()
    reaches = [0.0, *(0.0 if light.source is None else light.source.radius_mm for light in scene.rig.lights)]
    clearances = cones.distances(np.concatenate([np.zeros((1, 3)), lights])) - np.array(reaches)[:, None]
    names = ["the camera", *(f"rig.lights.{i}" for i in range(len(lights)))]
    for place, part in zip(*np.nonzero(~(clearances > 0)), strict=True):
        raise InputError(
            f"scene {scene.name}: instruments.{cones.owners[part]}: lies {-clearances[place, part]:.3g} mm over "
            f"{names[place]}; must leave it free: another tip, azimuth_deg or tilt_deg"
        )
    for index in np.unique(cones.owners):
        # The shaft comes first.
        end = cones.ends[np.flatnonzero(cones.owners == index)[0]]
        pixel = camera.project(end[None])[0]
        if np.isfinite(pixel).all() and camera.contains(pixel[None])[0]:
            raise InputError(
                f"scene {scene.name}: instruments.{index}.length_mm = {scene.instruments[index].length_mm:g}: its end "
                f"is seen at ({pixel[0]:.0f}, {pixel[1]:.0f}) px; must be longer, or leave the picture by another "
                "azimuth_deg or tilt_deg"
            )


def check_motion(scene: Scene, surface: SurfaceModel) -> None:
    """Raise `InputError` where the camera, or what must be in free space of its rig, enters the wall as it moves."""
    motion = scene.camera.moving
    if motion is None:
        return
    names, points = ["the camera"], [np.zeros((1, 3))]
    positions = scene.rig.true_mm()
    for i, light in enumerate(scene.rig.lights):
        rim = np.zeros((0, 3)) if light.source is None else _rim_points(light, positions[i])
        kept_free = np.concatenate([positions[i : i + 1] if surface.solid else rim[:0], rim])
        names += [f"rig.lights.{i}"] * len(kept_free)
        points.append(kept_free)
    # Camera and rig at each moment, in the camera frame of the middle.
    poses, still = motion.poses(), np.concatenate(points)
    moved = np.einsum("kij,nj->kni", poses[:, :3, :3], still) + poses[:, None, :3, 3]
    clearances = _clearances(surface, moved.reshape(-1, 3)).reshape(moved.shape[:2])
    moment, point = np.unravel_index(np.argmin(clearances), clearances.shape)
    if not clearances[moment, point] > 0:
        raise InputError(
            f"scene {scene.name}: camera.motion: {motion.times_s[moment]:.3g} s from the middle of the exposure "
            f"{names[point]} lies {-clearances[moment, point]:.3g} mm inside the wall; it must be in free space: make "
            "velocity_mm_s, angular_velocity_deg_s or exposure_s smaller"
        )


def _check_rims(scene: Scene, surface: SurfaceModel, positions: Array) -> None:
    """Raise `InputError` where the rim of a source, or what it encloses, touches tissue."""
    rims = {i: _rim_points(light, positions[i]) for i, light in enumerate(scene.rig.lights) if light.source}
    # Next to the free camera, or to the source's own free middle, nothing has to be looked up.
    pose = surface.model_from_camera
    free = surface.free_mm(pose[:3, 3])
    rims = {i: points for i, points in rims.items() if np.linalg.norm(points, axis=1).max() >= free}
    for i in [i for i in rims if _clearances(surface, positions[i : i + 1])[0] > 0]:
        reach = np.linalg.norm(rims[i] - positions[i], axis=1).max()
        if reach < surface.free_mm(pose[:3, :3] @ positions[i] + pose[:3, 3]):
            del rims[i]
    if not rims:
        return
    every = _clearances(surface, np.concatenate(list(rims.values())))
    ends = np.cumsum([len(points) for points in rims.values()])[:-1]
    for (i, points), clearances in zip(rims.items(), np.split(every, ends), strict=True):
        light = scene.rig.lights[i]
        assert light.source is not None
        worst = int(np.argmin(clearances))
        if not clearances[worst] > 0:
            position = ", ".join(f"{value:.4g}" for value in points[worst])
            raise InputError(
                f"scene {scene.name}: rig.lights.{i}.source: its {light.source.type} of radius_mm = "
                f"{light.source.radius_mm:g} touches the {scene.surface.label}: at ({position}) mm its clearance is "
                f"{clearances[worst]:.3g} mm, must be above 0; move it away or make it smaller"
            )


def _rim_points(light: LightSpec, position: Array) -> Array:
    """Return the rim of a source, shape (N, 3), and smaller copies of it: a fold may rise through a disc."""
    assert light.source is not None
    rim = light.source.rim() - light.source.centroid_mm
    return np.asarray(np.concatenate([share * rim for share in RIM_COPIES]) @ light.across + position)


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
