"""From pictures of a ball or plate to the positions of the lights."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration
from simtest.calibration.lights.mirrors import Mirrors
from simtest.calibration.lights.result import LightCalibration, covariance_of_variations, judge
from simtest.calibration.lights.search import MOST_LIGHTS, Found, find_lights
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER, UNTOLD_OFFSET_MM, Matrix
from simtest.errors import InputError
from simtest.geometry import Array, Image
from simtest.geometry.camera import Camera
from simtest.geometry.checks import check_integer, check_number
from simtest.reconstruction.images import is_sequence, open_source, read_picture
from simtest.reconstruction.light_calibration.observations import (
    Circle,
    View,
    Views,
    balls_of,
    common_outline_errors,
    moved_outline,
    plates_of,
    read_balls,
    read_plates,
    unlit_outline_errors,
)
from simtest.reconstruction.light_calibration.outline import outline_through
from simtest.reconstruction.options import check_encoding, complete
from simtest.reconstruction.poses import check_names, read_poses

LEAST_PICTURES = 2

Pictures = Sequence[tuple[str, Callable[[], Image]]]


@dataclass(frozen=True)
class Ball:
    """A ball: its radius, mm, with its standard deviation; rough outlines, px, by the pictures' names."""

    radius_mm: float
    radius_sd_mm: float = 0.0
    circles: dict[str, Circle] | None = None

    def __post_init__(self) -> None:
        check_number("--ball-radius", self.radius_mm, above=0)
        check_number("--ball-radius-sd", self.radius_sd_mm, least=0)
        if self.radius_sd_mm >= self.radius_mm:
            raise InputError(
                f"--ball-radius-sd = {self.radius_sd_mm:g}: must be less than the radius, {self.radius_mm:g}"
            )


@dataclass(frozen=True)
class Plate:
    """A flat plate in the plane z = 0 of the poses' world, and the standard deviations of that."""

    poses: Path
    sd_mm: float = 0.2
    sd_deg: float = 0.2

    def __post_init__(self) -> None:
        check_number("--plate-sd", self.sd_mm, above=0)
        check_number("--plate-tilt-sd", self.sd_deg, above=0)


@dataclass(frozen=True)
class Calibrated:
    """The result, with the pictures that it stands on.

    Parameters
    ----------
    result : LightCalibration
        Lights, intervals and doubts.
    views : Views
        Pictures, their highlights, and pictures left out.
    mirror : Ball or Plate
        What was photographed.
    calibration : Calibration
        As it was given, with the lights that travel with the camera.
    """

    result: LightCalibration
    views: Views
    mirror: Ball | Plate
    calibration: Calibration


def picture_readers(paths: Sequence[Path]) -> list[tuple[str, Callable[[], Image]]]:
    """Return name and reader of each picture of files and folders; `InputError` where a folder holds none.

    Pictures of the same file name in several folders are named by their paths; one that is given twice counts once.
    """
    found: dict[str, tuple[str, Callable[[], Image]]] = {}
    for path in paths:
        if is_sequence(path):
            for frame in open_source(path).frames():
                found.setdefault(str(path / frame.name), (frame.name, frame.read))
        else:
            found.setdefault(str(path), (path.name, partial(read_picture, path)))
    counts = Counter(name for name, _ in found.values())
    return [(name if counts[name] == 1 else path, read) for path, (name, read) in found.items()]


def calibrate_lights(
    pictures: Pictures, calibration: Calibration, mirror: Ball | Plate, encoding: str | None = None,
    most: int = MOST_LIGHTS,
) -> Calibrated:  # fmt: skip
    """Measure the positions of the lights.

    Parameters
    ----------
    pictures : sequence of tuple
        Name, and a function that reads the values in [0, 1], as they are encoded, shape (H, W) or (H, W, 3).
    calibration : Calibration
        Of the camera. Its own lights are replaced.
    mirror : Ball or Plate
        What the pictures show.
    encoding : {"srgb", "linear"}, optional
        As of `simtest.reconstruct`.
    most : int
        Lights at most, 1 to 4.
    """
    check_integer("--most", most, 1, MOST_LIGHTS)
    check_encoding(encoding, calibration)
    seen = _read(pictures, complete(calibration, encoding), mirror)
    camera = calibration.camera
    highlights = seen.highlights()
    if len(np.unique(highlights.view)) < LEAST_PICTURES:
        raise InputError(_too_few(seen, len(pictures)))
    mirrors = _mirrors(seen.views, camera, mirror)
    found = find_lights(camera, mirrors, highlights, most)
    if found is None:
        raise InputError(
            f"no light explains highlights in most of the {len(seen.views)} pictures; must be pictures of one rig: "
            "the lights fixed to the camera, --ball-radius and --camera right"
        )
    further = covariance_of_variations(_variations(seen.views, calibration, mirror, found), highlights, found)
    share = mirror.radius_sd_mm / mirror.radius_mm if isinstance(mirror, Ball) else 0.0
    result = judge(camera, mirrors, highlights, found, share, further)
    if isinstance(mirror, Ball):
        result = replace(result, notes=(*result.notes, _scale_note(result, mirror)))
    return Calibrated(result, seen, mirror, with_lights(calibration, result))


def _read(pictures: Pictures, calibration: Calibration, mirror: Ball | Plate) -> Views:
    names = [name for name, _ in pictures]
    check_names("pictures", {name for name in names if names.count(name) > 1}, names)
    if isinstance(mirror, Ball):
        circles = mirror.circles or {}
        check_names("--outlines", circles, names)
        return read_balls(pictures, calibration, circles)
    return read_plates(pictures, calibration, read_poses(mirror.poses).of_files(names))


def _mirrors(views: Sequence[View], camera: Camera, mirror: Ball | Plate) -> Mirrors:
    if isinstance(mirror, Ball):
        return balls_of(views, camera, mirror.radius_mm)
    return plates_of(views, mirror.sd_mm, float(np.radians(mirror.sd_deg)))


def _seen_by(views: Sequence[View], camera: Camera, other: Camera, mirror: Ball | Plate) -> Mirrors:
    """Return the mirrors that another camera sees at the same pixels."""
    if isinstance(mirror, Plate):
        return _mirrors(views, other, mirror)
    moved = []
    for view in views:
        assert view.outline is not None
        traced = outline_through(other, view.outline.pixels(camera))
        moved.append(replace(view, outline=replace(traced, covariance=view.outline.covariance)))
    return balls_of(moved, other, mirror.radius_mm)


def _variations(
    views: Sequence[View], calibration: Calibration, mirror: Ball | Plate, found: Found
) -> Iterator[tuple[Camera, Mirrors]]:
    """Return camera and mirrors with each independent error that all pictures share, of one standard deviation."""
    camera, prior = calibration.camera, calibration.priors.camera
    for errors in np.diag([prior.focal_sd, prior.centre_sd_px, prior.centre_sd_px, prior.distortion_sd]):
        if errors.any():
            focal, dx, dy, radial = errors.tolist()
            other = replace(
                camera, fx=camera.fx * (1 + focal), fy=camera.fy * (1 + focal), cx=camera.cx + dx, cy=camera.cy + dy
            ).with_radial_error(radial, prior.edge_reach)
            yield other, _seen_by(views, camera, other, mirror)
    if isinstance(mirror, Ball):
        changed = [
            [moved_outline(view, camera, np.array([dx, dy]), wider) for view in views]
            for dx, dy, wider in common_outline_errors(found.bundle.lights)
        ]
        for outlines in (*changed, *unlit_outline_errors(views, camera, mirror.radius_mm)):
            moved = [replace(view, outline=outline) for view, outline in zip(views, outlines, strict=True)]
            yield camera, balls_of(moved, camera, mirror.radius_mm)


def _too_few(seen: Views, given: int) -> str:
    why = next(iter(seen.left_out.items()), None)
    dark = next((view.name for view in seen.views if not view.usable), None)
    reason = f"; {why[0]}: {why[1]}" if why else f"; {dark}: shows no single highlight" if dark else ""
    usable = sum(bool(view.usable) for view in seen.views)
    return f"{usable} of {given} pictures can be used; must be at least {LEAST_PICTURES}, better 8{reason}"


def _scale_note(result: LightCalibration, ball: Ball) -> str:
    farthest = max((float(np.linalg.norm(light.position_mm)) for light in result.own), default=0.0)
    stated = f"± {ball.radius_sd_mm:g} mm is in the intervals" if ball.radius_sd_mm else "it counts as exact"
    return (
        f"the pictures cannot check the ball's radius, {ball.radius_mm:g} mm ({stated}): a radius wrong by 1 % moves "
        f"the lights by up to {0.01 * farthest:.2g} mm and leaves the residuals as they are"
    )


def with_lights(calibration: Calibration, result: LightCalibration) -> Calibration:
    """Return a calibration with the measured lights that travel with the camera."""
    positions = tuple(_triple(light.position_mm.round(5)) for light in result.own)
    matrices = tuple(_matrix((light.covariance_mm2 + light.covariance_mm2.T) / 2) for light in result.own)
    if not positions:
        return calibration
    told = replace(
        calibration.priors, lights_mm=positions, lights_covariance_mm2=matrices, light_offset_mm=UNTOLD_OFFSET_MM
    )
    if told.falloff_power is None and not calibration.emission.is_uniform:
        # An emission is undone for a light at the camera alone.
        told = replace(told, falloff_power=UNTOLD_FALLOFF_POWER)
    return replace(calibration, priors=told)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(f"{value:.10g}") for value in values)
    return x, y, z


def _matrix(values: Array) -> Matrix:
    first, second, third = (_triple(row) for row in values)
    return first, second, third
