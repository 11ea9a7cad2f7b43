"""The axes that a normal map's channels stand for: stated, or found out by the truth of all frames together.

Axes are written as the camera's own axis (x right, y down, z forward) that each channel holds, with its sign:
"x,-y,-z" says that red holds x, green holds -y (up) and blue holds -z (towards the camera).
"""

from dataclasses import dataclass, field

import numpy as np

from simtest.errors import InputError
from simtest.geometry.axes import ALL, NAMED, matrix
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject

LEAST_COSINE = 0.5
"""A mean cosine between map and truth below this, 60 deg, is no fit."""

CLEAR_COSINE = 0.005
"""By so much at least the best axes exceed the others in the mean cosine ..."""

CLEAR_ERRORS = 3.0
"""... and by as many standard errors over the bands of all frames."""

BANDS, LEAST_PIXELS = 16, 20
"""Each frame is judged in so many bands of rows, of so many pixels at least."""


def parse_axes(text: str) -> str:
    """Return axes such as "x,-y,-z" from these or their name; raise `InputError` for others."""
    axes = NAMED.get(text.strip().lower(), text.replace(" ", "").replace("+", "").lower())
    if axes not in ALL:
        raise InputError(
            f"--frame {text}: unknown; allowed: {', '.join(NAMED)}, or the axes of the three channels, such as x,-y,-z"
        )
    return axes


_MATRICES = np.stack([matrix(axes) for axes in ALL])


@dataclass
class AxesEvidence:
    """How well each assignment of axes fits the truth, over all frames that were added.

    The mean cosine of an assignment is a signed sum of the entries of the correlation between channels and axes, so
    that one matrix judges all 48. Normals of one frame hang together; its bands tell what is chance.
    """

    cosines: list[Array] = field(default_factory=list)
    """Mean cosine of each of `ALL`, shape (48,), a band."""

    def add(self, vectors: Array, normal: Array) -> None:
        """Add a frame: unit channel vectors and true normals, shape (N, 3), of its answered pixels, row by row."""
        bands = min(BANDS, max(1, len(vectors) // LEAST_PIXELS))
        for own, true in zip(np.array_split(vectors, bands), np.array_split(normal, bands), strict=True):
            if len(own):
                self.cosines.append(np.einsum("kij,ij->k", _MATRICES, true.T @ own / len(own)))

    @property
    def mean(self) -> Array:
        """Mean cosine of each of `ALL`, each band with the same weight."""
        return np.mean(self.cosines, axis=0) if self.cosines else np.zeros(len(ALL))

    @property
    def best(self) -> str:
        """The axes that fit best so far."""
        return ALL[int(np.argmax(self.mean))]

    def decide(self, what: str) -> str:
        """Return the axes that fit best by a clear margin."""
        if not self.cosines:
            raise InputError(
                f"{what}: hold no normal: every pixel is NaN, 0, transparent or too long or short for a unit vector; "
                "say --frame to score them as unanswered"
            )
        best, second, gap, error = self._compare()
        if self.mean[best] < LEAST_COSINE:
            angle = np.degrees(np.arccos(np.clip(self.mean[best], -1, 1)))
            raise InputError(
                f"{what}: normals fit the truth with no axes (at best {ALL[best]}, by {angle:.0f} deg); must be in the "
                "camera frame, or say --frame to score them as they are"
            )
        if gap < max(CLEAR_COSINE, CLEAR_ERRORS * error):
            raise InputError(
                f"{what}: axes {ALL[best]} and {ALL[second]} fit the truth alike (mean cosine {self.mean[best]:.4f} "
                f"and {self.mean[second]:.4f}); say which: --frame {ALL[best]}"
            )
        return ALL[best]

    def _compare(self) -> tuple[int, int, float, float]:
        """Return the best axes, those next to them, and by how much they differ, with its standard error."""
        order = np.argsort(-self.mean, kind="stable")
        best = int(order[0])
        rows = np.array(self.cosines).reshape(-1, len(ALL))
        gaps = rows[:, [best]] - rows
        errors = gaps.std(axis=0, ddof=1) / np.sqrt(len(rows)) if len(rows) > 1 else np.zeros(len(ALL))
        # The rival is the one that is least clearly worse.
        others = order[1:]
        margin = gaps.mean(axis=0)[others] - CLEAR_ERRORS * errors[others]
        second = int(others[int(np.argmin(margin))])
        return best, second, float(gaps[:, second].mean()), float(errors[second])

    def to_json(self) -> JsonObject:
        """Return the fit of the best axes and of the next."""
        if not self.cosines:
            return {}
        best, second, gap, error = self._compare()
        return {"axes": ALL[best], "mean_cosine": float(self.mean[best]), "next": ALL[second],
                "difference": gap, "standard_error": error}  # fmt: skip


def to_camera(vectors: Array, axes: str) -> Array:
    """Return channel vectors, shape (..., 3), in the camera frame."""
    return vectors @ matrix(axes).T


def unit(vectors: Array, least: float = 1e-3) -> Array:
    """Return unit vectors, shape (..., 3); NaN where the length is below `least` or not finite."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.isfinite(length) & (length >= least), vectors / length, np.nan)
