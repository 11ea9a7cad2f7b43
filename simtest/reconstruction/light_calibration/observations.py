"""What the pictures show: the ball or plate of each, and its highlights."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration
from simtest.calibration.lights.bundle import REACH_MM, Highlights
from simtest.calibration.lights.mirrors import Balls, Plates
from simtest.errors import InputError
from simtest.geometry import Array, Image, Mask
from simtest.geometry.camera import Camera
from simtest.reconstruction.light_calibration.ball_highlights import MeasuredHighlight, measure_highlights
from simtest.reconstruction.light_calibration.ball_search import find_ball, trace_outline
from simtest.reconstruction.light_calibration.outline import BallOutline, has_dark_ring, refine_outline

OUTLINE_FLOOR_PX = 0.02
"""Error of an outline that stays however little noise there is, px: pixels are squares, lenses no Gaussians."""

COMMON_PX, COMMON_RADIUS_PX = 0.015, 0.012
"""Error that the outlines of all pictures share, px: of their position an axis, and of their radius."""

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

INSIDE = 0.97
"""Highlights are searched within this share of the cone's half-angle."""


@dataclass(frozen=True)
class View:
    """A picture with its mirror and highlights.

    Parameters
    ----------
    name : str
        The picture's file.
    intensity : ndarray, shape (H, W)
        Linear light, falloff undone.
    highlights : list of MeasuredHighlight
        The brightest first.
    outline : BallOutline, optional
        Of the ball.
    plane : tuple, optional
        Of the plate: unit normal towards the camera, shape (3,), and n . x on it, mm.
    """

    name: str
    intensity: Array
    highlights: list[MeasuredHighlight]
    outline: BallOutline | None = None
    plane: tuple[Array, float] | None = None

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


def read_balls(
    pictures: Sequence[tuple[str, Callable[[], Image]]], calibration: Calibration, circles: dict[str, Circle]
) -> Views:
    """Read pictures of a ball.

    Parameters
    ----------
    pictures : sequence of tuple
        Name, and a function that reads the values in [0, 1] as they are encoded.
    calibration : Calibration
        Of the camera, with the response.
    circles : dict
        Rough outline of the ball by the picture's name, where it need not be searched.
    """
    found = Views()
    camera = calibration.camera
    contents: dict[bytes, str] = {}
    for name, read in pictures:
        values = read()
        if (first := _first_of(contents, name, values)) != name:
            found.left_out[name] = _SAME.format(str(first))
            continue
        intensity = _linear(name, values, calibration)
        outline = _outline(intensity, camera, circles.get(name))
        if isinstance(outline, str):
            found.left_out[name] = outline
            continue
        inside = _inside(camera, outline)
        radius_px = float(np.sqrt(inside.sum() / np.pi))
        widest = max(WIDEST * radius_px, LEAST_WIDEST_PX)
        found.views.append(View(name, intensity, measure_highlights(intensity, inside, widest), outline))
    return replace(found, views=without_merged(found.views))


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
        marked.append(replace(view, highlights=[_if_narrow(each, most) for each in view.highlights]))
    return marked


def _if_narrow(highlight: MeasuredHighlight, most_px: float) -> MeasuredHighlight:
    # Noise alone makes a dim spot wide.
    if highlight.problem or highlight.width_px - SURELY * highlight.width_sd_px <= most_px:
        return highlight
    return replace(highlight, problem="wider than on a ball that looks larger: several highlights that merge")


def read_plates(
    pictures: Sequence[tuple[str, Callable[[], Image]]], calibration: Calibration, poses: Sequence[Array | None]
) -> Views:
    """Read pictures of a plate that lies in the plane z = 0 of the poses' world (`world_from_camera`, mm)."""
    found, camera = Views(), calibration.camera
    everywhere = camera.contains(camera.pixel_centres())
    contents: dict[bytes, str] = {}
    for (name, read), pose in zip(pictures, poses, strict=True):
        if pose is None:
            found.left_out[name] = "the file of poses does not name it"
            continue
        plane = _plane(pose)
        if plane is None:
            found.left_out[name] = "the camera is in the plate's plane, z = 0"
            continue
        values = read()
        if (first := _first_of(contents, name, values)) != name:
            found.left_out[name] = _SAME.format(str(first))
            continue
        intensity = _linear(name, values, calibration)
        widest = WIDEST_ON_PLATE * max(camera.width, camera.height)
        found.views.append(View(name, intensity, measure_highlights(intensity, everywhere, widest), plane=plane))
    return found


def _plane(world_from_camera: Array) -> tuple[Array, float] | None:
    """Return the plane z = 0 of the world in the camera's frame: its normal towards the camera, and n . x there."""
    normal, height = world_from_camera[2, :3], float(world_from_camera[2, 3])
    if abs(height) < 1e-6:
        return None
    side = 1.0 if height > 0 else -1.0
    return side * normal / np.linalg.norm(normal), -abs(height) / float(np.linalg.norm(normal))


_SAME = "the same picture as {}; it counts once"


def _first_of(contents: dict[bytes, str], name: str, values: Image) -> str:
    """Return the name of the first picture with the same values; a copy would count as a second measurement."""
    from hashlib import sha256

    content = np.ascontiguousarray(values)
    digest = sha256(repr((content.shape, content.dtype.str)).encode() + content.tobytes()).digest()
    return contents.setdefault(digest, name)


def _linear(name: str, values: Image, calibration: Calibration) -> Array:
    camera = calibration.camera
    if values.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{name}: {values.shape[1]} x {values.shape[0]} px; must be {camera.width} x {camera.height} px as "
            "the calibration's camera"
        )
    return np.asarray(calibration.correct(np.asarray(values, dtype=np.float32)).intensity, dtype=float)


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
    if has_dark_ring(intensity, camera, outline):
        return (
            "a dark ring inside the outline: the ball's shadow on the wall hides its edge; light the wall by the room"
        )
    return outline


def _inside(camera: Camera, outline: BallOutline) -> Mask:
    border = outline.pixels(camera, 180)
    low, high = np.floor(border.min(axis=0)).astype(int), np.ceil(border.max(axis=0)).astype(int)
    low, high = np.clip(low, 0, [camera.width, camera.height]), np.clip(high, 0, [camera.width, camera.height])
    inside = np.zeros((camera.height, camera.width), dtype=bool)
    x, y = (np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True))
    cosine = camera.unproject(np.stack(np.meshgrid(x, y), axis=-1)) @ outline.direction
    inside[low[1] : high[1], low[0] : high[0]] = cosine > np.cos(INSIDE * outline.half_angle)
    return inside


def balls_of(views: Sequence[View], camera: Camera, radius_mm: float) -> Balls:
    """Return the balls of pictures, with the errors of their outlines."""
    centres, factors = [], []
    for view in views:
        assert view.outline is not None
        centre, covariance = with_floor(view.outline, camera, radius_mm).centre_mm(radius_mm)
        centres.append(centre)
        factors.append(np.linalg.cholesky(covariance))
    return Balls(np.array(centres), np.array(factors), np.full(len(views), radius_mm))


def with_floor(outline: BallOutline, camera: Camera, radius_mm: float) -> BallOutline:
    """Return an outline with the errors that its fit cannot see: of pixels, and of a shadow at a dark background."""
    pixel = float(np.linalg.norm(camera.step_of_pixels(camera.project(outline.direction))) / np.sqrt(2))
    strip = _unlit_strip(outline, radius_mm)
    error = np.diag([SHADOW * strip, SHADOW * strip, SHADOW * strip]) ** 2 + (OUTLINE_FLOOR_PX * pixel) ** 2 * np.eye(3)
    return replace(outline, covariance=outline.covariance + error)


def _unlit_strip(outline: BallOutline, radius_mm: float) -> float:
    """Return the width of the rim that a light beside the camera leaves dark, rad; 0 before a bright background."""
    distance = radius_mm / np.sin(outline.half_angle)
    return float(outline.dark_share * outline.half_angle * (LIGHT_MM / distance) ** 2 / 2)


def unlit_outline_errors(views: Sequence[View], camera: Camera, radius_mm: float) -> Iterator[list[BallOutline]]:
    """Return all outlines, moved by what the unlit rim may do to all of them alike; none where every rim is seen.

    The lights stay where they are, so a dark background moves the outlines of all pictures to the same side, each by
    its own strip (`with_floor` counts what differs between the pictures). They move along x, along y, and in radius.
    """
    strips = []
    for view in views:
        assert view.outline is not None
        pixel = np.linalg.norm(camera.step_of_pixels(camera.project(view.outline.direction))) / np.sqrt(2)
        strips.append(SHADOW * _unlit_strip(view.outline, radius_mm) / float(pixel))
    if any(strips):
        for dx, dy, wider in np.eye(3):
            yield [
                moved_outline(view, camera, strip * np.array([dx, dy]), strip * wider)
                for view, strip in zip(views, strips, strict=True)
            ]


def common_outline_errors(lights: Array) -> Array:
    """Return independent errors that all outlines share, shape (4, 3): shift along x and y and of the radius, px.

    `lights`, shape (S, 3), mm, are all lights found; far lamps cast no shadow that moves with the camera.
    """
    near = lights[np.linalg.norm(lights, axis=1) < REACH_MM]
    beside = near[:, :2].mean(axis=0) if len(near) else np.zeros(2)
    length = float(np.linalg.norm(beside))
    shaded = SHADED_PX * beside * min(1.0, MOST_SHADED_MM / max(length, 1e-9))
    return np.array([[COMMON_PX, 0, 0], [0, COMMON_PX, 0], [0, 0, COMMON_RADIUS_PX], [*shaded, 0]])


def moved_outline(view: View, camera: Camera, shift_px: Array, wider_px: float) -> BallOutline:
    """Return the outline of a view, shifted in the picture and with a larger radius, px."""
    assert view.outline is not None
    at = camera.project(view.outline.direction)
    pixel = float(np.linalg.norm(camera.step_of_pixels(at)) / np.sqrt(2))
    direction = camera.unproject(at + shift_px)
    return replace(view.outline, direction=direction, half_angle=view.outline.half_angle + wider_px * pixel)


def plates_of(views: Sequence[View], sd_mm: float, sd_rad: float) -> Plates:
    """Return the plates of pictures; their poses are uncertain by a turn about each tangent axis, and along z."""
    planes = [view.plane for view in views if view.plane is not None]
    factor = np.diag([sd_rad, sd_rad, sd_mm])
    return Plates(
        np.array([normal for normal, _ in planes]),
        np.array([offset for _, offset in planes]),
        np.broadcast_to(factor, (len(planes), 3, 3)).copy(),
    )


def circles_of(path: Path) -> dict[str, Circle]:
    """Read rough outlines: lines of name, x, y, radius, px, separated by commas; a header line is skipped."""
    import csv

    from simtest.runtime.files import require_plain

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
            text = f"{','.join(row)!s:.60}"
            raise InputError(
                f"--outlines {path}: line {number}: {text}: must be name,x,y,radius, px, radius > 0, all "
                f"within {FARTHEST_PX:g}"
            ) from None
        if name in found:
            raise InputError(f"--outlines {path}: line {number}: {name} is given twice")
        found[name] = (x, y, radius)
    if not found:
        raise InputError(f"--outlines {path}: holds no outline; must be lines of name,x,y,radius in px")
    return found
