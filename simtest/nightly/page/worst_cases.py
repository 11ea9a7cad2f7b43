"""The worst cases: frames with overlays, before and after, each with the command that makes it again."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from simtest.errors import InputError
from simtest.nightly.records import JudgedRun
from simtest.report.run_folder import GalleryItem, KeptEstimate, read_item

if TYPE_CHECKING:
    from simtest.validation.worst import WorstCase

MOST_CASES = 12

_NORMAL = ("normal_x", "normal_y", "normal_z")
_SAME = ("seed", "truth_x", "truth_y", "truth_z")
_NEEDED = ("experiment", "setting", "realisation", "estimator", "true_id", "status", "error_deg", *_NORMAL)


def read_cases(judged: JudgedRun) -> tuple[list[GalleryItem], list[str]]:
    """Read the gallery items; returns those that can be read, and a line for each that cannot.

    To the answers of tonight those of the baseline are added, of the estimator that missed: the picture shows what was
    and what is.
    """
    items, lines = [], []
    paths = judged.gallery[:MOST_CASES]
    for path, case in zip_longest(paths, judged.cases[: len(paths)]):
        try:
            item = read_item(Path(path))
        except InputError as error:
            lines.append(str(error))
            continue
        items.append(item if case is None else _with_baseline(item, case, judged))
    return items, lines


def _with_baseline(item: GalleryItem, case: "WorstCase", judged: JudgedRun) -> GalleryItem:
    """Return an item with the baseline's answers at the true highlights of its frame."""
    if not {*_NEEDED, *_SAME} <= set(judged.before.columns):
        return item
    was = tuple(_answers(case, judged.before, judged.run.rows))
    if not was:
        return item
    told = "; ".join(f"highlight {one.true_id}: {one.result}" for one in was)
    meta = item.meta
    why = f"{meta.why} In the baseline: {told}.".strip()
    return replace(item, meta=meta.model_copy(update={"estimates": (*meta.estimates, *was), "why": why}))


def _answers(case: "WorstCase", before: pl.DataFrame, tonight: pl.DataFrame) -> Iterator[KeptEstimate]:
    shown = (
        pl.col("experiment") == case.experiment, pl.col("setting") == case.setting,
        pl.col("realisation") == case.realisation, pl.col("estimator") == case.estimator,
        pl.col("true_id").is_not_null(),
    )  # fmt: skip
    # Only of the same frame: with another seed or definition the true normals differ.
    # Baselines hold numbers in single precision.
    was, now = (
        rows.filter(shown).with_columns(pl.col(*_SAME, "true_id").cast(pl.Float32).name.prefix("same_"))
        for rows in (before, tonight)
    )
    own = was.join(now, on=[f"same_{name}" for name in (*_SAME, "true_id")], how="semi", maintain_order="left")
    for row in own.select(_NEEDED).iter_rows(named=True):
        normal = tuple(row[name] for name in _NORMAL)
        yield KeptEstimate(
            estimator=f"{case.estimator} (baseline)", status=row["status"], true_id=row["true_id"],
            normal=None if None in normal else normal, error_deg=row["error_deg"],
        )  # fmt: skip
