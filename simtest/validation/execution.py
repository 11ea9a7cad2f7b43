"""The parts that an experiment's work is cut into: each makes some rows, in any process and in any order."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from simtest.estimators import load_estimators
from simtest.rendering import Session
from simtest.runtime.engines import OnStep
from simtest.simulation.rendered_view import View, view
from simtest.spec import Experiment, Scene
from simtest.validation import gallery_items as gallery
from simtest.validation.cases import Case
from simtest.validation.metrics import completed, table
from simtest.validation.paper.bound import cramer_rao_bound
from simtest.validation.paper.item import save_realisation
from simtest.validation.paper.rows import paper_rows
from simtest.validation.realisation import realise

PAPER_CHUNK = 125
"""Realisations of the published protocol that a part makes: a second's work."""


@dataclass(frozen=True)
class Part:
    """Some realisations of a case.

    Parameters
    ----------
    experiment : Experiment
        Name, seed and estimators.
    case : Case
        The case.
    numbers : range
        Which of its realisations.
    swept : dict
        An example of each swept value of the experiment, for the columns' types.
    item : str or None
        Where to keep the first realisation for the gallery.
    variant : str or None
        Mitsuba variant.
    """

    experiment: Experiment
    case: Case
    numbers: range
    swept: dict[str, Any]
    item: str | None
    variant: str | None


class _Renderer:
    """A process's rendering session, which stays from part to part."""

    def __init__(self, variant: str | None) -> None:
        self._variant = variant
        self.session: Session | None = None

    def view(self, scene: Scene) -> tuple[Session, View]:
        if self.session is None:
            self.session = Session(scene, self._variant)
        return self.session, view(self.session, scene)


@lru_cache(maxsize=1)
def _renderer(variant: str | None) -> _Renderer:
    return _Renderer(variant)


def forget() -> None:
    """Let this process's rendering session go."""
    _renderer.cache_clear()


def parts_of(
    experiment: Experiment, case: Case, swept: dict[str, Any], item: Path | None, variant: str | None
) -> list[Part]:
    """Cut a case into parts: the published protocol into chunks, a rendered case not at all."""
    numbers = case.numbers()
    size = PAPER_CHUNK if case.is_paper else max(1, len(numbers))
    return [
        Part(experiment, case, numbers[first : first + size], swept, str(item) if item and not first else None, variant)
        for first in range(0, len(numbers), size)
    ]


def make_rows(part: Part, tell: OnStep) -> pl.DataFrame:
    """Make a part's rows.

    Parameters
    ----------
    part : Part
        Which.
    tell : callable
        Told of each realisation.

    Returns
    -------
    polars.DataFrame
        In the order of the realisations.
    """
    if part.case.is_paper:
        made = completed(_published(part), part.swept)
        for _ in part.numbers:
            tell()
        return made
    return table(_rendered(part, tell), part.swept)


def _rendered(part: Part, tell: OnStep) -> list[dict[str, Any]]:
    experiment, case = part.experiment, part.case
    estimators, renderer = load_estimators(experiment.estimators), _renderer(part.variant)
    rows: list[dict[str, Any]] = []
    seen: View | None = None
    for done, number in enumerate(part.numbers):
        scene, drawn = case.scene(experiment, number)
        if seen is None or scene != seen.scene:
            session, seen = renderer.view(scene)
        made = realise(session, experiment, case, number, seen, drawn, estimators)
        rows += made.rows
        if part.item and not done:
            again = f"{case.again(experiment, number)} --out frame"
            gallery.save(Path(part.item), session, case, seen, made, again)
        tell()
    return rows


def _published(part: Part) -> pl.DataFrame:
    experiment, case, setting = part.experiment, part.case, part.case.paper_setting()
    names = {"label": case.label, "setting": case.setting}
    common: dict[str, Any] = {"experiment": experiment.name, **names, **case.paper_columns(), **case.swept}
    seeds = [case.noise_seed(experiment, number) for number in part.numbers]
    if part.item:
        save_realisation(Path(part.item), setting, experiment.estimators, seeds[0], names)
    # The bound is that of the light at V.
    bound = cramer_rao_bound(setting) if setting.eps == 0 else None
    common["bound_deg"] = None if bound is None else float(np.degrees(bound))
    return paper_rows(setting, common, part.numbers, seeds, experiment.estimators)
