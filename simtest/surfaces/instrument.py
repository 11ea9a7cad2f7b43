"""Shape of instruments: round cones, each the hull of two balls, whose rays, normals and distances are closed forms.

A shaft is one of equal balls. A grasper has a shaft, a narrower wrist, and two jaws of two round cones each, which bow
outwards at their knees.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from simtest.runtime.arrays import Array, IntArray
from simtest.spec.surfaces import Instrument

DEFAULT_OPENING_DEG = 30.0

WRIST, HINGE, KNEE, JAW_TIP = 0.36, 0.30, 0.26, 0.14
"""Radii of a grasper's parts over the shaft's diameter."""

KNEE_SHARE, BOW = 0.45, 0.08
"""Where along a jaw its knee is, and by what share of its length it stands out."""


@dataclass(frozen=True)
class RoundCones:
    """Hulls of two balls each."""

    # starts, ends: (K, 3): centres of the balls, mm
    starts: Array
    ends: Array
    radii: Array  # (K, 2): mm; they differ by less than the centres are apart
    owners: IntArray  # (K,): index of the instrument that each belongs to

    @property
    def lengths(self) -> Array:
        """Distances of the centres, mm, shape (K,)."""
        return np.asarray(np.linalg.norm(self.ends - self.starts, axis=1))

    def moved(self, pose: Array) -> "RoundCones":
        """Return the same shapes after a rigid motion, shape (4, 4)."""
        starts, ends = (points @ pose[:3, :3].T + pose[:3, 3] for points in (self.starts, self.ends))
        return RoundCones(starts, ends, self.radii, self.owners)

    def distances(self, points: Array) -> Array:
        """Return signed distances of points, shape (N, 3), from each of them, mm, shape (N, K); negative inside."""
        h = self.lengths
        axes = (self.ends - self.starts) / h[:, None]
        from_start = points[:, None] - self.starts
        y = np.einsum("nki,ki->nk", from_start, axes)
        x = np.linalg.norm(from_start - y[..., None] * axes, axis=2)
        # Along the generators: the tangent of both balls, from the one foot to the other.
        sine = (self.radii[:, 0] - self.radii[:, 1]) / h
        cosine = np.sqrt(1 - sine**2)
        along = cosine * y - sine * x
        first, second = np.hypot(x, y) - self.radii[:, 0], np.hypot(x, y - h) - self.radii[:, 1]
        between = cosine * x + sine * y - self.radii[:, 0]
        return np.where(along <= 0, first, np.where(along >= cosine * h, second, between))


def round_cones(instruments: Mapping[int, Instrument], tips: Mapping[int, Array]) -> RoundCones:
    """Return the shape of instruments, camera frame, whose tips, shape (3,), mm, are given; both by index."""
    parts = [(index, *part) for index, one in instruments.items() for part in _parts(one, tips[index])]
    starts, ends, radii = (np.array([part[k] for part in parts], dtype=float) for k in (1, 2, 3))
    return RoundCones(starts, ends, radii, np.array([part[0] for part in parts], dtype=np.int64))


Part = tuple[Array, Array, tuple[float, float]]
"""Centres of both balls, mm, and their radii, mm."""


def _parts(instrument: Instrument, tip: Array) -> list[Part]:
    back, radius = instrument.back, instrument.diameter_mm / 2
    end = tip + (instrument.length_mm - radius) * back
    if instrument.kind == "shaft":
        # The tip is the foremost point of the round end.
        return [(tip + radius * back, end, (radius, radius))]
    hinge = tip + instrument.jaw_length_mm * back
    shaft, wrist = tip + (instrument.head_mm + radius) * back, WRIST * instrument.diameter_mm
    jaws = [part for sign in (1, -1) for part in _jaw(instrument, hinge, sign)]
    return [(shaft, end, (radius, radius)), (hinge, shaft, (wrist, wrist)), *jaws]


def _jaw(instrument: Instrument, hinge: Array, sign: int) -> list[Part]:
    """Return a grasper's jaw, which opens towards its side (1) or away from it (-1)."""
    opening = DEFAULT_OPENING_DEG if instrument.opening_deg is None else instrument.opening_deg
    angle, side = np.radians(opening) / 2, sign * instrument.side
    ahead = np.cos(angle) * -instrument.back + np.sin(angle) * side
    outwards = np.cos(angle) * side + np.sin(angle) * instrument.back
    diameter, length = instrument.diameter_mm, instrument.jaw_length_mm
    hinge_mm, knee_mm, tip_mm = HINGE * diameter, KNEE * diameter, JAW_TIP * diameter
    # Closed jaws touch at their tips.
    knee = hinge + KNEE_SHARE * length * ahead + (tip_mm + BOW * length) * outwards
    foremost = hinge + (length - tip_mm) * ahead + tip_mm * outwards
    return [(hinge, knee, (hinge_mm, knee_mm)), (knee, foremost, (knee_mm, tip_mm))]
