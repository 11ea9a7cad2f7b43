"""Asks a scope what it can reach: writes and runs the experiment, renders a frame, reads the answers, writes them."""

import math
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.advice.answers import (
    WIDE,
    Answers,
    BreakPoint,
    Choice,
    MethodAnswers,
    SpotSize,
    break_points,
    read_results,
    spot_size,
)
from simtest.advice.plan import DISTANCES, MOST_ASKED, Question, main_experiment, surroundings, write_experiment
from simtest.errors import InputError
from simtest.pages import pixels
from simtest.pages.charts import Axis, Chart, Mark, Panel, embedded, png
from simtest.pages.html import environment
from simtest.pages.pixels import Pixels
from simtest.pages.style import SERIES, number, symbols
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json, written_together
from simtest.runtime.processes import make_engine
from simtest.runtime.statistics import Interval
from simtest.simulation.frame import make_frame
from simtest.simulation.sensor import displayed
from simtest.spec import Experiment, load_scene
from simtest.spec.toml_files import toml_tables
from simtest.validation import laws
from simtest.validation.guide import LEAST_ANSWERED
from simtest.validation.runner import Progress, run_experiments

MAIN, SCENE, FRAME, RUN = "experiment.toml", "scene.toml", "frame.png", "run"


@dataclass(frozen=True)
class Advised:
    """What was found of a question."""

    question: Question
    answers: Answers  # errors and answers in frames of the organ
    breaks: list[BreakPoint]
    spots: SpotSize
    spot_radius_px: float | None  # median radius of the visible highlights that hold one glint alone, as rendered
    picture: Pixels  # a frame as the scope shows it
    commands: dict[str, str]  # what makes each figure again: errors, picture
    drawn: dict[str, tuple[float, float]]  # by key path, with its ends

    def to_json(self) -> dict[str, Any]:
        """Return all figures as JSON; the picture stands beside it."""
        asked, scope, farthest = self.question, self.question.scope, self.spots.shapeless_beyond_mm
        question = {
            "scope": scope.name, **scope.tables, "organ": asked.organ,
            "distances_mm": asked.distances_mm,
            "bound_deg": asked.bound_deg, "seed": asked.seed,
        }  # fmt: skip
        spots = {**asdict(self.spots), "shapeless_beyond_mm": None if farthest == math.inf else farthest}
        return {"question": question, "drawn": self.drawn, **self.answers.to_json(),
                "break_points": [asdict(each) for each in self.breaks],
                "spot_radius": {**spots, "rendered_px": self.spot_radius_px},
                "commands": self.commands}  # fmt: skip


def advise(question: Question, out: Path, progress: Progress | None = None, workers: int = 1) -> Advised:
    """Answer a question by renders, with so many processes at once.

    The folder gets the files of the experiment and the scene, the run, and frame.png. A run that is there and is the
    same is kept. `progress` is called with steps done, steps in all, and what is done.
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
    alone = run.results.drop_nulls("radius_px").unique(["setting", "realisation", "true_id"])["radius_px"]
    radius = None if alone.is_empty() else float(alone.median())  # type: ignore[arg-type]
    _write(out / FRAME, pixels.png(picture))
    # A run that is kept is not rendered anew.
    commands = {
        "errors": shlex.join(["simtest", "validate", str(out / MAIN), "--out", str(out / RUN)]),
        "picture": shlex.join(["simtest", "render", str(out / SCENE), "--out", str(out / "frame")]),
    }
    answers = read_results(run.results, question.per_distance * DISTANCES)
    return Advised(question, answers, break_points(question), spot_size(question), radius, picture, commands,
                   surroundings(question).random)  # fmt: skip


def _write(path: Path, content: bytes) -> None:
    write_atomically(path, lambda part: part.write_bytes(content))


def write_scene(question: Question, main: Experiment, path: Path) -> Path:
    """Write the scene of the picture: the organ itself, with its vessels, through the scope; return its path."""
    group, organ = main.groups[0], question.kind.scene
    wall = group.set["surface"]
    surface = wall
    if not question.kind.smooth:
        surface = load_scene(organ).model_dump(mode="json", exclude_unset=True)["surface"]
        if question.scope.relief is not None:
            # That of the walls that are measured.
            surface.pop("relief", None)
            surface |= {key: value for key, value in wall.items() if key == "relief"}
    if question.kind.smooth or surface["type"] == "quadric":
        surface = {**surface, "distance_mm": question.middle_mm}
    # The colours of the frames that are measured have no vessels.
    settings = {key: value for key, value in group.set.items() if key != "reflectance.albedo"} | {"surface": surface}
    tables = load_scene(organ, settings).model_dump(mode="json", exclude_unset=True, exclude_none=True)
    named = {key: value for key, value in tables.items() if isinstance(value, dict)}
    write_atomically(path, lambda part: part.write_text(toml_tables(named), encoding="utf-8"))
    return path


# Files and page -------------------------------------------------------------------------------------------------------

PAGE, RESULT = "index.html", "advice.json"

PICTURE_HEIGHT_PX = 480

_SURFACES = {"fine": "the fine surface", "base": "the organ below its relief"}


def write_advice(advised: Advised, out: Path, command: str = "") -> Path:
    """Write an advice, called by a command, into a folder: advice.json, figures and the page, which is returned."""
    make_folder(out / "figures")
    chart = distance_chart(advised)
    _write(out / "figures" / "distance.png", png([chart]))
    about = provenance.environment()
    html = environment().get_template("advice.html.j2").render(
        advised=advised, sentences=[sentence(advised, choice) for choice in advised.answers.choices] or [NOTHING],
        chart=chart, picture=pixels.data_address(advised.picture, PICTURE_HEIGHT_PX), command=command,
        narrower=narrower(advised, command), distances=DISTANCES,
        interval=interval, counts=counts(advised.answers),
        parts=list(dict.fromkeys(name for each in advised.answers.methods for name in each.budget_deg)),
        provenance={"commit": about["commit"] or "–", "simtest": about["version"], "python": about["python"]},
        **embedded([chart]),
    )  # fmt: skip
    with written_together(out, (RESULT, PAGE)) as new:
        write_json(new / RESULT, {**advised.to_json(), "run": {"command": command, **about}})
        write_atomically(new / PAGE, lambda part: part.write_text(html, encoding="utf-8"))
    return out / PAGE


NOTHING = "No highlight was found in the frames: there is nothing to compare the methods by."


def sentence(advised: Advised, choice: Choice) -> str:
    """Return which method to use for a surface's normal, with the error to expect."""
    surface = _SURFACES[choice.target]
    if choice.best is None:
        return f"For the normal of {surface} no method answered."
    method = advised.answers.method(choice.best)
    text = f"For the normal of {surface} use {choice.best}: mean error {number(method.own.mean_deg)} deg"
    text += f" (95 % interval {interval(method.own.interval_deg)}), {method.answered} of {method.asked} answered."
    if choice.ties:
        text += f" It cannot be told from {', '.join(choice.ties)}."
    text += _smaller_means(advised, choice) + _nearer(advised, method)
    if method.own.is_wide:
        text += f" The interval is wide: {_remedy(advised, choice)}"
    return text


def _smaller_means(advised: Advised, choice: Choice) -> str:
    """Return why methods with a smaller mean error than the best are not recommended, a sentence each."""
    text, best = "", advised.answers.method(choice.best or "").own.mean_deg or 0.0
    for each in choice.others:
        method, difference = advised.answers.method(each.other), each.mean_deg
        if method.own.mean_deg is None or method.own.mean_deg >= best:
            continue
        text += (
            f" {each.other} has a smaller mean, {number(method.own.mean_deg)} deg, over its {method.answered} answers"
        )
        if difference is None:
            text += "; there is no highlight that both answered."
            continue
        side = "larger" if difference >= 0 else "smaller"
        text += f": over the {each.highlights} that both answered its error is {number(abs(difference))} deg {side}"
        if difference < 0:
            if each.tied:
                text += ", but the two cannot be told apart"
            elif method.answered < LEAST_ANSWERED * method.asked:
                text += ", but it answers fewer than half"
            else:
                text += ", but other methods are better than it"
        text += "."
    return text


def counts(answers: Answers) -> str:
    """Return what was rendered and detected; the numbers of detections add up."""
    return (
        f"{answers.frames} frames show {answers.visible} visible highlights; the detector found {answers.found} of "
        f"them. Its {answers.detections} detections: {answers.matched} at a true highlight, {answers.unmatched} in a "
        f"visible highlight that melts several glints or holds none, {answers.false} false."
    )


def _nearer(advised: Advised, best: MethodAnswers) -> str:
    """Return a sentence if a method of the fine surface comes nearer to the base than the best of those that state it.

    Only methods that state the base's normal are ranked for it, however few answers they have.
    """
    if best.target == "fine" or best.own.mean_deg is None:
        return ""
    others = [each for each in advised.answers.methods if each.target == "fine" and each.base.mean_deg is not None]
    nearest = min(others, key=lambda each: each.base.mean_deg or 0.0, default=None)
    if nearest is None or (nearest.base.mean_deg or 0.0) >= best.own.mean_deg:
        return ""
    return (
        f" In these frames the fine normals of {nearest.estimator} lie nearer to it: mean "
        f"{number(nearest.base.mean_deg)} deg, {nearest.answered} of {nearest.asked} answered."
    )


def _remedy(advised: Advised, choice: Choice) -> str:
    """Return what makes the interval of a choice's error narrower."""
    frames = frames_for(advised, choice)
    if frames is None or choice.best is None:
        return "more frames (--frames) make it narrower."
    reach = 100 * (advised.answers.method(choice.best).own.reach or 0.0)
    return f"it reaches {reach:.0f} % from the mean; {frames} frames would narrow it to about {100 * WIDE:.0f} %."


def narrower(advised: Advised, command: str) -> str | None:
    """Return the command with the frames that narrow the first interval that is too wide; None where there is none."""
    frames = next((frames for choice in advised.answers.choices if (frames := frames_for(advised, choice))), None)
    if frames is None or not command:
        return None
    words = shlex.split(command)
    if "--frames" in words[:-1]:
        at = words.index("--frames")
        del words[at : at + 2]
    return shlex.join([*(word for word in words if not word.startswith("--frames=")), "--frames", str(frames)])


def frames_for(advised: Advised, choice: Choice) -> int | None:
    """Return about how many frames narrow the interval of a choice's error to `WIDE`.

    The width of the mean's logarithm falls with the root of the number. None where the interval is narrow enough or
    unknown, or where so many frames are not allowed.
    """
    reach = None if choice.best is None else advised.answers.method(choice.best).own.reach
    if reach is None or reach <= WIDE:
        return None
    needed = math.ceil(advised.answers.frames * (math.log1p(reach) / math.log1p(WIDE)) ** 2 / DISTANCES) * DISTANCES
    return needed if needed <= MOST_ASKED else None


def interval(ends: Interval) -> str:
    """Write an interval."""
    return "–" if ends[0] is None else f"{number(ends[0])} to {number(ends[1])}"


def distance_chart(advised: Advised) -> Chart:
    """Describe the best methods' mean error over the distance, with the laws of the light's offset."""
    asked = advised.question
    near, far = asked.distances_mm
    at = np.geomspace(near / 1.3, far * 1.3, 60)
    offset = float(np.mean(asked.scope.offsets_mm))
    marks = []
    if offset:
        ignored = np.degrees(laws.offset_error(offset / at))
        points = np.stack([np.zeros_like(at), np.zeros_like(at), at], axis=-1)
        known = np.degrees(laws.bisector_residual(points, np.array([offset, 0.0, 0.0]), asked.middle_mm / at - 1))
        marks += [
            Mark(at, ignored, SERIES[1], "law: offset ignored", line="dash", hover="{x} mm: {y} deg"),
            Mark(at, known, SERIES[2], "law: bisector, range known", line="dot", hover="{x} mm: {y} deg"),
        ]
    bound = f"bound, {asked.bound_deg:g} deg"
    marks.append(Mark([at[0], at[-1]], [asked.bound_deg] * 2, SERIES[5], bound, line="dashdot"))
    for colour, choice in zip((SERIES[0], SERIES[3]), advised.answers.choices, strict=False):
        rows = [(d, each) for d, each in sorted(choice.by_distance.items()) if each.mean_deg is not None and d > 0]
        if not rows or choice.best is None:
            continue
        x, y = [d for d, _ in rows], [float(each.mean_deg or 0.0) for _, each in rows]
        told = [f"{choice.best}, {choice.target}\n{d:g} mm: {number(v)} deg, {each.answered} answers"
                for v, (d, each) in zip(y, rows, strict=True)]  # fmt: skip
        symbol = symbols(["fine", "base"])[choice.target]
        marks.append(Mark(x, y, colour, f"{choice.best} ({choice.target})", symbol=symbol, size=9, hover=told))
    panel = Panel(Axis("distance (mm)", "log"), Axis("mean error (deg)", "log"), tuple(marks))
    return Chart("distance", "Mean error over the distance", (panel,), 420)
