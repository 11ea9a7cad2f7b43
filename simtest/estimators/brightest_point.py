"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from simtest.calibration import NO_PRIORS, Priors
from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators.flags import isophote_flags
from simtest.estimators.isophote_family import fit_isophote_family
from simtest.estimators.light_offset import add_light_offset_uncertainty
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch


def brightest_point(patch: Patch, camera: Camera, priors: Priors = NO_PRIORS) -> Estimate | Failure:
    """Give the reversed sightline through the peak of the smoothed patch.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.
    priors : Priors
        Its lights are used, to say where they are beside the camera (`simtest.estimators.light_offset`).

    Returns
    -------
    Estimate
        One candidate; it looks where the peak is. Flags as of `cone_axis`, by the isophote at t = 0.5: where that runs
        into the border the peak itself may be cut off, and along a streak it may lie anywhere.
    """
    normal = -camera.unproject(patch.peak_px)
    estimate = Estimate(normal, normal[None], patch.peak_px, flags=_flags(patch, camera))
    return add_light_offset_uncertainty(estimate, priors)


def _flags(patch: Patch, camera: Camera) -> tuple[str, ...]:
    spot = fit_isophote_family(patch, camera, (HIGHLIGHT_ISOVALUE,))
    if isinstance(spot, Failure):
        return ("partial_arc",) if spot.reason == Reason.NO_CLOSED_ISOPHOTE else ()
    return isophote_flags(spot)
