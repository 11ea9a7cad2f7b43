"""Bright pixels that are no tissue: burnt-in text, and the streaks of light along an instrument's shaft or jaws.

Text stands in lines of characters of one height with thin strokes. A tool is straight and far longer than wide, and so
is what shines along it; what shines close beside such a streak belongs to the tool as well.
"""

import cv2
import numpy as np

from simtest.runtime.arrays import Array, Mask

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

FILLED = 0.75
"""Largest share of a character's box that its strokes fill."""

STREAK_LENGTH = 0.045
"""Least length of an instrument's streak, as a share of the picture's longer side."""

STREAK_WIDTH = 0.06
"""Largest width of a streak over its length, both as standard deviations."""

TOOL_WIDTH, TOOL_ENDS = 0.55, 0.6
"""What lies nearer to a streak than this share of its length, or beyond its ends by the second, is on the tool too."""


def find_foreign(bright: Mask) -> Mask:
    """Find what is no tissue among bright pixels.

    Parameters
    ----------
    bright : ndarray of bool, shape (H, W)
        Pixels above half of the height of what shines there.

    Returns
    -------
    ndarray of bool, shape (H, W)
        Areas of text and instruments; what shines there is no highlight.
    """
    count, labels, stats, centres = cv2.connectedComponentsWithStats(bright.astype(np.uint8), connectivity=8)
    area = np.zeros(bright.shape, dtype=np.uint8)
    if count > 1:
        for x0, y0, x1, y1 in _text_lines(labels, stats[1:].astype(np.int64)):
            area[max(y0, 0) : max(y1, 0), max(x0, 0) : max(x1, 0)] = 1
        for corners in _tools(labels, stats, centres):
            cv2.fillPoly(area, [np.rint(corners).astype(np.int32)], 1)
    return area > 0


def _text_lines(labels: np.ndarray, stats: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Return the boxes of lines of text: left, top, right, bottom."""
    left, top, width, height, area = stats.T
    low, high = CHARACTER_PX
    fitting = (height >= low) & (height <= high) & (width <= 1.5 * height) & (area <= FILLED * width * height)
    # A thin stroke, as that of the 1, may fill its box.
    fitting |= (height >= low) & (height <= high) & (width <= 0.35 * height)
    characters = [i for i in np.flatnonzero(fitting).tolist() if _is_thin(labels, stats[i], i + 1)]
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
    boxes = []
    for line in sure:
        reach = int(1.5 * size)
        boxes.append((
            int(left[line[0]]) - reach, int(np.min(top[line])) - 2,
            int(left[line[-1]] + width[line[-1]]) + reach, int(np.max(top[line] + height[line])) + 2,
        ))  # fmt: skip
    return boxes


def _is_thin(labels: np.ndarray, box: np.ndarray, number: int) -> bool:
    """Return whether a component is made of strokes."""
    x, y, width, height, _ = (int(v) for v in box)
    own = np.pad((labels[y : y + height, x : x + width] == number).astype(np.uint8), 1)
    return float(cv2.distanceTransform(own, cv2.DIST_L2, 3).max()) <= max(STROKE * height, 1.5)


def _tools(labels: np.ndarray, stats: np.ndarray, centres: np.ndarray) -> list[Array]:
    """Return the areas of instruments, corners of shape (4, 2), by the streaks along them."""
    least = STREAK_LENGTH * max(labels.shape)
    found = []
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
        found.append(np.array([middle - half - side, middle + half - side, middle + half + side, middle - half + side]))
    return found
