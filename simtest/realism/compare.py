"""How far one set of frames is from another, statistic by statistic, with intervals over scenes.

A scene is what shows one anatomy: a film, or one picture. The distance of a statistic is the Wasserstein distance of
its two distributions over the spread of the real scenes: the mean distance of each real scene from all the others. At
1 the generated frames differ from the real ones as much as a real scene does from other real scenes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from simtest.errors import InputError
from simtest.realism.frames import NamedFrame
from simtest.reconstruction.statistics import COLUMNS, STATISTICS, Measured, Statistic, measure
from simtest.runtime.arrays import Array, Image, IntArray, Picture
from simtest.runtime.files import Json
from simtest.runtime.seeds import from_integer
from simtest.runtime.statistics import CONFIDENCE, bootstrap_interval

VERDICTS = ("near", "between", "far", "too few scenes")

LEAST_SCENES = 5
"""Fewer scenes on a side carry no verdict."""

NEAR = 1.5
"""A distance up to here is near; one is far where it is larger and its interval lies above 1."""

RESAMPLES = 400

BLOCK_VALUES = 2_000_000
"""Values of drawn scenes that are held at a time."""

Scenes = Mapping[str, Measured]
"""Measured values by scene: those of all its frames, one after the other."""

Quartiles = tuple[float, float, float]
"""First quartile, median and third quartile."""


@dataclass(frozen=True)
class StatisticDistance:
    """Distance of a statistic between two sets of frames, the mean over its columns.

    The distance is NaN where a side has too few scenes that tell it (two real ones, one generated), infinite where all
    real scenes are alike and the generated ones differ. The 95 % interval, by bootstrap over the scenes of both sides,
    is NaN without a distance, or with one generated scene.
    """

    statistic: Statistic
    distance: float
    interval: tuple[float, float]
    n_real: int  # scenes that tell it, all of its columns
    n_generated: int

    @property
    def verdict(self) -> str:
        """Whether it is "near" or "far", "between", or judged by "too few scenes"."""
        if min(self.n_real, self.n_generated) < LEAST_SCENES or np.isnan(self.distance):
            return "too few scenes"
        if self.distance <= NEAR:
            return "near"
        return "far" if self.interval[0] > 1 else "between"


def by_scene(frames: Sequence[tuple[str, Measured]]) -> dict[str, Measured]:
    """Collect the values of frames, each with its scene's name."""
    held: dict[str, dict[str, list[Array]]] = {}
    for scene, values in frames:
        columns = held.setdefault(scene, {name: [] for name in COLUMNS})
        for name in COLUMNS:
            columns[name].append(values[name])
    return {scene: {name: np.concatenate(parts) for name, parts in held[scene].items()} for scene in held}


def distances(real: Scenes, generated: Scenes, seed: int = 0) -> list[StatisticDistance]:
    """Compare two sets of frames by every statistic."""
    return [_distance(statistic, real, generated, seed) for statistic in STATISTICS]


def _distance(statistic: Statistic, real: Scenes, generated: Scenes, seed: int) -> StatisticDistance:
    rng = from_integer(seed)
    sides = [[values for values in scenes.values() if all(len(values[c.name]) for c in statistic.columns)]
             for scenes in (real, generated)]  # fmt: skip
    n, m = counts = (len(sides[0]), len(sides[1]))
    if n < 2 or m < 1:
        return StatisticDistance(statistic, np.nan, (np.nan, np.nan), n, m)
    # The same scenes for all columns, which vary together: drawn again from each side, and dealt anew to both.
    drawn = [rng.integers(count, size=(RESAMPLES, count)) for count in counts]
    dealt = rng.permuted(np.tile(np.arange(n + m), (RESAMPLES, 1)), axis=1)[:, :n]
    columns = []
    for column in statistic.columns:
        held, shown = ([values[column.name] for values in side] for side in sides)
        columns.append(_column_distance(held, shown, drawn[0], drawn[1], dealt))
    value, samples, exchanged = (np.mean(parts, axis=0) for parts in zip(*columns, strict=True))
    return StatisticDistance(statistic, float(value), _interval(value, samples, exchanged, min(n, m)), n, m)


def _column_distance(
    real: list[Array], generated: list[Array], real_rows: IntArray, generated_rows: IntArray, dealt: IntArray
) -> tuple[Array, Array, Array]:
    """Return the distance over the real scenes' spread, that of resampled scenes, and how far sides dealt anew differ.

    The last are mean differences of the distribution functions over all values, which the largest do not rule; the
    first of them is that of the sides as they are. Rows have shape (RESAMPLES, N): of each side, and of both together,
    those that stand for the real ones.
    """
    grid = _grid([*real, *generated])
    # Distribution functions of all scenes on one grid: each resample is then a mean of rows.
    both = np.stack([_shares_below(v, grid[:-1]) for v in (*real, *generated)])
    own, other = both[: len(real)], both[len(real) :]
    widths = np.diff(grid)

    def gap(first: Array, second: Array) -> Array:
        return np.asarray(np.abs(first - second) @ widths)

    def spread_of(scenes: Array) -> float:
        rest = (scenes.sum(axis=0) - scenes) / (len(scenes) - 1)
        return float(gap(scenes, rest).mean())

    value, spread = gap(own.mean(axis=0), other.mean(axis=0)), spread_of(own)
    samples = gap(_means(own, real_rows), _means(other, generated_rows))
    first = np.concatenate([own.mean(axis=0)[None], _means(both, dealt)])
    second = (both.sum(axis=0) - len(own) * first) / len(other)
    exchanged = np.abs(first - second) @ np.diff(both.mean(axis=0), prepend=0.0)
    if spread <= 0:
        # All real scenes are alike: any difference is infinitely many spreads.
        some = 1e-9 * widths.sum()
        return np.where(value > some, np.inf, 0.0), np.where(samples > some, np.inf, 0.0), exchanged
    # The spread varies with the scenes too, by what each of them adds to it (jackknife): a scene that is drawn twice
    # would be near to itself. In the logarithm, so that it stays positive.
    pull = np.zeros(len(own))
    if len(own) > 2:
        pull = (len(own) - 1) * (1 - np.array([spread_of(np.delete(own, i, axis=0)) for i in range(len(own))]) / spread)
    return value / spread, samples / spread * np.exp(-pull[real_rows].mean(axis=1)), exchanged


def _interval(value: float, samples: Array, exchanged: Array, scenes: int) -> tuple[float, float]:
    """Return the 95 % interval of a distance; `scenes` are those of the smaller side.

    Of two sets of one distribution each estimate is above 0. So 0 is the lower end where sides to which the scenes were
    dealt anew often differ as much (`exchanged`, see `_column_distance`). NaN with a single scene on a side, whose
    spread is unknown.
    """
    if scenes < 2:
        return np.nan, np.nan
    if np.isfinite(samples).all():
        low, high = bootstrap_interval(value, samples, scenes)
    else:
        # Order statistics: between infinite distances nothing can be interpolated.
        low, high = np.quantile(samples, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    alike = np.mean(exchanged >= exchanged[0] * (1 - 1e-9)) > 1 - CONFIDENCE
    return 0.0 if alike else max(float(low), 0.0), float(high)


def _means(scenes: Array, rows: IntArray) -> Array:
    """Return the mean of some rows of scenes for each draw, shape (draws, grid)."""
    # In blocks: all of them at once would not fit into memory.
    blocks = np.array_split(rows, max(1, scenes.size * len(rows) // BLOCK_VALUES))
    return np.concatenate([scenes[block].mean(axis=1) for block in blocks])


def _grid(values: list[Array]) -> Array:
    """Return the values at which a distribution function may step, thinned where there are many."""
    every = np.unique(np.concatenate(values))
    if len(every) > 2000:
        every = np.unique(np.quantile(every, np.linspace(0, 1, 2000)))
    return every if len(every) > 1 else np.array([every[0], every[0] + 1.0])


def distance_text(value: float) -> str:
    """Write a distance with two decimals; NaN becomes a dash, infinity its sign."""
    return "–" if np.isnan(value) else "∞" if np.isinf(value) else f"{value:.2f}"


def mean_distribution(scenes: Scenes, column: str, at: Array) -> Array:
    """Return the distribution function of a column at values, each scene with the same weight; NaN without a scene."""
    held = [values[column] for values in scenes.values() if len(values[column])]
    if not held:
        return np.full(len(at), np.nan)
    return np.asarray(np.mean([_shares_below(v, at) for v in held], axis=0))


def quartiles(scenes: Scenes, column: str) -> Quartiles | None:
    """Return where `mean_distribution` reaches 1/4, 1/2 and 3/4; None without a scene."""
    held = [values[column] for values in scenes.values() if len(values[column])]
    if not held:
        return None
    weights = np.concatenate([np.full(len(values), 1 / len(values)) for values in held])
    found = np.quantile(np.concatenate(held), (0.25, 0.5, 0.75), weights=weights, method="inverted_cdf")
    low, middle, high = (float(value) for value in found)
    return low, middle, high


def _shares_below(values: Array, at: Array) -> Array:
    """Return the distribution function of values."""
    return np.asarray(np.searchsorted(np.sort(values), at, side="right") / len(values))


# Frames ---------------------------------------------------------------------------------------------------------------

Progress = Callable[[int, int, str], None]
"""Called with how much is done, how much there is, and what is done now; may raise to stop."""

Side = Literal["real", "generated"]

SHOWN, SHOWN_HEIGHT_PX = 8, 240
"""Frames of each side that a page shows, evenly spread, and their greatest height."""


@dataclass(frozen=True)
class LeftOut:
    """A frame that could not be measured: its side, its name and why."""

    side: Side
    frame: str
    reason: str


@dataclass(frozen=True)
class SetOfFrames:
    """What was measured of one side."""

    scenes: dict[str, Measured]
    frames: int
    without_highlights: int
    pictures: list[tuple[str, Picture]]  # name and small picture, RGB, of some frames

    def quartiles(self, column: str) -> Quartiles | None:
        """Return the quartiles of a column, each scene with the same weight; None where no frame tells it."""
        return quartiles(self.scenes, column)

    @property
    def counts(self) -> dict[str, Json]:
        """How many scenes and frames were measured."""
        return {"scenes": len(self.scenes), "frames": self.frames, "without_highlights": self.without_highlights}


@dataclass(frozen=True)
class Comparison:
    """Two sets of frames and their distances, in the order of `STATISTICS`."""

    real: SetOfFrames
    generated: SetOfFrames
    distances: list[StatisticDistance]
    left_out: list[LeftOut]

    @property
    def verdict(self) -> str:
        """A sentence on all statistics together."""
        near, far, few = (sum(d.verdict == word for d in self.distances) for word in ("near", "far", "too few scenes"))
        judged = len(self.distances) - few
        if not judged:
            scenes = f"{len(self.real.scenes)} real and {len(self.generated.scenes)} generated"
            return f"too few scenes: {scenes}; a verdict needs {LEAST_SCENES} of each"
        text = f"{near} of {judged} statistics are near the real frames, {far} {'is' if far == 1 else 'are'} far"
        return text + (f"; {few} {'has' if few == 1 else 'have'} too few scenes" if few else "")

    def is_inside(self, column: str) -> bool | None:
        """Return whether the generated median lies between the real quartiles; None where a side has no value."""
        real, generated = self.real.quartiles(column), self.generated.quartiles(column)
        return None if real is None or generated is None else real[0] <= generated[1] <= real[2]

    def to_json(self) -> dict[str, Json]:
        """Return distances with their intervals, and quartiles of both sides by column."""
        return {
            "verdict": self.verdict,
            "sets": {"real": self.real.counts, "generated": self.generated.counts},
            "statistics": [self._row(d) for d in self.distances],
            "real": {name: self.real.quartiles(name) for name in COLUMNS},
            "generated": {name: self.generated.quartiles(name) for name in COLUMNS},
            "left_out": [vars(frame) for frame in self.left_out],
        }

    def _row(self, d: StatisticDistance) -> Json:
        return {
            "statistic": d.statistic.name,
            "distance": plain(d.distance),
            "ci95": [plain(v) for v in d.interval],
            "verdict": d.verdict,
            "real_scenes": d.n_real,
            "generated_scenes": d.n_generated,
            "median_inside_real_quartiles": {c.name: self.is_inside(c.name) for c in d.statistic.columns},
        }


def compare(
    real: Sequence[NamedFrame], generated: Sequence[NamedFrame], progress: Progress | None = None, seed: int = 0
) -> Comparison:
    """Measure both sets and compare them; frames that cannot be measured are left out with their reason."""
    total, done = len(real) + len(generated), 0
    left_out: list[LeftOut] = []
    sides = []
    names: tuple[Side, Side] = ("real", "generated")
    for side, frames in zip(names, (real, generated), strict=True):
        measured: list[tuple[str, Measured]] = []
        pictures = []
        shown = {int(i) for i in np.linspace(0, len(frames) - 1, min(SHOWN, len(frames)))}
        for number, frame in enumerate(frames):
            if progress:
                progress(done, total, f"measuring {frame.name}")
            try:
                picture = frame.read()
                measured.append((frame.scene, measure(picture)))
                if number in shown:
                    pictures.append((frame.name, small(picture, SHOWN_HEIGHT_PX)))
            except InputError as error:
                left_out.append(LeftOut(side, frame.name, str(error)))
            done += 1
        if not measured:
            reason = next((each.reason for each in reversed(left_out) if each.side == side), "the set is empty")
            raise InputError(f"realism: no {side} frame can be measured ({reason})")
        bare = sum(not values["per_frame"].any() for _, values in measured)
        sides.append(SetOfFrames(by_scene(measured), len(measured), bare, pictures))
    if progress:
        progress(total, total, "comparing the distributions")
    return Comparison(sides[0], sides[1], distances(sides[0].scenes, sides[1].scenes, seed), left_out)


def small(picture: Image, height: int) -> Picture:
    """Return a picture of values in [0, 1], RGB, as bytes and at most so high."""
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    share = height / values.shape[0]
    if share >= 1:
        return values
    return np.asarray(cv2.resize(values, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), np.uint8)


def plain(value: float) -> float | None:
    """Return what JSON holds of a number: None where it is not finite."""
    return float(value) if math.isfinite(value) else None
