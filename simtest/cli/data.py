"""Commands about frames for learning and about real ones: dataset, realism, fit, advise."""

import shlex
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from simtest.cli.common import (
    ONE_PROCESS,
    OUT,
    AsJson,
    Distances,
    EngineOptions,
    Out,
    Seed,
    Table,
    Told,
    about,
    command,
    command_line,
    counted,
    few,
    flag,
    named,
    path,
    print_json,
    replacing,
    values_of,
    whole,
    whole_number,
)
from simtest.cli.progress import progress_bar
from simtest.runtime.files import check_count
from simtest.runtime.locks import exclusive_file, exclusive_folder

if TYPE_CHECKING:
    from simtest.advice.advise import Advised
    from simtest.realism.compare import Comparison
    from simtest.realism.fitting.fit import FittedRecipe

dataset = App(name="dataset", help="Make a labelled dataset for learning, check it, look at it.")

Folder = Annotated[Path, path("The dataset's folder.")]
Settings = Annotated[list[str] | None, replacing("samples_per_anatomy=5 or sensor.noise_sigma=0")]
Variant = Annotated[
    str | None,
    about("llvm, cuda on an NVIDIA GPU, or a Mitsuba variant by name; default SIMTEST_VARIANT, else llvm."),
]


@dataset.default
@command
def make(
    described: Annotated[str, named("datasets", files=True, name="DATASET")],
    /,
    *,
    out: Annotated[Path, path("Folder of the dataset; made if need be.", OUT)],
    samples: Annotated[int | None, whole("Number of samples; default the file's.", ("--samples", "-n"))] = None,
    seed: Seed = None,
    settings: Settings = None,
    engine: EngineOptions = ONE_PROCESS,
    variant: Variant = None,
) -> Told:
    """Make a dataset: shards, tables, manifest and card; the same command goes on where it was stopped.

    Parameters
    ----------
    described : str
        A dataset file, or the name of a shipped one: endoscopy, endoscopy_close, highlights,
        highlights_smooth, highlights_tiny, smooth, tiny.
    """
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS, write_dataset
    from simtest.rendering.backend import needs_gpu
    from simtest.spec import load_dataset

    wanted = load_dataset(described, values_of(settings, samples=samples, seed=seed))
    with progress_bar("writing the tables") as progress:
        chosen = engine.make(needs_gpu(variant), SHARDS_PER_PROCESS)
        write_dataset(wanted, out, chosen, variant, progress)
    return Told([out / "README.md"], {"dataset": wanted.name, "samples": wanted.samples})


@dataset.command
def verify(
    folder: Folder,
    /,
    *,
    repair: Annotated[bool, flag("Make again what is broken; remove files that do not belong.")] = False,
    engine: EngineOptions = ONE_PROCESS,
    as_json: AsJson = False,
) -> int:
    """Check a dataset's files and values; exit 1 if anything is broken, and name it."""
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS
    from simtest.dataset.verify import repair_files
    from simtest.dataset.verify import verify as check

    left = None
    with progress_bar("done") as progress:
        faults = check(folder, progress)
        if not as_json:
            print(*few(list(map(str, faults))), sep="\n", end="\n" * bool(faults))
        if faults and repair:
            chosen = engine.make(renew_after=SHARDS_PER_PROCESS)
            left = repair_files(folder, faults, chosen, progress)
    broken = faults if left is None else left
    if as_json:
        print_json({"folder": str(folder), "sound": not broken, "repaired": left is not None,
                    "faults": faults, "left": broken})  # fmt: skip
    elif left is not None:
        print(*few([f"still broken: {fault}" for fault in left]), f"left: {len(left)}" if left else "mended", sep="\n")
    else:
        print(counted(len(faults), "fault") if faults else "sound")
    return 1 if broken else 0


@dataset.command
@command
def sample(
    folder: Folder,
    index: Annotated[int, Parameter(converter=whole_number)],
    /,
    *,
    out: Annotated[Path | None, path("Folder for the files; default sample-INDEX.", OUT)] = None,
    variant: Annotated[str | None, about("Mitsuba variant; default the dataset's own.")] = None,
) -> Told:
    """Make one sample of a dataset again, alone; exit 1 if it differs from the stored one.

    Parameters
    ----------
    index : int
        Of the sample, from 0.
    """
    from simtest.dataset.reader import open_manifest
    from simtest.dataset.verify import compare, reproduce_sample

    target = out or Path(f"sample-{index}")
    files = reproduce_sample(folder, index, target, variant)
    verdict = compare(folder, index, target)
    same = verdict.endswith("same bytes")
    record = {"same": same, "verdict": verdict, "files": files}
    # With another variant the frame has other noise.
    rendered = variant or open_manifest(folder).origin["variant"]
    scene = next(str(file) for file in files if file.suffix == ".json")
    again = shlex.join(["simtest", "render", scene, "--variant", rendered])
    return Told(data=record, parts=[*files, f"its frame, rendered again: {again}", verdict], code=0 if same else 1)


@dataset.command
@command
def preview(
    folder: Folder,
    /,
    *,
    out: Annotated[Path | None, path("Page to write; default preview.html in the current folder.", OUT)] = None,
    samples: Annotated[int, whole("How many samples to show.", ("--samples", "-n"))] = 24,
) -> Told:
    """Write a page with a dataset's frames, labels, highlights and distributions."""
    from simtest.dataset.card import write_preview

    page = out or Path("preview.html")
    with exclusive_file(page):
        return Told([write_preview(folder, page, samples)])


@dataset.command
@command
def export(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, path("Folder for the frames; made if need be.", OUT)],
    engine: EngineOptions = ONE_PROCESS,
) -> Told:
    """Export a dataset's frames without their truth, for methods that run elsewhere; `simtest score` takes answers."""
    from simtest.dataset.export import export_dataset
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS

    with progress_bar("writing the tables") as progress:
        chosen = engine.make(renew_after=SHARDS_PER_PROCESS)
        return Told([export_dataset(folder, out, chosen, progress)])


@command
def realism(
    frames: list[Path],
    /,
    *,
    against: Annotated[str, about("Generated frames: a dataset's folder, a folder of pictures, or a scene.")],
    out: Out,
    count: Annotated[int, whole("Generated frames that are taken or rendered, at most.", ("--count", "-n"))] = 40,
    surfaces: Annotated[
        list[str] | None,
        flag("Take samples of this surface (colon) or scene (stomach) alone; may be repeated.", "--surface"),
    ] = None,
    seed: Seed = None,
) -> Told:
    """Measure how far generated frames are from real ones, statistic by statistic; write a page and JSON.

    Parameters
    ----------
    frames : list of Path
        Real colour frames: pictures, films, or folders of pictures. A film is one scene, and so is a folder whose name
        ends in .film; any other picture is a scene of its own.
    """
    from simtest.realism.compare import LEAST_SCENES, compare
    from simtest.realism.frames import open_frames, open_generated
    from simtest.realism.page import write_comparison

    real, generated = open_frames(frames), open_generated(against, count, surfaces or ())
    stopped = "an earlier page stays; the same command begins anew"
    with exclusive_folder(out), progress_bar("comparing the distributions", stopped) as progress:
        # Before the frames are measured, which takes long.
        scenes = [len({frame.scene for frame in side}) for side in (real, generated)]
        if min(scenes) < LEAST_SCENES:
            told = f"{scenes[0]} real and {scenes[1]} generated scenes: a verdict needs {LEAST_SCENES} of each"
            warnings.warn(told, stacklevel=1)
        found = compare(real, generated, progress, seed or 0)
        page = write_comparison(found, out, against, command_line(), progress)
    return Told([page], found.to_json, _distances(found))


def _distances(found: "Comparison") -> "Iterator[str | Table]":
    from simtest.realism.compare import distance_text

    rows = []
    for d in found.distances:
        interval = f"{distance_text(d.interval[0])} to {distance_text(d.interval[1])}"
        counts = f"{d.n_real} / {d.n_generated}"
        rows.append((d.statistic.title, distance_text(d.distance), interval, counts, d.verdict))
    yield Table(("statistic", "distance", "95 % interval", "scenes, real / generated", "verdict"), rows)
    yield from few([f"left out: {frame.frame}: {frame.reason}" for frame in found.left_out])
    yield found.verdict


@command
def fit(
    frames: list[Path],
    /,
    *,
    recipe: Annotated[str, about("A dataset file, or the name of a shipped one, whose ranges are fitted.")],
    out: Annotated[Path, path("TOML file for the fitted recipe; the report stands beside it.", OUT)],
    scene: Annotated[
        str | None, about("Base scene of the family that is fitted; needed where there are several.")
    ] = None,
    size: Annotated[int, whole("Frames that are rendered over the ranges.")] = 150,
    bank: Annotated[
        Path | None, path("Folder that keeps them, for other fits too; default OUT with the suffix .bank.")
    ] = None,
    seed: Seed = None,
) -> Told:
    """Fit the ranges of a dataset recipe to real frames, with intervals, and say what the frames do not tell.

    Parameters
    ----------
    frames : list of Path
        Real colour frames of at least three scenes: pictures, films, or folders of pictures. A film is one scene, and
        so is a folder whose name ends in .film; any other picture is a scene of its own.
    """
    from simtest.realism.fitting.bank import one_family
    from simtest.realism.fitting.fit import check_out, report_json, write_fit
    from simtest.realism.fitting.fit import fit as fitted_to
    from simtest.realism.frames import MOST_GENERATED, open_frames
    from simtest.spec.recipes import load_dataset

    check_out(out)
    check_count(size, "--size", MOST_GENERATED)
    dataset = one_family(load_dataset(recipe), scene)
    opened, kept = open_frames(frames), bank or out.with_suffix(".bank")
    with exclusive_file(out), exclusive_folder(kept, "--bank"):
        with progress_bar("writing") as progress:
            found = fitted_to(opened, dataset, kept, size, seed or 0, progress)
        paths = write_fit(found, out)
    return Told(paths, lambda: report_json(found), _ranges(found))


def _ranges(found: "FittedRecipe") -> "Iterator[str | Table]":
    rows = []
    for number, parameter in enumerate(found.parameters):
        share = found.fitted.interval[number]
        low, high = parameter.from_unit(share)
        centre = parameter.from_unit(found.fitted.centre[number])
        told = "yes" if found.fitted.told[number] else "not told"
        rows.append((parameter.kind, parameter.key, f"{centre:.3g}", f"{low:.3g} to {high:.3g}",
                     f"{share[1] - share[0]:.0%}", told))  # fmt: skip
    yield Table(("parameter", "key", "centre", "95 % interval", "of its range", "told"), rows, width=140)
    yield from few([f"note: {note}" for note in found.notes()])
    yield from few([f"left out: {name}: {reason}" for name, reason in found.left_out.items()])


@command
def advise(
    rig: str,
    /,
    *,
    out: Out,
    organ: Annotated[str, about("colon, stomach, liver, gallbladder, or plane (a phantom).")] = "colon",
    distances: Distances = (20.0, 60.0),
    camera: Annotated[Path | None, path("Camera file in place of the scope's camera.")] = None,
    bound: Annotated[float, about("Error beyond which a method counts as broken, deg.")] = 5.0,
    frames: Annotated[
        int | None,
        whole(
            "Frames of the organ, rounded up to as many at each of 8 distances; default what two minutes allow."
        ),
    ] = None,
    seed: Seed = None,
    workers: Annotated[int, whole("Processes that work at once.")] = 2,
) -> Told:  # fmt: skip
    """Measure what a scope and its lights can reach before an organ: best method, expected error, break-points.

    The errors are measured on frames rendered for the purpose, the break-points follow from laws; the page prints the
    command behind each measured figure.

    Parameters
    ----------
    rig : str
        A preset (colocated, colonoscope_2, colonoscope_3, laparoscope), or a TOML file with the tables [camera], [rig],
        [sensor] and [relief].
    """
    from simtest.advice.advise import advise as run
    from simtest.advice.advise import write_advice
    from simtest.advice.plan import Question
    from simtest.advice.scope import read_scope

    question = Question(read_scope(rig, camera), organ, distances, bound, frames, seed or 0)
    with exclusive_folder(out), progress_bar("writing the page") as progress:
        found = run(question, out, progress, workers)
        page = write_advice(found, out, command_line())
    return Told([page], found.to_json, _advice(found))


def _advice(advised: "Advised") -> "Iterator[str | Table]":
    from simtest.advice.advise import NOTHING, counts, interval, sentence
    from simtest.pages.style import number

    rows = []
    for m in advised.answers.methods:
        beside = advised.answers.beside(m.estimator)
        difference = f"{number(beside.mean_deg)} ({beside.highlights})" if beside else "–"
        rows.append((m.estimator, m.target, f"{m.answered} of {m.asked}", number(m.fine.mean_deg),
                     interval(m.fine.interval_deg), number(m.base.mean_deg), interval(m.base.interval_deg),
                     difference))  # fmt: skip
    columns = ("method", "states", "answered", "error, fine", "95 % interval", "error, base", "95 % interval",
               "minus the first's")  # fmt: skip
    yield Table(columns, rows, width=140)
    yield counts(advised.answers)
    breaks = [
        (b.title, b.method, f"{b.quantity} {number(b.value)} {b.unit}".strip(),
         "refuses" if b.expected is None else number(b.expected))
        for b in advised.breaks
    ]  # fmt: skip
    yield Table(("what breaks", "method", "at", "law, deg"), breaks)
    yield from few([sentence(advised, choice) for choice in advised.answers.choices] or [NOTHING])
