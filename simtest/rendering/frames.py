"""Records that a session returns: radiance, labels, ground-truth maps and highlight points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.runtime.arrays import Array, Image, Mask


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


@dataclass(frozen=True)
class Labels:
    """What was rendered at each pixel's centre, single precision, camera frame; NaN where there is no surface.

    Of a mesh these are the hit triangle's, with normals and shape operators interpolated between its corners;
    `TruthMaps` holds the exact values of the smooth surface.

    Parameters
    ----------
    depth : ndarray of float32, shape (H, W)
        Distance along the ray, mm.
    position : ndarray of float32, shape (H, W, 3)
        mm.
    normal, geometric_normal : ndarray of float32, shape (H, W, 3)
        Unit normals: that of the shading, as it is, and that of the triangle, facing the camera.
    k_min, k_max : ndarray of float32, shape (H, W)
        Principal curvatures, 1/mm, convex towards the camera positive; NaN also where a mesh's could not be fitted.
    instance : ndarray of int32, shape (H, W)
        Number of the surface, from 0; -1 where there is none.
    face : ndarray of int32, shape (H, W)
        Triangle of a mesh, 0 for other shapes; -1 where there is none.
    """

    depth: Image
    position: Image
    normal: Image
    geometric_normal: Image
    k_min: Image
    k_max: Image
    instance: npt.NDArray[np.int32]
    face: npt.NDArray[np.int32]

    @property
    def mask(self) -> Mask:
        """Where there is a surface, shape (H, W)."""
        return self.instance >= 0


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


@dataclass(frozen=True)
class TruthMaps:
    """Ground truth at each pixel's centre, camera frame; NaN where there is no surface.

    Parameters
    ----------
    depth : ndarray, shape (H, W)
        Distance along the ray, mm.
    position, normal : ndarray, shape (H, W, 3)
        Point, mm, and unit normal of the smooth surface facing the camera.
    shading_normal, geometric_normal : ndarray, shape (H, W, 3)
        Normals that the renderer used: interpolated, and of the triangle.
    k_min, k_max : ndarray, shape (H, W)
        Principal curvatures, 1/mm, convex towards the camera positive.
    direction_min, direction_max : ndarray, shape (H, W, 3)
        Unit principal directions.
    mask : ndarray of bool, shape (H, W)
        Where there is a surface.
    """

    depth: Array
    position: Array
    normal: Array
    shading_normal: Array
    geometric_normal: Array
    k_min: Array
    k_max: Array
    direction_min: Array
    direction_max: Array
    mask: Mask

    @property
    def larger_curvature(self) -> Array:
        """Principal curvature of larger size, 1/mm, shape (H, W)."""
        return np.where(np.abs(self.k_max) >= np.abs(self.k_min), self.k_max, self.k_min)


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
        Camera frame: point, mm, unit normal, and unit principal direction of the smaller curvature.
    distance : float
        d, mm.
    kd_min, kd_max : float
        Distance times principal curvatures.
    lit : bool
        Whether the light reaches the point.
    radiance : float
        Radiance at the nearest pixel.
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

    @property
    def min_gain(self) -> float:
        """Least abs(1 + d k): near 0 the highlight is a streak or a ring."""
        return min(abs(1 + self.kd_min), abs(1 + self.kd_max))
