"""The parts that an experiment's work is split into: each makes some rows, in any process and in any order."""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import polars as pl

from simtest.estimators import AnyEstimator, load_estimators
from simtest.estimators.names import forgive_cores
from simtest.runtime.processes import OnStep
from simtest.spec import Experiment
from simtest.spec.recipes import PaperSetting
from simtest.validation import gallery_items as gallery
from simtest.validation.cases import Case
from simtest.validation.columns import Row, Value, swept_columns, table
from simtest.validation.paper.gallery_item import save_realisation
from simtest.validation.paper.predictions import cramer_rao_bound
from simtest.validation.paper.rows import paper_rows, pipeline_with
from simtest.validation.realisation import Realiser

PAPER_CHUNK = 125
"""Realisations of the published protocol that a part makes: a second's work."""

GALLERY_ITEMS = 18
"""Cases of an experiment that are kept for the gallery."""


@dataclass(frozen=True)
class Part:
    """Some realisations of a case.

    Parameters
    ----------
    swept : mapping
        An example of each swept value of the experiment, for the columns' types.
    item : Path or None
        Where to keep the first realisation for the gallery.
    variant : str or None
        Mitsuba variant.
    """

    experiment: Experiment
    case: Case
    numbers: range
    swept: Mapping[str, Value]
    item: Path | None
    variant: str | None


@lru_cache(maxsize=1)
def realiser_of(variant: str | None) -> Realiser:
    """Return this process's realiser, which stays from part to part; that of another variant is let go."""
    return Realiser(variant)


@lru_cache(maxsize=1)
def _estimators(names: tuple[str, ...]) -> dict[str, AnyEstimator]:
    """Return the estimators of the last parts: to find them the metadata of all installed packages are read."""
    return load_estimators(names)


def forget() -> None:
    """Let this process's rendering session and estimators go."""
    realiser_of.cache_clear()
    _estimators.cache_clear()
    pipeline_with.cache_clear()


def gallery_cases(cases: list[Case]) -> set[int]:
    """Choose the cases whose first realisation is kept: evenly spaced ones, and the published protocol's defaults."""
    count = min(GALLERY_ITEMS, len(cases))
    chosen = set(np.linspace(0, len(cases) - 1, count).round().astype(int).tolist())
    at_defaults = (i for i, case in enumerate(cases) if case.is_paper and case.paper_setting() == PaperSetting())
    return chosen | set(itertools.islice(at_defaults, 1))


def parts_of(
    experiment: Experiment, case: Case, swept: Mapping[str, Value], item: Path | None, variant: str | None
) -> list[Part]:
    """Split a case into parts: the published protocol into chunks, a rendered case not at all."""
    # A rendered case shares its view between realisations; the protocol's realisations have nothing in common.
    numbers = case.numbers()
    size = PAPER_CHUNK if case.is_paper else max(1, len(numbers))
    return [
        Part(experiment, case, numbers[first : first + size], swept, None if first else item, variant)
        for first in range(0, len(numbers), size)
    ]


def make_rows(part: Part, tell: OnStep) -> pl.DataFrame:
    """Make a part's rows, in the order of its realisations; `tell` is called after each."""
    # The rows must not depend on the parts that this process has made before.
    forgive_cores()
    if part.case.is_paper:
        rows = _published(part)
        for _ in part.numbers:
            tell()
    else:
        rows = _rendered(part, tell)
    return table(rows, part.swept)


def _rendered(part: Part, tell: OnStep) -> list[Row]:
    experiment, case, realiser = part.experiment, part.case, realiser_of(part.variant)
    estimators = _estimators(tuple(experiment.estimators))
    rows: list[Row] = []
    for number in part.numbers:
        made = realiser.make(experiment, case, number, estimators)
        rows += made.rows
        if part.item and number == part.numbers[0]:
            gallery.save(part.item, realiser.session, experiment, case, made)
        tell()
    return rows


def _published(part: Part) -> list[Row]:
    experiment, case, setting = part.experiment, part.case, part.case.paper_setting()
    seeds = [case.noise_seed(experiment, number) for number in part.numbers]
    if part.item:
        save_realisation(part.item, experiment, case, part.numbers[0])
    # The bound is that of the light at V.
    bound = cramer_rao_bound(setting) if setting.eps == 0 else None
    bound_deg = None if bound is None else float(np.degrees(bound))
    swept = {**case.paper_columns(), **case.swept, "bound_deg": bound_deg}
    common: Row = {"experiment": experiment.name, "label": case.label, "setting": case.setting, **swept_columns(swept)}
    return paper_rows(setting, common, part.numbers, seeds, experiment.estimators)
