"""The only package that imports Mitsuba: backend, Phong reflectance, sessions, radiance and ground truth."""

from simtest.rendering.frames import Frame, Labels, Radiance, TrueHighlight, TruthMaps
from simtest.rendering.integrate import Progress
from simtest.rendering.session import Session

__all__ = ["Frame", "Labels", "Progress", "Radiance", "Session", "TrueHighlight", "TruthMaps"]
