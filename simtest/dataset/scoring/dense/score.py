"""Dense maps of a method against the truth of a run or a dataset: figures, tables, JSON and a page.

Each frame leaves the figures of its angles and depth errors, a row a cell. The scenes, not the pixels, are the sample
(of a dataset the anatomies): frames of one scene differ in noise alone.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from simtest.dataset.scoring.dense.depth import ALIGNMENTS, align, depth_factor, normals_of_distance
from simtest.dataset.scoring.dense.maps import Answer, Fit, MapFolder, MapOptions, Method, decode_depth, open_method
from simtest.dataset.scoring.dense.page import Shown, picture_row, write_dense_page
from simtest.dataset.scoring.dense.truth import (
    ANGLE,
    BELOW,
    BINS,
    CELLS,
    DEPTH,
    EXCLUDED,
    NORMAL,
    SURFACES,
    ZONE_MEANINGS,
    Cell,
    FrameTruth,
    Key,
    cell_pixels,
    depth_source,
    kept_file,
    read_truth,
    truth_of_view,
)
from simtest.dataset.scoring.frames import Use, open_source, read_record, scored_frames
from simtest.errors import InputError
from simtest.geometry.vectors import angle_deg
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, IntArray
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json, write_parquet
from simtest.runtime.locks import exclusive_folder
from simtest.runtime.statistics import Interval, mean_interval, median_interval, root_mean_square, share_interval
from simtest.spec import Experiment
from simtest.validation.run_folder import TRUTH
from simtest.validation.runner import Progress

TABLE, SUMMARY, PAGE = "dense.parquet", "dense.json", "index.html"
SCHEMA = 3

UNITS = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3}
"""mm of one unit."""

SAME_UNIT = 1.25
"""Depths are taken for those of another unit where the factors of all frames are that of the unit up to this one."""

MOST_SHOWN, LEAST_SHOWN = 6, 3
"""Frames that the page shows: one of each setting up to the larger number, and the first ones up to the smaller."""


@dataclass
class DenseScore:
    """The figures of a method."""

    name: str  # of the method
    on: str  # the run or dataset, as it was named
    options: MapOptions  # how maps are read
    sources: tuple[str, ...]  # sources that some frame has; a frame without one counts as unanswered there
    has_unit: bool = True  # whether the depths are of a unit at all, as those of files are
    fit: Fit = field(init=False)  # how well the maps fit the truth as they are read
    # frames, frames without any map, scored pixels, and pixels excluded by reason
    counts: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("frames", "frames_without_map", "scored", *EXCLUDED), 0)
    )
    rows: list[JsonObject] = field(default_factory=list)  # figures of each frame and cell
    # factor and shift in each frame, by alignment
    alignments: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    scenes: dict[str, str] = field(default_factory=dict)  # scene of each frame
    shown: list[Shown] = field(default_factory=list)  # pictures of some frames
    page: Path | None = None  # where the page was written

    def __post_init__(self) -> None:
        self.fit = Fit(self.options)

    # Frame by frame

    def add(self, truth: FrameTruth, answer: Answer) -> None:
        """Score a frame."""
        self.fit.add(truth, answer)
        self.counts["frames"] += 1
        self.counts["frames_without_map"] += answer.normal is None and answer.depth is None
        self.counts["scored"] += int(truth.scored.sum())
        for reason in EXCLUDED:
            self.counts[reason] += truth.excluded[reason]
        self.scenes[truth.name] = truth.scene or truth.name
        normals, distances = self._read(truth, answer)
        unanswered = np.full(int(truth.scored.sum()), np.nan)
        in_cells = {surface: cell_pixels(truth, surface) for surface in SURFACES}
        for surface in SURFACES:
            true = truth.normal[surface][truth.scored]
            for source in self.sources:
                values = angle_deg(normals[source][truth.scored], true) if source in normals else unanswered
                self._count((source, ANGLE, surface), truth, values, in_cells[surface])
        true = truth.distance[truth.scored]
        for source in self.sources:
            if source != NORMAL:
                known = source in distances
                values = 100 * np.abs(distances[source][truth.scored] / true - 1) if known else unanswered
                self._count((source, DEPTH, "fine"), truth, values, in_cells["fine"])
        self._show(truth, normals)

    def _read(self, truth: FrameTruth, answer: Answer) -> tuple[dict[str, Array], dict[str, Array]]:
        """Return the normals, shape (H, W, 3), and, of depths, the distances along the rays, by source."""
        normals: dict[str, Array] = {}
        distances: dict[str, Array] = {}
        if answer.normal is not None:
            normals[NORMAL] = self.options.normals(answer.normal)
        if answer.depth is not None:
            depth = decode_depth(answer.depth, self.options.unit_mm)
            factor = depth_factor(truth.camera, self.options.along)
            rays = truth.camera.unproject(truth.camera.pixel_centres())
            true, fitted_on = truth.distance * factor, truth.scored & np.isfinite(factor) & np.isfinite(depth)
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

    def _count(self, key: Key, truth: FrameTruth, values: Array, in_cells: list[tuple[int, IntArray]]) -> None:
        source, quantity, surface = key
        common = {"frame": truth.name, "setting": truth.setting, **truth.swept, "source": source,
                  "quantity": quantity, "surface": surface}  # fmt: skip
        penalty = PENALTY if quantity == ANGLE else None
        for number, pixels in in_cells:
            figures = frame_figures(values[pixels], BELOW[quantity], penalty)
            self.rows.append({**common, **vars(CELLS[number]), **figures})

    def _show(self, truth: FrameTruth, normals: dict[str, Array]) -> None:
        """Keep the pictures of a frame for the page, if it is the first of its setting or one of the first."""
        settings = {one.setting for one in self.shown}
        if len(self.shown) >= MOST_SHOWN or (truth.setting in settings and len(self.shown) >= LEAST_SHOWN):
            return
        best = (NORMAL, depth_source("affine"), depth_source("scale"), depth_source("none"))
        source = next((name for name in best if name in normals), None)
        self.shown.append(picture_row(truth, None if source is None else normals[source], source))

    # All frames

    @cached_property
    def cells(self) -> list[tuple[Key, JsonObject]]:
        """The figures of every cell that holds a pixel; all frames must have been added."""
        held: dict[tuple[Key, Cell], list[JsonObject]] = {}
        for row in self.rows:
            key = (row["source"], row["quantity"], row["surface"])
            held.setdefault((key, Cell(row["group"], row["label"], row["scope"])), []).append(row)
        keys = list(dict.fromkeys(key for key, _ in held))
        return [
            (key, {**vars(cell), **self._joined(held[key, cell])})
            for key, cell in sorted(held, key=lambda each: (keys.index(each[0]), CELLS.index(each[1])))
        ]

    def _joined(self, rows: list[JsonObject]) -> JsonObject:
        names = [[self.scenes[row["frame"]] for row in rows], [row["setting"] for row in rows]]
        scenes, settings = (np.unique(each, return_inverse=True)[1] for each in names)
        figures = [*rows[0]][[*rows[0]].index("scope") + 1 :]
        return joined_figures([{name: row[name] for name in figures} for row in rows], scenes, settings)

    def cell(self, source: str, surface: str = "fine", label: str = "all", quantity: str = ANGLE) -> JsonObject:
        """Return the figures of a cell of the zones."""
        for key, figures in self.cells:
            if key == (source, quantity, surface) and (figures["group"], figures["label"]) == ("zone", label):
                return dict(figures)
        raise KeyError((source, quantity, surface, label))

    def alignment_summary(self) -> JsonObject:
        """Return median, least and largest factor and shift of each alignment over the frames.

        Frames whose factor is not positive are counted apart; their depths count as unanswered.
        """
        summary: JsonObject = {}
        for how, pairs in self.alignments.items():
            fitted = np.array([pair for pair in pairs if np.isfinite(pair).all()]).reshape(-1, 2)
            if how == "none" or not len(fitted):
                continue
            sound = fitted[fitted[:, 0] > 0]
            summary[how] = {"frames": len(sound), "frames_turned_round": len(fitted) - len(sound)}
            names = ("factor", "shift_mm") if how == "affine" else ("factor",)
            for name, part in zip(names, sound.T, strict=False) if len(sound) else ():
                summary[how][name] = {
                    "median": float(np.median(part)), "least": float(part.min()), "largest": float(part.max())
                }  # fmt: skip
        return summary

    def _unit_lines(self) -> Iterator[str]:
        """Yield a warning where a factor between units would bring the depths of every frame to the truth."""
        factor = self.alignment_summary().get("scale", {}).get("factor")
        if factor is None or not self.has_unit:
            return
        given = 1.0 if self.options.unit_mm is None else self.options.unit_mm
        for name, unit_mm in UNITS.items():
            near = sorted(factor[each] * given / unit_mm for each in ("least", "median", "largest"))
            if not np.isclose(unit_mm, given) and near[0] * SAME_UNIT >= 1 and near[2] <= SAME_UNIT:
                yield (
                    f"warning: depths: read in units of {given:g} mm, the truth is about {unit_mm / given:g} times "
                    f"them, as if they were in {name}; --unit-mm {unit_mm:g} says so"
                )

    @property
    def lines(self) -> list[str]:
        """What is told in words: conventions, alignments, and what was not answered."""
        told = [*self.fit.lines(), *self._unit_lines()]
        for how, found in self.alignment_summary().items():
            if turned := found["frames_turned_round"]:
                told.append(
                    f"warning: depths, {how}: the factor is negative in {turned} frames, whose pixels count as "
                    "unanswered; inverse depths (disparities) must be inverted first"
                )
            if not found["frames"]:
                continue
            factor = found["factor"]
            text = f"depths, {how}: factor {factor['median']:.4g} ({factor['least']:.4g} to {factor['largest']:.4g})"
            if "shift_mm" in found:
                text += f", shift {found['shift_mm']['median']:.3g} mm"
            told.append(text + f", fitted in each of {found['frames']} frames")
        frames, empty = self.counts["frames"], self.counts["frames_without_map"]
        told.append(f"frames: {frames}" + (f", {empty} of them without a map: all their pixels count as unanswered"
                                           if empty else ""))  # fmt: skip
        excluded = ", ".join(f"{self.counts[reason]} {reason.replace('_', ' ')}" for reason in EXCLUDED)
        told.append(f"pixels: {self.counts['scored']} scored; not scored: {excluded}")
        return told

    def to_json(self) -> JsonObject:
        """Return the content of dense.json."""
        cells: dict[str, dict[str, dict[str, list[object]]]] = {}
        for (source, quantity, surface), found in self.cells:
            cells.setdefault(source, {}).setdefault(quantity, {}).setdefault(surface, []).append(found)
        return {
            "schema": SCHEMA, "name": self.name, "on": self.on, "counts": self.counts,
            "conventions": self.fit.to_json(),
            "alignments": self.alignment_summary(), "zones": ZONE_MEANINGS,
            "bins": {name: [edge if np.isfinite(edge) else None for edge in edges] for name, edges in BINS.items()},
            "sources": cells, "told": self.lines,
        }  # fmt: skip


def score_frames(
    frames: Iterable[FrameTruth], method: Method, options: MapOptions, on: str = "", is_checked: bool = False
) -> DenseScore:
    """Score a method's maps on frames, one at a time.

    `is_checked` says that the names of the method's maps were checked against the frames before.
    """
    options.check()
    options = method.options(options)
    sources: tuple[str, ...] = (NORMAL,) if "normal" in method.kinds else ()
    sources += tuple(map(depth_source, ALIGNMENTS)) if "depth" in method.kinds else ()
    score = DenseScore(options.name or method.name, on, options, sources, isinstance(method, MapFolder))
    names = []
    for truth in frames:
        names.append(truth.name)
        score.add(truth, method.answer(truth))
    if not is_checked:
        method.check(names)
    if not names:
        raise InputError(f"{str(on) if on else 'the run'}: holds no frame")
    return score


def frames_of(folder: Path, progress: Progress | None = None, total: int = 0) -> Iterator[FrameTruth]:
    """Yield each exported frame of a run or dataset once, with its truth.

    `progress` is called when a frame has been used, with their number, the `total` and its name. Raises `InputError` as
    `scored_frames` does.
    """
    used: set[str] = set()
    kept = _kept_truths(folder)
    for each in scored_frames(folder) if kept is None else kept:
        # One frame may stand for several realisations; it has one map.
        if each.name not in used:
            used.add(each.name)
            yield each if isinstance(each, FrameTruth) else truth_of_view(
                each.name, each.view, each.session, each.setting, each.swept, each.image, each.anatomy
            )  # fmt: skip
            if progress:
                progress(len(used), total, each.name)


def _kept_truths(folder: Path) -> Iterator[FrameTruth] | None:
    """Return the truths that the export of a run kept, in the order of its cases; None where some are missing."""
    record = read_record(folder)
    source = open_source(folder, record)
    if not isinstance(source.recipe, Experiment) or not (folder / TRUTH).is_dir():
        return None
    first: dict[str, Use] = {}
    files = []
    for use in record.uses:
        first.setdefault(use.frame, use)
    for use in first.values():
        case = source.cases[use.case]
        scene, drawn = case.scene(source.recipe, use.realisation)
        path = kept_file(folder / TRUTH, use.frame, scene, source.variant)
        files.append((path, use.frame, scene, case.setting, {**case.swept, **drawn}))
    if not all(file[0].is_file() for file in files):
        return None
    return (read_truth(*file) for file in files)


def write_score(score: DenseScore, out: Path, command: str = "") -> Path:
    """Write dense.parquet, dense.json and the page into a folder, which is made if need be; return the page."""
    import polars as pl

    make_folder(out)
    table = pl.DataFrame(score.rows, infer_schema_length=None)
    write_parquet(out / TABLE, table)
    write_json(out / SUMMARY, {**score.to_json(), "run": {"command": command, **provenance.environment()}})
    score.page = out / PAGE
    write_atomically(score.page, lambda part: write_dense_page(part, score, command))
    return score.page


def score_maps(
    maps: str | Path, on: Path, out: Path, options: MapOptions | None = None, command: str = "",
    progress: Progress | None = None,
) -> DenseScore:  # fmt: skip
    """Score maps of normals or depths on a run or a dataset, and write the figures into a folder.

    Parameters
    ----------
    maps : str or Path
        Folder of the maps, each called as its frame, or "shading" for the baseline.
    on : Path
        Folder of the run or dataset, whose frames were exported.
    out : Path
        Gets dense.parquet, dense.json and index.html.
    options : MapOptions, optional
        What is stated of the maps.
    command : str
        How the scoring was called.
    progress : callable, optional
        Called with the frames done, frames in all, and the frame's name.
    """
    options = options or MapOptions()
    options.check()
    method = open_method(maps)
    names = list(read_record(on).frames)
    if (out / PAGE).exists() and not (out / SUMMARY).exists():
        raise InputError(f"--out {out}: holds another page; must be an empty folder or one of such figures")
    # Before anything is rendered, which takes long.
    method.check(names)
    with exclusive_folder(out):
        score = score_frames(frames_of(on, progress, len(names)), method, options, str(on), is_checked=True)
        write_score(score, out, command)
    return score


# Figures ------------------------------------------------------------------------------------------------------------

PENALTY = 90.0
"""An unanswered pixel counts as this angle, deg, in the penalised mean."""

QUANTILES = {"median": 0.5, "p95": 0.95}


def frame_figures(values: Array, below: Sequence[float], penalty: float | None = PENALTY) -> JsonObject:
    """Return the figures of a frame's pixels of one cell: shares are of all, the unanswered among them.

    Parameters
    ----------
    values : ndarray, shape (N,)
        At least one; NaN where there is no answer.
    below : sequence of float
        Thresholds; the share of the pixels below each is told.
    penalty : float or None
        What an unanswered pixel counts in `mean_penalised`; None where the values have no such figure.
    """
    own = values[np.isfinite(values)]
    n, missing = len(values), len(values) - len(own)
    quantiles = np.quantile(own, [*QUANTILES.values()]).tolist() if own.size else [None] * len(QUANTILES)
    return {
        "n": n, "n_unanswered": missing,
        "mean": float(own.mean()) if own.size else None, "rms": root_mean_square(own),
        **({} if penalty is None else {"mean_penalised": float((own.sum() + penalty * missing) / n)}),
        "share_unanswered": missing / n,
        **{f"below_{most:g}": np.count_nonzero(own < most) / n for most in below},
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }  # fmt: skip


def joined_figures(rows: Sequence[JsonObject], scenes: IntArray, settings: IntArray) -> JsonObject:
    """Return the figures of a cell over its frames, with 95 % intervals where these show two scenes or more.

    Means and shares are of all pixels; median and p95 are the medians over the frames of each frame's.

    Parameters
    ----------
    rows : sequence of dict
        `frame_figures` of each frame.
    scenes, settings : ndarray of int, shape (N,)
        Number of the scene and of the setting of each frame.
    """
    columns = {name: np.array([np.nan if row[name] is None else row[name] for row in rows], float) for name in rows[0]}
    pixels = columns.pop("n")
    answers = pixels - columns.pop("n_unanswered")
    found: JsonObject = {"frames": len(rows), "n": int(pixels.sum()), "n_unanswered": int((pixels - answers).sum())}
    intervals: JsonObject = {}
    for name, values in columns.items():
        known = np.isfinite(values)
        value, interval = _joined(
            name, values[known], scenes[known], settings[known], (answers if name in ("mean", "rms") else pixels)[known]
        )
        found[name] = value
        if interval[0] is not None and len(np.unique(scenes)) > 1:
            intervals[name] = list(interval)
    return found | {"ci95": intervals}


def _joined(
    name: str, values: Array, scenes: IntArray, settings: IntArray, counts: Array
) -> tuple[float | None, Interval]:
    if not len(values):
        return None, (None, None)
    if name in QUANTILES:
        return float(np.median(values)), median_interval(values, scenes, settings)
    root = np.sqrt if name == "rms" else float
    totals = counts * (values**2 if name == "rms" else values)
    interval_of = share_interval if name.startswith(("share", "below")) else mean_interval
    low, high = interval_of(totals, scenes, settings, counts)
    ends = (None, None) if low is None or high is None else (float(root(max(low, 0.0))), float(root(high)))
    return float(root(totals.sum() / counts.sum())), ends
