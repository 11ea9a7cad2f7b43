"""`cone_axis`: the axis of the isophotes' back-projected cones carries the normal (theory.md section 3, item 4)."""

from collections.abc import Sequence

import numpy as np

from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure
from simtest.estimators.base import Estimate, fit_isophotes
from simtest.geometry import Camera, Patch

MIN_ISOPHOTES = 2
"""One isophote alone may be an accident of the background."""


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
        ``missing_isovalues``; with fewer than 2 left it fails for the first one's reason.
    """
    fitted, failures = fit_isophotes(patch, camera, isovalues)
    poses = []
    for isophote in fitted:
        pose = isophote.pose()
        if isinstance(pose, Failure):
            failures.append(pose)
        else:
            poses.append(pose)
    if len(poses) < min(MIN_ISOPHOTES, len(isovalues)):
        return failures[0]
    axis = np.mean([pose.axis for pose in poses], axis=0)
    axis /= np.linalg.norm(axis)
    return Estimate(
        normal=-axis,
        candidates=-axis[None],
        look_px=camera.project(axis),
        axis_ratio=float(np.mean([pose.axis_ratio for pose in poses])),
        isophotes=tuple(fitted),
        flags=("missing_isovalues",) if failures else (),
    )
