"""From pictures of a ball or a plate to the positions of the lights: what each picture shows, and what follows.

A mirror, ball or plate, reads its pictures, and states where it stands in them for a camera.
"""

import csv
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration
from simtest.calibration.lights.bundle import REACH_MM, Highlights
from simtest.calibration.lights.mirrors import Balls, Mirrors, Plates
from simtest.calibration.lights.result import LightCalibration, covariance_of_variations, judge
from simtest.calibration.lights.search import MOST_LIGHTS, Found, find_lights
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER, UNTOLD_OFFSET_MM, Matrix
from simtest.errors import InputError
from simtest.geometry import Array, Image, Mask
from simtest.geometry.camera import Camera
from simtest.geometry.checks import check_integer, check_number
from simtest.reconstruction.images import open_source, read_picture
from simtest.reconstruction.light_calibration.highlights import MeasuredHighlight, measure_highlights
from simtest.reconstruction.light_calibration.outline import (
    BallOutline,
    find_ball,
    has_dark_ring,
    outline_through,
    refine_outline,
    trace_outline,
)
from simtest.reconstruction.options import check_encoding, complete
from simtest.reconstruction.poses import check_names, read_poses
from simtest.runtime.files import JsonObject, require_plain

LEAST_PICTURES = 2

OUTLINE_FLOOR_PX = 0.02
"""Error of an outline that stays however little noise there is, px: pixels are squares, lenses no Gaussians."""

COMMON_PX, COMMON_RADIUS_PX = 0.015, 0.012
"""Error that the outlines of all pictures share, px: of their position an axis, and of their radius."""

UNSURE = 1.5
"""The same, in standard deviations of each outline's own error: where the ball is as bright as the room behind it,
that is so on the same side in all pictures. On mirror balls it is up to 3 of them
(45 drawn rigs; script not kept)."""

SHADED_PX = 0.03
"""The ball's shadow beside its outline moves all outlines away from the lights, by so many px for each mm that the
middle of the lights lies beside the camera: a standard deviation."""

MOST_SHADED_MM = 6.0

LIGHT_MM = 4.0
"""Where a picture is dark behind the ball, a light so far beside the camera leaves a strip of the rim in its shadow."""

SHADOW = 1.5
"""Standard deviation of the outline's error by that strip, in widths of it."""

WIDEST, LEAST_WIDEST_PX = 0.2, 12.0
"""Longest highlight, as a share of the ball's radius, but at least so many px."""

WIDEST_ON_PLATE = 0.06
"""Longest highlight on a plate, as a share of the picture's longer side."""

WIDER = 1.08
"""A spot that is wider by this factor than spots on a ball that looks larger is several highlights that merge."""

SURELY = 3.0
"""By so many standard deviations of its width, too."""

FARTHEST_PX = 1e5
"""Largest number of a rough outline, px."""

MERGED = "wider than on a ball that looks larger: several highlights that merge"

INSIDE = 0.97
"""Highlights are searched within this share of the cone's half-angle."""


Pictures = Sequence[tuple[str, Callable[[], Image]]]


@dataclass(frozen=True)
class View:
    """A picture with its mirror and highlights, the brightest first.

    `intensity` is linear light, falloff undone. A ball has an outline, a plate a plane: its unit normal towards the
    camera, shape (3,), and n . x on it, mm.
    """

    name: str
    intensity: Array
    highlights: list[MeasuredHighlight]
    outline: BallOutline | None = None
    plane: tuple[Array, float] | None = None

    @property
    def seen_outline(self) -> BallOutline:
        """The outline of the ball, which it shows."""
        assert self.outline is not None
        return self.outline

    @property
    def usable(self) -> list[MeasuredHighlight]:
        """Highlights without a problem."""
        return [each for each in self.highlights if not each.problem]


@dataclass
class Views:
    """The pictures that can be used, and why the others cannot."""

    views: list[View] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)

    def highlights(self) -> Highlights:
        """Return the usable highlights of all pictures."""
        rows = [(i, each) for i, view in enumerate(self.views) for each in view.usable]
        return Highlights(
            np.array([i for i, _ in rows], dtype=np.intp),
            np.array([each.pixel for _, each in rows]).reshape(-1, 2),
            np.array([each.covariance for _, each in rows]).reshape(-1, 2, 2),
        )


Circle = tuple[float, float, float]
"""Centre and radius, px."""


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
            needed = f"must be less than the radius, {self.radius_mm:g}"
            raise InputError(f"--ball-radius-sd = {self.radius_sd_mm:g}: {needed}")

    @property
    def scale_share(self) -> float:
        """Standard deviation of the scale of all lengths, as a share."""
        return self.radius_sd_mm / self.radius_mm

    def read(self, pictures: Pictures, calibration: Calibration) -> Views:
        """Read pictures of it, with a calibration that states the response."""
        circles = self.circles or {}
        check_names("--outlines", circles, [name for name, _ in pictures])

        def shown(name: str, intensity: Array) -> View | str:
            outline = _outline(intensity, calibration.camera, circles.get(name))
            if isinstance(outline, str):
                return outline
            inside = _inside(calibration.camera, outline)
            widest = max(WIDEST * float(np.sqrt(inside.sum() / np.pi)), LEAST_WIDEST_PX)
            return View(name, intensity, measure_highlights(intensity, inside, widest), outline)

        seen = _read(pictures, calibration, {}, shown)
        return replace(seen, views=without_merged(seen.views))

    def mirrors(self, views: Sequence[View], camera: Camera, other: Camera | None = None) -> Balls:
        """Return the balls of pictures, with the errors of their outlines; or what another camera sees in their place.

        That sees the same pixels.
        """
        outlines = [view.seen_outline for view in views]
        if other is not None:
            outlines = [
                replace(outline_through(other, each.pixels(camera)), covariance=each.covariance) for each in outlines
            ]
        return self._of_outlines(outlines, other or camera)

    def variations(self, views: Sequence[View], camera: Camera, lights: Array) -> Iterator[Balls]:
        """Return the balls with each error of the outlines that all pictures share, of one standard deviation."""
        outlines = [view.seen_outline for view in views]
        common = common_outline_errors(outlines, camera, lights)
        for moves in (*common, *unlit_outline_errors(outlines, camera, self.radius_mm)):
            moved = [moved_outline(each, camera, move) for each, move in zip(outlines, moves, strict=True)]
            yield self._of_outlines(moved, camera)

    def notes(self, result: LightCalibration) -> tuple[str, ...]:
        """Return what a reader of the result must know of the ball."""
        farthest = max((float(np.linalg.norm(light.position_mm)) for light in result.own), default=0.0)
        stated = f"± {self.radius_sd_mm:g} mm is in the intervals" if self.radius_sd_mm else "it counts as exact"
        return (
            f"the pictures cannot check the ball's radius, {self.radius_mm:g} mm ({stated}): a radius wrong by 1 % "
            f"moves the lights by up to {0.01 * farthest:.2g} mm and leaves the residuals as they are",
        )

    def to_json(self) -> JsonObject:
        """Return what lights.json says of it."""
        return {"ball_radius_mm": self.radius_mm, "ball_radius_sd_mm": self.radius_sd_mm}

    def view_json(self, view: View) -> JsonObject:
        """Return where it stands in a picture."""
        centre, covariance = view.seen_outline.centre_mm(self.radius_mm)
        return {"ball_centre_mm": centre.round(4).tolist(), "ball_centre_sd_mm": np.sqrt(np.diag(covariance)).tolist()}

    def _of_outlines(self, outlines: Sequence[BallOutline], camera: Camera) -> Balls:
        placed = [with_floor(outline, camera, self.radius_mm).centre_mm(self.radius_mm) for outline in outlines]
        factors = [np.linalg.cholesky(covariance) for _, covariance in placed]
        centres = np.array([centre for centre, _ in placed])
        return Balls(centres, np.array(factors), np.full(len(placed), self.radius_mm))


@dataclass(frozen=True)
class Plate:
    """A flat plate in the plane z = 0 of the poses' world, and the standard deviations of that."""

    poses: Path
    sd_mm: float = 0.2
    sd_deg: float = 0.2
    scale_share = 0.0

    def __post_init__(self) -> None:
        check_number("--plate-sd", self.sd_mm, above=0)
        check_number("--plate-tilt-sd", self.sd_deg, above=0)

    def read(self, pictures: Pictures, calibration: Calibration) -> Views:
        """Read pictures of it, with a calibration that states the response."""
        camera, names = calibration.camera, [name for name, _ in pictures]
        everywhere = camera.contains(camera.pixel_centres())
        widest = WIDEST_ON_PLATE * max(camera.width, camera.height)
        planes: dict[str, tuple[Array, float]] = {}
        refused = {}
        for name, pose in zip(names, read_poses(self.poses).of_files(names), strict=True):
            if pose is None:
                refused[name] = "the file of poses does not name it"
            elif (plane := _plane(pose)) is None:
                refused[name] = "the camera is in the plate's plane, z = 0"
            else:
                planes[name] = plane

        def shown(name: str, intensity: Array) -> View:
            return View(name, intensity, measure_highlights(intensity, everywhere, widest), plane=planes[name])

        return _read(pictures, calibration, refused, shown)

    def mirrors(self, views: Sequence[View], camera: Camera, other: Camera | None = None) -> Plates:
        """Return the plates of pictures, for any camera: the poses tell where they are.

        They are uncertain by a turn about each tangent axis, and along z.
        """
        planes = [view.plane for view in views if view.plane is not None]
        sd_rad = float(np.radians(self.sd_deg))
        factor = np.diag([sd_rad, sd_rad, self.sd_mm])
        return Plates(
            np.array([normal for normal, _ in planes]),
            np.array([offset for _, offset in planes]),
            np.broadcast_to(factor, (len(planes), 3, 3)).copy(),
        )

    def variations(self, views: Sequence[View], camera: Camera, lights: Array) -> Iterator[Plates]:
        """Return nothing: no error of the plates is known to be shared."""
        return iter(())

    def notes(self, result: LightCalibration) -> tuple[str, ...]:
        """Return nothing."""
        return ()

    def to_json(self) -> JsonObject:
        """Return what lights.json says of it."""
        return {"poses": str(self.poses), "plate_sd_mm": self.sd_mm, "plate_tilt_sd_deg": self.sd_deg}

    def view_json(self, view: View) -> JsonObject:
        """Return where it stands in a picture."""
        assert view.plane is not None
        return {"plate_normal": view.plane[0].tolist(), "plate_distance_mm": -view.plane[1]}


@dataclass(frozen=True)
class Calibrated:
    """The lights, with what was photographed, the pictures that they stand on, and the calibration that states them."""

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
        if path.is_dir():
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
    names = [name for name, _ in pictures]
    check_names("pictures", {name for name in names if names.count(name) > 1}, names)
    seen = mirror.read(pictures, complete(calibration, encoding))
    camera = calibration.camera
    highlights = seen.highlights()
    if len(np.unique(highlights.view)) < LEAST_PICTURES:
        raise InputError(_too_few(seen, len(pictures)))
    mirrors = mirror.mirrors(seen.views, camera)
    lights = find_lights(camera, mirrors, highlights, most)
    if lights is None:
        raise InputError(
            f"no light explains highlights in most of the {len(seen.views)} pictures; must be pictures of one rig: "
            "the lights fixed to the camera, --ball-radius and --camera right"
        )
    further = covariance_of_variations(_variations(seen.views, calibration, mirror, lights), highlights, lights)
    result = judge(camera, mirrors, highlights, lights, mirror.scale_share, further)
    result = replace(result, notes=(*result.notes, *mirror.notes(result)))
    return Calibrated(result, seen, mirror, with_lights(calibration, result))


def _read(
    pictures: Pictures, calibration: Calibration, refused: Mapping[str, str],
    shown: Callable[[str, Array], View | str],
) -> Views:  # fmt: skip
    """Read pictures: `shown` makes a view of a name and its linear light, or says why not."""
    seen, camera = Views(), calibration.camera
    contents: dict[str, str] = {}
    for name, read in pictures:
        if name in refused:
            seen.left_out[name] = refused[name]
            continue
        values = np.ascontiguousarray(read())
        content = repr((values.shape, values.dtype.str)).encode() + values.tobytes()
        # A copy would count as a second measurement.
        if (first := contents.setdefault(sha256(content).hexdigest(), name)) != name:
            seen.left_out[name] = f"the same picture as {first}; it counts once"
            continue
        if values.shape[:2] != (camera.height, camera.width):
            needed = f"must be {camera.width} x {camera.height} px as the calibration's camera"
            raise InputError(f"{name}: {values.shape[1]} x {values.shape[0]} px; {needed}")
        light = calibration.correct(np.asarray(values, dtype=np.float32))
        view = shown(name, np.asarray(light.intensity, dtype=float))
        if isinstance(view, str):
            seen.left_out[name] = view
        else:
            seen.views.append(view)
    return seen


def _variations(
    views: Sequence[View], calibration: Calibration, mirror: Ball | Plate, lights: Found
) -> Iterator[tuple[Camera, Mirrors]]:
    """Return camera and mirrors with each independent error that all pictures share, of one standard deviation."""
    camera, prior = calibration.camera, calibration.priors.camera
    for errors in np.diag([prior.focal_sd, prior.centre_sd_px, prior.centre_sd_px, prior.distortion_sd]):
        if errors.any():
            focal, dx, dy, radial = errors.tolist()
            other = replace(
                camera, fx=camera.fx * (1 + focal), fy=camera.fy * (1 + focal), cx=camera.cx + dx, cy=camera.cy + dy
            ).with_radial_error(radial, prior.edge_reach)
            yield other, mirror.mirrors(views, camera, other)
    for mirrors in mirror.variations(views, camera, lights.bundle.lights):
        yield camera, mirrors


def _too_few(seen: Views, given: int) -> str:
    why = next(iter(seen.left_out.items()), None)
    dark = next((view.name for view in seen.views if not view.usable), None)
    reason = f"; {why[0]}: {why[1]}" if why else f"; {dark}: shows no single highlight" if dark else ""
    usable = sum(bool(view.usable) for view in seen.views)
    return f"{usable} of {given} pictures can be used; must be at least {LEAST_PICTURES}, better 8{reason}"


def with_lights(calibration: Calibration, result: LightCalibration) -> Calibration:
    """Return a calibration with the measured lights that travel with the camera."""
    if not result.own:
        return calibration
    positions, matrices = [], list[Matrix]()
    for light in result.own:
        positions.append(_triple(light.position_mm.round(5)))
        first, second, third = (_triple(row) for row in (light.covariance_mm2 + light.covariance_mm2.T) / 2)
        matrices.append((first, second, third))
    told = replace(
        calibration.priors, lights_mm=tuple(positions), lights_covariance_mm2=tuple(matrices),
        light_offset_mm=UNTOLD_OFFSET_MM,
    )  # fmt: skip
    if told.falloff_power is None and not calibration.emission.is_uniform:
        # An emission is undone for a light at the camera alone.
        told = replace(told, falloff_power=UNTOLD_FALLOFF_POWER)
    return replace(calibration, priors=told)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(f"{value:.10g}") for value in values)
    return x, y, z


# What a picture shows ------------------------------------------------------------------------------------------------


def without_merged(views: Sequence[View]) -> list[View]:
    """Return the views of balls with those spots marked that are too wide for a single highlight.

    The blur of the lens is the same in all pictures, and the lobe on the ball scales with the ball's size in the
    picture. So a spot is at most as wide as one on a ball that looks larger.
    """
    angles = np.array([0.0 if view.outline is None else view.outline.half_angle for view in views])
    narrow = np.array([np.median([h.width_px for h in v.usable if h.width_px] or [np.inf]) for v in views])
    marked = []
    for view, angle in zip(views, angles, strict=True):
        most = WIDER * float(narrow[angles >= angle].min(initial=np.inf))
        # Noise alone makes a dim spot wide.
        wide = [not each.problem and each.width_px - SURELY * each.width_sd_px > most for each in view.highlights]
        spots = [replace(s, problem=MERGED) if is_wide else s for s, is_wide in zip(view.highlights, wide, strict=True)]
        marked.append(replace(view, highlights=spots))
    return marked


def _plane(world_from_camera: Array) -> tuple[Array, float] | None:
    """Return the plane z = 0 of the world in the camera's frame: its normal towards the camera, and n . x there."""
    normal, height = world_from_camera[2, :3], float(world_from_camera[2, 3])
    if abs(height) < 1e-6:
        return None
    side = 1.0 if height > 0 else -1.0
    return side * normal / np.linalg.norm(normal), -abs(height) / float(np.linalg.norm(normal))


def _outline(intensity: Array, camera: Camera, circle: Circle | None) -> BallOutline | str:
    """Return a ball's outline, or why there is none."""
    if circle is None:
        searched = find_ball(intensity, camera)
        if searched is None:
            return "no ball found; give its outline with --outlines"
    else:
        searched = trace_outline(intensity, camera, np.array(circle[:2]), circle[2])
        if searched is None:
            return "no edge of a ball near the outline that is given"
    outline = refine_outline(intensity, camera, searched[0])
    if outline is None:
        return "too little of the ball's outline shows an edge"
    ring = "a dark ring inside the outline: the ball's shadow on the wall hides its edge; light the wall by the room"
    return ring if has_dark_ring(intensity, camera, outline) else outline


def _inside(camera: Camera, outline: BallOutline) -> Mask:
    border, size = outline.pixels(camera, 180), [camera.width, camera.height]
    low = np.clip(np.floor(border.min(axis=0)).astype(int), 0, size)
    high = np.clip(np.ceil(border.max(axis=0)).astype(int), 0, size)
    inside = np.zeros((camera.height, camera.width), dtype=bool)
    x, y = (np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True))
    cosine = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1)) @ outline.direction
    inside[low[1] : high[1], low[0] : high[0]] = cosine > np.cos(INSIDE * outline.half_angle)
    return inside


def with_floor(outline: BallOutline, camera: Camera, radius_mm: float) -> BallOutline:
    """Return an outline with the errors that its fit cannot see: of pixels, and of a shadow at a dark background."""
    strip, floor = SHADOW * _unlit_strip(outline, radius_mm), OUTLINE_FLOOR_PX * outline.pixel_rad(camera)
    error = np.diag([strip, strip, strip]) ** 2 + floor**2 * np.eye(3)
    return replace(outline, covariance=outline.covariance + error)


def _unlit_strip(outline: BallOutline, radius_mm: float) -> float:
    """Return the width of the rim that a light beside the camera leaves dark, rad; 0 before a bright background."""
    distance = radius_mm / np.sin(outline.half_angle)
    return float(outline.dark_share * outline.half_angle * (LIGHT_MM / distance) ** 2 / 2)


def unlit_outline_errors(outlines: Sequence[BallOutline], camera: Camera, radius_mm: float) -> list[list[Array]]:
    """Return how the unlit rim may move all outlines alike (`moved_outline`); nothing where every rim is seen.

    The lights stay where they are, so a dark background moves the outlines of all pictures to the same side, each by
    its own strip (`with_floor` counts what differs between the pictures). They move along x, along y, and in radius.
    """
    strips = [SHADOW * _unlit_strip(each, radius_mm) / each.pixel_rad(camera) for each in outlines]
    return [[strip * error for strip in strips] for error in np.eye(3)] if any(strips) else []


def common_outline_errors(outlines: Sequence[BallOutline], camera: Camera, lights: Array) -> Array:
    """Return independent errors that all outlines share, shape (4, V, 3): shift along x and y and of the radius, px.

    `lights`, shape (S, 3), mm, are all lights found; far lamps cast no shadow that moves with the camera.
    """
    near = lights[np.linalg.norm(lights, axis=1) < REACH_MM]
    beside = near[:, :2].mean(axis=0) if len(near) else np.zeros(2)
    length = float(np.linalg.norm(beside))
    shaded = SHADED_PX * beside * min(1.0, MOST_SHADED_MM / max(length, 1e-9))
    errors = np.zeros((4, len(outlines), 3))
    for i, outline in enumerate(outlines):
        own = np.sqrt(np.diag(outline.covariance)) / outline.pixel_rad(camera)
        errors[range(3), i, range(3)] = np.hypot(UNSURE * own, [COMMON_PX, COMMON_PX, COMMON_RADIUS_PX])
    errors[3, :, :2] = shaded
    return errors


def moved_outline(outline: BallOutline, camera: Camera, move_px: Array) -> BallOutline:
    """Return an outline shifted in the picture along x and y, and with a larger radius, px."""
    direction = camera.unproject(camera.project(outline.direction) + move_px[:2])
    half_angle = outline.half_angle + float(move_px[2]) * outline.pixel_rad(camera)
    return replace(outline, direction=direction, half_angle=half_angle)


def circles_of(path: Path) -> dict[str, Circle]:
    """Read rough outlines: lines of name, x, y, radius, px, separated by commas; a header line is skipped."""
    require_plain(path, "record_bytes", "a file of outlines (name,x,y,radius)")
    found: dict[str, Circle] = {}
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8-sig").splitlines()))
    except (UnicodeDecodeError, OSError, csv.Error) as error:
        raise InputError(f"--outlines {path}: cannot be read as text ({type(error).__name__})") from error
    for number, row in enumerate(rows, 1):
        if not row or (number == 1 and [cell.strip() for cell in row] == ["name", "x", "y", "radius"]):
            continue
        try:
            name, (x, y, radius) = row[0].strip(), (float(cell) for cell in row[1:])
            if not (max(abs(x), abs(y), radius) <= FARTHEST_PX and radius > 0):
                raise ValueError
        except ValueError:
            needed = f"must be name,x,y,radius, px, radius > 0, all within {FARTHEST_PX:g}"
            raise InputError(f"--outlines {path}: line {number}: {','.join(row)!s:.60}: {needed}") from None
        if name in found:
            raise InputError(f"--outlines {path}: line {number}: {name} is given twice")
        found[name] = (x, y, radius)
    if not found:
        raise InputError(f"--outlines {path}: holds no outline; must be lines of name,x,y,radius in px")
    return found
