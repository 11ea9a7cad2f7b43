"""The camera: pixels to unit sightlines and back, pixel centres at integer + 0.5; and its field of view."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.errors import InputError
from simtest.geometry.checks import check_integer, check_number
from simtest.geometry.lenses import BrownConrady, Distortion, with_radial_error
from simtest.runtime.arrays import Array, Mask, short_repr

FOLD_GRID = 33
"""Points along each side of the image at which a lens is checked for a fold."""

FOLD_CIRCLE = 256
"""The same around a view mask."""

FOV_DEG = (0.05, 179.0)
"""Fields of view that a pinhole may have."""

FovExtent = Literal["width", "height", "diagonal"]

FOV_EXTENTS: tuple[FovExtent, ...] = get_args(FovExtent)

_LONGEST_FOCAL = 1e7
"""Focal length up to which one is sought, over the picture's diagonal."""

_FOV_STEPS = 200
"""Of the bisection; 120 reach the last digit."""


@dataclass(frozen=True)
class ViewMask:
    """The field of view of an endoscope: pixels whose centres lie outside see nothing.

    Round, or a rectangle with corners cut at 45 deg, as a video processor masks the picture of a colonoscope.

    Parameters
    ----------
    cx, cy : float
        Centre, px, pixel centres at integer + 0.5.
    radius : float
        Radius, or half width of the rectangle, px; positive.
    corner : float, optional
        Length that each cut takes off the sides that it joins, px; None: round. A square with corners of
        ``(2 - sqrt(2)) * radius`` is a regular octagon.
    half_height : float, optional
        Of the rectangle, px; default `radius`.

    Raises
    ------
    InputError
        If a number is not finite, the radius is not positive, or the cuts are longer than the sides.

    Examples
    --------
    >>> import simtest
    >>> simtest.ViewMask(320.0, 240.0, 230.0)
    ViewMask(cx=320, cy=240, radius=230)
    """

    cx: float
    cy: float
    radius: float
    corner: float | None = None
    half_height: float | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name in ("cx", "cy", "radius", "corner", "half_height"):
            if name not in ("corner", "half_height") or getattr(self, name) is not None:
                check_number(f"view_mask.{name}", getattr(self, name))
        for name in ("radius", "half_height"):
            if (value := getattr(self, name)) is not None and value <= 0:
                raise InputError(f"view_mask.{name} = {value!r}: must be > 0")
        if self.corner is None:
            if self.half_height is not None:
                raise InputError(f"view_mask.half_height = {self.half_height!r}: needs corner; a round view has none")
            return
        most = min(self.radius, self.half_height or self.radius)
        if not 0 <= self.corner <= most:
            raise InputError(
                f"view_mask.corner = {self.corner!r}: must lie between 0 and {most:g}, half the shorter side"
            )

    def contains(self, points_px: npt.ArrayLike) -> Mask:
        """Return which pixel positions, shape (..., 2), lie inside."""
        points = np.asarray(points_px, dtype=float)
        x, y = points[..., 0] - self.cx, points[..., 1] - self.cy
        # Terms as in the renderer, so that both decide alike at the border.
        if self.corner is None:
            return np.asarray(x**2 + y**2 <= self.radius**2)
        across, down = np.abs(x), np.abs(y)
        height = self.half_height or self.radius
        within = (across <= self.radius) & (down <= height)
        return np.asarray(within & (across + down <= self.radius + height - self.corner))

    def outline(self, count: int) -> Array:
        """Return points on the border, shape (N, 2), px; `count` on a circle or on each side of a rectangle."""
        if self.corner is None:
            phase = np.linspace(0, 2 * np.pi, count)
            return np.array([self.cx, self.cy]) + self.radius * np.stack([np.cos(phase), np.sin(phase)], axis=1)
        w, h, c = self.radius, self.half_height or self.radius, self.corner
        right = np.array([[w - c, -h], [w, c - h], [w, h - c], [w - c, h]])
        corners = np.concatenate([right, -right])
        share = np.linspace(0, 1, count)[:, None]
        sides = [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        return np.array([self.cx, self.cy]) + np.concatenate(sides)


@dataclass(frozen=True)
class Camera:
    """A camera in the OpenCV frame (x right, y down, z forward): a pinhole, or a lens with distortion.

    Parameters
    ----------
    width, height : int
        Image size, px.
    fx, fy : float
        Focal lengths, px; positive.
    cx, cy : float
        Principal point, px, pixel centres at integer + 0.5.
    skew : float
        px.
    distortion : BrownConrady, KannalaBrandt or Scaramuzza, optional
        The lens between sightlines and normalised image coordinates; default none.
    view_mask : ViewMask, optional
        The part of the image that is seen; default all of it.

    Raises
    ------
    InputError
        If the size is not positive, a number is not finite, K is singular, the view mask covers no pixel, or the lens
        folds over inside the image (inside the view mask, where there is one).

    Examples
    --------
    >>> import simtest
    >>> camera = simtest.Camera.from_fov(70.0, 640, 480)
    >>> camera.unproject([[320.0, 240.0]])
    array([[0., 0., 1.]])
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    distortion: Distortion | None = None
    view_mask: ViewMask | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            check_integer(f"camera.{name}", getattr(self, name), 1)
        for name in ("fx", "fy", "cx", "cy", "skew"):
            check_number(f"camera.{name}", getattr(self, name))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise InputError(f"camera.{name} = {getattr(self, name)!r}: must be > 0, else K is singular")
        if self.view_mask is not None and not self.view_mask.contains(self.pixel_centres()).any():
            raise InputError(f"camera.view_mask = {self.view_mask}: must cover a pixel of the image")
        if self.distortion is not None:
            self._check_fold(self.distortion)

    def _check_fold(self, distortion: Distortion) -> None:
        """Raise `InputError` where a pixel that should be seen has no sightline on the lens's first branch."""
        # candidates: a grid over the image, and the border of the view mask
        x, y = (np.linspace(0.0, size, FOLD_GRID) for size in (self.width, self.height))
        tried = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        if self.view_mask is not None:
            border = self.view_mask.outline(FOLD_CIRCLE)
            tried = np.concatenate([tried[self.view_mask.contains(tried)], border])
            tried = tried[(tried >= 0).all(axis=1) & (tried <= [self.width, self.height]).all(axis=1)]
        # reject a camera with a folded point, and name the one nearest to the principal point
        folded = tried[np.isnan(self.unproject(tried)).any(axis=1)]
        if len(folded):
            gaps = np.hypot(*(folded - [self.cx, self.cy]).T)
            pixel = folded[int(gaps.argmin())]
            within = "image" if self.view_mask is None else "view mask"
            raise InputError(
                f"camera.distortion: the lens folds over at {np.degrees(distortion.limit_angle):.4g} deg off its axis, "
                f"by pixel ({pixel[0]:.0f}, {pixel[1]:.0f}), {gaps.min():.0f} px from the principal point; must stay "
                f"monotone over the {within}: other coefficients, or a smaller view_mask.radius"
            )

    @classmethod
    def from_matrix(cls, matrix: npt.ArrayLike, width: int, height: int) -> "Camera":
        """Make a camera from K, array_like, shape (3, 3), px, pixel centres at integer + 0.5, and the image's size.

        Raises
        ------
        InputError
            If K has another shape, is not upper triangular with K[2, 2] = 1, or is singular.
        """
        try:
            K = np.asarray(matrix, dtype=float)
        except (TypeError, ValueError):
            raise InputError("K: must be a (3, 3) array of numbers") from None
        if K.shape != (3, 3):
            raise InputError(f"K has shape {K.shape}: must be (3, 3)")
        if not np.allclose([K[1, 0], K[2, 0], K[2, 1], K[2, 2]], [0, 0, 0, 1]):
            raise InputError(f"K = {K.tolist()}: must be upper triangular with K[2][2] = 1")
        fx, fy, cx, cy, skew = (float(K[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2), (0, 1)))
        return cls(width, height, fx, fy, cx, cy, skew)

    @classmethod
    def from_fov(cls, fov_deg: float, width: int, height: int) -> "Camera":
        """Make a camera with square pixels from its horizontal field of view, deg, in [0.05, 179].

        Raises
        ------
        InputError
            If the angle is out of range.
        """
        low, high = FOV_DEG
        if isinstance(fov_deg, bool) or not isinstance(fov_deg, int | float) or not low <= fov_deg <= high:
            raise InputError(f"fov = {fov_deg!r}: must be {low:g} to {high:g} deg")
        focal = float(width / 2 / np.tan(np.radians(fov_deg) / 2))
        return cls(width, height, focal, focal, width / 2, height / 2)

    @cached_property
    def K(self) -> Array:
        """Calibration matrix, shape (3, 3), px."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def with_radial_error(self, error: float, edge_reach: float = 0.0) -> "Camera":
        """Return the camera whose radial distortion k1 is larger by an error; a pinhole is one without distortion.

        Points at `edge_reach` focal lengths from the centre stay: k1 r (r^2 - edge_reach^2) is another k1 at another
        focal length.
        """
        if not error:
            return self
        lens, at_axis = with_radial_error(self.distortion or BrownConrady(), error, edge_reach)
        fx, fy, skew = (at_axis * each for each in (self.fx, self.fy, self.skew))
        return replace(self, fx=fx, fy=fy, skew=skew, distortion=lens)

    def unproject(self, points_px: npt.ArrayLike) -> Array:
        """Return the unit sightlines, shape (..., 3), of pixels, shape (..., 2), inside the image and outside.

        They are in the camera frame; NaN where the lens sees no direction.
        """
        points = np.asarray(points_px, dtype=float)
        y = (points[..., 1] - self.cy) / self.fy
        x = (points[..., 0] - self.cx - self.skew * y) / self.fx
        if self.distortion is not None:
            return self.distortion.undistort(np.stack([x, y], axis=-1))
        rays = np.empty((*x.shape, 3))
        rays[..., 0], rays[..., 1], rays[..., 2] = x, y, 1.0
        rays /= np.sqrt(x * x + y * y + 1.0)[..., None]
        return rays

    def step_of_pixels(self, point_px: Array) -> Array:
        """Return how the unit sightline moves by a pixel along x and along y, rows, shape (2, 3), at a pixel, (2,).

        Central differences over half a pixel either way.
        """
        steps = np.array([[0.5, 0.0], [0.0, 0.5]])
        return self.unproject(point_px + steps) - self.unproject(point_px - steps)

    def project(self, points: npt.ArrayLike) -> Array:
        """Return the pixels, shape (..., 2), at which the lens images points or directions, shape (..., 3).

        These are in the camera frame. Like `unproject` it describes the lens alone, also outside the image and the view
        mask; what is in view, `contains` decides. NaN where the lens images nothing: z <= 0 (but for lenses that
        see sideways and backwards), and where the lens folds over.
        """
        P = np.asarray(points, dtype=float)
        if self.distortion is not None:
            x, y = np.moveaxis(self.distortion.distort(P), -1, 0)
        else:
            z = np.where(P[..., 2] > 0, P[..., 2], np.nan)
            x, y = P[..., 0] / z, P[..., 1] / z
        return np.stack([self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy], axis=-1)

    def pixel_centres(self) -> Array:
        """Return the centres of all pixels, shape (height, width, 2), px."""
        x = np.arange(self.width) + PIXEL_CENTRE
        y = np.arange(self.height) + PIXEL_CENTRE
        return np.stack(np.meshgrid(x, y), axis=-1)

    @cached_property
    def seen(self) -> Mask | None:
        """Pixels whose centres lie inside the view mask, shape (height, width); None where there is no mask."""
        return None if self.view_mask is None else self.view_mask.contains(self.pixel_centres())

    def contains(self, points_px: npt.ArrayLike) -> Mask:
        """Return which pixel positions, shape (..., 2), lie inside the image and the view mask."""
        points = np.asarray(points_px, dtype=float)
        inside = ((points >= 0) & (points <= [self.width, self.height])).all(axis=-1)
        return np.asarray(inside if self.view_mask is None else inside & self.view_mask.contains(points))


def field_of_view(camera: Camera, across: FovExtent = "width") -> float:
    """Return the angle, deg, that a camera's picture spans across its width, height or diagonal.

    It is the sum of the angles from the optical axis at the two ends: of the line through the principal point, or of
    the diagonal from the upper left corner. NaN where the lens images nothing at an end.
    """
    ends = _ends(camera.width, camera.height, (camera.cx, camera.cy), across)
    return float(np.degrees(_angles(camera.unproject(ends + np.array([camera.cx, camera.cy])))))


def focal_of_view(
    fov_deg: float,
    size: tuple[int, int],
    centre: tuple[float, float],
    lens: Distortion | None = None,
    across: FovExtent = "width",
) -> float:
    """Return the focal length, px, of a camera with square pixels that has a given field of view.

    The angle, deg, is as `field_of_view` gives it. Size and principal point of the picture are px; the lens, whose
    field it is, is by default a pinhole.
    """
    wanted, ends = np.radians(fov_deg), _ends(*size, centre, across)
    lengths = np.linalg.norm(ends, axis=1)
    if lens is None and lengths[0] == lengths[1] and 0 < wanted < np.pi:
        return float(lengths[0] / np.tan(wanted / 2))

    def spans(focal: float) -> float:
        """Return the angle at a focal length; inf where the lens folds over before an end of the picture."""
        m = ends / focal
        angle = _angles(np.column_stack([m, [1.0, 1.0]]) if lens is None else lens.undistort(m))
        return float(angle) if np.isfinite(angle) else np.inf

    # The angle falls as the focal length grows.
    low, high = np.log(lengths.max() * 1e-6), np.log(lengths.max() * _LONGEST_FOCAL)
    for _ in range(_FOV_STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if spans(float(np.exp(middle))) > wanted else (low, middle)
    focal = float(np.exp(high))
    if not abs(spans(focal) - wanted) <= 1e-9 * wanted:
        most = np.degrees(np.pi if lens is None else 2 * lens.limit_angle)
        raise InputError(
            f"fov_deg = {fov_deg:g}: this lens cannot span that angle across the {across}; must be below {most:.4g} "
            "deg, where it ends or folds over"
        )
    return focal


def _ends(width: int, height: int, centre: tuple[float, float], across: FovExtent) -> Array:
    """Return the two ends of an extent, shape (2, 2), px from the principal point."""
    cx, cy = centre
    ends = {
        "width": [[-cx, 0.0], [width - cx, 0.0]],
        "height": [[0.0, -cy], [0.0, height - cy]],
        "diagonal": [[-cx, -cy], [width - cx, height - cy]],
    }
    return np.array(ends[across])


def _angles(rays: Array) -> Array:
    """Return the sum of the angles between two rays, shape (2, 3), and the optical axis, rad."""
    return np.asarray(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).sum())
