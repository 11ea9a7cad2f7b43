"""`circle_pose`: the published reconstruction [MB, section 2.3], one isovalue."""

import numpy as np

from simtest.conventions import CIRCLE_POSE_ISOVALUE
from simtest.errors import Failure
from simtest.estimators.base import Estimate, fit_isophote
from simtest.geometry import Camera, Patch


def circle_pose(patch: Patch, camera: Camera, isovalue: float = CIRCLE_POSE_ISOVALUE) -> Estimate | Failure:
    """Reconstruct the normal of a plane from one isophote taken as the image of a circle.

    The article leaves the choice between N+ and N- to a person. Both make the same angle with the cone's axis, so
    the one is proposed whose projected circle centre (along C'^-1 N) is nearer to the sub-pixel peak.

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
    Estimate or Failure
        Two candidates; it looks at the projected circle centre.
    """
    fitted = fit_isophote(patch, camera, isovalue)
    if isinstance(fitted, Failure):
        return fitted
    pose = fitted.pose()
    if isinstance(pose, Failure):
        return pose
    looks = camera.project(pose.centres)
    gaps = np.linalg.norm(looks - patch.peak_px, axis=1)
    order = np.argsort(gaps, kind="stable")
    return Estimate(
        normal=pose.normals[order[0]],
        candidates=pose.normals[order],
        look_px=looks[order[0]],
        axis_ratio=pose.axis_ratio,
        isophotes=(fitted,),
    )
