"""Frames by Mitsuba's own integrators, of a session's scene: what our frames are timed against.

All use the box filter, which is Mitsuba's fastest, and from several samples on its sampler "multijitter", with which
the picture's error is that of ours; with the default "independent" it is seven times as large. `nested` is the usual
way to labels, `direct` inside `aov`: the labels are computed for every sample and averaged, which is no ground truth.
`alike` does what our labelled frame does: radiance from all samples, labels from one ray a pixel. `radiance` has no
labels at all.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from simtest.rendering import Session

AOVS = "d:depth,p:position,s:sh_normal,g:geo_normal,i:shape_index,f:prim_index"


def references(session: Session, samples: int) -> dict[str, Callable[[], object]]:
    """Return the functions that render the session's scene, by name: "nested", "alike" and "radiance"."""
    mi = session.mi
    assert session._built is not None
    scene, sensor = session._built.scene, _sensor(session, samples)
    direct = mi.load_dict({"type": "direct"})
    nested = mi.load_dict({"type": "aov", "aovs": AOVS, "image": {"type": "direct"}})
    labels = mi.load_dict({"type": "aov", "aovs": AOVS})

    def render(integrator: Any, count: int) -> object:
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=count, seed=1))

    return {
        "nested": lambda: render(nested, samples),
        "alike": lambda: (render(direct, samples), render(labels, 1)),
        "radiance": lambda: render(direct, samples),
    }


def _sensor(session: Session, samples: int) -> Any:
    """Return Mitsuba's sensor at the session's camera."""
    mi, camera = session.mi, session.camera
    pose = session.surface.model_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {
        "type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
        "pixel_format": "luminance",
    }  # fmt: skip
    return mi.load_dict(
        {
            "type": "perspective", "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
            "fov_axis": "x", "near_clip": 1e-2, "far_clip": 1e4, "film": film,
            "sampler": {"type": "multijitter" if samples > 1 else "independent", "sample_count": samples},
            "to_world": mi.ScalarTransform4f(pose.tolist()),
        }
    )  # fmt: skip
