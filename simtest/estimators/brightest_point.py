"""`brightest_point`: the sightline through the peak carries the normal (theory.md section 3, item 1)."""

from simtest.errors import Failure
from simtest.estimators.base import Estimate
from simtest.geometry import Camera, Patch


def brightest_point(patch: Patch, camera: Camera) -> Estimate | Failure:
    """Give the reversed sightline through the peak of the smoothed patch.

    Parameters
    ----------
    patch : Patch
        Region of interest.
    camera : Camera
        Calibration.

    Returns
    -------
    Estimate
        One candidate; it looks where the peak is.
    """
    normal = -camera.unproject(patch.peak_px)
    return Estimate(normal=normal, candidates=normal[None], look_px=patch.peak_px)
