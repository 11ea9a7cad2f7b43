"""The only package that imports Mitsuba: backend, Phong reflectance, sessions, radiance and ground truth."""

from simtest.render.frames import Radiance, TrueHighlight, TruthMaps
from simtest.render.session import Session

__all__ = ["Radiance", "Session", "TrueHighlight", "TruthMaps"]
