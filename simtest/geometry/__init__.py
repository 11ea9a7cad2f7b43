"""NumPy geometry of images: cameras, isophotes, conics, ellipse fits and circle pose."""

from simtest.geometry.arc_fit import FittedArc, fit_arc
from simtest.geometry.camera import Camera, ViewMask
from simtest.geometry.circle_pose import CirclePose, CirclePoses, circle_pose, circle_poses, cone_axes
from simtest.geometry.conics import Ellipse, backproject_conic, cone_of_conic, cone_rays, ellipse_of_conic
from simtest.geometry.distortion import BrownConrady, Distortion, KannalaBrandt
from simtest.geometry.ellipse_fit import FittedConic, fit_ellipse, fit_ellipses
from simtest.geometry.isophotes import Patch, smooth

__all__ = [
    "BrownConrady",
    "Camera",
    "CirclePose",
    "CirclePoses",
    "Distortion",
    "Ellipse",
    "FittedArc",
    "FittedConic",
    "KannalaBrandt",
    "Patch",
    "ViewMask",
    "backproject_conic",
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
