"""Formulas by which the checks judge, written from the manual's definitions alone: nothing here calls the package.

Camera frame: x right, y down, z forward, mm; pixel centres at integer + 0.5; tables are those of a scene file.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy import ndimage

from simtest.runtime.arrays import AnyArray, Array, Mask

Tables = Mapping[str, Any]

CHI2_95 = -2 * np.log(0.05)
"""95 % of a chi-squared with two degrees of freedom."""


def unit(v: Array) -> Array:
    """Return vectors, shape (..., 3), at unit length."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def angle_deg(a: AnyArray, b: AnyArray) -> Array:
    """Return angles between unit vectors, shape (..., 3), deg; exact for small ones."""
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def rotation(axis: Array) -> Array:
    """Return the right-handed rotation about an axis by its length, rad (Rodrigues)."""
    turn = float(np.linalg.norm(axis))
    x, y, z = (axis / turn if turn else np.zeros(3)).tolist()
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(turn) * K + (1 - np.cos(turn)) * K @ K


def rotation_vector(R: Array) -> Array:
    """Return the axis times the angle, rad, of a rotation of less than half a turn."""
    twice_sine = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    length = float(np.linalg.norm(twice_sine))
    return twice_sine / length * np.arctan2(length, np.trace(R) - 1) if length else np.zeros(3)


# Camera --------------------------------------------------------------------------------------------------------------


def bend(camera: Tables, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Return the normalised image coordinates of directions, by the lens of a camera's tables."""
    lens = camera.get("distortion")
    if lens is None:
        return x / z, y / z
    k = {name: lens.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")}
    if lens["type"] == "brown_conrady":
        a, b = x / z, y / z
        u = a * a + b * b
        radial = (1 + k["k1"] * u + k["k2"] * u**2 + k["k3"] * u**3) / (
            1 + k["k4"] * u + k["k5"] * u**2 + k["k6"] * u**3
        )
        return (
            a * radial + 2 * k["p1"] * a * b + k["p2"] * (u + 2 * a * a),
            b * radial + k["p1"] * (u + 2 * b * b) + 2 * k["p2"] * a * b,
        )
    across = np.hypot(x, y)
    theta = np.arctan2(across, z)
    image = theta * (1 + k["k1"] * theta**2 + k["k2"] * theta**4 + k["k3"] * theta**6 + k["k4"] * theta**8)
    share = image / np.where(across > 0, across, 1.0)
    return x * share, y * share


def project(camera: Tables, points: Array) -> Array:
    """Return the pixels, shape (..., 2), of points, shape (..., 3)."""
    x, y = bend(camera, *np.moveaxis(np.asarray(points, dtype=float), -1, 0))
    return np.stack([camera["fx"] * x + camera["cx"], camera["fy"] * y + camera["cy"]], axis=-1)


def sightlines(camera: Tables, pixels: Array) -> Array:
    """Return unit sightlines, shape (..., 3), of pixels, by Newton steps on `project` with differences."""
    pixels = np.asarray(pixels, dtype=float)
    fisheye = (camera.get("distortion") or {}).get("type") == "kannala_brandt"
    m = np.stack([(pixels[..., 0] - camera["cx"]) / camera["fx"], (pixels[..., 1] - camera["cy"]) / camera["fy"]], -1)

    def rays(v: Array) -> Array:
        if not fisheye:
            return unit(np.concatenate([v, np.ones_like(v[..., :1])], axis=-1))
        # Two coordinates of a direction beyond 90 deg, too: its angle times the direction around the axis.
        theta = np.linalg.norm(v, axis=-1, keepdims=True)
        return np.concatenate([v * np.sinc(theta / np.pi), np.cos(theta)], axis=-1)

    step = 1e-6
    for _ in range(25):
        gap = project(camera, rays(m)) - pixels
        if np.abs(gap).max() < 1e-11 * camera["fx"]:
            break
        J = np.stack(
            [(project(camera, rays(m + d)) - project(camera, rays(m - d))) / (2 * step) for d in step * np.eye(2)], -1
        )
        m = m - np.linalg.solve(J, gap[..., None])[..., 0]
    return rays(m)


def pixel_centres(camera: Tables) -> Array:
    """Return the centres of all pixels, shape (H, W, 2)."""
    x, y = np.meshgrid(np.arange(camera["width"]) + 0.5, np.arange(camera["height"]) + 0.5)
    return np.stack([x, y], axis=-1)


def moved_pose(camera: Tables) -> Array:
    """Return unmoved_from_moved, shape (4, 4)."""
    moved = camera.get("moved") or {}
    pose = np.eye(4)
    pose[:3, :3] = rotation(np.radians(np.array(moved.get("rotation_deg", (0, 0, 0)), dtype=float)))
    pose[:3, 3] = moved.get("translation_mm", (0, 0, 0))
    return pose


def lights_mm(rig: Tables) -> Array:
    """Return the lights' positions, shape (L, 3)."""
    angles = [np.radians(light.get("azimuth_deg", 0.0)) for light in rig["lights"]]
    offsets = [light.get("offset_mm", 0.0) for light in rig["lights"]]
    return np.array([[o * np.cos(a), o * np.sin(a), 0.0] for o, a in zip(offsets, angles, strict=True)])


# Surfaces ------------------------------------------------------------------------------------------------------------


def surface_frame(scene: Tables) -> Array:
    """Return camera_from_model, shape (4, 4), of an analytic surface: origin at the anchor, z the normal there."""
    surface = scene["surface"]
    tilt, azimuth, spin = np.radians([surface["tilt_deg"], surface["azimuth_deg"], surface["spin_deg"]])
    normal = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    # The tangent plane leans with the normal, about the axis across both.
    lean = rotation(tilt * np.array([np.sin(azimuth), -np.cos(azimuth), 0.0]))
    first = lean @ np.array([np.cos(spin), np.sin(spin), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([first, np.cross(normal, first), normal], axis=1)
    pose[:3, 3] = [0.0, 0.0, surface["distance_mm"]]
    return np.linalg.inv(moved_pose(scene["camera"])) @ pose


def implicit(surface: Tables) -> tuple[Callable[[Array], Array], Callable[[Array], Array], Array]:
    """Return F, its gradient and its Hessian, of a surface F = 0 in its model frame: F grows towards the camera."""
    if surface["type"] == "cylinder":
        k = np.array([1.0, 0.0, 1.0]) / surface["radius_mm"]
    else:
        k = np.array([surface.get("k1_per_mm", 0.0), surface.get("k2_per_mm", 0.0), 0.0])
    return lambda p: p[..., 2] + np.sum(k * p**2, -1) / 2, lambda p: k * p + [0.0, 0.0, 1.0], np.diag(k)


def cast(scene: Tables, rays: Array) -> tuple[Array, Array]:
    """Return distance, shape (...), and unit normal, shape (..., 3), at the first hit of an analytic surface.

    Both are NaN where rays, shape (..., 3), meet none; of a quadric, where it lies within its patch: half a side is
    the anchor's distance.
    """
    pose = surface_frame(scene)
    F, gradient, _ = implicit(scene["surface"])
    origin, along = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
    # F is quadratic along a ray: three values give it.
    f0, f1, f2 = (F(origin + t * along) for t in (0.0, 1.0, 2.0))
    a, b, c = (f2 - 2 * f1 + f0) / 2, (4 * f1 - f2 - 3 * f0) / 2, f0
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        q = -(b + np.copysign(root, b)) / 2
        roots = np.stack([c / q, np.where(np.abs(a) > 1e-12, q / np.where(a == 0, 1, a), np.nan)])
    points = origin + roots[..., None] * along
    good = roots > 0
    if scene["surface"]["type"] == "quadric":
        reach = scene["surface"]["distance_mm"]
        good &= (np.abs(points[..., :2]) <= reach).all(-1)
    distance = np.where(good, roots, np.inf).min(axis=0)
    distance = np.where(np.isfinite(distance), distance, np.nan)
    normal = unit(gradient(origin + distance[..., None] * along)) @ pose[:3, :3].T
    return distance, np.where(np.sum(normal * rays, -1, keepdims=True) > 0, -normal, normal)


def curvatures(scene: Tables, points: Array) -> Array:
    """Return the principal curvatures, the smaller first, shape (..., 2), of an analytic surface, convex positive."""
    pose = surface_frame(scene)
    _, gradient, hessian = implicit(scene["surface"])
    g = gradient((points - pose[:3, 3]) @ pose[:3, :3])
    size = np.linalg.norm(g, axis=-1)
    n = g / size[..., None]
    P = np.eye(3) - n[..., :, None] * n[..., None, :]
    S = P @ hessian @ P / size[..., None, None]
    # One eigenvalue is 0, along the normal: the others follow from trace and sum of squares.
    trace, squares = np.trace(S, axis1=-2, axis2=-1), np.sum(S * S, axis=(-2, -1))
    half = np.sqrt(np.maximum(2 * squares - trace**2, 0)) / 2
    return np.stack([trace / 2 - half, trace / 2 + half], axis=-1)


def bisectors(points: Array, light: Array) -> Array:
    """Return the unit bisectors of the directions from points, shape (..., 3), to the light and to the camera."""
    return unit(unit(light - points) + unit(-points))


# Labels --------------------------------------------------------------------------------------------------------------


def at_half_height(
    image: AnyArray, start: tuple[int, int], allowed: Mask | None = None, level: float | None = None
) -> Mask:
    """Return the pixels of at least half of a pixel's value, or of a level, that are connected with it by sides."""
    above = image >= (image[start] / 2 if level is None else level)
    if allowed is not None:
        above &= allowed
    numbers, _ = ndimage.label(above)
    return numbers == numbers[start] if numbers[start] else np.zeros(image.shape, dtype=bool)


def climbed(image: AnyArray, start: tuple[int, int]) -> tuple[int, int]:
    """Return the local maximum that steepest ascent over eight neighbours leads to."""
    row, column = start
    while True:
        window = image[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        down, right = np.unravel_index(int(window.argmax()), window.shape)
        best = (int(down) + max(row - 1, 0), int(right) + max(column - 1, 0))
        if image[best] <= image[row, column]:
            return row, column
        row, column = best


def tangent_basis(normal: Array) -> Array:
    """Return the basis, shape (2, 3), in which covariances of a unit normal are stated (Duff et al. 2017)."""
    x, y, z = normal.tolist()
    sign = 1.0 if z >= 0 else -1.0
    a = -1 / (sign + z)
    return np.array([[1 + sign * x * x * a, sign * x * y * a, -sign * x], [x * y * a, sign + y * y * a, -y]])


def squared_mahalanobis(normal: Array, covariance: Array, truth: Array) -> float:
    """Return the squared Mahalanobis distance of a true unit normal from an estimate of it."""
    off = tangent_basis(normal) @ truth
    # The angle, not its sine.
    sine = float(np.linalg.norm(off))
    angle = float(np.arctan2(sine, normal @ truth))
    off = off * (angle / sine if sine > 0 else 1.0)
    return float(off @ np.linalg.solve(covariance, off))


def wilson(inside: float, count: int) -> tuple[float, float]:
    """Return Wilson's 95 % interval of a share."""
    if count == 0:
        return 0.0, 1.0
    z = 1.959964
    share, room = inside / count, z * z / count
    middle = (share + room / 2) / (1 + room)
    half = z * np.sqrt(share * (1 - share) / count + room / (4 * count)) / (1 + room)
    return float(middle - half), float(middle + half)
