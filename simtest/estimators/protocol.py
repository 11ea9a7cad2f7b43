"""What an estimator takes and gives, and the steps that several share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason
from simtest.geometry import (
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
from simtest.geometry.arc_fit import MIN_ARC_RAD, angular_extent
from simtest.geometry.ellipse_fit import MIN_POINTS
from simtest.geometry.fitting_planes import FORWARD, fitting_planes
from simtest.geometry.pose_region import PoseRegion

Array = npt.NDArray[np.float64]

MAX_ARC_RESIDUAL = 0.1
"""Most that an arc may miss its ellipse, RMS over the radius, noise included: more, and it is no part of one."""


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
        A direction inside the cone: tells its two sides apart.
    cut : bool
        Whether only a part of the contour is seen.
    """

    isovalue: float
    points: Array
    conic: FittedConic | None
    cone: Array
    sightline: Array = field(default_factory=lambda: FORWARD)
    cut: bool = False

    def pose(self) -> CirclePose | Failure:
        """Give what the cone says about a circle (see `simtest.geometry.circle_pose`)."""
        return circle_pose(self.cone, self.sightline)

    def ellipse_px(self, camera: Camera) -> Array:
        """Give the fitted curve as the camera images it, shape (N, 2), px, closed: for drawing."""
        return camera.project(cone_rays(self.cone, self.sightline))


@dataclass(frozen=True)
class EstimatedCurvature:
    """The surface's curvature at a highlight.

    Parameters
    ----------
    directions : ndarray, shape (2, 3)
        Principal directions, unit, camera frame: of the smaller and of the larger abs(1 + d k); of either sign.
    axis_ratio : float
        abs(1 + d k) of the first over that of the second, in (0, 1].
    hypotheses : ndarray, shape (H, 2), optional
        1 + d k along both directions: all that the data allow, the most plausible first; None where the lobe's width is
        not known.
    """

    directions: Array
    axis_ratio: float
    hypotheses: Array | None = None

    @property
    def gains(self) -> Array | None:
        """The most plausible 1 + d k along both directions, shape (2,)."""
        return None if self.hypotheses is None else self.hypotheses[0]


@dataclass(frozen=True)
class Estimate:
    """A reconstructed normal.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        The proposed normal, unit, facing the camera, camera frame.
    candidates : ndarray, shape (K, 3)
        All normals that the data allow, the proposed one first.
    look_px : ndarray, shape (2,)
        Pixel at whose surface point the normal is proposed.
    axis_ratio : float, optional
        Smaller over larger half-axis of the back-projected cone.
    isophotes : tuple of FittedIsophote
        What was fitted.
    choice_margin : float, optional
        How clearly the proposed candidate won, in standard deviations.
    covariance : ndarray, shape (2, 2), optional
        Of the normal in the basis `simtest.geometry.vectors.tangent_basis(normal)`, rad^2.
    flags : tuple of str
        Warnings.
    curvature : EstimatedCurvature, optional
        What the estimator says of the surface's curvature.
    region : PoseRegion, optional
        The normals that the data allow, where they are no ellipse about the proposed one: in place of a covariance.
    """

    normal: Array
    candidates: Array
    look_px: Array
    axis_ratio: float | None = None
    isophotes: tuple[FittedIsophote, ...] = ()
    choice_margin: float | None = None
    covariance: Array | None = None
    flags: tuple[str, ...] = field(default=())
    curvature: EstimatedCurvature | None = None
    region: PoseRegion | None = None

    def contours(self, patch: Patch | Failure) -> list[tuple[float, Array]]:
        """Give the isophotes that were used on a patch: isovalue and closed polygon, shape (N, 2), px."""
        if isinstance(patch, Failure):
            return []
        traced = [(isophote.isovalue, patch.isophote(isophote.isovalue)) for isophote in self.isophotes]
        return [(t, points) for t, points in traced if not isinstance(points, Failure)]


def drawable(curve: Array) -> list[list[float]]:
    """Give a curve, shape (N, 2), px, as lists for a JSON file; points that the lens does not image are left out."""
    return np.round(curve[np.isfinite(curve).all(axis=1)], 3).tolist()


BatchEstimator = Callable[[Sequence[Patch | Failure], Camera], list[Estimate | Failure]]
"""The same for several highlights seen by one camera; what is a Failure already stays one."""

Estimator = Callable[..., Estimate | Failure]
"""An estimator: a callable that takes the patch of a highlight and the camera.

One with an attribute `each`, a `BatchEstimator` that gives the same of each patch, is asked for all highlights of a
frame at once (`answers_each`). One that has a parameter `known` is also given what is known beside the picture, as
`simtest.calibration.Priors`, by that name.

Other packages register theirs under the entry-point group ``simtest.estimators``.
"""


def answers_each(each: BatchEstimator) -> Callable[[Estimator], Estimator]:
    """Give a decorator of an estimator that takes several highlights at once, too, and is faster then."""

    def add(estimator: Estimator) -> Estimator:
        estimator.each = each  # type: ignore[attr-defined]
        return estimator

    return add


def fit_isophote(patch: Patch, camera: Camera, isovalue: float) -> FittedIsophote | Failure:
    """Trace one isophote and fit its ellipse [MB, section 2.3, steps 1 to 3].

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isovalue : float
        t in (0, 1).

    Returns
    -------
    FittedIsophote or Failure
    """
    return _fit([isovalue], [patch.crossings(isovalue)], camera)[0]


def fit_isophotes(
    patch: Patch, camera: Camera, isovalues: Sequence[float]
) -> tuple[list[FittedIsophote], list[Failure]]:
    """Fit several isophotes (see `fit_isophote`); gives those that succeeded and the failures of the others."""
    results = _fit(isovalues, patch.crossings_of(isovalues), camera)
    fitted = [result for result in results if isinstance(result, FittedIsophote)]
    return fitted, [result for result in results if isinstance(result, Failure)]


def fit_cut_isophote(patch: Patch, camera: Camera, isovalue: float) -> FittedIsophote | Failure:
    """Fit what is seen of an isophote that the border or the view cuts (see `simtest.geometry.fit_arc`).

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isovalue : float
        t in (0, 1).

    Returns
    -------
    FittedIsophote or Failure
        A Failure, too, where what is seen is no part of an ellipse around the peak, as where the region of interest
        lies on a slope, or a wide isophote shows in one corner of the frame alone.
    """
    points = patch.arc(isovalue)
    if len(points) < MIN_POINTS:
        return Failure(Reason.TOO_FEW_POINTS, f"{len(points)} points of the arc; at least {MIN_POINTS} are needed")
    planes = fitting_planes([points], camera)
    fitted = planes.failures.get(0) or fit_arc(planes.points[0])
    if isinstance(fitted, Failure):
        return fitted
    if fitted.residual > MAX_ARC_RESIDUAL:
        return Failure(Reason.NOT_AN_ELLIPSE, f"the arc misses its ellipse by {fitted.residual:.2g} of the radius")
    plane_from_camera = planes.plane_from_camera if planes.plane_from_camera.ndim == 2 else planes.plane_from_camera[0]
    cone = cone_of_conic(fitted.conic, plane_from_camera)
    peak = camera.unproject(patch.peak_px)
    # Inside, s^T C s has the sign of the one eigenvalue that differs from the other two.
    if not float(peak @ cone @ peak) * float(np.linalg.det(cone)) > 0:
        return Failure(Reason.NOT_AN_ELLIPSE, "the arc's ellipse does not enclose the peak")
    if (seen := angular_extent(points - patch.peak_px)) < MIN_ARC_RAD:
        return Failure(Reason.TOO_FEW_POINTS, f"an arc of {np.degrees(seen):.0f} deg around the peak")
    in_image = fitted.conic if camera.distortion is None else None
    return FittedIsophote(isovalue, points, in_image, cone, planes.sightlines[0], cut=True)


def fit_isophote_of_each(
    patches: Sequence[Patch | Failure], camera: Camera, isovalue: float
) -> list[FittedIsophote | Failure]:
    """Fit the isophote of the same value of several patches (see `fit_isophote`)."""
    contours = [patch if isinstance(patch, Failure) else patch.crossings(isovalue) for patch in patches]
    return _fit([isovalue] * len(patches), contours, camera)


def _fit(
    isovalues: Sequence[float], contours: Sequence[Array | Failure], camera: Camera
) -> list[FittedIsophote | Failure]:
    """Fit ellipses to contours at their isovalues, each in its fitting plane; failures are passed on."""
    traced = {i: contour for i, contour in enumerate(contours) if not isinstance(contour, Failure)}
    planes = fitting_planes(list(traced.values()), camera)
    conics = fit_ellipses(planes.points)
    cones = cone_of_conic(conics, planes.plane_from_camera)
    results: dict[int, FittedIsophote | Failure] = {i: c for i, c in enumerate(contours) if isinstance(c, Failure)}
    for place, (i, points) in enumerate(traced.items()):
        conic = planes.failures.get(place) or conics[place]
        if isinstance(conic, Failure):
            results[i] = conic
        else:
            in_image = conic if camera.distortion is None else None
            results[i] = FittedIsophote(isovalues[i], points, in_image, cones[place], planes.sightlines[place])
    return [results[i] for i in range(len(contours))]
