"""`cone_axis`: the axis of the isophotes' back-projected cones carries the normal (theory.md section 3, item 4)."""

from collections.abc import Sequence

from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure
from simtest.estimators.base import Estimate
from simtest.estimators.flags import spot_flags
from simtest.estimators.spot import fit_spot
from simtest.geometry import Camera, Patch


def cone_axis(patch: Patch, camera: Camera, isovalues: Sequence[float] = CONE_AXIS_ISOVALUES) -> Estimate | Failure:
    """Average the cones' axes over several isovalues.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    isovalues : sequence of float
        Each t in (0, 1).

    Returns
    -------
    Estimate or Failure
        One candidate; it looks along the axis. Isovalues without a closed isophote are left out and flagged
        ``missing_isovalues``; with fewer than 2 left it fails for the first one's reason. The covariance is that of
        the noise, and of the axis' drift with the isovalue where that is more than noise.
    """
    spot = fit_spot(patch, camera, isovalues)
    if isinstance(spot, Failure):
        return spot
    return Estimate(
        normal=-spot.axis,
        candidates=-spot.axis[None],
        look_px=camera.project(spot.axis),
        axis_ratio=spot.axis_ratio,
        isophotes=spot.isophotes,
        covariance=spot.axis_covariance,
        flags=spot_flags(spot),
    )
