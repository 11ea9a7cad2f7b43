"""`circle_pose`: the published reconstruction [MB, section 2.3], one isovalue."""

from collections.abc import Sequence

import numpy as np

from simtest.conventions import CIRCLE_POSE_ISOVALUE
from simtest.errors import Failure
from simtest.estimators.base import Estimate, FittedIsophote, fit_isophote_of_each
from simtest.geometry import Camera, Patch
from simtest.geometry import circle_poses as poses_of_cones


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
    return circle_poses([patch], camera, isovalue)[0]


def circle_poses(
    patches: Sequence[Patch | Failure], camera: Camera, isovalue: float = CIRCLE_POSE_ISOVALUE
) -> list[Estimate | Failure]:
    """Give `circle_pose` of several patches at once, many times faster than one by one; a Failure stays one."""
    fitted = fit_isophote_of_each(patches, camera, isovalue)
    pending = [
        (patch, isophote)
        for patch, isophote in zip(patches, fitted, strict=True)
        if not (isinstance(patch, Failure) or isinstance(isophote, Failure))
    ]
    posed = iter(_pose(pending, camera))
    return [isophote if isinstance(isophote, Failure) else next(posed) for isophote in fitted]


def _pose(fitted: Sequence[tuple[Patch, FittedIsophote]], camera: Camera) -> list[Estimate | Failure]:
    if not fitted:
        return []
    poses = poses_of_cones(
        np.array([isophote.cone for _, isophote in fitted]), np.array([isophote.sightline for _, isophote in fitted])
    )
    looks = camera.project(poses.centres)
    gaps = np.linalg.norm(looks - np.array([patch.peak_px for patch, _ in fitted])[:, None], axis=2)
    order = np.argsort(gaps, axis=1, kind="stable")[:, :, None]
    normals, looks = np.take_along_axis(poses.normals, order, axis=1), np.take_along_axis(looks, order, axis=1)
    return [
        poses.failures.get(i)
        or Estimate(normals[i, 0], normals[i], looks[i, 0], float(poses.axis_ratios[i]), isophotes=(isophote,))
        for i, (_, isophote) in enumerate(fitted)
    ]
