"""Scores maps frame by frame: each frame leaves the figures of its angles and depth errors, a row a cell."""

from dataclasses import dataclass, field

import numpy as np

from simtest.dataset.scoring.dense.cells import CELLS, Cell, labels
from simtest.dataset.scoring.dense.conventions import Answer, MapOptions
from simtest.dataset.scoring.dense.depth import ALIGNMENTS, align, answered, depth_factor, normals_of_distance
from simtest.dataset.scoring.dense.frame_truth import SURFACES, FrameTruth
from simtest.dataset.scoring.dense.map_files import decode_depth
from simtest.dataset.scoring.dense.tally import PENALTY, frame_figures, joined_figures
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject

ANGLE, DEPTH = "angle_deg", "depth_percent"
"""What is measured: the angle between estimated and true normal, and the depth's error as a share of the distance."""

BELOW = {ANGLE: (5.0, 11.25, 22.5, 30.0), DEPTH: (1.0, 5.0, 10.0, 25.0)}
"""Thresholds below which the share of the pixels is reported."""

NORMAL = "normal"


def depth_source(how: str) -> str:
    """Return the name of the source of normals and depths that an alignment gives."""
    return f"depth_{how}"


Key = tuple[str, str, str]
"""Source, quantity, surface."""


@dataclass
class Scorer:
    """The figures of all frames that were added.

    Parameters
    ----------
    options : MapOptions
        How maps are read.
    """

    options: MapOptions
    rows: list[JsonObject] = field(default_factory=list)
    alignments: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    sources: tuple[str, ...] = ()
    """Sources that some frame has; a frame without one counts as unanswered there."""
    _scenes: dict[str, str] = field(default_factory=dict)
    _cells: list[tuple[Key, JsonObject]] = field(default_factory=list)
    _told_rows: int = 0

    def add(self, truth: FrameTruth, answer: Answer) -> dict[str, Array]:
        """Score a frame; return the normals of each source, shape (H, W, 3), NaN where it has none."""
        normals, distances = self._read(truth, answer)
        for surface in SURFACES:
            sorted_in = labels(truth, surface)
            for source in self.sources:
                estimate = normals.get(source)
                true = truth.normal[surface][truth.scored]
                values = np.full(len(true), np.nan) if estimate is None else angle_deg(estimate[truth.scored], true)
                self._count((source, ANGLE, surface), truth, values, sorted_in)
        for source in self.sources:
            if source != NORMAL:
                distance = distances.get(source)
                true = truth.distance[truth.scored]
                values = np.full(len(true), np.nan) if distance is None else (
                    100 * np.abs(distance[truth.scored] / true - 1)
                )  # fmt: skip
                self._count((source, DEPTH, "fine"), truth, values, labels(truth, "fine"))
        return normals

    def _read(self, truth: FrameTruth, answer: Answer) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the normals and, of depths, the distances along the rays, by source."""
        normals: dict[str, Array] = {}
        distances: dict[str, Array] = {}
        if answer.normal is not None:
            normals[NORMAL] = self.options.normals(answer.normal)
        if answer.depth is not None:
            depth = decode_depth(answer.depth, self.options.unit_mm)
            factor = depth_factor(truth.camera, self.options.along)
            rays = truth.camera.unproject(truth.camera.pixel_centres())
            true, fitted_on = truth.distance * factor, answered(depth, truth.scored & np.isfinite(factor))
            for how in ALIGNMENTS:
                a, b = align(depth[fitted_on], true[fitted_on], how)
                self.alignments.setdefault(how, []).append((a, b))
                # A factor below 0 turns the depths round: they are inverse ones, or no depths.
                aligned = (a * depth + b) / factor if a > 0 else np.full(depth.shape, np.nan)
                aligned[~(aligned > 0)] = np.nan
                distances[depth_source(how)] = aligned
                # A factor turns no normal.
                as_stated = normals.get(depth_source("none")) if b == 0 and a > 0 else None
                normals[depth_source(how)] = normals_of_distance(aligned, rays) if as_stated is None else as_stated
        return normals, distances

    def _count(self, key: Key, truth: FrameTruth, values: Array, sorted_in: list[IntArray]) -> None:
        source, quantity, surface = key
        self._scenes[truth.name] = truth.scene or truth.name
        common = {"frame": truth.name, "setting": truth.setting, **truth.swept, "source": source,
                  "quantity": quantity, "surface": surface}  # fmt: skip
        penalty = PENALTY if quantity == ANGLE else None
        for sorting in sorted_in:
            for number in np.unique(sorting[sorting >= 0]):
                cell, own = CELLS[number], values[sorting == number]
                told = {"group": cell.group, "label": cell.label, "scope": cell.scope}
                self.rows.append({**common, **told, **frame_figures(own, BELOW[quantity], penalty)})

    def alignment_summary(self) -> JsonObject:
        """Return median, least and largest factor and shift of each alignment over the frames.

        Frames whose factor is not positive are counted apart; their depths count as unanswered.
        """
        summary: JsonObject = {}
        for how, pairs in self.alignments.items():
            found = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
            values = found[found[:, 0] > 0]
            if how == "none" or not len(found):
                continue
            own: JsonObject = {"frames": len(values), "frames_turned_round": len(found) - len(values)}
            if not len(values):
                summary[how] = own
                continue
            for column, name in enumerate(("factor", "shift_mm")):
                if name == "factor" or how == "affine":
                    part = values[:, column]
                    own[name] = {"median": float(np.median(part)), "least": float(part.min()),
                                 "largest": float(part.max())}  # fmt: skip
            summary[how] = own
        return summary

    def cells(self) -> list[tuple[Key, JsonObject]]:
        """Return the figures of every cell that holds a pixel."""
        if len(self.rows) != self._told_rows:
            held: dict[tuple[Key, Cell], list[JsonObject]] = {}
            for row in self.rows:
                key = (row["source"], row["quantity"], row["surface"])
                held.setdefault((key, Cell(row["group"], row["label"], row["scope"])), []).append(row)
            order = {cell: number for number, cell in enumerate(CELLS)}
            keys = list(dict.fromkeys(key for key, _ in held))
            self._cells = [
                (key, {**vars(cell), **self._joined(held[key, cell])})
                for key, cell in sorted(held, key=lambda each: (keys.index(each[0]), order[each[1]]))
            ]
            self._told_rows = len(self.rows)
        return self._cells

    def _joined(self, rows: list[JsonObject]) -> JsonObject:
        names = [[self._scenes[row["frame"]] for row in rows], [row["setting"] for row in rows]]
        scenes, settings = (np.unique(each, return_inverse=True)[1] for each in names)
        figures = [*rows[0]][[*rows[0]].index("scope") + 1 :]
        return joined_figures([{name: row[name] for name in figures} for row in rows], scenes, settings)
