"""Asks a scope what it can reach: writes the experiments, runs them, renders a frame, and reads the answers."""

import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from simtest.advice.break_points import BreakPoint, SpotSize, break_points, spot_size
from simtest.advice.figures import Found, read_results
from simtest.advice.plan import Question, main_experiment, surroundings, write_experiment
from simtest.errors import InputError
from simtest.pages.pixels import Pixels
from simtest.runtime.files import make_folder, write_atomically
from simtest.runtime.processes import make_engine
from simtest.simulation.frame import make_frame
from simtest.simulation.sensor import displayed
from simtest.spec import Experiment, load_scene
from simtest.spec.toml_files import toml_tables
from simtest.validation.runner import run_experiments

MAIN, SCENE, FRAME, RUN = "experiment.toml", "scene.toml", "frame.png", "run"

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Advised:
    """What was found of a question.

    Parameters
    ----------
    question : Question
        What was asked.
    found : Found
        Errors and answers in frames of the organ.
    breaks : list of BreakPoint
        Where methods fail, by the laws.
    spots : SpotSize
        Size of highlights by the laws.
    spot_radius_px : float or None
        Median radius of the visible highlights that hold one glint alone, as rendered, px.
    picture : ndarray of uint8, shape (H, W, 3)
        A frame as the scope shows it.
    commands : dict
        What makes each figure again: ``errors``, ``picture``.
    drawn : dict
        What is drawn, by key path, with its ends.
    """

    question: Question
    found: Found
    breaks: list[BreakPoint]
    spots: SpotSize
    spot_radius_px: float | None
    picture: Pixels
    commands: dict[str, str]
    drawn: dict[str, tuple[float, float]]

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON; the picture stands beside it."""
        asked, scope = self.question, self.question.scope
        question = {
            "scope": scope.name, **scope.tables, "organ": asked.organ,
            "distances_mm": asked.distances_mm,
            "bound_deg": asked.bound_deg, "seed": asked.seed,
        }  # fmt: skip
        spots = {"smooth_px": self.spots.smooth_px, "relief_px": self.spots.relief_px,
                 "shapeless_beyond_mm": _finite(self.spots.shapeless_beyond_mm),
                 "rendered_px": self.spot_radius_px}  # fmt: skip
        return {"question": question, "drawn": self.drawn, **self.found.to_json(),
                "break_points": [asdict(each) for each in self.breaks], "spot_radius": spots,
                "commands": self.commands}  # fmt: skip


def _finite(value: float | None) -> float | None:
    return value if value is not None and value < float("inf") else None


def advise(question: Question, out: Path, progress: Progress | None = None, workers: int = 1) -> Advised:
    """Answer a question by renders.

    Parameters
    ----------
    question : Question
        What is asked.
    out : Path
        Folder; gets the files of the experiment and the scene, the run, and frame.png. A run that is there and is
        the same is kept.
    progress : callable, optional
        Called with steps done, steps in all, and what is done.
    workers : int
        Processes that render at once.
    """
    engine = make_engine(workers=workers)
    make_folder(out)
    written = [path for path in (out / MAIN, out / SCENE) if not path.exists()]
    try:
        main = write_experiment(main_experiment(question), out / MAIN)
        # The frame first: what cannot be rendered is found before the long part.
        frame = make_frame(load_scene(write_scene(question, main, out / SCENE)))
    except (InputError, OSError):
        for path in written:
            path.unlink(missing_ok=True)
        raise
    picture = np.asarray(np.round(255 * displayed(frame.image, frame.scene.sensor)), dtype=np.uint8)
    (run,) = run_experiments([(main, out / RUN)], "", None, progress, engine)
    results = run.results
    count = sum(len(next(iter(table.values()))) for group in main.groups for table in group.pool) * main.realisations
    _write_picture(out / FRAME, picture)
    return Advised(
        question, read_results(results, count), break_points(question), spot_size(question),
        _median_radius(results), picture, _commands(out),
        surroundings(question).random,
    )  # fmt: skip


def write_scene(question: Question, main: Experiment, path: Path) -> Path:
    """Write the scene of the picture: the organ itself, with its vessels, through the scope; return its path."""
    group = main.groups[0]
    settings = {**group.set, "surface": _organ_surface(question, group.set["surface"])}
    # The colours of the frames that are measured have no vessels.
    settings.pop("reflectance.albedo", None)
    described = load_scene(question.kind.scene, settings)
    tables = described.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    named = {key: value for key, value in tables.items() if isinstance(value, dict)}
    write_atomically(path, lambda part: part.write_text(toml_tables(named), encoding="utf-8"))
    return path


def _organ_surface(question: Question, wall: dict[str, Any]) -> dict[str, Any]:
    """Return the organ's surface, with the relief of the walls that are measured where one is stated."""
    if question.kind.smooth:
        return {**wall, "distance_mm": question.middle_mm}
    surface = load_scene(question.kind.scene).model_dump(mode="json", exclude_unset=True)["surface"]
    if question.scope.relief is not None:
        surface.pop("relief", None)
        surface |= {key: value for key, value in wall.items() if key == "relief"}
    if surface["type"] == "quadric":
        surface["distance_mm"] = question.middle_mm
    return dict(surface)


def _write_picture(path: Path, picture: Pixels) -> None:
    from simtest.pages import pixels

    content = pixels.png(picture)
    write_atomically(path, lambda part: part.write_bytes(content))


def _median_radius(results: pl.DataFrame) -> float | None:
    alone = results.drop_nulls("radius_px").unique(["setting", "realisation", "true_id"])["radius_px"]
    return None if alone.is_empty() else float(alone.median())  # type: ignore[arg-type]


def _commands(out: Path) -> dict[str, str]:
    """Return the commands that make the figures again; a run that is kept is not rendered anew."""

    def words(*parts: object) -> str:
        return shlex.join(["simtest", *map(str, parts)])

    return {
        "errors": words("validate", out / MAIN, "--out", out / RUN),
        "picture": words("render", out / SCENE, "--out", out / "frame"),
    }
