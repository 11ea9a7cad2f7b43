"""The only package that imports Mitsuba.

`backend` chooses libLLVM and variant. `session` holds the scene, which `shapes`, `materials`, `phong` and `emission`
describe to Mitsuba; `rays`, `integrate`, `direct` and `indirect` trace its radiance. Ground truth comes from
`shape_labels` (the rendered shape), `exact_points` (the smooth surface) and `highlights` (the points where the normal
bisects light and camera). `frames` defines the records; `mitsuba_export` writes a scene for Mitsuba.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtest.rendering.frames import Frame, HighlightPoint, Labels, Radiance, TruthMaps
    from simtest.rendering.integrate import Progress
    from simtest.rendering.session import Session

_HOME = {
    **dict.fromkeys(("Frame", "HighlightPoint", "Labels", "Radiance", "TruthMaps"), "simtest.rendering.frames"),
    "Progress": "simtest.rendering.integrate",
    "Session": "simtest.rendering.session",
}

__all__ = ["Frame", "HighlightPoint", "Labels", "Progress", "Radiance", "Session", "TruthMaps"]


def __getattr__(name: str) -> Any:
    """Load a name at first use: who asks for the backend alone needs no renderer."""
    import importlib

    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
