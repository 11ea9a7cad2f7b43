"""Finds a ball in a picture: circles by Hough's transform, each moved onto the edges around it."""

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.geometry import Array, Mask
from simtest.geometry.camera import Camera
from simtest.reconstruction.light_calibration.outline import (
    LEAST_RADIUS_PX,
    BallOutline,
    angles_to,
    cone_through,
    outline_through,
)

SEARCHED_PX = 480
"""Longer side of the picture in which circles are searched."""

CANDIDATES = 6
DIRECTIONS = 96
REACH = 0.2
"""Edges are searched within this share of the radius."""

ON_EDGE_PX = 1.5
LEAST_ON_EDGE = 0.5
"""Share of the directions whose strongest edge must lie on the outline."""

SAME = 0.05
"""Circles that differ by less than this share of their radius lead to the same edges."""

DISPLAY_GAMMA = 2.2


def find_ball(intensity: Array, camera: Camera) -> tuple[BallOutline, float] | None:
    """Return the outline that most of the edges around it agree with, and their share; None where there is none.

    `intensity` is linear light, shape (H, W).
    """
    found = [
        traced
        for x, y, radius in _distinct(_circles(intensity))
        if (traced := trace_outline(intensity, camera, np.array([x, y]), radius)) is not None
    ]
    best = max(found, key=lambda each: each[1], default=None)
    return best if best is not None and best[1] >= LEAST_ON_EDGE else None


def _distinct(circles: list[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Return circles without those that lead to the same edges as an earlier one."""
    kept: list[tuple[float, float, float]] = []
    for circle in circles:
        if all(np.linalg.norm(np.subtract(circle, each)) > SAME * each[2] for each in kept):
            kept.append(circle)
    return kept


def trace_outline(
    intensity: Array, camera: Camera, centre_px: Array, radius_px: float
) -> tuple[BallOutline, float] | None:
    """Return the outline on the strongest edges near a circle, and the share of directions that agree with it."""
    edges, agreeing = np.empty((0, 2)), np.empty(0, dtype=bool)
    for reach in (REACH, REACH / 2, REACH / 4):
        edges = _edges(intensity, camera, centre_px, radius_px, reach)
        traced = _robust(camera, edges)
        if traced is None:
            return None
        (direction, half_angle), agreeing = traced
        border = BallOutline(direction, half_angle, np.eye(3)).pixels(camera)
        if not np.isfinite(border).all():
            return None
        centre_px = border.mean(axis=0)
        radius_px = float(np.linalg.norm(border - centre_px, axis=1).mean())
        if radius_px < LEAST_RADIUS_PX:
            return None
    try:
        outline = outline_through(camera, edges[agreeing])
    except (InputError, np.linalg.LinAlgError):
        return None
    return outline, float(agreeing.sum() / DIRECTIONS)


def _circles(intensity: Array) -> list[tuple[float, float, float]]:
    """Return circles, x, y and radius, px, the strongest first."""
    height, width = intensity.shape
    share = min(1.0, SEARCHED_PX / max(height, width))
    most = max(float(np.quantile(intensity, 0.995)), 1e-9)
    shown = np.clip(np.asarray(intensity) / most, 0, 1) ** (1 / DISPLAY_GAMMA)
    small = cv2.resize(np.rint(255 * shown).astype(np.uint8), None, fx=share, fy=share, interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), 1.0)
    found: list[tuple[float, float, float]] = []
    for edge, votes in ((100, 0.8), (60, 0.5), (30, 0.3)):
        circles = cv2.HoughCircles(
            small, cv2.HOUGH_GRADIENT_ALT, 1.5, 8, param1=edge, param2=votes,
            minRadius=max(4, int(share * LEAST_RADIUS_PX)), maxRadius=max(small.shape) // 2,
        )  # fmt: skip
        if circles is not None:
            found += [(x / share, y / share, r / share) for x, y, r in circles.reshape(-1, circles.shape[-1])[:, :3]]
        if len(found) >= CANDIDATES:
            break
    return [(float(x), float(y), float(r)) for x, y, r in found[:CANDIDATES]]


def _edges(intensity: Array, camera: Camera, centre_px: Array, radius_px: float, reach: float) -> Array:
    """Return the strongest edge in each direction from a centre, px, shape (N, 2); those in view."""
    phase = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)
    half = max(reach * radius_px, 4.0)
    radii = np.arange(max(radius_px - half, 2.0), radius_px + half, 0.5)
    rays = np.stack([np.cos(phase), np.sin(phase)], axis=1)
    points = centre_px + radii[None, :, None] * rays[:, None]
    at = (points - 0.5).astype(np.float32)
    blurred = cv2.GaussianBlur(np.asarray(intensity, np.float32), (0, 0), 1.0)
    # The root evens out what highlights and dark parts of the outline count.
    profile = np.sqrt(np.maximum(cv2.remap(blurred, at[..., 0], at[..., 1], cv2.INTER_LINEAR), 0))
    steepness = np.abs(np.gradient(profile, axis=1))
    best = steepness[:, 1:-1].argmax(axis=1) + 1
    found = points[np.arange(DIRECTIONS), best]
    return np.asarray(found[camera.contains(found)])


def _robust(camera: Camera, edges: Array) -> tuple[tuple[Array, float], Mask] | None:
    """Return the cone through most of the edges, the farthest left out in turn, and which edges agree with it."""
    rays = camera.unproject(edges)
    pixel = np.linalg.norm(camera.unproject(edges + 1) - rays, axis=1) / np.sqrt(2)
    fine = np.asarray(np.isfinite(rays).all(axis=1) & np.isfinite(pixel) & (pixel > 0))
    kept, cone, agreeing = fine, None, fine
    for share in (0.8, 0.7, 0.7, 0.8, 1.0):
        if kept.sum() < DIRECTIONS // 4:
            return None
        cone = cone_through(rays[kept])
        if cone is None:
            return None
        gaps = np.where(fine, np.abs(angles_to(rays, cone[0]) - cone[1]) / np.where(fine, pixel, 1), np.inf)
        agreeing = gaps < ON_EDGE_PX
        limit = ON_EDGE_PX if share == 1.0 else max(float(np.quantile(gaps, share)), ON_EDGE_PX)
        kept = gaps <= limit
    return (cone, agreeing) if cone is not None and agreeing.sum() >= DIRECTIONS // 4 else None
