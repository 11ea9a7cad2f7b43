"""`cone_axis`: the axis of the isophotes' back-projected cones carries the normal (theory.md section 3, item 4)."""

from collections.abc import Sequence

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure
from simtest.estimators.flags import isophote_flags
from simtest.estimators.isophote_family import fit_isophote_family
from simtest.estimators.light_offset import add_light_offset_uncertainty
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


def cone_axis(
    patch: Patch,
    camera: Camera,
    priors: Priors = NO_PRIORS,
    isovalues: Sequence[float] = CONE_AXIS_ISOVALUES,
) -> Estimate | Failure:
    """Average the cones' axes over several isovalues.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    priors : Priors
        Its lights are used, to say where they are beside the camera (`simtest.estimators.light_offset`).
    isovalues : sequence of float
        Each t in (0, 1).

    Returns
    -------
    Estimate or Failure
        One candidate; it looks along the axis. Isovalues without a closed isophote are left out and flagged
        ``missing_isovalues``; with fewer than 2 left it fails for the first one's reason. The covariance is that of
        the noise, and of the axis' drift with the isovalue where that is more than noise.
    """
    spot = fit_isophote_family(patch, camera, isovalues)
    if isinstance(spot, Failure):
        return spot
    estimate = Estimate(
        normal=-spot.axis,
        candidates=-spot.axis[None],
        look_px=camera.project(spot.axis),
        axis_ratio=spot.axis_ratio,
        isophotes=spot.isophotes,
        covariance=spot.axis_covariance,
        flags=isophote_flags(spot),
    )
    return add_light_offset_uncertainty(estimate, priors)
