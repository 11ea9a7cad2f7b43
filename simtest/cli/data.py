"""Commands about frames for learning and about real ones: dataset, realism, fit, advise."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter, Token

from simtest.cli.common import (
    ONE_PROCESS,
    AsJson,
    EngineOptions,
    Out,
    Seed,
    command_line,
    counted,
    named,
    named_path,
    print_files,
    print_json,
    print_lines,
    print_table,
    replacing,
    whole_number,
)
from simtest.cli.progress import progress_bar
from simtest.errors import InputError
from simtest.runtime.files import check_count
from simtest.runtime.locks import exclusive_file, exclusive_folder

if TYPE_CHECKING:
    from simtest.advice.advise import Advised
    from simtest.realism.comparison import Comparison
    from simtest.realism.fitting.fit import FittedRecipe

dataset = App(name="dataset", help="Make a labelled dataset for learning, check it, look at it.")

Folder = Annotated[Path, Parameter(help="The dataset's folder.", converter=named_path)]
Settings = Annotated[list[str] | None, replacing("samples_per_anatomy=5 or sensor.noise_sigma=0")]
Variant = Annotated[
    str | None,
    Parameter(help="llvm, cuda on an NVIDIA GPU, or a Mitsuba variant by name; default SIMTEST_VARIANT, else llvm."),
]
Samples = Annotated[int | None, Parameter(help="Number of samples; default the file's.", converter=whole_number)]


@dataset.default
def make(
    described: Annotated[str, named("datasets", files=True, name="DATASET")],
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder of the dataset; made if need be.", converter=named_path)],
    samples: Samples = None,
    seed: Seed = None,
    settings: Settings = None,
    engine: EngineOptions = ONE_PROCESS,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """Make a dataset: shards, tables, manifest and card; the same command goes on where it was stopped.

    Parameters
    ----------
    described : str
        A dataset file, or the name of a shipped one: endoscopy, highlights, highlights_smooth,
        highlights_tiny, smooth, tiny.
    """
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS, write_dataset
    from simtest.rendering.backend import needs_gpu
    from simtest.spec import load_dataset, parse_settings

    values = parse_settings(settings or []) | {
        key: value for key, value in (("samples", samples), ("seed", seed)) if value is not None
    }
    wanted = load_dataset(described, values)
    with progress_bar("writing the tables") as progress:
        chosen = engine.make(needs_gpu(variant), SHARDS_PER_PROCESS)
        write_dataset(wanted, out, chosen, variant, progress)
    print_files([out / "README.md"], as_json, dataset=wanted.name, samples=wanted.samples)


@dataset.command
def verify(
    folder: Folder,
    /,
    *,
    repair: Annotated[
        bool, Parameter(negative="", help="Make again what is broken; remove files that do not belong.")
    ] = False,
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
            print_lines(list(map(str, faults)))
        if faults and repair:
            chosen = engine.make(renew_after=SHARDS_PER_PROCESS)
            left = repair_files(folder, faults, chosen, progress)
    broken = faults if left is None else left
    if as_json:
        print_json({"folder": str(folder), "sound": not broken, "repaired": left is not None,
                    "faults": faults, "left": broken})  # fmt: skip
    elif left is not None:
        print_lines([f"still broken: {fault}" for fault in left])
        print("mended" if not left else f"left: {len(left)}")
    else:
        print(counted(len(faults), "fault") if faults else "sound")
    return 1 if broken else 0


@dataset.command
def sample(
    folder: Folder,
    index: Annotated[int, Parameter(converter=whole_number)],
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder for the files; default sample-INDEX.", converter=named_path)
    ] = None,
    variant: Annotated[str | None, Parameter(help="Mitsuba variant; default the dataset's own.")] = None,
    as_json: AsJson = False,
) -> int:
    """Make one sample of a dataset again, alone; exit 1 if it differs from the stored one.

    Parameters
    ----------
    index : int
        Of the sample, from 0.
    """
    from simtest.dataset.reproduce import compare, reproduce_sample

    target = out or Path(f"sample-{index}")
    files = reproduce_sample(folder, index, target, variant)
    verdict = compare(folder, index, target)
    same = verdict.endswith("same bytes")
    print_files(files, as_json, **({"same": same, "verdict": verdict} if as_json else {}))
    if not as_json:
        print(verdict)
    return 0 if same else 1


@dataset.command
def preview(
    folder: Folder,
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Page to write; default preview.html in the current folder.", converter=named_path)
    ] = None,
    samples: Annotated[int, Parameter(help="How many samples to show.", converter=whole_number)] = 24,
    as_json: AsJson = False,
) -> None:
    """Write a page with a dataset's frames, labels, highlights and distributions."""
    from simtest.dataset.preview import write_preview

    page = out or Path("preview.html")
    with exclusive_file(page):
        print_files([write_preview(folder, page, samples)], as_json)


@dataset.command
def export(
    folder: Folder,
    /,
    *,
    out: Annotated[Path, Parameter(help="Folder for the frames; made if need be.", converter=named_path)],
    engine: EngineOptions = ONE_PROCESS,
    as_json: AsJson = False,
) -> None:
    """Export a dataset's frames without their truth, for methods that run elsewhere; `simtest score` takes answers."""
    from simtest.dataset.export import export_dataset
    from simtest.dataset.shard_writer import SHARDS_PER_PROCESS

    with progress_bar("writing the tables") as progress:
        chosen = engine.make(renew_after=SHARDS_PER_PROCESS)
        readme = export_dataset(folder, out, chosen, progress)
    print_files([readme], as_json)


def realism(
    frames: list[Path],
    /,
    *,
    against: Annotated[str, Parameter(help="Generated frames: a dataset's folder, a folder of pictures, or a scene.")],
    out: Out,
    count: Annotated[
        int, Parameter(help="Generated frames that are taken or rendered, at most.", converter=whole_number)
    ] = 40,
    surfaces: Annotated[
        list[str] | None,
        Parameter(name="--surface", negative="", help="Take samples of this surface alone; may be repeated."),
    ] = None,
    seed: Seed = None,
    as_json: AsJson = False,
) -> None:
    """Measure how far generated frames are from real ones, statistic by statistic; write a page and JSON.

    Parameters
    ----------
    frames : list of Path
        Real colour frames: pictures, films, or folders of pictures. A film is one scene, and so is a folder whose name
        ends in .film; any other picture is a scene of its own.
    """
    from simtest.realism.comparison import compare
    from simtest.realism.frame_sets import open_frames, open_generated
    from simtest.realism.page import write_comparison

    real, generated = open_frames(frames), open_generated(against, count, surfaces or ())
    command = command_line()
    try:
        with exclusive_folder(out), progress_bar("compared") as progress:
            found = compare(real, generated, progress, seed or 0)
            page = write_comparison(found, out, against, command, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("an earlier page stays; the same command begins anew") from None
    if as_json:
        print_files([page], as_json, **found.to_json())
        return
    _print_distances(found)
    print(page)


def _print_distances(found: "Comparison") -> None:
    from simtest.realism.distance import distance_text

    rows = []
    for d in found.distances:
        interval = f"{distance_text(d.interval[0])} to {distance_text(d.interval[1])}"
        counts = f"{d.n_real} / {d.n_generated}"
        rows.append((d.statistic.title, distance_text(d.distance), interval, counts, d.verdict))
    print_table(("statistic", "distance", "95 % interval", "scenes, real / generated", "verdict"), rows)
    print_lines([f"left out: {frame.frame}: {frame.reason}" for frame in found.left_out])
    print(found.verdict)


def fit(
    frames: list[Path],
    /,
    *,
    recipe: Annotated[str, Parameter(help="A dataset file, or the name of a shipped one, whose ranges are fitted.")],
    out: Annotated[
        Path, Parameter(help="TOML file for the fitted recipe; the report stands beside it.", converter=named_path)
    ],
    scene: Annotated[
        str | None, Parameter(help="Base scene of the family that is fitted; needed where there are several.")
    ] = None,
    size: Annotated[int, Parameter(help="Frames that are rendered over the ranges.", converter=whole_number)] = 150,
    bank: Annotated[
        Path | None,
        Parameter(
            help="Folder that keeps them, for other fits too; default OUT with the suffix .bank.", converter=named_path
        ),
    ] = None,
    seed: Seed = None,
    as_json: AsJson = False,
) -> None:
    """Fit the ranges of a dataset recipe to real frames, with intervals, and say what the frames do not tell.

    Parameters
    ----------
    frames : list of Path
        Real colour frames of at least three scenes: pictures, films, or folders of pictures. A film is one scene, and
        so is a folder whose name ends in .film; any other picture is a scene of its own.
    """
    from simtest.realism.fitting.fit import fit as fitted_to
    from simtest.realism.fitting.outcome import check_out, report_json, write_fit
    from simtest.realism.fitting.parameters import one_family
    from simtest.realism.frame_sets import MOST_GENERATED, open_frames
    from simtest.spec.recipes import load_dataset

    check_out(out)
    check_count(size, "--size", MOST_GENERATED)
    dataset = one_family(load_dataset(recipe), scene)
    opened, kept = open_frames(frames), bank or out.with_suffix(".bank")
    with exclusive_file(out), exclusive_folder(kept, "--bank"):
        with progress_bar("writing") as progress:
            found = fitted_to(opened, dataset, kept, size, seed or 0, progress)
        paths = write_fit(found, out)
    if as_json:
        print_files(paths, as_json, **report_json(found))
        return
    _print_ranges(found)
    print_files(paths, as_json)


def _print_ranges(found: "FittedRecipe") -> None:

    rows = []
    for number, parameter in enumerate(found.parameters):
        share = found.fitted.interval[number]
        low, high = parameter.from_unit(share)
        centre = parameter.from_unit(found.fitted.centre[number])
        told = "yes" if found.fitted.told[number] else "not told"
        rows.append((parameter.kind, parameter.key, f"{centre:.3g}", f"{low:.3g} to {high:.3g}",
                     f"{share[1] - share[0]:.0%}", told))  # fmt: skip
    print_table(("parameter", "key", "centre", "95 % interval", "of its range", "told"), rows, width=140)
    print_lines([f"note: {note}" for note in found.notes()])
    print_lines([f"left out: {name}: {reason}" for name, reason in found.left_out.items()])


def _numbers(_: Any, tokens: Sequence[Token]) -> tuple[float, ...]:
    """Convert an option to numbers separated by commas."""
    try:
        return tuple(float(part) for part in tokens[0].value.split(","))
    except ValueError:
        raise ValueError(f"{tokens[0].value!r}: must be numbers separated by commas, such as 20,60") from None


def advise(
    rig: str,
    /,
    *,
    out: Out,
    organ: Annotated[str, Parameter(help="colon, stomach, liver, gallbladder, or plane (a phantom).")] = "colon",
    distances: Annotated[
        tuple[float, ...],
        Parameter(
            help="Nearest and farthest distance of the wall, mm: 20,60.",
            negative="", converter=_numbers, n_tokens=1, allow_leading_hyphen=True,
        ),
    ] = (20.0, 60.0),
    camera: Annotated[
        Path | None, Parameter(help="Camera file in place of the scope's camera.", converter=named_path)
    ] = None,
    bound: Annotated[float, Parameter(help="Error beyond which a method counts as broken, deg.")] = 5.0,
    frames: Annotated[
        int | None,
        Parameter(
            help="Frames of the organ, rounded up to as many at each of 8 distances; default what two minutes allow.",
            converter=whole_number,
        ),
    ] = None,
    seed: Seed = None,
    workers: Annotated[int, Parameter(help="Processes that work at once.", converter=whole_number)] = 2,
    as_json: AsJson = False,
) -> None:  # fmt: skip
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
    from simtest.advice.page import write_advice
    from simtest.advice.plan import Question
    from simtest.advice.scope import read_scope

    if len(distances) != 2:
        raise InputError(f"--distances: {len(distances)} numbers; must be two, the nearest and the farthest, mm")
    scope = read_scope(rig, camera)
    question = Question(scope, organ, (distances[0], distances[1]), bound, frames, seed or 0)
    command = command_line()
    with exclusive_folder(out), progress_bar("writing the page") as progress:
        found = run(question, out, progress, workers)
        page = write_advice(found, out, command)
    if as_json:
        print_files([page], as_json, **found.to_json())
        return
    _print(found)
    print(page)


def _print(found: "Advised") -> None:
    from simtest.advice.page import NOTHING, interval, sentence
    from simtest.advice.plan import DISTANCES
    from simtest.pages.style import number

    rows = [
        (m.estimator, m.target, f"{m.answered} of {m.asked}", number(m.fine.mean_deg), interval(m.fine.interval_deg),
         number(m.base.mean_deg), interval(m.base.interval_deg))
        for m in found.found.methods
    ]  # fmt: skip
    columns = ("method", "states", "answered", "error, fine", "95 % interval", "error, base", "95 % interval")
    print_table(columns, rows)
    print(f"{found.found.frames} frames, {found.question.per_distance} at each of {DISTANCES} distances")
    breaks = [
        (b.title, b.method, f"{b.quantity} {number(b.value)} {b.unit}".strip(),
         "refuses" if b.expected is None else number(b.expected))
        for b in found.breaks
    ]  # fmt: skip
    print_table(("what breaks", "method", "at", "law, deg"), breaks)
    print_lines([sentence(found, choice) for choice in found.found.choices] or [NOTHING])
