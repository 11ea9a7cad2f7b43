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
    backproject_conic,
    circle_pose,
    cone_of_conic,
    cone_rays,
    fit_ellipse,
)
from simtest.geometry.vectors import tangent_basis

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FittedIsophote:
    """An isophote with its ellipse.

    Parameters
    ----------
    isovalue : float
        t.
    points : ndarray, shape (N, 2)
        Contour, px.
    conic : FittedConic or None
        Ellipse, px; None where the lens distorts, since the fitted curve is then no ellipse in the image.
    cone : ndarray, shape (3, 3)
        C', the cone of sightlines through the fitted curve, camera frame.
    sightline : ndarray, shape (3,)
        A direction inside the cone: tells its two sides apart.
    """

    isovalue: float
    points: Array
    conic: FittedConic | None
    cone: Array
    sightline: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    def pose(self) -> CirclePose | Failure:
        """Give what the cone says about a circle (see `simtest.geometry.circle_pose`)."""
        return circle_pose(self.cone, self.sightline)

    def ellipse_px(self, camera: Camera) -> Array:
        """Give the fitted curve as the camera images it, shape (N, 2), px, closed: for drawing."""
        return camera.project(cone_rays(self.cone, self.sightline))


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
    """

    normal: Array
    candidates: Array
    look_px: Array
    axis_ratio: float | None = None
    isophotes: tuple[FittedIsophote, ...] = ()
    choice_margin: float | None = None
    covariance: Array | None = None
    flags: tuple[str, ...] = field(default=())


def drawable(curve: Array) -> list[list[float]]:
    """Give a curve, shape (N, 2), px, as lists for a JSON file; points that the lens does not image are left out."""
    return np.round(curve[np.isfinite(curve).all(axis=1)], 3).tolist()


Estimator = Callable[[Patch, Camera], Estimate | Failure]
"""An estimator: a callable that takes the patch of a highlight and the camera.

Other packages register theirs under the entry-point group ``simtest.estimators``.
"""


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
    points = patch.isophote(isovalue)
    if isinstance(points, Failure):
        return points
    if camera.distortion is not None:
        return _fit_on_sightlines(isovalue, points, camera)
    # The last point repeats the first and would count twice.
    conic = fit_ellipse(points[:-1])
    if isinstance(conic, Failure):
        return conic
    return FittedIsophote(isovalue, points, conic, backproject_conic(conic, camera))


def _fit_on_sightlines(isovalue: float, points: Array, camera: Camera) -> FittedIsophote | Failure:
    """Fit an ellipse where a lens has none in its image: in the plane across the contour's mean sightline.

    A cone of sightlines cuts every such (gnomonic) plane in an ellipse.
    """
    rays = camera.unproject(points[:-1])
    mean = rays.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if not length > 0:
        return Failure(Reason.NOT_FINITE, "the lens images nothing at points of the isophote")
    sightline = mean / length
    first, second = tangent_basis(sightline[None])
    plane_from_camera = np.concatenate([first, second, sightline[None]])
    across = rays @ plane_from_camera.T
    if across[:, 2].min() <= 0:
        return Failure(Reason.NOT_AN_ELLIPSE, "the isophote reaches 90 deg from its mean sightline")
    conic = fit_ellipse(across[:, :2] / across[:, 2:])
    if isinstance(conic, Failure):
        return conic
    return FittedIsophote(isovalue, points, None, cone_of_conic(conic, plane_from_camera), sightline)


def fit_isophotes(
    patch: Patch, camera: Camera, isovalues: Sequence[float]
) -> tuple[list[FittedIsophote], list[Failure]]:
    """Fit several isophotes (see `fit_isophote`); gives those that succeeded and the failures of the others."""
    results = [fit_isophote(patch, camera, t) for t in isovalues]
    fitted = [result for result in results if isinstance(result, FittedIsophote)]
    return fitted, [result for result in results if isinstance(result, Failure)]
