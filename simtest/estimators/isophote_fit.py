"""Fitting steps that estimators share: from a patch's isophotes to ellipses and the cones of their sightlines."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from simtest.errors import Failure, Reason
from simtest.geometry import (
    Array,
    Camera,
    CirclePose,
    FittedConic,
    Patch,
    circle_pose,
    cone_of_conic,
    cone_rays,
    fit_arc,
    fit_ellipses,
)
from simtest.geometry.cones import FORWARD, fitting_planes
from simtest.geometry.ellipse_fit import MIN_ARC_RAD, MIN_POINTS, angular_extent
from simtest.runtime.arrays import short_repr

MAX_ARC_RESIDUAL = 0.1
"""An arc that misses its ellipse by more, RMS over the radius, noise included, is no part of one."""


@dataclass(frozen=True)
class FittedIsophote:
    """An isophote with its ellipse.

    Parameters
    ----------
    isovalue : float
        t.
    points : ndarray, shape (N, 2)
        Where the contour crosses the lines between pixel centres, px, in no order.
    conic : FittedConic or None
        Ellipse, px; None where the lens distorts, since the fitted curve is then no ellipse in the image.
    cone : ndarray, shape (3, 3)
        C', the cone of sightlines through the fitted curve, camera frame.
    sightline : ndarray, shape (3,)
        A direction inside the cone, which tells its two sides apart.
    cut : bool
        Whether only a part of the contour is seen.
    """

    isovalue: float
    points: Array
    conic: FittedConic | None
    cone: Array
    sightline: Array = field(default_factory=lambda: FORWARD)
    cut: bool = False

    __repr__ = short_repr

    def pose(self) -> CirclePose | Failure:
        """Compute the poses of a circle with this cone (see `simtest.geometry.circle_pose`)."""
        return circle_pose(self.cone, self.sightline)

    def rays(self) -> Array:
        """Return sightlines along the fitted curve, shape (N, 3), closed."""
        return cone_rays(self.cone, self.sightline)

    def ellipse_px(self, camera: Camera) -> Array:
        """Return the fitted curve as the camera images it, shape (N, 2), px, closed: for drawing."""
        return camera.project(self.rays())


def fit_isophotes(
    patch: Patch, camera: Camera, isovalues: Sequence[float]
) -> tuple[list[FittedIsophote], list[Failure]]:
    """Trace isophotes at t in (0, 1) and fit their ellipses [MB, section 2.3, steps 1 to 3].

    Returns those that succeeded and the failures of the others.
    """
    return fit_isophotes_of_each([patch], camera, isovalues)[0]


def fit_isophotes_of_each(
    patches: Sequence[Patch], camera: Camera, isovalues: Sequence[float]
) -> list[tuple[list[FittedIsophote], list[Failure]]]:
    """Return what `fit_isophotes` returns of each patch, all ellipses fitted at once."""
    contours = [contour for patch in patches for contour in patch.crossings_of(isovalues)]
    results = iter(_fit([*isovalues] * len(patches), contours, camera))
    fitted: list[tuple[list[FittedIsophote], list[Failure]]] = []
    for _ in patches:
        own = [next(results) for _ in isovalues]
        kept = [result for result in own if isinstance(result, FittedIsophote)]
        fitted.append((kept, [result for result in own if isinstance(result, Failure)]))
    return fitted


def fit_isophote_of_each(
    patches: Sequence[Patch | Failure], camera: Camera, isovalue: float
) -> list[FittedIsophote | Failure]:
    """Fit the isophote at the same value of several patches."""
    contours = [patch if isinstance(patch, Failure) else patch.crossings(isovalue) for patch in patches]
    return _fit([isovalue] * len(patches), contours, camera)


def fit_cut_isophote(patch: Patch, camera: Camera, isovalue: float) -> FittedIsophote | Failure:
    """Fit the seen part of an isophote at t in (0, 1) that the border or the view cuts (see `geometry.fit_arc`).

    Also a Failure where the seen part is no arc of an ellipse around the peak: where the region of interest lies on a
    slope, for example, or a wide isophote shows in one corner of the frame alone.
    """
    points = patch.arc(isovalue)
    if len(points) < MIN_POINTS:
        return Failure(Reason.TOO_FEW_POINTS, f"{len(points)} points of the arc; at least {MIN_POINTS} are needed")
    planes = fitting_planes([points], camera)
    fitted = planes.failures.get(0) or fit_arc(planes.points[0])
    if isinstance(fitted, Failure):
        return fitted
    # reject: no ellipse, not around the peak, or too short an arc as seen from the peak
    if fitted.residual > MAX_ARC_RESIDUAL:
        return Failure(Reason.NOT_AN_ELLIPSE, f"the arc misses its ellipse by {fitted.residual:.2g} of the radius")
    plane_from_camera = planes.plane_from_camera if planes.plane_from_camera.ndim == 2 else planes.plane_from_camera[0]
    cone = cone_of_conic(fitted.conic, plane_from_camera)
    peak = camera.unproject(patch.peak_px)
    # Inside the cone, s^T C s has the sign of the one eigenvalue that differs from the other two.
    if not float(peak @ cone @ peak) * float(np.linalg.det(cone)) > 0:
        return Failure(Reason.NOT_AN_ELLIPSE, "the arc's ellipse does not enclose the peak")
    if (seen := angular_extent(points - patch.peak_px)) < MIN_ARC_RAD:
        return Failure(Reason.TOO_FEW_POINTS, f"an arc of {np.degrees(seen):.0f} deg around the peak")
    in_image = fitted.conic if camera.distortion is None else None
    return FittedIsophote(isovalue, points, in_image, cone, planes.sightlines[0], cut=True)


def _fit(
    isovalues: Sequence[float], contours: Sequence[Array | Failure], camera: Camera
) -> list[FittedIsophote | Failure]:
    """Fit ellipses to contours at their isovalues, each in its fitting plane; failures are passed on."""
    traced = {i: contour for i, contour in enumerate(contours) if not isinstance(contour, Failure)}
    planes = fitting_planes(list(traced.values()), camera)
    conics = fit_ellipses(planes.points)
    cones = cone_of_conic(conics, planes.plane_from_camera)
    # back into the order of the contours
    results: dict[int, FittedIsophote | Failure] = {i: c for i, c in enumerate(contours) if isinstance(c, Failure)}
    for row, (i, points) in enumerate(traced.items()):
        conic = planes.failures.get(row) or conics[row]
        if isinstance(conic, Failure):
            results[i] = conic
        else:
            in_image = conic if camera.distortion is None else None
            results[i] = FittedIsophote(isovalues[i], points, in_image, cones[row], planes.sightlines[row])
    return [results[i] for i in range(len(contours))]
