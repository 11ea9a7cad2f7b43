"""Figures of very many values, held in little memory: sums and histograms that can be added frame by frame.

The scenes, not the pixels, are the sample: intervals come from a bootstrap over scenes. Each replicate weighs a frame
with a Poisson number of mean 1, drawn from its scene's name, so that it can be computed frame by frame and in parts
[Chamandy et al. 2012, Estimating uncertainty for massive data streams, section 3]. Frames of one scene, which differ in
noise alone, have the same weight.
"""

from collections.abc import Sequence

import numpy as np

from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.files import JsonObject
from simtest.runtime.seeds import from_integer, key

LOWEST, HIGHEST = 1e-6, 1e4
"""Ends of the histogram; values beyond are counted in the outer bins."""

FINE_STEP, PER_COARSE = 0.005, 10
"""Width of a bin as a share of its value, and how many bins are one of the bootstrap's."""

REPLICATES = 100
PENALTY = 90.0
"""An unanswered pixel counts as this angle, deg, in the penalised mean."""

_EDGES = np.exp(np.arange(np.log(LOWEST), np.log(HIGHEST) + PER_COARSE * FINE_STEP, FINE_STEP))
BINS = PER_COARSE * (len(_EDGES) // PER_COARSE)
_COARSE = BINS // PER_COARSE


class Tally:
    """Counts, sums and histograms of values in cells, such as those of the zones and of the bins of a quantity.

    Parameters
    ----------
    cells : int
        Number of cells.
    below : sequence of float
        Thresholds; the share of the pixels below each is kept.
    penalty : float or None
        What an unanswered pixel counts in `mean_penalised`; None where the values have no such figure.
    """

    def __init__(self, cells: int, below: Sequence[float], penalty: float | None = PENALTY) -> None:
        self.below, self.penalty = tuple(below), penalty
        self.frames = np.zeros(cells, dtype=np.int64)
        self.scenes: list[set[int]] = [set() for _ in range(cells)]
        # count, unanswered, sum, sum of squares, and the counts below each threshold
        self.sums = np.zeros((cells, 4 + len(below)))
        self.counts = np.zeros((cells, BINS), dtype=np.int64)
        self.totals = np.zeros((cells, BINS))
        self._weighed = np.zeros((REPLICATES, cells, 4 + len(below)))
        self._weighed_counts = np.zeros((REPLICATES, cells, _COARSE), dtype=np.float32)

    def add(self, scene: str, values: Array, labels: Sequence[IntArray]) -> Array:
        """Add the values of a frame; return its own sums, shape (cells, 4 + thresholds).

        Parameters
        ----------
        scene : str
            Name of its scene, which several frames may show.
        values : ndarray, shape (N,)
            NaN where there is no answer.
        labels : sequence of ndarray of int, shape (N,)
            Cells that each value belongs to, -1 for none: an array for each way of sorting them.
        """
        cells = len(self.sums)
        answered = np.isfinite(values)
        bins = np.zeros(len(values), dtype=np.int64)
        bins[answered] = np.clip(np.searchsorted(_EDGES, values[answered], side="right") - 1, 0, BINS - 1)
        flat_counts, flat_totals = np.zeros(cells * BINS, dtype=np.int64), np.zeros(cells * BINS)
        sums = np.zeros_like(self.sums)
        for label in labels:
            kept = answered & (label >= 0)
            at, own = label[kept] * BINS + bins[kept], values[kept]
            flat_counts += np.bincount(at, minlength=cells * BINS)
            flat_totals += np.bincount(at, own, cells * BINS)
            sums += self._sums(label, kept, own, cells)
        counts, totals = flat_counts.reshape(cells, BINS), flat_totals.reshape(cells, BINS)
        self.counts += counts
        self.totals += totals
        self.sums += sums
        held = sums[:, 0] + sums[:, 1] > 0
        self.frames += held
        for cell in np.flatnonzero(held):
            self.scenes[cell].add(key(scene))
        # the bootstrap's replicates, where this frame counts as often as its weight says
        weights = from_integer(key(scene)).poisson(1.0, REPLICATES)
        coarse = counts[:, :BINS].reshape(cells, _COARSE, PER_COARSE).sum(axis=2)
        rows, columns = np.nonzero(coarse)
        self._weighed += weights[:, None, None] * sums
        self._weighed_counts[:, rows, columns] += weights[:, None].astype(np.float32) * coarse[rows, columns]
        return sums

    def _sums(self, label: IntArray, kept: Mask, own: Array, cells: int) -> Array:
        number = label[kept]
        missing = label[(label >= 0) & ~kept]
        columns = [
            np.bincount(number, minlength=cells),
            np.bincount(missing, minlength=cells),
            np.bincount(number, own, cells),
            np.bincount(number, own * own, cells),
            *(np.bincount(number[own < most], minlength=cells) for most in self.below),
        ]
        return np.stack(columns, axis=1).astype(float)

    def merge(self, other: "Tally") -> None:
        """Add what another tally of other frames and the same cells has counted."""
        for name in ("frames", "sums", "counts", "totals", "_weighed", "_weighed_counts"):
            getattr(self, name).__iadd__(getattr(other, name))
        for own, others in zip(self.scenes, other.scenes, strict=True):
            own |= others

    def figures(self, cell: int) -> JsonObject:
        """Return the figures of a cell, with 95 % intervals where two scenes or more hold pixels of it."""
        sums, frames = self.sums[cell], int(self.frames[cell])
        means = self.totals[cell] / np.maximum(self.counts[cell], 1)
        median, p95 = (_quantile(self.counts[cell], means, q) for q in (0.5, 0.95))
        found: JsonObject = {
            "frames": frames,
            "n": int(sums[0] + sums[1]),
            "n_unanswered": int(sums[1]),
            **named(sums, self.below, self.penalty),
            "median": median,
            "p95": p95,
        }
        found["ci95"] = self._intervals(cell) if len(self.scenes[cell]) > 1 else {}
        return found

    def _intervals(self, cell: int) -> JsonObject:
        """Return the 95 % interval of each figure over the bootstrap's replicates."""
        coarse = self.counts[cell].reshape(_COARSE, PER_COARSE).sum(axis=1)
        means = self.totals[cell].reshape(_COARSE, PER_COARSE).sum(axis=1) / np.maximum(coarse, 1)
        # A replicate that holds none of the frames tells nothing.
        holds = self._weighed[:, cell, 0] > 0
        if holds.sum() < 2:
            return {}
        rows = [named(sums, self.below, self.penalty) for sums in self._weighed[holds, cell]]
        drawn = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        cumulated = np.cumsum(self._weighed_counts[holds, cell], axis=1, dtype=float)
        for name, share in (("median", 0.5), ("p95", 0.95)):
            number = (cumulated < share * cumulated[:, -1:]).sum(axis=1)
            drawn[name] = means[np.minimum(number, _COARSE - 1)]
        return {name: np.percentile(values, [2.5, 97.5]).tolist() for name, values in drawn.items()}


def named(sums: Array, below: Sequence[float], penalty: float | None = PENALTY) -> JsonObject:
    """Return the figures that sums hold: shares are of all pixels, the unanswered among them."""
    answered, unanswered = sums[0], sums[1]
    everything = answered + unanswered
    if everything == 0:
        penalised: JsonObject = {} if penalty is None else {"mean_penalised": None}
        return {"mean": None, "rms": None, **penalised, "share_unanswered": None} | {
            f"below_{most:g}": None for most in below
        }
    return {
        "mean": float(sums[2] / answered) if answered else None,
        "rms": float(np.sqrt(sums[3] / answered)) if answered else None,
        **({} if penalty is None else {"mean_penalised": float((sums[2] + penalty * unanswered) / everything)}),
        "share_unanswered": float(unanswered / everything),
        **{f"below_{most:g}": float(sums[4 + i] / everything) for i, most in enumerate(below)},
    }


def _quantile(counts: Array | IntArray, means: Array, share: float) -> float | None:
    """Return a quantile of binned values: the mean of those in the bin that holds it; None without values."""
    total = counts.sum()
    if total <= 0:
        return None
    cumulated = np.cumsum(counts, dtype=float)
    return float(means[min(int(np.searchsorted(cumulated, share * total)), len(counts) - 1)])
