"""NumPy geometry of images.

Pixels to sightlines (`camera`, `lenses`), a highlight's isophotes (`patch`, `level_sets`), ellipses fitted to them
(`ellipse_fit`), the cones of their sightlines and the circles whose images these may be (`cones`).
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.geometry.camera import Camera, ViewMask
    from simtest.geometry.cones import (
        CirclePose,
        CirclePoses,
        circle_pose,
        circle_poses,
        cone_axes,
        cone_of_conic,
        cone_rays,
    )
    from simtest.geometry.ellipse_fit import (
        FittedArc,
        FittedConic,
        ellipse_of_conic,
        fit_arc,
        fit_ellipse,
        fit_ellipses,
    )
    from simtest.geometry.lenses import BrownConrady, KannalaBrandt, Scaramuzza
    from simtest.geometry.patch import Patch, smooth
    from simtest.runtime.arrays import Array, Image, Index, Mask

__getattr__, __dir__, __all__ = lazy_names(__name__)
