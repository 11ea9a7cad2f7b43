"""Records that a session returns: radiance, labels, ground-truth maps and highlight points."""

from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.runtime.arrays import Array, Image, Mask, short_repr


@dataclass(frozen=True)
class Radiance:
    """Linear radiance, relative units (power per steradian over mm^2), split by light path.

    Parameters
    ----------
    specular, diffuse, indirect : ndarray of float32, shape (H, W) or (H, W, 3)
        Direct light off the specular lobe, direct light off the diffuse base, and light of more than one bounce.
        Two dimensions in mono variants.
    """

    specular: Image
    diffuse: Image
    indirect: Image

    __repr__ = short_repr

    @property
    def total(self) -> Image:
        """Sum of the parts, shape (H, W) or (H, W, 3)."""
        return self.specular + self.diffuse + self.indirect

    @property
    def channels(self) -> int:
        """Number of channels."""
        return 1 if self.specular.ndim == 2 else self.specular.shape[2]

    @property
    def intensity(self) -> Image:
        """Mean of the channels, shape (H, W): what estimators see."""
        return self.total if self.channels == 1 else self.total.mean(axis=2, dtype=np.float32)


Real = TypeVar("Real", np.float32, np.float64)


@dataclass(frozen=True)
class Maps(Generic[Real]):
    """What is at each pixel's centre, camera frame; NaN where there is no surface.

    `Labels` are that of the rendered shape, in single precision: of a mesh the hit triangle's, with normals and shape
    operators interpolated between its corners. `TruthMaps` are exact, of the smooth surface. Where an instrument is
    seen, depth, position and normals are its own, also those of the base, curvatures and directions are NaN, and there
    is no pool.

    Parameters
    ----------
    depth : ndarray, shape (H, W)
        Distance along the ray, mm.
    position, normal : ndarray, shape (H, W, 3)
        Point, mm, and unit normal of the fine surface; without a relief it faces the camera, but for labels.
    shading_normal, geometric_normal : ndarray, shape (H, W, 3)
        Normals that the renderer used: interpolated, for light off the lobe (on a relief the fine one; the base below
        the lobe is shaded by that of the smoothed relief), and of the triangle, facing the camera.
    k_min, k_max : ndarray, shape (H, W)
        Principal curvatures, 1/mm, convex towards the camera positive; of labels NaN also where a mesh's could not be
        fitted.
    normal_base : ndarray, shape (H, W, 3)
        Unit normal of the base, without the relief; `normal` where there is no relief.
    k_min_base, k_max_base : ndarray, shape (H, W)
        Principal curvatures of the base, 1/mm; `k_min` and `k_max` where there is no relief.
    pool, mask : ndarray of bool, shape (H, W)
        Where the liquid film fills a valley, and where there is a surface.
    instrument : ndarray of uint8, shape (H, W)
        1 + the index of the instrument that is seen, 0 where none is.
    direction_min, direction_max : ndarray, shape (H, W, 3), or None
        Unit principal directions, of truth.
    polyp : ndarray of uint8, shape (H, W), or None
        1 + the number of the polyp that is seen, 0 where none is; None of a surface without any.
    face : ndarray of int32, shape (H, W), or None
        Of labels: triangle of a mesh, 0 for other shapes; -1 where there is none.
    """

    depth: npt.NDArray[Real]
    position: npt.NDArray[Real]
    normal: npt.NDArray[Real]
    shading_normal: npt.NDArray[Real]
    geometric_normal: npt.NDArray[Real]
    k_min: npt.NDArray[Real]
    k_max: npt.NDArray[Real]
    normal_base: npt.NDArray[Real]
    k_min_base: npt.NDArray[Real]
    k_max_base: npt.NDArray[Real]
    pool: Mask
    mask: Mask
    instrument: npt.NDArray[np.uint8]
    direction_min: npt.NDArray[Real] | None = None
    direction_max: npt.NDArray[Real] | None = None
    polyp: npt.NDArray[np.uint8] | None = None
    face: npt.NDArray[np.int32] | None = None

    __repr__ = short_repr

    @property
    def instance(self) -> npt.NDArray[np.int32]:
        """0 for the surface, 1 + its index for an instrument, -1 where there is neither, shape (H, W)."""
        return np.where(self.mask, self.instrument.astype(np.int32), np.int32(-1))

    @property
    def larger_curvature(self) -> npt.NDArray[Real]:
        """Principal curvature of larger size, 1/mm, shape (H, W)."""
        return np.where(np.abs(self.k_max) >= np.abs(self.k_min), self.k_max, self.k_min)


Labels = Maps[np.float32]
TruthMaps = Maps[np.float64]


@dataclass(frozen=True)
class Frame:
    """A frame with its labels.

    Parameters
    ----------
    radiance : Radiance
        Of as many samples a pixel as the scene asks for.
    labels : Labels
        At the pixels' centres.
    """

    radiance: Radiance
    labels: Labels

    __repr__ = short_repr


# Compared by identity: it is a key of what is made from it.
@dataclass(frozen=True, eq=False)
class MisfitMaps:
    """Normal minus bisector across the sightline (see `exact_misfit`) of the rendered shape, a map for each light.

    They are known at the centres of every `stride`-th pixel, from half a stride on, and reach beyond the frame, so that
    a zero next to its border lies between cells too.
    """

    distance: Image  # (h, w): distance along the ray, mm; NaN where there is no surface
    # fine, base: (L, 2, h, w): of the fine normal and of the base's; one array where there is no relief
    fine: Image
    base: Image
    margin: int  # Cells beyond the frame on each side
    stride: int  # px

    __repr__ = short_repr

    def pixels(self, cells: Array) -> Array:
        """Return the pixel positions, shape (N, 2), of columns and rows of the maps, whole or not."""
        return (cells - self.margin) * self.stride + (self.stride // 2 + PIXEL_CENTRE)


@dataclass(frozen=True)
class HighlightPoint:
    """A surface point where the normal bisects the directions to a light and to the camera.

    Parameters
    ----------
    light : int
        Index of the light in the rig.
    bp_px : ndarray, shape (2,)
        Sub-pixel position in the image.
    position, normal, direction_min : ndarray, shape (3,)
        Camera frame: point, mm, unit normal, and unit principal direction of the smaller curvature; of the fine
        surface.
    distance : float
        d, mm.
    kd_min, kd_max : float
        Distance times principal curvatures of the fine surface.
    lit : bool
        Whether the light reaches the point.
    radiance : float
        Direct radiance at the nearest pixel.
    normal_base : ndarray, shape (3,)
        Unit normal of the base, without the relief, at the same point; `normal` on a smooth surface.
    kd_min_base, kd_max_base : float
        Distance times the base's principal curvatures.
    pool : bool
        Whether the point lies in a pool of the liquid film.
    hidden : bool
        Whether an instrument, stool or what is drawn hides it from the camera; it is not lit then.
    """

    light: int
    bp_px: Array
    position: Array
    normal: Array
    direction_min: Array
    distance: float
    kd_min: float
    kd_max: float
    lit: bool
    radiance: float
    normal_base: Array
    kd_min_base: float
    kd_max_base: float
    pool: bool
    hidden: bool = False

    __repr__ = short_repr

    @property
    def min_gain(self) -> float:
        """Least abs(1 + d k): near 0 the highlight is a streak or a ring."""
        return min(abs(1 + self.kd_min), abs(1 + self.kd_max))
