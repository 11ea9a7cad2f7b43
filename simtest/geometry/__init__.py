"""NumPy geometry of images.

Pixels to sightlines (`camera`, `distortion`), a highlight's isophotes (`patch`, `isophotes`, `level_sets`), ellipses
fitted to them (`ellipse_fit`, `arc_fit`), the cones of their sightlines (`conics`), and the circles whose images these
may be (`circle_from_cone`, `pose_region`).
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.geometry.arc_fit import FittedArc, fit_arc
    from simtest.geometry.camera import Camera, ViewMask
    from simtest.geometry.circle_from_cone import CirclePose, CirclePoses, circle_pose, circle_poses, cone_axes
    from simtest.geometry.conics import Ellipse, cone_of_conic, cone_rays, ellipse_of_conic
    from simtest.geometry.distortion import Distortion, KannalaBrandt
    from simtest.geometry.ellipse_fit import FittedConic, fit_ellipse, fit_ellipses
    from simtest.geometry.gaussian_smoothing import smooth
    from simtest.geometry.omnidirectional import Scaramuzza
    from simtest.geometry.patch import Patch
    from simtest.geometry.perspective import BrownConrady
    from simtest.runtime.arrays import Array, Image, Index, Mask

__all__ = [
    "Array",
    "BrownConrady",
    "Camera",
    "CirclePose",
    "CirclePoses",
    "Distortion",
    "Ellipse",
    "FittedArc",
    "FittedConic",
    "Image",
    "Index",
    "KannalaBrandt",
    "Mask",
    "Patch",
    "Scaramuzza",
    "ViewMask",
    "circle_pose",
    "circle_poses",
    "cone_axes",
    "cone_of_conic",
    "cone_rays",
    "ellipse_of_conic",
    "fit_arc",
    "fit_ellipse",
    "fit_ellipses",
    "smooth",
]

__getattr__, __dir__, _ = lazy_names(__name__)
