"""Commands that run experiments and judge methods: validate, score, core, nightly, bench."""

import itertools
import json
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from simtest.cli.common import (
    NO_REGIONS,
    ONE_PROCESS,
    OUT,
    Address,
    EngineName,
    EngineOptions,
    Estimators,
    NamedPath,
    Out,
    Realisations,
    RegionOptions,
    Seed,
    Settings,
    Table,
    Told,
    Variant,
    Views,
    about,
    command,
    command_line,
    few,
    first,
    flag,
    named,
    path,
    read_guide,
    run_record,
    values_of,
    whole,
)
from simtest.cli.main import MANNERS
from simtest.cli.progress import progress_bar
from simtest.errors import InputError
from simtest.runtime.locks import exclusive_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rich.console import Console

    from simtest.dataset.scoring.dense.maps import MapOptions
    from simtest.nightly.run import Outcome

RUNS = Path("reports/runs")
MESHES = (".ply", ".obj", ".stl", ".vtk")
"""Suffixes of files that may be taken for an experiment by mistake."""


@command
def validate(
    experiment: Annotated[str, named("experiments", files=True)],
    /,
    *,
    out: Annotated[Path | None, path("Folder of the run; default reports/runs/EXPERIMENT.", OUT)] = None,
    realisations: Realisations = None,
    seed: Seed = None,
    views: Views = None,
    settings: Settings = None,
    estimators: Estimators = None,
    variant: Variant = None,
    engine: EngineOptions = ONE_PROCESS,
    calibrated: RegionOptions = NO_REGIONS,
    export: Annotated[Path | None, path("Folder for the frames without their truth, for methods elsewhere.")] = None,
    charts: Annotated[bool, flag("Write the page's charts as PNG files too.")] = False,
) -> Told:
    """Run an experiment and write results.parquet, summary.json and index.html; a stopped run goes on.

    Parameters
    ----------
    experiment : str
        An experiment file, or the name of a shipped one: overview, curvature, light_offset, grid, laws, compare,
        known_light, sensor, reflectance, relief, interreflection, rig, camera, motion, anatomy, anatomy_sensor, dense,
        colon, liver, mesh, paper, paper_limits.
    """
    from simtest.api import validate as run
    from simtest.rendering.backend import needs_gpu
    from simtest.spec import load_experiment
    from simtest.validation.mesh_verdicts import mesh_verdicts

    if Path(experiment).suffix.lower() in MESHES:
        raise InputError(f"{experiment}: is a mesh; use simtest validate mesh --set surface.path={experiment}")
    values = values_of(settings, realisations=realisations, seed=seed, estimators=estimators, viewpoints=views)
    described = load_experiment(experiment, values)
    if (regions := calibrated.read()) is not None:
        described = described.model_copy(update={"regions": regions})
    meshes = mesh_verdicts(described)
    for mesh in meshes:
        if not mesh.usable:
            # Before the work: it takes long, and its figures may mean nothing.
            warnings.warn(str(mesh), stacklevel=1)
    with progress_bar() as progress:
        folder = out or RUNS / described.name
        chosen = engine.make(needs_gpu(variant))
        run(described, folder, None, command_line(), variant, progress, engine=chosen, export=export, charts=charts)
    exported = {} if export is None else {"export": export / "README.md"}
    # A warning has told what is wrong with a mesh, unless --quiet left it out.
    verdicts = [str(mesh) for mesh in meshes if mesh.usable or MANNERS.quiet]
    return Told(
        data=lambda: run_record(folder, meshes=meshes, **exported),
        parts=[*verdicts, lambda: print_guide(folder), folder / "index.html", *exported.values()],
    )


GUIDE_WIDTH = 80
_WIDTHS = (16, 17, 15, 10)  # of all columns but the last


def print_guide(run: Path, console: "Console | None" = None) -> None:
    """Print the guide of a run folder as a table, without colours or frames where nobody looks on at a terminal."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    if console is None:
        console = Console(emoji=False, highlight=False)
        if not console.is_terminal:
            console = Console(emoji=False, highlight=False, width=GUIDE_WIDTH)
    guide = read_guide(run)
    if guide is None:
        console.print(
            f"{run / 'guide.json'}: missing or not readable, so the methods cannot be compared", soft_wrap=True
        )
        return
    rows = guide["rows"]
    if not rows:
        console.print("No true highlight: there is nothing to compare the methods by.")
        return
    kept, more = first(rows, "as the page shows them")
    room = max(console.width, GUIDE_WIDTH) - sum(_WIDTHS) - len(_WIDTHS)

    def table(show_header: bool) -> Table:
        made = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0), show_header=show_header)
        for head, width in zip(guide["heads"], (*_WIDTHS, room), strict=True):
            made.add_column(head, width=width, overflow="fold", header_style="bold")
        return made

    console.print(table(True))
    for circumstances, group in itertools.groupby(kept, lambda row: row["circumstances"]):
        if circumstances:
            console.print(f"[bold]{escape(circumstances)}[/bold]")
        # A table of its own for each kind of light, noise and relief, all with the same columns.
        part = table(False)
        for row in group:
            tied = f"tied: {', '.join(row['ties'])}" if row["ties"] else ""
            best = "\n".join(text for text in (row["best"] or "none", tied, row.get("unranked")) if text)
            part.add_row(*map(escape, (row["surface"], best, *_figures(row))))
            for guest in row.get("guests", ()):
                own = f"{guest['estimator']}\n({guest['standing']})"
                part.add_row(*map(escape, ("", own, *_figures(guest))))
        console.print(part)
    for line in (*more, *map(escape, filter(None, (guide["shared"], guide.get("seen"))))):
        console.print(line)
    _print_practice(console, guide.get("practice") or {"rows": ()}, table)


def _print_practice(console: "Console", practice: "dict[str, Any]", table: Callable[[bool], Any]) -> None:
    """Print what practice gives below a run's own rows, each command above the rows that it measures."""
    from rich.markup import escape

    for index, (measured_by, group) in enumerate(itertools.groupby(practice["rows"], lambda row: row["command"])):
        if not index:
            console.print(f"[bold]{escape(practice['title'])}[/bold]")
        part = table(False)
        for row in group:
            part.add_row(*map(escape, (row["surface"], row["best"], *_figures(row))))
        console.print(escape(measured_by), part, sep="\n")


def _figures(row: "dict[str, Any]") -> tuple[str, str, str]:
    """Return the cells on error, answers and breaks of a row, each part on a line of its own."""
    answered = "\n".join((row["answered"], *filter(None, row["unanswered"].split(", "))))
    return row["error"].replace(" (", "\n("), answered, row["breaks"]


@Parameter(name="*")
@dataclass(frozen=True)
class HowMapsAreRead:
    """What is stated of maps of normals or depths; None: the default."""

    encoding: Annotated[
        str | None,
        about("Maps: how values hold a component: components, unit, centred or positive_z; integers: unit."),
    ] = None
    frame: Annotated[
        str | None, about("Maps: axes of the channels: opencv (default), opengl, directx, or such as x,-y,-z.")
    ] = None
    depth: Annotated[str | None, about("Maps: depths are along the axis (z, default) or the pixel's ray (ray).")] = None
    unit_mm: Annotated[
        float | None, about("Maps: mm of one unit of the depths; integers need it. Default 1 for floats.")
    ] = None

    def named(self, name: str | None) -> "MapOptions":
        """Return it with the name of the method."""
        from simtest.dataset.scoring.dense.maps import MapOptions

        return MapOptions(name, **vars(self))

    def refuse(self, **others: str | None) -> None:
        """Raise `InputError` for options of maps, these and others, where there are none."""
        for name, value in {**others, **vars(self)}.items():
            if value is not None:
                raise InputError(f"--{name.replace('_', '-')} {value}: for folders of maps alone; a table needs none")


NOTHING_STATED = HowMapsAreRead()

WORDS = ("shading",)
"""Words that stand for maps of a method of our own, where no file or folder is called so."""

ZONES = ("highlight", "all")
"""Zones that the terminal shows; the page has all."""


def is_dense(answers: Path) -> bool:
    """Return whether what is to be scored are maps: a folder, or the word for a method."""
    return answers.is_dir() or (str(answers) in WORDS and not answers.exists())


def score_dense(maps: Path, on: Path, out: Path | None, options: "MapOptions") -> Told:
    """Score maps; tell how they were read, and the figures by zone."""
    from simtest.dataset.scoring.dense.score import score_maps
    from simtest.pages.style import number

    folder = out or SCORES / (options.name or maps.resolve().name)
    # The sums over frames are held in memory alone.
    stopped = "an earlier page stays; the same command begins anew"
    with progress_bar("writing the page", stopped) as progress:
        score = score_maps(str(maps), on, folder, options, command_line(), progress)
    rows = []
    for (source, quantity, surface), cell in score.cells:
        if quantity == "angle_deg" and cell["group"] == "zone" and cell["label"] in ZONES:
            figures = [number(cell[key]) for key in ("median", "mean", "p95")]
            shares = [f"{100 * float(str(cell[key])):.1f} %" for key in ("below_11.25", "share_unanswered")]
            rows.append((source, surface, str(cell["label"]), *figures, *shares))
    heads = ("source", "surface", "zone", "median, deg", "mean", "p95", "below 11.25 deg", "unanswered")
    return Told([score.page], score.to_json, [*few(score.lines), Table(heads, rows)])


SCORES = Path("reports/scores")


@command
def score(
    answers: NamedPath,
    /,
    *,
    on: Annotated[Path, path("Run or dataset whose frames were exported; it holds export.json.")],
    out: Annotated[Path | None, path("Folder of the scored run; default reports/scores/NAME.", OUT)] = None,
    name: Annotated[str | None, about("Name of the method in the results; default that of the file.")] = None,
    engine: EngineOptions = ONE_PROCESS,
    how: HowMapsAreRead = NOTHING_STATED,
    calibrated: RegionOptions = NO_REGIONS,
) -> Told:
    """Score normals that were estimated elsewhere on exported frames, as our own estimators are scored.

    Parameters
    ----------
    answers : Path
        Table of normals, CSV or Parquet: frame, x_px, y_px, normal_x, normal_y, normal_z (docs/howto/scoring.md). Or a
        folder of maps of normals or depths, or the word shading, for a score of every pixel (docs/howto/scoring.md).
    """
    if is_dense(answers):
        calibrated.refuse()
        return score_dense(answers, on, out, how.named(name))
    how.refuse()
    from simtest.dataset.scoring.score import score_table
    from simtest.report import write_report

    folder = out or SCORES / (name or answers.stem)
    with progress_bar() as progress:
        run = score_table(answers, on, folder, name, command_line(), engine.make(), progress, calibrated.read())
        page = write_report(run.folder, progress)
    return Told(data=lambda: run_record(folder), parts=[lambda: print_guide(folder), page])


core = App(name="core", help="Check a reconstruction core that runs as a command of its own.")


@core.command
@command
def check(command: str, /) -> Told:
    """Check a core against the process protocol, step by step; exit 1 if a step is wrong.

    The core is started, asked about highlights whose normals are known by formula, and ended. Each step has a line:
    ok, or what is wrong and what is expected.

    Parameters
    ----------
    command : str
        The command in quotes, such as "python core.py", or the TOML file of a core.
    """
    from simtest.estimators.process.check import check_core

    report = check_core(command)
    return Told(data=report.to_json, parts=report.lines(), code=0 if report.is_ok else 1)


nightly = App(name="nightly", help="Run the fixed experiments, compare with the baseline, write the page.")

ProfileName = Annotated[
    str, named("profiles", files=True, help="A profile file, or the name of a shipped one: quick, full.")
]
ReportsFolder = Annotated[Path, path("Folder of history, baselines and pages.", "--reports")]
DEFAULT_REPORTS = Path("reports")


@nightly.default
@command
def run_nightly(
    *,
    profile: ProfileName = "quick",
    reports: ReportsFolder = DEFAULT_REPORTS,
    variant: Variant = None,
    engine: EngineName = "local",
    workers: Annotated[int | None, whole("Processes that work at once; default one for each core, 8 at most.")] = None,
    address: Address = None,
) -> Told:
    """Run a profile; exit 0 fine, 1 a regression or a change to explain, 2 it could not be run.

    The night is kept in the history, compared with the accepted baseline, and its page written.
    """
    from simtest.nightly.run import RunOptions
    from simtest.nightly.run import run_nightly as run_profile
    from simtest.nightly.store import Reports
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.processes import make_engine
    from simtest.spec import load_profile

    stopped = "nothing of this night is kept; history, baseline and the last page are as they were"
    with progress_bar("writing the page", stopped) as progress:
        described, count = load_profile(profile), _cores() if workers is None else workers
        chosen = make_engine(engine, count, address, gpu=needs_gpu(variant))
        options = RunOptions(command_line(), variant, chosen, count, progress)
        outcome = run_profile(described, Reports(reports), options)
    code = outcome.judged.verdict.exit_code
    return Told([outcome.folder / "index.html"], lambda: _verdict(outcome), _night_parts(outcome), code)


@nightly.command
@command
def accept(
    *,
    reason: Annotated[str, about("Why these numbers are right; stored with them.")],
    profile: ProfileName = "quick",
    reports: ReportsFolder = DEFAULT_REPORTS,
) -> Told:
    """Make the last night's numbers the baseline."""
    from simtest.nightly.store import Reports, log_note
    from simtest.nightly.store import accept as accept_night
    from simtest.spec import load_profile

    folder, name = Reports(reports), load_profile(profile).name
    note = log_note(folder, name)
    accepted = accept_night(folder, name, reason)
    told = {"baseline": accepted.id, "profile": accepted.profile, "reason": accepted.reason, "note": note}
    line = f"{accepted.id} is the baseline of {accepted.profile}: {accepted.reason}"
    return Told(data=told, parts=[note, line] if note else [line])


def _cores() -> int:
    import os

    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def _verdict(outcome: "Outcome") -> dict[str, Any]:
    """Read the verdict as it stands in the folder of the last run."""
    from simtest.nightly.outputs import VERDICT

    verdict: dict[str, Any] = json.loads((outcome.folder / VERDICT).read_text(encoding="utf-8"))
    return verdict


def _night_parts(outcome: "Outcome") -> "Iterator[str | Table]":
    """Yield what the gate says, and a table by experiment."""
    from simtest.nightly.records import OUTCOMES
    from simtest.nightly.words import headline

    judged, verdict = outcome.judged, outcome.judged.verdict
    counts = OUTCOMES if verdict.baseline is not None else ()
    columns = ("experiment", "rows", "answered", "missed", "false", *counts)
    rows = [
        ["" if value is None else str(value) for value in values]
        for values in judged.by_experiment().select(columns).iter_rows()
    ]
    yield Table(columns, rows, title=f"{judged.run.record.profile}: {headline(verdict)}")
    # The cause first, then what else a reader must know.
    yield from verdict.causes
    yield from verdict.notes


bench = App(name="bench", help="Run the frozen benchmark, make a table of its certificates.")

BENCH_WIDTH = 185
"""Columns of the table of parts; in fewer its words would be cut."""

SuiteVersion = Annotated[str, about("Version of the suite.", "--suite")]


@bench.command
@command
def run(
    *,
    out: Out,
    core: Annotated[str | None, about('Estimator by name, or a command: "command: ./core --flag".')] = None,
    maps: Annotated[Path | None, path("Folder of maps for the part dense, in place of a core; or shading.")] = None,
    name: Annotated[str | None, about("Maps: name of the method; default that of the folder.")] = None,
    how: HowMapsAreRead = NOTHING_STATED,
    parts: Annotated[list[str] | None, flag("Run this part alone; may be repeated.", "--part")] = None,
    suite: SuiteVersion = "v1",
    engine: EngineOptions = ONE_PROCESS,
    calibrated: RegionOptions = NO_REGIONS,
) -> Told:
    """Run a core on the frozen cases; print its table and write certificate.json. A stopped run goes on."""
    from simtest.bench.run import run_bench, run_maps
    from simtest.bench.suite import load_suite

    if (core is None) == (maps is None):
        raise InputError("--core and --maps: give one of them; --maps runs the part dense, --core all others")
    if core is None and parts not in (None, ["dense"]):
        raise InputError(f"--part {parts[0] if parts else ''}: maps are scored on the part dense alone")
    if core is None:
        calibrated.refuse()
    read, chosen = load_suite(suite), engine.make()
    stopped = "finished frames are kept; the same command scores all maps anew" if core is None else ""
    with exclusive_folder(out), progress_bar(stopped=stopped) as progress:
        if core is None:
            made = run_maps(read, maps or "", out, how.named(name), chosen, progress)
        else:
            how.refuse(name=name)
            made = run_bench(read, core, out, parts, chosen, progress, regions=calibrated.read())
    return Told([made.certificate], made.content, _part_rows(made.content))


@bench.command
@command
def table(
    folder: Path,
    /,
    *,
    out: Annotated[Path, path("The page; or a folder, which gets index.html.", OUT)],
    suite: SuiteVersion = "v1",
) -> Told:
    """Make a page that ranks the certificates below a folder.

    Parameters
    ----------
    folder : Path
        Holds certificates, at any depth.
    """
    from simtest.bench.suite import load_suite
    from simtest.bench.table import read_entries, write_leaderboard

    read = load_suite(suite)
    board = read_entries(folder, read)
    return Told([write_leaderboard(read, board, out)], board.to_json)


@bench.command
@command
def frames(*, out: Out, suite: SuiteVersion = "v1", engine: EngineOptions = ONE_PROCESS) -> Told:
    """Write the frames of the part dense without their truth, for methods that give maps."""
    from simtest.bench.run import export_frames
    from simtest.bench.suite import load_suite

    read = load_suite(suite)
    with exclusive_folder(out), progress_bar() as progress:
        return Told([export_frames(read, out, engine.make(), progress)])


@bench.command
@command
def cases(*, suite: SuiteVersion = "v1") -> Told:
    """List the frozen cases with their hashes."""
    from simtest.bench.suite import load_suite

    read = load_suite(suite)
    rows = [
        (case.name, str(case.spec.draws), str(case.spec.draws * case.spec.realisations), case.digest[:16])
        for case in read.cases
    ]
    record = {"suite": read.spec.name, "version": suite, "sha256": read.digest, "cases": read.hashes}
    title = f"{read.spec.title}: {read.digest}"
    return Told(data=record, parts=[Table(("case", "scenes", "frames", "sha256"), rows, title)])


def _part_rows(content: dict[str, Any]) -> "Iterator[str | Table]":
    """Yield a row for each part, the reasons of its refusals, and the headline."""
    from simtest.bench.table import COLUMNS, part_cells, refusals

    rows = [(part, *part_cells(told)) for part, told in content["parts"].items()]
    title = f"{content['core']['name']} on {content['suite']['version']}"
    yield Table(("part", *COLUMNS), rows, title, BENCH_WIDTH)
    yield from refusals(content["parts"])
    overall = content["overall"]
    if overall["complete"]:
        yield f"overall: {overall['score_deg']:.3f} deg, the mean of the parts' scores"
