"""The only package that imports Mitsuba.

`backend` chooses libLLVM and variant. `session` holds the scene, which `shapes`, `materials`, `phong`, `tissue` and
`emission` describe to Mitsuba; `rays`, `integrate`, `direct` and `indirect` trace its radiance. Ground truth comes from
`shape_labels` (the rendered shape), `exact_points` (the smooth surface) and `highlights` (the points where the normal
bisects light and camera). `frames` defines the records; `mitsuba_export` writes a scene for Mitsuba.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.rendering.frames import Frame, HighlightPoint, Labels, Radiance, TruthMaps
    from simtest.rendering.session import Session
    from simtest.rendering.trace import Progress

_HOMES = {
    "simtest.rendering.frames": ("Frame", "HighlightPoint", "Labels", "Radiance", "TruthMaps"),
    "simtest.rendering.trace": ("Progress",),
    "simtest.rendering.session": ("Session",),
}

__all__ = ["Frame", "HighlightPoint", "Labels", "Progress", "Radiance", "Session", "TruthMaps"]

# Who asks for the backend alone needs no renderer.
__getattr__, __dir__ = lazy_names(__name__, _HOMES)
