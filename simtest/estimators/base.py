"""What an estimator takes and gives, and the steps that several share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.geometry import Camera, FittedConic, Patch, backproject_conic, fit_ellipse

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
    conic : FittedConic
        Ellipse, px.
    cone : ndarray, shape (3, 3)
        C' = K^T C K.
    """

    isovalue: float
    points: Array
    conic: FittedConic
    cone: Array


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
    # The last point repeats the first and would count twice.
    conic = fit_ellipse(points[:-1])
    if isinstance(conic, Failure):
        return conic
    return FittedIsophote(isovalue, points, conic, backproject_conic(conic, camera))


def fit_isophotes(
    patch: Patch, camera: Camera, isovalues: Sequence[float]
) -> tuple[list[FittedIsophote], list[Failure]]:
    """Fit several isophotes (see `fit_isophote`); gives those that succeeded and the failures of the others."""
    results = [fit_isophote(patch, camera, t) for t in isovalues]
    fitted = [result for result in results if isinstance(result, FittedIsophote)]
    return fitted, [result for result in results if isinstance(result, Failure)]
