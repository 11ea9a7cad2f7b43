"""`score_maps`: dense maps of a method against the truth of a run or a dataset, with tables, JSON and a page."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from simtest.dataset.scoring.dense.cells import BINS, ZONE_MEANINGS
from simtest.dataset.scoring.dense.conventions import Answer, Fit, MapOptions
from simtest.dataset.scoring.dense.depth import ALIGNMENTS
from simtest.dataset.scoring.dense.frame_truth import EXCLUDED, FrameTruth, Progress
from simtest.dataset.scoring.dense.methods import Method, open_method
from simtest.dataset.scoring.dense.pictures import Shown, picture_row
from simtest.dataset.scoring.dense.scorer import ANGLE, NORMAL, Key, Scorer, depth_source
from simtest.errors import InputError
from simtest.runtime import provenance
from simtest.runtime.arrays import Array
from simtest.runtime.files import JsonObject, make_folder, write_atomically, write_json
from simtest.runtime.locks import exclusive_folder

TABLE, SUMMARY, PAGE = "dense.parquet", "dense.json", "index.html"
SCHEMA = 3

MOST_SHOWN, LEAST_SHOWN = 6, 3
"""Frames that the page shows: one of each setting up to the larger number, and the first ones up to the smaller."""


@dataclass
class DenseScore:
    """The figures of a method.

    Parameters
    ----------
    name : str
        Of the method.
    on : str
        The run or dataset, as it was named.
    fit : Fit
        How the maps were read, and how well they fit the truth so.
    scorer : Scorer
        The figures of each frame.
    counts : dict of int
        Frames, frames without any map, scored pixels, and pixels excluded by reason.
    shown : list of Shown
        Pictures of some frames.
    page : Path, optional
        Where the page was written.
    """

    name: str
    on: str
    fit: Fit
    scorer: Scorer
    counts: dict[str, int]
    shown: list[Shown] = field(default_factory=list)
    page: Path | None = None

    @property
    def lines(self) -> list[str]:
        """What is told in words: conventions, alignments, and what was not answered."""
        told = self.fit.lines()
        for how, found in self.scorer.alignment_summary().items():
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

    def cell(self, source: str, surface: str = "fine", label: str = "all", quantity: str = ANGLE) -> JsonObject:
        """Return the figures of a cell of the zones."""
        for key, found in self.scorer.cells():
            if key == (source, quantity, surface) and (found["group"], found["label"]) == ("zone", label):
                return dict(found)
        raise KeyError((source, quantity, surface, label))

    def to_json(self) -> JsonObject:
        """Return the content of dense.json."""
        cells: dict[str, dict[str, dict[str, list[object]]]] = {}
        for (source, quantity, surface), found in self.scorer.cells():
            cells.setdefault(source, {}).setdefault(quantity, {}).setdefault(surface, []).append(found)
        return {
            "schema": SCHEMA, "name": self.name, "on": self.on, "counts": self.counts,
            "conventions": self.fit.to_json(),
            "alignments": self.scorer.alignment_summary(), "zones": ZONE_MEANINGS,
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
    counts = dict.fromkeys(("frames", "frames_without_map", "scored", *EXCLUDED), 0)
    scorer = Scorer(options, sources=_sources(method))
    score = DenseScore(options.name or method.name, on, Fit(options), scorer, counts)
    names = []
    for truth in frames:
        names.append(truth.name)
        answer = method.answer(truth)
        score.fit.add(truth, answer)
        _count(counts, truth, answer)
        _show(score, truth, scorer.add(truth, answer))
    if not is_checked:
        method.check(names)
    if not names:
        raise InputError(f"{str(on) if on else 'the run'}: holds no frame")
    return score


def _sources(method: Method) -> tuple[str, ...]:
    """Return the sources of normals that a method gives."""
    own = (NORMAL,) if "normal" in method.kinds else ()
    return own + (tuple(map(depth_source, ALIGNMENTS)) if "depth" in method.kinds else ())


def _count(counts: dict[str, int], truth: FrameTruth, answer: Answer) -> None:
    counts["frames"] += 1
    counts["frames_without_map"] += answer.normal is None and answer.depth is None
    counts["scored"] += int(truth.scored.sum())
    for reason in EXCLUDED:
        counts[reason] += truth.excluded[reason]


def _show(score: DenseScore, truth: FrameTruth, normals: dict[str, npt.NDArray[np.float64]]) -> None:
    """Keep the pictures of a frame for the page, if it is the first of its setting or one of the first."""
    settings = {one.setting for one in score.shown}
    if len(score.shown) >= MOST_SHOWN or (truth.setting in settings and len(score.shown) >= LEAST_SHOWN):
        return
    best = (NORMAL, depth_source("affine"), depth_source("scale"), depth_source("none"))
    source = next((name for name in best if name in normals), None)
    estimate: Array | None = None if source is None else normals[source]
    score.shown.append(picture_row(truth, estimate, source))


def write_score(score: DenseScore, out: Path, command: str = "") -> Path:
    """Write dense.parquet, dense.json and the page into a folder, which is made if need be; return the page."""
    import polars as pl

    from simtest.dataset.scoring.dense.page import write_dense_page

    make_folder(out)
    table = pl.DataFrame(score.scorer.rows, infer_schema_length=None)
    write_atomically(out / TABLE, table.write_parquet)
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
    from simtest.dataset.scoring.dense.from_folder import frame_names, frames_of

    options = options or MapOptions()
    options.check()
    method = open_method(maps)
    names = frame_names(on)
    _refuse_run(out)
    # Before anything is rendered, which takes long.
    method.check(names)
    with exclusive_folder(out):
        score = score_frames(frames_of(on, progress, len(names)), method, options, str(on), is_checked=True)
        write_score(score, out, command)
    return score


def _refuse_run(out: Path) -> None:
    """Raise `InputError` where a folder for figures holds something else that has a page."""
    if out.is_dir() and (out / PAGE).exists() and not (out / SUMMARY).exists():
        raise InputError(f"--out {out}: holds another page; must be an empty folder or one of such figures")


__all__ = ["DenseScore", "Key", "score_frames", "score_maps", "write_score"]
