"""Compares generated frames with real ones, and writes what was found."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from simtest.errors import InputError
from simtest.realism.distance import LEAST_SCENES, StatisticDistance, by_scene, distances
from simtest.realism.frame_sets import NamedFrame
from simtest.realism.frame_statistics import COLUMNS, Measured, measure
from simtest.runtime.files import Json, make_folder, write_json

Progress = Callable[[int, int, str], None]
"""Called with frames measured, frames in all, and what is done; may raise to stop."""


@dataclass(frozen=True)
class Comparison:
    """Two sets of frames and their distances.

    Parameters
    ----------
    real, generated : dict
        Measured values by scene.
    distances : list of StatisticDistance
        In the order of `STATISTICS`.
    left_out : dict
        Reason by frame that could not be measured.
    """

    real: dict[str, Measured]
    generated: dict[str, Measured]
    distances: list[StatisticDistance]
    left_out: dict[str, str]

    @property
    def verdict(self) -> str:
        """A sentence on all statistics together."""
        judged = [d for d in self.distances if d.verdict != "too few scenes"]
        if not judged:
            counts = f"{len(self.real)} real and {len(self.generated)} generated"
            return f"too few scenes: {counts}; a verdict needs {LEAST_SCENES} of each"
        near = sum(d.verdict == "near" for d in judged)
        far = sum(d.verdict == "far" for d in judged)
        return f"{near} of {len(judged)} statistics are near the real frames, {far} are far"

    def to_json(self) -> dict[str, Json]:
        """Return distances with their intervals, and medians of both sides by column."""
        rows: list[Json] = []
        for d in self.distances:
            rows.append(
                {
                    "statistic": d.statistic.name,
                    "distance": _plain(d.distance),
                    "ci95": [_plain(v) for v in d.interval],
                    "verdict": d.verdict,
                    "real_scenes": d.n_real,
                    "generated_scenes": d.n_generated,
                }
            )
        return {
            "verdict": self.verdict,
            "statistics": rows,
            "real": {name: _quartiles(self.real, name) for name in COLUMNS},
            "generated": {name: _quartiles(self.generated, name) for name in COLUMNS},
            "left_out": dict(self.left_out),
        }


def compare(
    real: Sequence[NamedFrame], generated: Sequence[NamedFrame], progress: Progress | None = None, seed: int = 0
) -> Comparison:
    """Measure both sets and compare them; frames that cannot be measured are left out with their reason.

    Raises
    ------
    InputError
        If a side has no frame that can be measured.
    """
    left_out: dict[str, str] = {}
    total, sides = len(real) + len(generated), []
    for first, frames in ((0, real), (len(real), generated)):
        measured: list[tuple[str, Measured]] = []
        for number, frame in enumerate(frames):
            try:
                measured.append((frame.scene, measure(frame.read())))
            except InputError as error:
                left_out[frame.name] = str(error)
            if progress:
                progress(first + number + 1, total, f"measuring {frame.name}")
        if not measured:
            reason = next(iter(left_out.values()), "the set is empty")
            raise InputError(f"realism: no frame of a set can be measured ({reason})")
        sides.append(by_scene(measured))
    return Comparison(sides[0], sides[1], distances(sides[0], sides[1], seed), left_out)


def write_comparison(comparison: Comparison, out: Path) -> Path:
    """Write realism.json into a folder and return its path."""
    make_folder(out)
    write_json(out / "realism.json", comparison.to_json())
    return out / "realism.json"


def _quartiles(scenes: dict[str, Measured], column: str) -> Json:
    """Return the quartiles of a column over all values of a side; None where there are none."""
    values = np.concatenate([values[column] for values in scenes.values()])
    return None if not len(values) else [float(v) for v in np.quantile(values, [0.25, 0.5, 0.75])]


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
