"""A quadric patch under a highlight: its parameters, and the condition that ties its normal to its position."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from simtest.estimators.bisector import bisect
from simtest.geometry import Array
from simtest.inverse.patch_renderer import PatchRenderer


@dataclass(frozen=True)
class RenderedQuadric:
    """A quadric patch with rendered radiance: a model for `simtest.estimators.lobe_fit.fit_lobe`.

    The BP is P0 = d s; its normal N bisects the directions to the highlight's light and to the camera. Around it the
    surface is z + ((x, y) K (x, y)^T + q z^2) / (2 d) = 0 along N, K = d S. With q = 0 it is a paraboloid; with
    q = tr(K^3) / tr(K^2) it is a sphere or cylinder where the curvatures are those of one. Parameters: rotation of s
    along `turning` (2), the three of sqrt(n) (I + K) in the basis e, f, log of the scale, then the base where it is
    open. To second order a highlight's shape depends on sqrt(n) (I + K) alone, and hardly on n besides.

    Parameters
    ----------
    renderer : PatchRenderer
        Holds the pixels' sightlines.
    sightline : ndarray, shape (3,)
        s, unit, camera frame.
    first : ndarray, shape (3,)
        e: unit, across N.
    distance : float
        d, mm.
    light : ndarray, shape (3,)
        The highlight's own light, camera frame, mm.
    lights : ndarray, shape (L, 3)
        All lights, camera frame, mm.
    stretch : ndarray, shape (3,)
        sqrt(n) (1 + K11), sqrt(n) K12, sqrt(n) (1 + K22).
    log_scale, log_exponent, base : float
        Of the lobe c cos^n(beta); the base's albedo over c.
    open_base : bool
        Whether the base is fitted.
    roundness : float
        Share of q: 0 a paraboloid, 1 a sphere or cylinder.
    """

    renderer: PatchRenderer
    sightline: Array
    first: Array
    distance: float
    light: Array
    lights: Array
    stretch: Array
    log_scale: float
    log_exponent: float
    base: float
    open_base: bool
    roundness: float = 0.0

    @property
    def normal(self) -> Array:
        """N, unit, facing the camera, shape (3,)."""
        return bisect(self.distance * self.sightline, self.light)

    @property
    def basis(self) -> Array:
        """Rows e, f across N, shape (2, 3): K's basis."""
        return np.stack([self.first, np.cross(self.normal, self.first)])

    @property
    def turning(self) -> Array:
        """Two unit vectors across s, shape (2, 3): the basis of its rotation."""
        s = self.sightline
        across = self.first - (self.first @ s) * s
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(s, across)])

    @property
    def shape(self) -> Array:
        """K, shape (2, 2), in the basis e, f."""
        first, both, second = self.stretch * np.exp(-self.log_exponent / 2)
        return np.array([[first - 1, both], [both, second - 1]])

    def moved(self, step: Array) -> Self:
        """Return the patch at parameters that differ by a step."""
        # The normal follows from s; e is carried along, made perpendicular to the new normal.
        s = self.sightline + step[:2] @ self.turning
        s /= np.linalg.norm(s)
        normal = bisect(self.distance * s, self.light)
        first = self.first - (self.first @ normal) * normal
        return replace(
            self, sightline=s, first=first / np.linalg.norm(first), stretch=self.stretch + step[2:5],
            log_scale=self.log_scale + float(step[5]), base=self.base + (float(step[6]) if self.open_base else 0.0),
        )  # fmt: skip

    def evaluate(self) -> tuple[Array, Array]:
        """Return the pixels' intensities, shape (m,), and their derivatives, shape (m, p)."""
        return self.renderer.radiance(self, [True] * 6 + [self.open_base])
