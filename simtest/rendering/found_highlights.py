"""A session's highlight points, searched once while surface, camera and rig stay; frames give them their radiance.

Where the points lie does not depend on the light that reaches the camera, and the search is a large part of a frame.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from simtest.rendering import glints, highlights
from simtest.rendering.frames import HighlightPoint, Radiance
from simtest.spec.surfaces import AnatomySurface

if TYPE_CHECKING:
    from simtest.rendering.session import Session

FINE_STRIDE_PX = 2
"""Seeds' grid for anatomies, whose highlights are small and many."""

COARSE_STRIDE_PX = 4
"""Seeds' grid for analytic surfaces."""


def search(session: "Session", base: bool) -> list[HighlightPoint]:
    """Find the highlight points of all lights in view, of the `base` or of the fine surface, in a dark frame.

    Their radiance is 0, and equal values are not sorted: they stand in the order in which they were found.
    """
    camera = session.camera
    dark = np.zeros((camera.height, camera.width), dtype=np.float32)
    radiance = Radiance(dark, dark, dark)
    if session.surface.relief is not None and not base:
        return glints.find(session, radiance)
    stride = FINE_STRIDE_PX if isinstance(session.scene.surface, AnatomySurface) else COARSE_STRIDE_PX
    return highlights.find(session, radiance, stride=stride)


def lit_by(radiance: Radiance, points: Sequence[HighlightPoint]) -> list[HighlightPoint]:
    """Return highlight points with the direct radiance of their pixels in a frame, the brightest first.

    Bounces are left out: their noise would change the order from seed to seed.
    """
    if not points:
        return []
    height, width = radiance.specular.shape[:2]
    columns, rows = np.array([point.bp_px for point in points]).astype(int).T
    at = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    direct = radiance.specular[at] + radiance.diffuse[at]
    values = (direct if direct.ndim == 1 else direct.mean(axis=1, dtype=np.float32)).tolist()
    shone = (replace(point, radiance=value) for point, value in zip(points, values, strict=True))
    return highlights.brightest_first(list(shone))
