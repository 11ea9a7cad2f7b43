"""The truth of one frame, as far as dense maps are scored against it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.dataset.scoring.dense.zones import zones
from simtest.geometry import Camera
from simtest.runtime.arrays import Array, Image, IntArray, Mask, short_repr

if TYPE_CHECKING:
    from simtest.rendering import Session, TruthMaps
    from simtest.simulation.frame import RenderedView

Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all, and the frame's name."""

SURFACES = ("fine", "base")
"""The two truths: with relief and without. They are equal where a scene has none."""


@dataclass(frozen=True)
class FrameTruth:
    """The truth at each pixel's centre, camera frame.

    Parameters
    ----------
    name : str
        Of the frame; its map has the same.
    camera : Camera
        Calibration.
    normal : dict of ndarray, shape (H, W, 3)
        Unit normal of the fine surface and of the base, by name of the surface.
    curvature : dict of ndarray, shape (H, W)
        Principal curvature of the larger size, 1/mm, convex towards the camera positive, of both.
    distance : ndarray, shape (H, W)
        Along the pixel's ray, mm.
    eps : float
        Offset of the light that is farthest from the camera, mm.
    scored : ndarray of bool, shape (H, W)
        Pixels of the surface inside the view, which are scored.
    excluded : dict of int
        How many pixels are not, by reason.
    zone : ndarray of uint8, shape (H, W)
        See `zones`.
    image : ndarray of float32, shape (H, W) or (H, W, 3), optional
        The frame as the sensor encoded it.
    calibration : Calibration, optional
        What methods are told of the camera.
    setting : str
        Of the experiment.
    swept : dict
        Values of the swept parameters.
    scene : str
        Names the scene, of a dataset the anatomy, which other frames may show too. Empty where each has its own.
    """

    name: str
    camera: Camera
    normal: Mapping[str, Array]
    curvature: Mapping[str, Array]
    distance: Array
    eps: float
    scored: Mask
    excluded: Mapping[str, int]
    zone: npt.NDArray[np.uint8]
    image: Image | None = None
    calibration: Calibration | None = None
    setting: str = ""
    swept: Mapping[str, object] = field(default_factory=dict)
    scene: str = ""

    __repr__ = short_repr

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.camera.height, self.camera.width


EXCLUDED = ("outside_view", "no_surface", "instrument")
"""Why a pixel is not scored; each pixel is counted at the first reason that holds."""


def frame_truth(
    name: str, maps: "TruthMaps", camera: Camera, eps: float, regions: IntArray, image: Image | None = None,
    calibration: Calibration | None = None, setting: str = "", swept: Mapping[str, object] | None = None,
) -> FrameTruth:  # fmt: skip
    """Return the truth of a frame from its maps and the regions of its visible highlights (`VisibleSpots.regions`)."""
    metal = maps.instrument > 0
    seen = np.ones(maps.mask.shape, dtype=bool) if camera.seen is None else camera.seen
    bare = ~maps.mask | ~np.isfinite(maps.normal).all(axis=-1) | ~np.isfinite(maps.normal_base).all(axis=-1)
    reasons = (~seen, bare & ~metal, metal)
    scored, excluded = np.ones(maps.mask.shape, dtype=bool), {}
    for reason, where in zip(EXCLUDED, reasons, strict=True):
        excluded[reason] = int((scored & where).sum())
        scored &= ~where
    # A reflection on metal is no highlight of the surface.
    of_surface = np.where(np.isin(regions, np.unique(regions[metal])), 0, regions) if metal.any() else regions
    return FrameTruth(
        name=name,
        camera=camera,
        normal={"fine": maps.normal, "base": maps.normal_base},
        curvature={"fine": maps.larger_curvature, "base": _larger(maps.k_min_base, maps.k_max_base)},
        distance=maps.depth,
        eps=eps,
        scored=scored,
        excluded=excluded,
        zone=zones(of_surface),
        image=image,
        calibration=calibration,
        setting=setting,
        swept=dict(swept or {}),
    )


def _larger(low: Array, high: Array) -> Array:
    return np.where(np.abs(high) >= np.abs(low), high, low)


def truth_of_view(
    name: str, view: "RenderedView", session: "Session", setting: str = "",
    swept: Mapping[str, object] | None = None, image: Image | None = None, scene: str = "",
) -> FrameTruth:  # fmt: skip
    """Return the truth of a rendered view; the session stands at its scene, which `scene` names."""
    eps = float(np.linalg.norm(view.scene.rig.true_mm(), axis=1).max())
    truth = frame_truth(
        name, session.truth(), session.camera, eps, view.spots.regions, image, view.calibration, setting, swept
    )
    return replace(truth, scene=scene or view.scene.model_dump_json())
