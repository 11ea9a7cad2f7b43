"""The only package that imports Mitsuba: backend, Phong reflectance, sessions, radiance and ground truth."""

from simtest.rendering.frames import Radiance, TrueHighlight, TruthMaps
from simtest.rendering.session import Session

__all__ = ["Radiance", "Session", "TrueHighlight", "TruthMaps"]
