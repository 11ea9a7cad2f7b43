"""The only package that imports Mitsuba.

`backend` chooses libLLVM and variant. `session` holds the scene: a `built_scene` of surface, reflectance and lights
(`elements` has those that Mitsuba lacks), with `tissue_kernels` and `instruments`. `rays`, `lighting`, `trace` and
`adaptive` render its radiance. `truth` is of the rendered shape and of the smooth surface (a colon's by `tube_kernel`);
`highlights` are the points where the normal bisects light and camera, `misfits` how far it is from that. `frames`
defines the records.
"""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.rendering.frames import Frame, HighlightPoint, Labels, Radiance, TruthMaps
    from simtest.rendering.session import Session
    from simtest.rendering.trace import Progress

# Who asks for the backend alone needs no renderer.
__getattr__, __dir__, __all__ = lazy_names(__name__)
