"""The outline of a ball in a picture, and the ball's centre from it, for any lens.

The sightlines that touch a ball form a circular cone about the direction c to its centre, with the half-angle a whose
sine is radius over distance. So the outline is a circle on the unit sphere. A pixel's angle to c, less a, over the
angle of a pixel, is its signed distance s from the outline.

Across the outline the brightness is modelled as blurred by a Gaussian and by the pixel: a constant and a ramp outside,
and inside a step, a ramp and a term with the square root of the depth below the outline, as a matt ball that is lit
from the camera has it. Their amplitudes are fitted in each sector of the outline, direction, half-angle and blur over
all of it. With the square root the outline is not drawn inwards where the ball grows dark towards it.

Two errors are the same in all pictures of a scope, so no number of pictures averages them. A point spread that is no
Gaussian (defocus, sharpening) is symmetric, so it changes the step by a function that is odd about the outline: three
odd terms in each sector, the step's second, fourth and sixth derivative, take it up. Blur moves a curved edge towards
its centre of curvature by variance / (2 radius); the model is moved as far.
"""

from dataclasses import dataclass
from functools import cache, lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Array, Mask
from simtest.geometry.camera import Camera
from simtest.geometry.vectors import basis_across

SECTORS = 24
BAND_PX = 5.0
"""Pixels up to so far from the outline are used, on both sides."""

BESIDE_PX = 2.0
"""So far from the outline a blurred edge has ended."""

MOST_PIXELS = 4000
"""Of the band; of more pixels every second or third one is used."""

RING_FROM_PX, RING_DEPTH, RING_LEAST_PX = 2.5, 0.15, 10.0
"""A dark ring is searched from here inside the outline to this share of its radius, but at least so far, px."""

RING_STEPS = np.linspace(0.85, 1.0, 61)
RING_WIDTH_PX = 2.0
RING_GAIN = 2.0
"""A ring is told where the ball's shading begins so far inside the outline, and explains the profile so much better."""

LEAST_SECTORS = 8
LEAST_PIXELS = 20
LEAST_RADIUS_PX = 6.0
"""A smaller outline has no band of its own inside."""

BLUR_PX = (0.25, 3.0)
ROUNDS = 12
HUBER = 2.0
PIXEL_VARIANCE = 1 / 12
COLUMNS = 8
"""Amplitudes of a sector."""

STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-3])
"""Steps of the parameters: two turns and the half-angle in px, and the logarithm of the blur."""

_STEP_PX, _REACH_PX = 0.02, 16.0
_GRID = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2, _STEP_PX)
"""Depths below the outline, px, of the tabulated profile: all of the band, and what steps of the fit add."""

_PIXEL = np.sqrt(0.15) * np.array([-1.0, 0.0, 1.0]), np.array([5.0, 8.0, 5.0]) / 18.0
"""Gauss-Legendre points and weights of a pixel's width, px."""

_ROOT_GRID = np.linspace(-6.0, 80.0, 4301)


@cache
def _blurred_root() -> Array:
    """Return the square root of max(x, 0), blurred by a Gaussian of deviation 1, on its grid."""
    # Substituted u^2 = x, so that the root's infinite slope does no harm.
    u = np.linspace(0.0, 9.5, 1901)
    kernel = np.exp(-((_ROOT_GRID[:, None] - u[None] ** 2) ** 2) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(np.trapezoid(2 * u**2 * kernel, u, axis=1))


@lru_cache(maxsize=8)
def _profiles(blur: float, with_odd: bool) -> Array:
    """Return step, ramp and root, blurred, on the grid, and derivatives of the step if asked for; shape (3 or 6, G)."""
    from scipy.special import ndtr

    total = np.zeros((6 if with_odd else 3, len(_GRID)))
    for offset, weight in zip(*_PIXEL, strict=True):
        t = (_GRID + offset) / blur
        bell, inside = np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi), ndtr(t)
        root = np.interp(t, _ROOT_GRID, _blurred_root(), right=np.nan)
        root = np.where(np.isnan(root), np.sqrt(np.maximum(t, 0)), root)
        odd = [bell * t, bell * (t**3 - 3 * t), bell * (t**5 - 10 * t**3 + 15 * t)] if with_odd else []
        total += weight * np.stack([inside, blur * (t * inside + bell), root, *odd])
    return total


@dataclass(frozen=True)
class BallOutline:
    """A ball's outline in a picture, and where the ball is if its radius is 1 mm.

    Parameters
    ----------
    direction : ndarray, shape (3,)
        Unit direction of the centre, camera frame.
    half_angle : float
        Of the cone that touches the ball, rad.
    covariance : ndarray, shape (3, 3)
        Of two turns of the direction in the basis ``basis_across(direction)``, and of the half-angle; rad^2.
    blur_px : float
        Fitted standard deviation of the blur, px; NaN of an outline that was given.
    sectors : int
        Sectors of the outline that were used.
    dark_share : float
        Share of these behind which the picture is darker than the ball.
    """

    direction: Array
    half_angle: float
    covariance: Array
    blur_px: float = np.nan
    sectors: int = 0
    dark_share: float = 0.0

    def centre_mm(self, radius_mm: float) -> tuple[Array, Array]:
        """Return the centre, shape (3,), mm, and its covariance, shape (3, 3), mm^2."""
        distance = radius_mm / np.sin(self.half_angle)
        along = -distance / np.tan(self.half_angle)
        J = np.column_stack([distance * basis_across(self.direction).T, along * self.direction])
        return distance * self.direction, J @ self.covariance @ J.T

    def pixel_rad(self, camera: Camera) -> float:
        """Return the angle of a pixel at the ball's centre, rad: the mean over its two directions."""
        return float(np.linalg.norm(camera.step_of_pixels(camera.project(self.direction))) / np.sqrt(2))

    def pixels(self, camera: Camera, count: int = 72) -> Array:
        """Return points of the outline, shape (count, 2), px."""
        phase = np.linspace(0, 2 * np.pi, count, endpoint=False)
        first, second = basis_across(self.direction)
        circle = np.cos(phase)[:, None] * first + np.sin(phase)[:, None] * second
        return camera.project(np.cos(self.half_angle) * self.direction + np.sin(self.half_angle) * circle)


def outline_through(camera: Camera, pixels: npt.ArrayLike, sd_px: float = 0.5) -> BallOutline:
    """Return the outline through points, shape (N, 2), px, N >= 3, each with an independent error of `sd_px`.

    Raises `InputError` where the points lie on no such cone.
    """
    points = np.asarray(pixels, dtype=float)
    rays = camera.unproject(points)
    cone = cone_through(rays)
    if cone is None:
        raise InputError(f"outline: {len(points)} points lie on no ball's outline; must be px on its edge")
    direction, half_angle = cone
    first, second = basis_across(direction)
    across = rays - (rays @ direction)[:, None] * direction
    across /= np.linalg.norm(across, axis=1)[:, None]
    J = np.column_stack([-across @ np.array([first, second]).T, -np.ones(len(rays))])
    along, down = np.eye(2)
    pixel = camera.unproject(points + along) - rays, camera.unproject(points + down) - rays
    step = np.sqrt(np.linalg.norm(np.cross(*pixel), axis=1))
    weighted = J / (sd_px * step)[:, None]
    return BallOutline(direction, half_angle, np.asarray(np.linalg.inv(weighted.T @ weighted), dtype=float))


def cone_through(rays: Array) -> tuple[Array, float] | None:
    """Return axis and half-angle, rad, of the circular cone through unit sightlines, (N, 3); None where there is none.

    Sightlines u of the cone meet u . m = 1, with m along the axis and of length 1 / cos(half-angle).
    """
    m: Array = np.asarray(np.linalg.lstsq(rays, np.ones(len(rays)), rcond=None)[0], dtype=float)
    length = float(np.linalg.norm(m))
    return (m / length, float(np.arccos(1 / length))) if length > 1 else None


@dataclass(frozen=True)
class _Band:
    """Pixels near an outline: sightlines (N, 3), values (N,), and rad of a pixel across the outline (N,)."""

    rays: Array
    values: Array
    pixel_rad: Array
    sector: npt.NDArray[np.intp]


def refine_outline(intensity: Array, camera: Camera, start: BallOutline) -> BallOutline | None:
    """Fit the outline to linear light, from a start within about 3 px; None where too little of it shows an edge."""
    found = start
    for _ in range(3):
        # The band moves with the outline.
        before, fitted = found, _fit(intensity, camera, found, is_fine=False)
        if fitted is None:
            return None
        found = fitted
        if abs(found.half_angle - before.half_angle) * camera.fx < 0.05:
            break
    return _fit(intensity, camera, found, is_fine=True)


def _band(intensity: Array, camera: Camera, outline: BallOutline) -> _Band | None:
    border = outline.pixels(camera, 180)
    if not np.isfinite(border).all():
        return None
    reach = BAND_PX + 3
    low = np.maximum(np.floor(border.min(axis=0) - reach).astype(int), 0)
    high = np.minimum(np.ceil(border.max(axis=0) + reach).astype(int), [camera.width, camera.height])
    if (high - low < 3).any():
        return None
    x, y = (np.arange(a, b) + 0.5 for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    rays = camera.unproject(grid)
    angle = angles_to(rays, outline.direction)
    pixel = np.hypot(*np.gradient(angle))
    with np.errstate(invalid="ignore"):
        near = np.abs(angle - outline.half_angle) < BAND_PX * pixel
    # The gradient at the window's border is one-sided; the window has room for that.
    near[[0, -1]], near[:, [0, -1]] = False, False
    near &= np.isfinite(rays).all(axis=-1) & camera.contains(grid)
    kept = rays[near]
    first, second = basis_across(outline.direction)
    phase = np.arctan2(kept @ second, kept @ first)
    every = max(1, len(kept) // MOST_PIXELS)
    sector = np.floor((phase / (2 * np.pi) + 0.5) * SECTORS).astype(np.intp) % SECTORS
    values = np.asarray(intensity, dtype=float)[low[1] : high[1], low[0] : high[0]][near]
    return _Band(kept[::every], values[::every], pixel[near][::every], sector[::every])


def angles_to(rays: Array, direction: Array) -> Array:
    """Return the angles of unit sightlines, shape (..., 3), to a direction, rad."""
    sine = np.linalg.norm(np.cross(rays, direction), axis=-1)
    return np.arctan2(sine, rays @ direction)


def _fit(intensity: Array, camera: Camera, start: BallOutline, is_fine: bool) -> BallOutline | None:
    """Fit direction, half-angle and blur by Gauss-Newton steps, the amplitudes projected out (see the module).

    The fine fit keeps the blur and has the odd terms, which could take the outline elsewhere if it began farther off.
    """
    band = _band(intensity, camera, start)
    if band is None:
        return None
    scale = float(np.median(band.pixel_rad))
    used = [np.flatnonzero(band.sector == k) for k in range(SECTORS)]
    used = [rows for rows in used if len(rows) >= LEAST_PIXELS]
    if len(used) < LEAST_SECTORS:
        return None
    basis = basis_across(start.direction)
    at = np.array([0.0, 0.0, 0.0, np.log(1.0 if np.isnan(start.blur_px) else start.blur_px)])
    weights = np.ones(len(band.values))

    def outline_at(p: Array) -> tuple[Array, float, float]:
        turned = start.direction + scale * (p[:2] @ basis)
        blur = float(np.clip(np.exp(p[3]), *BLUR_PX))
        return turned / np.linalg.norm(turned), start.half_angle + scale * p[2], blur

    def residuals(p: Array) -> Array:
        direction, half_angle, blur = outline_at(p)
        s = (angles_to(band.rays, direction) - half_angle) / band.pixel_rad
        curvature = band.pixel_rad / np.tan(half_angle)
        depth = -s - (blur**2 + PIXEL_VARIANCE) * curvature / 2
        return _projected(depth, curvature, band.values, _profiles(blur, is_fine), weights, used)

    steps = np.diag(STEPS)[: 3 if is_fine else 4]
    r = residuals(at)
    for _ in range(ROUNDS):
        J = np.stack([(residuals(at + d) - residuals(at - d)) / (2 * d.sum()) for d in steps], axis=1)
        step = np.append(np.linalg.lstsq(J, -r, rcond=None)[0], [0.0] * (4 - len(steps)))
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-12))
        at = at + step
        at[3] = np.clip(at[3], *np.log(BLUR_PX))
        r = residuals(at)
        if np.abs(step[:3]).max() < 1e-3:
            break
        # Sectors whose edge is another one, such as a shadow's, count less.
        weights = _weights(r, weights, used)
        r = residuals(at)
    J = np.stack([(residuals(at + d) - residuals(at - d)) / (2 * d.sum()) for d in steps], axis=1)
    covariance = _covariance(J, r, used)
    if covariance is None or not np.abs(at[:3]).max() < 2 * BAND_PX:
        return None
    direction, half_angle, blur = outline_at(at)
    # Sectors that are darker outside the outline than inside, some px from it.
    s, dark = (angles_to(band.rays, direction) - half_angle) / band.pixel_rad, 0
    for rows in used:
        inside, outside = (band.values[rows][beyond[rows]] for beyond in (s < -BESIDE_PX, s > BESIDE_PX))
        dark += bool(len(inside) and len(outside) and np.median(outside) < np.median(inside))
    return BallOutline(direction, half_angle, covariance[:3, :3] * scale**2, blur, len(used), dark / len(used))


def _projected(
    depth: Array, curvature: Array, values: Array, profiles: Array, weights: Array, used: list[npt.NDArray[np.intp]]
) -> Array:
    """Return the weighted residuals of the best amplitudes of each sector, shape (N,); 0 outside the sectors.

    `depth` below the outline is in px, the outline's `curvature` in 1/px.
    """
    step, ramp, root, *odd = (np.interp(depth, _GRID, profile) for profile in profiles)
    # A sphere's shading is sqrt(2 depth c - (depth c)^2).
    root = root * np.sqrt(1 - np.clip(depth * curvature / 2, 0.0, 0.9))
    columns = np.stack([np.ones_like(depth), depth, step, ramp, root, *odd], axis=1)
    left = np.zeros(len(depth))
    for rows in used:
        A, y, w = columns[rows], values[rows], weights[rows]
        Q, R = np.linalg.qr(A * w[:, None])
        # A column that others explain adds nothing but rounding.
        Q = Q[:, np.abs(np.diag(R)) > 1e-9]
        left[rows] = w * y - Q @ (Q.T @ (w * y))
    return left


def _weights(r: Array, weights: Array, used: list[npt.NDArray[np.intp]]) -> Array:
    """Return weights that limit the influence of sectors whose residuals are larger than usual."""
    raw = r / np.maximum(weights, 1e-9)
    sizes = np.array([np.sqrt(np.mean(raw[rows] ** 2)) for rows in used])
    usual = max(float(np.median(sizes)), 1e-12)
    made = np.zeros_like(weights)
    for rows, size in zip(used, sizes, strict=True):
        made[rows] = min(1.0, HUBER * usual / max(size, 1e-12))
    return made


def _covariance(J: Array, r: Array, used: list[npt.NDArray[np.intp]]) -> Array | None:
    """Return the covariance of the parameters, in their units: the larger of white noise's and the sectors' own."""
    normal = J.T @ J
    if np.linalg.cond(normal) > 1e12:
        return None
    inverse = np.linalg.inv(normal)
    count = sum(len(rows) for rows in used)
    white = float(r @ r) / max(count - COLUMNS * len(used) - J.shape[1], 1) * inverse
    # Errors that go together within a sector, such as a texture behind the ball.
    scores = np.array([J[rows].T @ r[rows] for rows in used])
    share = len(used) / max(len(used) - J.shape[1], 1)
    grouped = share * inverse @ (scores.T @ scores) @ inverse
    chosen = grouped if np.trace(grouped[:3, :3]) > np.trace(white[:3, :3]) else white
    return np.asarray(chosen, dtype=float)


def has_dark_ring(intensity: Array, camera: Camera, outline: BallOutline) -> bool:
    """Return whether a dark ring lies between an outline and where a matt ball's shading begins.

    Lights nearer to the ball than the camera, or beside it, cast a shadow on a near wall that is larger than the ball.
    Its edge is then stronger than the ball's own. A ball that is lit from the camera has the brightness
    sqrt(1 - (r / q)^2) at the share r of the outline's radius, with q = 1 where the outline is the ball's.
    """
    border = outline.pixels(camera, 96)
    middle = border.mean(axis=0)
    radius_px = float(np.linalg.norm(border - middle, axis=1).mean())
    depth = min(max(RING_DEPTH * radius_px, RING_LEAST_PX), 0.5 * radius_px)
    shares = 1 - np.arange(RING_FROM_PX, depth, 0.5) / radius_px
    if len(shares) < 8:
        return False
    at = (middle + shares[:, None, None] * (border - middle) - 0.5).astype(np.float32)
    seen = cv2.remap(np.asarray(intensity, np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    profile = np.median(seen, axis=1)
    noise = float(np.median(np.abs(np.diff(seen, axis=1)))) / np.sqrt(len(border))
    left = []
    for q in RING_STEPS:
        shading = np.sqrt(np.maximum(1 - (shares / q) ** 2, 0))
        A = np.stack([np.ones_like(shares), shading], axis=1)
        amplitudes, *_ = np.linalg.lstsq(A, profile, rcond=None)
        # A rim that is brighter than the middle is no shading.
        left.append(np.sum((profile - A @ amplitudes) ** 2) if amplitudes[1] > 0 else np.inf)
    best = int(np.argmin(left))
    floor = len(shares) * noise**2
    gap_px = (1 - RING_STEPS[best]) * radius_px
    return bool(
        np.isfinite(left[-1]) and gap_px > RING_WIDTH_PX and left[-1] + floor > RING_GAIN * (left[best] + floor)
    )


# Search of a ball: circles by Hough's transform, each moved onto the edges around it ----------------------------------

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
        return outline_through(camera, edges[agreeing]), float(agreeing.sum() / DIRECTIONS)
    except (InputError, np.linalg.LinAlgError):
        return None


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
