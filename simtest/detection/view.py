"""What of a picture shows no tissue: outside of a view that is round or has cut corners, burnt-in text, instruments.

Text stands in lines of characters of one height with thin strokes, and these on the rows of one block; squares that
hide a name fill their boxes. A tool is straight and far longer than wide, and so
is what shines along it; what shines close beside such a streak belongs to the tool as well.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration.calibration import brightest_channel
from simtest.calibration.frame import Frame
from simtest.conventions import PIXEL_CENTRE
from simtest.geometry import Array, Image, Mask, ViewMask
from simtest.geometry.patch import dilated
from simtest.runtime.arrays import short_repr
from simtest.runtime.fitted import fitted_number

WORKING_PX = 480
"""Longer side of the picture in which the border is searched."""

DARK = 0.1
"""Corners outside of a view lie below this encoded value: black level, noise and stray light."""

TRIPLES = 300
"""Circles through three points of the border that are tried."""

INLIER_SHARE = 0.6
"""Least share of the border on the circle; the rest may be cut straight by the picture, or dark tissue."""

TOLERANCE = 0.006
"""Distance within which a point lies on the curve, as a share of the working picture's longer side."""

MAX_CORNERS = 10
"""Eight where four corners are cut, and one or two where noise splits a corner."""

SIDE_PX = 1.5
"""Largest distance of the lit part from straight sides, px of the working picture."""

UNFILLED, FILLED = 0.01, 0.6
"""Largest share of the picture that may be dark inside the sides, and least share that lies inside them."""

NOTCH, NOTCH_DARK = 0.1, 0.98
"""An inset's black box has at least this share of the view's height and width, and that share of it is dark: a cut
corner is dark by half."""

DENT_PX = 7
"""A dent of a straight border as wide as this, px of the working picture, is a badge's box."""

UNLIKE_TISSUE, BOX_PX, BOX_FILLED = 0.1, 10, 0.9
"""A box of one colour, which hides the tissue: green or blue exceeds red by this, encoded; it has so many pixels a side
or more in the working picture, and fills that share of the box around it."""

MARGIN = 0.012
"""Width of the rim that belongs to the border, as a share of the picture's longer side: bright edges, stray light."""

CHARACTERS = 3
"""A line of text has at least so many characters of one height; a picture with such a line may have shorter ones."""

CHARACTER_PX = (7, 64)
"""Least and largest height of a character."""

SLACK = 0.16
"""Tops and bottoms of a line's characters agree within this share of their height, or a pixel."""

GAP = 1.6
"""Largest gap between neighbouring characters, over their height: a blank, or one that is not seen."""

STROKE = 0.2
"""Largest half-width of a stroke over the character's height."""

STROKES = 0.75
"""Largest share of a character's box that its strokes fill."""

SOLID, SOLID_ALONE, SOLID_PX = fitted_number("overlays.solid"), fitted_number("overlays.solid_alone"), 8
"""A square that hides a character fills this share of its box, one that stands alone the second, with so many pixels a
side or more. A round highlight fills 0.8."""

PITCH, OFF_ROW = (fitted_number("overlays.least_pitch"), fitted_number("overlays.most_pitch")), 0.2
"""Distance of neighbouring rows of a block over the characters' height; larger ones span rows that are empty. A line
farther off than the second share of it is on no row."""

BLANK = 0.5
"""Pieces of characters that are too faint to be seen lie so near to the ends of a line, over the characters' height."""

ROWS_BEYOND = 4
"""The rows of a block are searched so far beyond the lines that are sure."""

ON_ROW_PX = fitted_number("overlays.on_row")
"""What is written on a row begins at its top or ends at its bottom within this distance."""

STREAK_LENGTH = 0.045
"""Least length of an instrument's streak, as a share of the picture's longer side."""

STREAK_WIDTH = 0.06
"""Largest width of a streak over its length, both as standard deviations."""

TOOL_WIDTH, TOOL_ENDS = 0.55, 0.6
"""What lies nearer to a streak than this share of its length, or beyond its ends by the second, is on the tool too."""


_Corners = tuple[int, int, int, int]
"""Left, top, right, bottom of a box, px; the last two are outside."""


@dataclass(frozen=True)
class View:
    """The part of a picture that shows tissue.

    `seen`, shape (H, W), is the inside of the border without its bright rim, None where the whole picture is seen;
    `circle` is the border, where it is round.
    """

    seen: Mask | None = None
    circle: ViewMask | None = None

    __repr__ = short_repr


def view_of(frame: Frame, search: bool = True) -> View:
    """Return the view that a frame states, or else the one that its picture shows; without `search` the whole."""
    if frame.seen is None:
        return find_view(frame.encoded) if search else View()
    stated = frame.camera.view_mask
    return View(frame.seen, stated if stated is not None and stated.corner is None else None)


def find_view(picture: npt.NDArray[np.floating]) -> View:
    """Find the border of the view in a picture, shape (H, W) or (H, W, 3), of values as encoded in [0, 1].

    The view is the whole picture where fewer than two of its corners are dark, or the border of the dark part is
    neither round nor a polygon of few corners: an organ before a dark background has no such border.
    """
    # candidates: the lit part of a small picture, and its border
    height, width = picture.shape[:2]
    scale = min(1.0, WORKING_PX / max(height, width))
    size = (max(round(width * scale), 8), max(round(height * scale), 8))
    small = cv2.resize(np.ascontiguousarray(picture, dtype=np.float32), size, interpolation=cv2.INTER_AREA)
    boxes = _coloured_boxes(small)
    # What such a box hides is as dark as the black one of an inset.
    brightness = np.where(boxes, np.float32(0), brightest_channel(small))
    whole = View(cv2.resize(boxes.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) == 0)
    whole = whole if boxes.any() else View()
    inside = _inside(brightness)
    if inside is None:
        return whole
    border = _border(inside)
    if len(border) < 30:
        return whole
    tolerance = max(1.5, TOLERANCE * max(size))
    ratio = np.array([width / size[0], height / size[1]])
    inside, notch = _without_notch(inside)
    hull = cv2.convexHull(_row_ends(inside))
    filled = cv2.fillConvexPoly(np.zeros(inside.shape, np.uint8), hull, 1) > 0
    # Cut corners also lie on a circle, within a pixel or two, so straight sides are tried first.
    polygon = _is_polygon(inside | boxes, filled, hull)
    circle = None if polygon else _circle(border, tolerance)
    if circle is None and not polygon:
        return whole
    if circle is not None:
        x, y, radius = circle
        grid_x, grid_y = np.arange(size[0]) - x, np.arange(size[1]) - y
        filled &= grid_x[None] ** 2 + grid_y[:, None] ** 2 <= radius**2
        # Coordinates of the small picture are integer-centred.
        cx, cy = (np.array([x, y]) + PIXEL_CENTRE) * ratio
        round_border = ViewMask(float(cx), float(cy), float(radius * ratio.mean()))
    else:
        round_border = None
        dents = (filled & ~inside).astype(np.uint8)
        filled &= cv2.morphologyEx(dents, cv2.MORPH_OPEN, np.ones((DENT_PX, DENT_PX), np.uint8)) == 0
    filled &= ~(notch | boxes)
    # The view less its rim. The distance transform ignores the picture's own edges, along which there is no rim.
    filled &= ~_bars(brightness)
    depth = cv2.distanceTransform(filled.astype(np.uint8), cv2.DIST_L2, 5)
    depth = cv2.resize(depth, (width, height), interpolation=cv2.INTER_LINEAR)
    return View(np.asarray(depth > max(3 * scale, MARGIN * max(size))), round_border)


def _inside(brightness: Image) -> Mask | None:
    """Return the lit part of a small picture without its dark surroundings; None where the corners are lit."""
    smooth = cv2.blur(brightness, (3, 3))
    corner = max(2, round(0.02 * max(smooth.shape)))
    ends = (np.s_[:corner], np.s_[-corner:])
    corners = [smooth[rows, columns] for rows in ends for columns in ends]
    # two or more dark corners
    dark = [float(c.mean()) for c in corners if float(c.mean()) < DARK]
    if len(dark) < 2:
        return None
    level = max(0.05, 1.5 * max(dark) + 0.02)
    # dark surroundings: connected to the corner
    below = np.pad((smooth < level).astype(np.uint8), 1, constant_values=1)
    cv2.floodFill(below, None, (0, 0), 2)
    lit = (below[1:-1, 1:-1] != 2).astype(np.uint8)
    lit = cv2.morphologyEx(lit, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    # the largest lit part
    count, labels, stats, _ = cv2.connectedComponentsWithStats(lit)
    if count < 2:
        return None
    return np.asarray(labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()))


def _without_notch(inside: Mask) -> tuple[Mask, Mask]:
    """Return the lit part with the black box that an inset picture leaves in a corner filled, and that box.

    The box is a dark part in a corner of the lit part's bounding box that has straight, upright sides.
    """
    none = np.zeros(inside.shape, dtype=bool)
    rows, columns = np.flatnonzero(inside.any(axis=1)), np.flatnonzero(inside.any(axis=0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    dark = ~inside[top:bottom, left:right]
    height, width = dark.shape
    for flip in (np.s_[:, :], np.s_[::-1, :], np.s_[:, ::-1], np.s_[::-1, ::-1]):
        corner = dark[flip]
        # how far the dark goes along the two sides, and the box that these span
        down, across = _run(corner[:, 0]), _run(corner[0])
        if not (NOTCH * height <= down < height and NOTCH * width <= across < width):
            continue
        box = np.zeros(dark.shape, dtype=bool)
        box[flip][:down, :across] = True
        if dark[box].mean() >= NOTCH_DARK:
            notch = none.copy()
            notch[top:bottom, left:right] = dilated(box)
            return inside | notch, notch
    return inside, none


def _coloured_boxes(small: Image) -> Mask:
    """Return the boxes of a small picture that are filled with a colour that tissue has not, whatever is in them."""
    boxes = np.zeros(small.shape[:2], dtype=bool)
    if small.ndim == 3:
        pure = (small[..., 1:].max(axis=2) - small[..., 0] >= UNLIKE_TISSUE).astype(np.uint8)
        contours, _ = cv2.findContours(pure, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            x, y, width, height = cv2.boundingRect(contour)
            # A contour runs through the pixels at the edge. Under narrow-band light all of the view is green.
            area = cv2.contourArea(contour) + cv2.arcLength(contour, True) / 2
            if min(width, height) >= BOX_PX and BOX_FILLED * width * height <= area <= pure.size / 4:
                boxes[y : y + height, x : x + width] = True
    return dilated(boxes)


def _row_ends(inside: Mask) -> npt.NDArray[np.int32]:
    """Return the first and the last pixel of each row that has any, column and row, shape (N, 1, 2)."""
    rows = np.flatnonzero(inside.any(axis=1))
    first = inside[rows].argmax(axis=1)
    last = inside.shape[1] - 1 - inside[rows, ::-1].argmax(axis=1)
    return np.stack([np.stack([first, last]), np.stack([rows, rows])], axis=-1).astype(np.int32).reshape(-1, 1, 2)


def _bars(brightness: Image) -> Mask:
    """Return the black bars along the sides of a picture, which cut a round view there."""
    bars = np.zeros(brightness.shape, dtype=bool)
    for turned, part in ((brightness, bars), (brightness.T, bars.T)):
        dark = turned.max(axis=1) < DARK
        part[: _run(dark)] = True
        part[len(dark) - _run(dark[::-1]) :] = True
    return bars


def _run(line: Mask) -> int:
    """Return how many elements of a line are set before the first that is not."""
    return int(np.argmin(np.append(line, False)))


def _border(inside: Mask) -> Array:
    """Return the border's points inside the picture, shape (N, 2), integer-centred."""
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = max(contours, key=len)[:, 0].astype(float)
    height, width = inside.shape
    clear = (points >= 2).all(axis=1) & (points[:, 0] < width - 2) & (points[:, 1] < height - 2)
    return np.asarray(points[clear])


def _circle(points: Array, tolerance: float) -> tuple[float, float, float] | None:
    """Fit a circle to the share of points that lie on one; return centre and radius, or None."""
    # Imported here: few pictures have a round view, and NumPy's generators are loaded with it.
    from simtest.runtime.seeds import from_integer

    rng = from_integer(0)
    # candidates: circles through three points
    a, b, c = points[rng.integers(0, len(points), (3, TRIPLES))]
    A = 2 * np.stack([b - a, c - a], axis=1)
    rhs = np.stack([(b**2 - a**2).sum(axis=1), (c**2 - a**2).sum(axis=1)], axis=1)
    solvable = np.abs(np.linalg.det(A)) > 1e-6
    centres = np.linalg.solve(A[solvable], rhs[solvable][:, :, None])[:, :, 0]
    radii = np.linalg.norm(a[solvable] - centres, axis=1)
    across, down = points.T[:, None] - centres.T[:, :, None]
    gaps = np.abs(np.sqrt(across * across + down * down) - radii[:, None])
    counts = (gaps <= tolerance).sum(axis=1)
    if not len(counts) or counts.max() < INLIER_SHARE * len(points):
        return None
    # refine: least squares over the points on the best one
    on = points[gaps[int(counts.argmax())] <= tolerance]
    solution, *_ = np.linalg.lstsq(np.column_stack([2 * on, np.ones(len(on))]), (on**2).sum(axis=1), rcond=None)
    x, y, level = (float(v) for v in solution)
    radius = float(np.sqrt(level + x * x + y * y))
    # reject flat arcs, whose centre may lie anywhere: a view's border surrounds the picture
    spread = np.ptp(on, axis=0)
    return (x, y, radius) if radius <= 1.2 * float(np.hypot(*spread)) else None


def _is_polygon(inside: Mask, filled: Mask, hull: npt.NDArray[np.int32]) -> bool:
    """Return whether the lit part is a convex polygon of few corners that fills most of the picture."""
    if np.count_nonzero(filled & ~inside) > UNFILLED * filled.size or np.count_nonzero(filled) < FILLED * filled.size:
        return False
    return len(cv2.approxPolyDP(hull, SIDE_PX, True)) <= MAX_CORNERS


def find_foreign(bright: Mask, overlays: bool = True) -> Mask:
    """Return the areas of instruments and overlays, shape (H, W), where what shines is no highlight.

    `bright`, shape (H, W), are the pixels above half of the height of what shines there. Overlays are text and squares.
    """
    count, labels, stats, centres = cv2.connectedComponentsWithStats(bright.astype(np.uint8), connectivity=8)
    area = np.zeros(bright.shape, dtype=np.uint8)
    if count > 1:
        for x0, y0, x1, y1 in _overlays(labels, stats[1:].astype(np.int64)) if overlays else ():
            area[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1
        for corners in _tools(labels, stats, centres):
            cv2.fillPoly(area, [np.rint(corners).astype(np.int32)], 1)
    return area > 0


def _overlays(labels: np.ndarray, stats: np.ndarray) -> list[_Corners]:
    """Return the boxes of text and squares."""
    left, top, width, height, area = stats.T
    square = (area >= SOLID * width * height) & (width <= 1.5 * height) & (height <= 2 * width)
    square &= (height <= CHARACTER_PX[1]) & (width >= CHARACTER_PX[0])
    single = square & (area >= SOLID_ALONE * width * height) & (np.minimum(width, height) >= SOLID_PX)
    boxes = np.stack([left, top, left + width, top + height], axis=1)
    lines = _text_lines(labels, stats, square)
    return [*lines, *(tuple(box) for box in boxes[single].tolist())]


def _text_lines(labels: np.ndarray, stats: np.ndarray, square: Mask) -> list[_Corners]:
    """Return the boxes of lines of text, in which squares may stand for characters."""
    left, top, width, height, area = stats.T
    low, high = CHARACTER_PX
    fitting = (height >= low) & (height <= high) & (width <= 1.5 * height) & (area <= STROKES * width * height)
    # A thin stroke, as that of the 1, may fill its box.
    fitting |= (height >= low) & (height <= high) & (width <= 0.35 * height)
    characters = np.flatnonzero(square).tolist()
    characters += [i for i in np.flatnonzero(fitting & ~square).tolist() if _is_thin(labels, stats[i], i + 1)]
    characters.sort(key=lambda i: int(left[i]))
    lines: list[list[int]] = []
    for i in characters:
        for line in lines:
            last = line[-1]
            tall = max(int(height[last]), int(height[i]))
            slack = max(1.0, SLACK * tall)
            level = abs(int(top[i]) - int(top[last])) <= slack
            level &= abs(int(top[i] + height[i]) - int(top[last] + height[last])) <= slack
            if level and int(left[i]) - int(left[last] + width[last]) <= GAP * tall:
                line.append(i)
                break
        else:
            lines.append([i])
    sure = [line for line in lines if len(line) >= CHARACTERS]
    if not sure:
        return []
    # shorter lines of the same type, in the same column of text
    size = float(np.median([height[i] for line in sure for i in line]))
    start = min(int(left[line[0]]) for line in sure)
    end = max(int(left[line[-1]] + width[line[-1]]) for line in sure)
    for line in lines:
        like = abs(float(np.median(height[line])) - size) <= max(1.0, SLACK * size)
        if line not in sure and like and start - size <= left[line[0]] <= end + size and len(line) >= CHARACTERS - 1:
            sure.append(line)
    margin = round(BLANK * size)
    boxes = [_box(stats, line, margin) for line in sure]
    # Characters before bright tissue are seen in parts, and thin type in pieces: these stand on the block's rows.
    rows = _rows(np.array([np.median(top[line]) for line in sure]), size)
    return boxes + [box for row in rows for box in _on_row(stats, row, size, start, end)]


def _rows(tops: Array, size: float) -> Array:
    """Return the tops of the rows of a block whose lines' tops and characters' height are given; none by one line."""
    tops = np.sort(tops)
    gaps = np.diff(tops) / size
    gaps = gaps[(gaps >= PITCH[0]) & (gaps <= PITCH[1])]
    if not len(gaps):
        return np.empty(0)
    pitch, first = float(np.median(gaps)) * size, float(tops[0])
    # Lines off the rows, as of another block, are left out.
    for slack in (OFF_ROW * pitch, SLACK * size):
        number = np.rint((tops - first) / pitch)
        on = np.abs(tops - first - number * pitch) <= slack
        if np.ptp(number[on]) > 0:
            pitch, first = (float(value) for value in np.polyfit(number[on], tops[on], 1))
    return np.asarray(first + pitch * np.arange(number.min() - ROWS_BEYOND, number.max() + ROWS_BEYOND + 1))


def _on_row(stats: np.ndarray, row: float, size: float, start: int, end: int) -> list[_Corners]:
    """Return the boxes of what is written on a row of a block of text: its pieces, between which are no wide gaps."""
    left, top, width, height, _ = stats.T
    bottom = top + height
    inside = (top >= row - 2) & (bottom <= row + size + 2) & (width <= 1.5 * size)
    at_ends = (np.abs(top - row) <= ON_ROW_PX) | (np.abs(bottom - row - size) <= ON_ROW_PX)
    groups: list[list[int]] = []
    right = -np.inf
    for i in sorted(np.flatnonzero(inside).tolist(), key=lambda i: int(left[i])):
        if left[i] - right > size:
            groups.append([])
        groups[-1].append(i)
        right = max(right if len(groups[-1]) > 1 else 0, int(left[i] + width[i]))
    return [
        _box(stats, g, 2)
        for g in groups
        if start - size <= left[g].min() <= end + size and np.count_nonzero(at_ends[g]) >= CHARACTERS
    ]


def _box(stats: np.ndarray, parts: list[int], margin: int) -> _Corners:
    """Return the box around components, with a margin at its ends."""
    left, top, width, height, _ = stats[parts].T
    return (
        int(left.min()) - margin, int(top.min()) - 2, int((left + width).max()) + margin, int((top + height).max()) + 2
    )  # fmt: skip


def _is_thin(labels: np.ndarray, box: np.ndarray, number: int) -> bool:
    """Return whether a component is made of strokes."""
    x, y, width, height, _ = (int(v) for v in box)
    character = np.pad((labels[y : y + height, x : x + width] == number).astype(np.uint8), 1)
    return float(cv2.distanceTransform(character, cv2.DIST_L2, 3).max()) <= max(STROKE * height, 1.5)


def _tools(labels: np.ndarray, stats: np.ndarray, centres: np.ndarray) -> list[Array]:
    """Return the areas of instruments, corners of shape (4, 2), by the streaks along them."""
    least = STREAK_LENGTH * max(labels.shape)
    areas = []
    for i in range(1, len(stats)):
        x, y, width, height, _ = (int(v) for v in stats[i])
        if np.hypot(width, height) < least:
            continue
        rows, columns = np.nonzero(labels[y : y + height, x : x + width] == i)
        points = np.stack([columns + x, rows + y], axis=1) - centres[i]
        (narrow, wide), axes = np.linalg.eigh(points.T @ points / len(points))
        along = points @ axes[:, 1]
        length = float(np.ptp(along))
        if length < least or narrow > (STREAK_WIDTH**2) * wide:
            continue
        middle = centres[i] + axes[:, 1] * (along.max() + along.min()) / 2
        half, side = (0.5 + TOOL_ENDS) * length * axes[:, 1], TOOL_WIDTH * length * axes[:, 0]
        areas.append(np.array([middle - half - side, middle + half - side, middle + half + side, middle - half + side]))
    return areas
