"""A scene in 3D: its surface coloured by curvature, camera, lights, true and estimated normals."""

from simtest.report.scene3d import Content
from simtest.report.viewer.scene_page import check_page, make_content, write_scene_page
from simtest.report.viewer.window import check_target, save_screenshot, show

__all__ = ["Content", "check_page", "check_target", "make_content", "save_screenshot", "show", "write_scene_page"]
