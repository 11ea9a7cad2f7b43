"""What the diffuse light around a cloud tells: how far the base is turned away from the camera at its centre.

Light and camera at one place: a base of even albedo at the distance r sends back L = cos(w) / r^2, where the misfit w
is the turn of its normal from the reversed sightline. Across a sightline w = grad ln r, so that

    grad ln L = -(2 + J) w,    J = grad w = I + dS,    Hessian of ln L = -(2 J + J^2) where w = 0.

A polynomial of ln L around a cloud gives J, and w at its centre. At a highlight point of the base w = 0. Folds that
come near to facing the camera make clouds too; there w is not 0. To first order a light beside the camera, at L across
the sightline, turns all by L / d: w - L / d takes the place of w.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from simtest.calibration import Frame
from simtest.conventions import PIXEL_CENTRE
from simtest.estimators.cloud_spots import bright_parts
from simtest.geometry import Array, Mask
from simtest.geometry.vectors import basis_across

STRIDE = 2
"""Of the pixels whose light is fitted, px."""

SPOT_MARGIN_PX = 4
"""So near to a spot nothing is fitted, px."""

REACH, LEAST_EXTENT = 2.0, np.radians(3.0)
"""The light is fitted within so many extents of a cloud; the least extent, rad, is added as a variance."""

LEAST_PIXELS, LEAST_SHARE = 60, 0.12
"""Fewer pixels between the spots, or a smaller share of all, tell nothing."""

MOST_MISSING = 0.05
"""Another channel tells the hue where it misses no larger share of these pixels."""

LEAST_LIGHT = 5.0
"""Light below so many standard deviations of the noise is dark."""

LEAST_LIT = 0.1
"""A frame shows diffuse light where this share of its pixels is lit between the spots."""

STEPS, OUTLYING = 6, 2.0
"""Steps of the robust fit; residuals of more standard deviations count less."""

FRONT = 0.3
"""Least cosine between a sightline that is fitted and the cloud's."""

MOST_GAIN = 20.0
"""A larger gain 1 + d k of the base is not told from this one."""

SECTORS = 8
"""The fit is repeated without each of so many sectors: the jackknife's covariance."""


@dataclass(frozen=True)
class Shading:
    """What the diffuse light tells of the base at a sightline, in ``basis_across(sightline)``.

    Parameters
    ----------
    gradient : ndarray, shape (2,)
        grad ln L = -(2 + J) w, w the turn of the base's normal from the direction to the light, per rad.
    covariance : ndarray, shape (2, 2)
        Of `gradient`, by the jackknife over sectors.
    gains : ndarray, shape (2, 2)
        I + dS of the base. A gain g below -1 makes the same light as -2 - g, which is given for it.
    """

    gradient: Array
    covariance: Array
    gains: Array

    @property
    def steepness(self) -> Array:
        """2 + J, shape (2, 2)."""
        return np.asarray(2 * np.eye(2) + self.gains)


@dataclass(frozen=True)
class DiffuseLight:
    """The light of a frame between its spots.

    Parameters
    ----------
    frame : Frame
        The frame. Falloffs that its calibration knows are undone.
    """

    frame: Frame

    @cached_property
    def _logs(self) -> tuple[Array, Mask, Mask]:
        """Return logs of the channels, shape (h, w, C), where they are lit between the spots, and not clipped there."""
        frame, cut = self.frame, (slice(None, None, STRIDE), slice(None, None, STRIDE))
        encoded = frame.encoded if frame.encoded.ndim == 3 else frame.encoded[..., None]
        light = frame.channels if frame.encoded.ndim == 3 else frame.channels[..., None]
        gain = frame.corrected.gain
        values = light[cut] if gain is None else light[cut] * gain[cut][..., None]
        # The noise is that of the channels' mean.
        lit = values > LEAST_LIGHT * float(np.median(frame.noise)) * np.sqrt(light.shape[2])
        margin = np.ones((2 * SPOT_MARGIN_PX + 1, 2 * SPOT_MARGIN_PX + 1), np.uint8)
        lit &= ~(cv2.dilate(bright_parts(frame).astype(np.uint8), margin)[cut] > 0)[..., None]
        if frame.seen is not None:
            lit &= frame.seen[cut][..., None]
        level = frame.calibration.saturation_level
        unclipped = lit if level is None else lit & (encoded[cut] < level)
        return np.log(np.maximum(values, 1e-9), dtype=np.float64), lit, unclipped

    @cached_property
    def _sightlines(self) -> Array:
        height, width = self._logs[0].shape[:2]
        rows, columns = np.mgrid[:height, :width]
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1) * STRIDE + PIXEL_CENTRE
        return np.nan_to_num(self.frame.camera.unproject(pixels))

    @cached_property
    def shows(self) -> bool:
        """Whether the frame shows diffuse light between its spots."""
        return bool(self._logs[1].any(axis=2).mean() > LEAST_LIT)

    def around(self, sightline: Array, covariance: Array) -> tuple[Shading, Shading] | None:
        """Fit polynomials of second and third degree to the light around a sightline.

        The first is steadier; the second knows that the gains change.

        Parameters
        ----------
        sightline : ndarray, shape (3,)
            Unit.
        covariance : ndarray, shape (2, 2)
            Of the cloud in the plane across the sightline at unit distance, in its basis, rad^2.

        Returns
        -------
        tuple of Shading or None
            None where too little is seen between the spots.
        """
        cosine = self._sightlines @ sightline
        points = self._sightlines @ basis_across(sightline).T / np.where(cosine > FRONT, cosine, np.nan)[:, None]
        reach = covariance + LEAST_EXTENT**2 * np.eye(2)
        radius2 = np.nan_to_num(np.einsum("ni,ij,nj->n", points, np.linalg.inv(reach), points), nan=np.inf)
        inside = np.flatnonzero(radius2 < REACH**2)
        logs, _, sound = self._logs
        logs, sound = logs.reshape(-1, logs.shape[2])[inside], sound.reshape(-1, sound.shape[2])[inside]
        enough = np.flatnonzero(sound.sum(axis=0) >= max(LEAST_PIXELS, LEAST_SHARE * len(inside)))
        if not len(enough):
            return None
        # The brightest channel, red, is the one that blood changes least.
        main = enough[np.argmax([np.median(logs[sound[:, c], c]) for c in enough])]
        others = [c for c in enough if c != main and sound[sound[:, main], c].mean() > 1 - MOST_MISSING]
        kept = sound[:, [main, *others]].all(axis=1)
        # Albedo changes the ratios of the channels, shading does not.
        hues = logs[kept][:, others] - logs[kept, main][:, None]
        points, radius2 = points[inside][kept], radius2[inside][kept]
        second, third = (_fitted(points, radius2, logs[kept, main], hues, cubic) for cubic in (False, True))
        return second, third


def _fitted(points: Array, radius2: Array, values: Array, hues: Array, cubic: bool) -> Shading:
    """Fit a polynomial and the hues' share to logs of light, shape (N,), at points, shape (N, 2)."""
    scale = float(np.sqrt((points**2).mean()))
    x, y = points.T / scale
    terms = [np.ones_like(x), x, y, x**2 / 2, x * y, y**2 / 2]
    terms += [x**3, x**2 * y, x * y**2, y**3] if cubic else []
    A = np.column_stack([*terms, hues - hues.mean(axis=0)])
    near = np.exp(-radius2 / 4)
    weights = near
    for _ in range(STEPS):
        solution = _solved(A, weights, values)
        gaps = values - A @ solution
        spread = 1.48 * float(np.median(np.abs(gaps))) + 1e-9
        weights = near / (1 + (gaps / (OUTLYING * spread)) ** 2)
    sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * SECTORS).astype(int) % SECTORS
    without = [_solved(A[sector != i], weights[sector != i], values[sector != i]) for i in range(SECTORS)]
    moves = (np.array(without) - solution)[:, 1:3] / scale
    return Shading(solution[1:3] / scale, moves.T @ moves * (SECTORS - 1) / SECTORS, _gains(solution[3:6] / scale**2))


def _solved(A: Array, weights: Array, values: Array) -> Array:
    weighted = (A * weights[:, None]).T
    return np.asarray(np.linalg.lstsq(weighted @ A, weighted @ values, rcond=None)[0])


def _gains(hessian: Array) -> Array:
    """Return I + dS from the second derivatives of the light's log: xx, xy, yy."""
    xx, xy, yy = hessian
    values, vectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    # Of the two roots of J^2 + 2 J + H = 0 the one that is not below -1.
    J = np.sqrt(np.clip(1 - values, 0.0, (1 + MOST_GAIN) ** 2)) - 1
    return np.asarray(vectors @ np.diag(J) @ vectors.T)
