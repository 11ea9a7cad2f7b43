"""A patch of tissue that a moving camera sees: the base's normal, and the map of fine normals, from all frames.

The tissue must stand still. The patch is told by a pixel of the first frame with a pose, and a radius. Where the tissue
lies beyond, along that pixel's sightline, is the calibration's working distance.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration, Frame, Priors, Response
from simtest.detection.view_mask import find_view
from simtest.errors import Failure, InputError
from simtest.estimators.accumulated import PatchNormal, base_normal
from simtest.estimators.cloud import UNEVEN
from simtest.estimators.sightings import FineMap, Plane, Sighting, fine_map, light_of, plane_axes, spots_of
from simtest.geometry.vectors import deviation_deg
from simtest.reconstruction.choices import DEFAULT_SMOOTHING_PX
from simtest.reconstruction.image_io import open_source
from simtest.reconstruction.output_files import write_csv
from simtest.reconstruction.picture import Options
from simtest.reconstruction.poses import Poses, read_poses
from simtest.runtime.arrays import Array, Image
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json
from simtest.runtime.machine_errors import write_error
from simtest.runtime.resources import shown

FILES = "patch.json", "fine_normals.csv", "fine_normals.npy"
COLUMNS = ("frame", "x_mm", "y_mm", "z_mm", "normal_x", "normal_y", "normal_z")
CELL_SHARE = 1 / 32
"""Side of a cell of fine_normals.npy, as a share of the patch's radius."""


@dataclass(frozen=True)
class PatchOfTissue:
    """A patch: the pixel of the first frame with a pose at which its middle is seen, and its radius, mm."""

    x_px: float
    y_px: float
    radius_mm: float


def parse_patch(text: str) -> PatchOfTissue:
    """Return the patch "x,y,radius_mm"; raise `InputError` where it is none."""
    try:
        x, y, radius = (float(part) for part in text.split(","))
    except ValueError:
        x = y = radius = float("nan")
    if not (np.isfinite([x, y, radius]).all() and 0 < radius <= 1e3):
        raise InputError(f"--patch {shown(text, 60)}: must be x,y,radius: a pixel, and 0 to 1000 mm")
    return PatchOfTissue(x, y, radius)


@dataclass(frozen=True)
class AccumulatedPatch:
    """What the frames show of a patch.

    Parameters
    ----------
    patch : PatchOfTissue
        As asked.
    plane : Plane
        On which highlights were placed: through the patch's middle, across the first frame's axis.
    frames : int
        Frames with a pose that could be read.
    base : PatchNormal or Failure
        The base's normal, or why there is none.
    fine : FineMap
        The fine normals of the spots inside the patch.
    """

    patch: PatchOfTissue
    plane: Plane
    frames: int
    base: PatchNormal | Failure
    fine: FineMap

    @property
    def summary(self) -> str:
        """The result in a line."""
        if isinstance(self.base, Failure):
            return f"patch: no normal of the base ({self.base.detail})"
        x, y, z = self.base.normal
        stated = deviation_deg(self.base.covariance)
        return (
            f"patch: normal of the base {x:.3f} {y:.3f} {z:.3f} (world) ± {stated:.2f} deg, slopes "
            f"{np.degrees(self.base.slope):.1f} deg, {len(self.fine.frame)} fine normals from {self.frames} frames"
        )

    def to_json(self) -> JsonObject:
        """Return what patch.json holds."""
        told: JsonObject = {
            "patch": vars(self.patch),
            "point_world_mm": self.plane.point,
            "axes_world": plane_axes(self.plane),
            "frames": self.frames,
            "fine_normals": len(self.fine.frame),
            "fields": FIELDS,
        }
        if isinstance(self.base, Failure):
            return {**told, "status": str(self.base.reason), "detail": self.base.detail}
        base = self.base
        budget = {name: deviation_deg(part) for name, part in base.budget.items()}
        return {
            **told,
            "status": "ok",
            "normal_base_world": base.normal,
            "tangents_world": base.tangents,
            "covariance_rad2": base.covariance,
            "budget_deg": budget,
            "stated_deg": deviation_deg(base.covariance),
            "slope_deg": float(np.degrees(base.slope)),
            "cells": base.cells,
        }


FIELDS = {
    "point_world_mm": "the patch's middle, at the working distance",
    "axes_world": "along the columns and rows of fine_normals.npy",
    "fine_normals": "rows of fine_normals.csv: position and normal in the world, by frame",
    "normal_base_world": "unit normal of the smooth surface below the relief",
    "covariance_rad2": "of its angles along tangents_world",
    "budget_deg": "square root of the trace of each part; stated_deg: of the sum",
    "slope_deg": "standard deviation along one direction of the slopes seen, with the lobe's own width",
    "cells": "cells of tissue, of 49, that share the light evenly",
}


def accumulate(source: Path, options: Options, patch: PatchOfTissue) -> AccumulatedPatch:
    """Estimate a patch's normals from a folder of pictures or a video.

    Parameters
    ----------
    source : Path
        Folder or video.
    options : Options
        With `camera`, whose calibration states the working distance and the lights, and `poses`.
    patch : PatchOfTissue
        Where.

    Raises
    ------
    InputError
        If camera or poses are not given or malformed, the patch's pixel lies outside the picture, or no frame with a
        pose can be read.
    """
    # Imported here: the models of files are slow to load.
    from simtest.spec.calibration_file import load_calibration

    if options.camera is None or options.poses is None:
        raise InputError("--patch: needs --camera and --poses")
    calibration, poses = load_calibration(options.camera), read_poses(options.poses)
    priors, camera = calibration.priors, calibration.camera
    if priors.distance_mm is None or not priors.lights_mm:
        missing = "rig.distance_mm or distance_range_mm" if priors.distance_mm is None else "rig.lights_mm"
        raise InputError(f"--camera {shown(options.camera)}: --patch needs {missing}")
    pixel = np.array([patch.x_px, patch.y_px])
    if not camera.contains(pixel):
        raise InputError(
            f"--patch {patch.x_px:g},{patch.y_px:g}: lies outside the view; must be in {camera.width} x {camera.height}"
        )
    if calibration.response is None and options.encoding is not None:
        calibration = replace(calibration, response=Response("linear" if options.encoding == "linear" else "srgb"))
    light, spots = _sightings(source, calibration, poses)
    first = light[0].world_from_camera
    ray = first[:3, :3] @ camera.unproject(pixel)
    plane = Plane(first[:3, 3] + priors.distance_mm.mean * ray, -first[:3, 2])
    fine = fine_map(spots, plane)
    near = np.linalg.norm((fine.position - plane.point) @ plane_axes(plane).T, axis=1) < patch.radius_mm
    inside = FineMap(fine.position[near], fine.normal[near], fine.frame[near])
    return AccumulatedPatch(patch, plane, len(light), _base(light, plane, patch, poses, priors), inside)


def _sightings(source: Path, calibration: Calibration, poses: Poses) -> tuple[list[Sighting], list[Sighting]]:
    """Return light and spots of each frame that has a pose and can be read."""
    opened = open_source(source)
    middle = calibration.priors.lights.mean(axis=0)
    position = middle if middle.any() else None
    if not opened.is_video:
        told = poses.of_frames([file.name for file in opened.files], range(len(opened.files)), True)
    light, spots, error = [], [], "it has no pose"
    for frame in opened.frames():
        pose = poses.of_frames([frame.name], [frame.index], False)[0] if opened.is_video else told[frame.index]
        if pose is None:
            continue
        try:
            picture = frame.read()
            seen = _frame(picture, calibration)
        except InputError as reason:
            error = str(reason)
            continue
        light.append(light_of(seen, pose, position))
        spots.append(spots_of(seen, pose, position))
    if not light:
        raise InputError(f"{shown(source)}: no frame with a pose could be read ({error})")
    return light, spots


def _frame(picture: Image, calibration: Calibration) -> Frame:
    height, width = picture.shape[:2]
    if (width, height) != (calibration.camera.width, calibration.camera.height):
        size = f"{calibration.camera.width} x {calibration.camera.height}"
        raise InputError(f"a picture of {width} x {height}; must be {size}, the calibration's")
    # Borders of a round view are no tissue.
    seen = calibration.camera.seen
    if picture.ndim == 3 and (view := find_view(picture).seen) is not None:
        seen = view if seen is None else view & seen
    return Frame(picture, calibration, DEFAULT_SMOOTHING_PX, seen=seen)


def _base(
    light: list[Sighting], plane: Plane, patch: PatchOfTissue, poses: Poses, priors: Priors
) -> PatchNormal | Failure:
    """Return the base's normal with what poses, distance and lights add to its budget."""
    assert priors.distance_mm is not None
    centres = np.array([sighting.world_from_camera[:3, 3] for sighting in light])
    reach = float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))))
    found = base_normal(light, plane, patch.radius_mm, (poses.error.translation * reach, poses.error.rotation))
    if isinstance(found, Failure):
        return found
    # The tissue may lie nearer or farther, where other parts of it would be taken for one.
    towards = plane.point - light[0].world_from_camera[:3, 3]
    moved = []
    for sign in (-1, 1):
        share = sign * priors.distance_mm.sd / priors.distance_mm.mean
        other = base_normal(light, Plane(plane.point + share * towards, plane.normal), patch.radius_mm)
        if isinstance(other, Failure):
            return Failure(other.reason, f"at a distance that the calibration allows: {other.detail}")
        moved.append(found.across(other.normal))
    budget = found.budget | {"distance": np.transpose(moved) @ moved / 2}
    if len(priors.lights) > 1:
        budget["light_offset"] = _uneven_lights(light, found, plane, priors)
    return replace(found, budget=budget)


def _uneven_lights(light: list[Sighting], found: PatchNormal, plane: Plane, priors: Priors) -> Array:
    """Return what lights of unequal power do to the mean over them, shape (2, 2), rad^2, over all cameras alike."""
    turns = []
    for source in priors.lights:
        each = [replace(sighting, source_mm=source).facing(plane.point[None])[0] for sighting in light]
        mean = np.mean([sighting.facing(plane.point[None])[0] for sighting in light], axis=0)
        turns.append(found.tangents @ (np.mean(each, axis=0) - mean))
    return np.asarray(UNEVEN**2 / len(turns) * (np.transpose(turns) @ turns) / len(turns))


def write_patch(out: Path, made: AccumulatedPatch) -> list[Path]:
    """Write patch.json, fine_normals.csv and fine_normals.npy into a folder; return the files.

    fine_normals.npy is an image of unit normals on the patch's plane, world frame, float32, shape (S, S, 3), NaN where
    no highlight was seen.
    """
    make_folder(out)
    files = [out / name for name in FILES]
    radius = made.patch.radius_mm
    raster = made.fine.raster(made.plane, radius, CELL_SHARE * radius).astype(np.float32)
    rows = np.column_stack([made.fine.frame, made.fine.position, made.fine.normal]).tolist()
    table = [(int(row[0]), *row[1:]) for row in rows]

    def save(part: Path) -> None:
        # By handle: given a name, NumPy would add a suffix to it.
        with part.open("wb") as file:
            np.save(file, raster, allow_pickle=False)

    try:
        write_json(files[0], made.to_json())
        write_atomically(files[1], lambda part: write_csv(part, COLUMNS, table))
        write_atomically(files[2], save)
    except OSError as error:
        raise write_error(error, out) from error
    return files
