"""Commands that run experiments and judge methods: validate, score, core, nightly, bench."""

import itertools
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from simtest.cli.common import (
    MOST_ROWS,
    ONE_PROCESS,
    Address,
    AsJson,
    EngineName,
    EngineOptions,
    Estimators,
    Out,
    Realisations,
    Seed,
    Settings,
    Variant,
    Views,
    command_line,
    named,
    named_path,
    print_files,
    print_json,
    print_lines,
    print_rest,
    print_run,
    print_table,
    read_guide,
    whole_number,
)
from simtest.cli.main import MANNERS
from simtest.cli.progress import progress_bar
from simtest.errors import InputError
from simtest.runtime.locks import exclusive_folder

if TYPE_CHECKING:
    from rich.console import Console

    from simtest.nightly.run import Outcome

RUNS = Path("reports/runs")
MESHES = (".ply", ".obj", ".stl", ".vtk")
"""Suffixes of files that may be taken for an experiment by mistake."""


def validate(
    experiment: Annotated[str, named("experiments", files=True)],
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder of the run; default reports/runs/EXPERIMENT.", converter=named_path)
    ] = None,
    realisations: Realisations = None,
    seed: Seed = None,
    views: Views = None,
    settings: Settings = None,
    estimators: Estimators = None,
    variant: Variant = None,
    engine: EngineOptions = ONE_PROCESS,
    export: Annotated[
        Path | None,
        Parameter(help="Folder for the frames without their truth, for methods elsewhere.", converter=named_path),
    ] = None,
    charts: Annotated[bool, Parameter(negative="", help="Write the page's charts as PNG files too.")] = False,
    as_json: AsJson = False,
) -> None:
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
    from simtest.spec import load_experiment, parse_settings
    from simtest.validation.mesh_verdicts import mesh_verdicts

    if Path(experiment).suffix.lower() in MESHES:
        raise InputError(f"{experiment}: is a mesh; use simtest validate mesh --set surface.path={experiment}")
    values = parse_settings(settings or [])
    own = {"realisations": realisations, "seed": seed, "estimators": estimators, "viewpoints": views}
    values |= {key: value for key, value in own.items() if value is not None}
    described = load_experiment(experiment, values)
    meshes = mesh_verdicts(described)
    for mesh in meshes:
        if not mesh.usable:
            # Before the work: it takes long, and its figures may mean nothing.
            warnings.warn(str(mesh), stacklevel=1)
    command = command_line()
    with progress_bar() as progress:
        folder = out or RUNS / described.name
        chosen = engine.make(needs_gpu(variant))
        run(described, folder, None, command, variant, progress, engine=chosen, export=export, charts=charts)
    if as_json:
        exported = {} if export is None else {"export": export / "README.md"}
        print_run(folder, meshes=meshes, **exported)
        return
    # A warning has told what is wrong with a mesh, unless --quiet left it out.
    verdicts = [mesh for mesh in meshes if mesh.usable or MANNERS.quiet]
    print(*verdicts, sep="\n", end="\n" * bool(verdicts))
    print_guide(folder)
    print(folder / "index.html")
    if export is not None:
        print(export / "README.md")


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
    kept = rows if MANNERS.verbose else rows[:MOST_ROWS]
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
    print_rest(len(rows) - len(kept), "as the page shows them", console.print)
    for sentence in filter(None, (guide["shared"], guide.get("seen"))):
        console.print(escape(sentence))


def _figures(row: "dict[str, Any]") -> tuple[str, str, str]:
    """Return the cells on error, answers and breaks of a row, each part on a line of its own."""
    answered = "\n".join((row["answered"], *filter(None, row["unanswered"].split(", "))))
    return row["error"].replace(" (", "\n("), answered, row["breaks"]


MapEncoding = Annotated[
    str | None,
    Parameter(help="Maps: how values hold a component: components, unit, centred or positive_z; integers: unit."),
]
MapFrame = Annotated[
    str | None,
    Parameter(help="Maps: axes of the channels: opencv (default), opengl, directx, or such as x,-y,-z."),
]
MapDepth = Annotated[
    str | None, Parameter(help="Maps: depths are along the axis (z, default) or the pixel's ray (ray).")
]
MapUnit = Annotated[
    float | None, Parameter(help="Maps: mm of one unit of the depths; integers need it. Default 1 for floats.")
]

WORDS = ("shading",)
"""Words that stand for maps of a method of our own, where no file or folder is called so."""

ZONES = ("highlight", "all")
"""Zones that the terminal shows; the page has all."""


def is_dense(answers: Path) -> bool:
    """Return whether what is to be scored are maps: a folder, or the word for a method."""
    return answers.is_dir() or (str(answers) in WORDS and not answers.exists())


def refuse_dense_options(**options: object) -> None:
    """Raise `InputError` for options of maps where a table is scored."""
    for name, value in options.items():
        if value is not None:
            raise InputError(f"--{name.replace('_', '-')} {value}: for folders of maps alone; a table needs none")


def score_dense(
    maps: Path, on: Path, out: Path | None, name: str | None, encoding: str | None, frame: str | None,
    depth: str | None, unit_mm: float | None, as_json: bool,
) -> None:  # fmt: skip
    """Score maps, print how they were read and the figures by zone, and name the page."""
    from simtest.dataset.scoring.dense import MapOptions, score_maps
    from simtest.pages.style import number

    command = command_line()
    folder = out or Path("reports/scores") / (name or maps.resolve().name)
    options = MapOptions(name, encoding, frame, depth, unit_mm)
    try:
        with progress_bar("writing the page") as progress:
            score = score_maps(str(maps), on, folder, options, command, progress)
    except KeyboardInterrupt:
        # The sums over frames are held in memory alone.
        raise KeyboardInterrupt("an earlier page stays; the same command begins anew") from None
    if as_json:
        print_files([score.page], as_json, **score.to_json())
        return
    print_lines(score.lines)
    rows = []
    for (source, quantity, surface), cell in score.scorer.cells():
        if quantity == "angle_deg" and cell["group"] == "zone" and cell["label"] in ZONES:
            figures = [number(cell[key]) for key in ("median", "mean", "p95")]
            shares = [f"{100 * float(str(cell[key])):.1f} %" for key in ("below_11.25", "share_unanswered")]
            rows.append((source, surface, str(cell["label"]), *figures, *shares))
    heads = ("source", "surface", "zone", "median, deg", "mean", "p95", "below 11.25 deg", "unanswered")
    print_table(heads, rows)
    print(score.page)


SCORES = Path("reports/scores")


def score(
    answers: Annotated[Path, Parameter(converter=named_path)],
    /,
    *,
    on: Annotated[
        Path,
        Parameter(help="Run or dataset whose frames were exported; it holds export.json.", converter=named_path),
    ],
    out: Annotated[
        Path | None, Parameter(help="Folder of the scored run; default reports/scores/NAME.", converter=named_path)
    ] = None,
    name: Annotated[str | None, Parameter(help="Name of the method in the results; default that of the file.")] = None,
    engine: EngineOptions = ONE_PROCESS,
    encoding: MapEncoding = None,
    frame: MapFrame = None,
    depth: MapDepth = None,
    unit_mm: MapUnit = None,
    as_json: AsJson = False,
) -> None:
    """Score normals that were estimated elsewhere on exported frames, as our own estimators are scored.

    Parameters
    ----------
    answers : Path
        Table of normals, CSV or Parquet: frame, x_px, y_px, normal_x, normal_y, normal_z (docs/howto/score.md). Or a
        folder of maps of normals or depths, or the word shading, for a score of every pixel (docs/howto/dense.md).
    """
    if is_dense(answers):
        score_dense(answers, on, out, name, encoding, frame, depth, unit_mm, as_json)
        return
    refuse_dense_options(encoding=encoding, frame=frame, depth=depth, unit_mm=unit_mm)
    from simtest.dataset.scoring.run import score_table
    from simtest.report import write_report

    command = command_line()
    folder = out or SCORES / (name or answers.stem)
    with progress_bar() as progress:
        chosen = engine.make()
        run = score_table(answers, on, folder, name, command, chosen, progress)
        page = write_report(run.folder, progress)
    if as_json:
        print_run(folder)
        return
    print_guide(folder)
    print(page)


core = App(name="core", help="Check a reconstruction core that runs as a command of its own.")


@core.command
def check(command: str, /, *, as_json: AsJson = False) -> int:
    """Check a core against the process protocol, step by step; exit 1 if a step is wrong.

    The core is started, asked about highlights whose normals are known by formula, and ended. Each step has a line:
    ok, or what is wrong and what is expected.

    Parameters
    ----------
    command : str
        The command in quotes, such as "python core.py", or the TOML file of a core.
    """
    from simtest.validation.core_check import check_core

    report = check_core(command)
    if as_json:
        print_json(report.to_json())
    else:
        for line in report.lines():
            print(line)
    return 0 if report.is_ok else 1


nightly = App(name="nightly", help="Run the fixed experiments, compare with the baseline, write the page.")

ProfileName = Annotated[
    str, named("profiles", files=True, help="A profile file, or the name of a shipped one: quick, full.")
]
ReportsFolder = Annotated[
    Path, Parameter(name="--reports", help="Folder of history, baselines and pages.", converter=named_path)
]
DEFAULT_REPORTS = Path("reports")


@nightly.default
def run_nightly(
    *,
    profile: ProfileName = "quick",
    reports: ReportsFolder = DEFAULT_REPORTS,
    variant: Variant = None,
    engine: EngineName = "local",
    workers: Annotated[
        int | None,
        Parameter(help="Processes that work at once; default one for each core, 8 at most.", converter=whole_number),
    ] = None,
    address: Address = None,
    as_json: AsJson = False,
) -> int:
    """Run a profile; exit 0 fine, 1 a regression or a change to explain, 2 it could not be run.

    The night is kept in the history, compared with the accepted baseline, and its page written.
    """
    try:
        outcome = _run(profile, reports, variant, engine, workers, address)
    except KeyboardInterrupt as stop:
        nothing = "nothing of this night is kept; history, baseline and the last page are as they were"
        raise KeyboardInterrupt(str(stop) or nothing) from None
    if as_json:
        _print_json(outcome)
    else:
        _print(outcome)
    return outcome.judged.verdict.exit_code


def _run(
    profile: str, reports: Path, variant: str | None, engine: str, workers: int | None, address: str | None
) -> "Outcome":
    from simtest.nightly.run import RunOptions, run_nightly
    from simtest.nightly.store import Reports
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.processes import make_engine
    from simtest.spec import load_profile

    described = load_profile(profile)
    command = command_line()
    count = _cores() if workers is None else workers
    chosen = make_engine(engine, count, address, gpu=needs_gpu(variant))
    with progress_bar("writing the page") as progress:
        return run_nightly(described, Reports(reports), RunOptions(command, variant, chosen, count, progress))


@nightly.command
def accept(
    *,
    reason: Annotated[str, Parameter(help="Why these numbers are right; stored with them.")],
    profile: ProfileName = "quick",
    reports: ReportsFolder = DEFAULT_REPORTS,
    as_json: AsJson = False,
) -> None:
    """Make the last night's numbers the baseline."""
    from simtest.nightly.store import Reports, log_note
    from simtest.nightly.store import accept as accept_night
    from simtest.spec import load_profile

    folder, name = Reports(reports), load_profile(profile).name
    note = log_note(folder, name)
    if note and not as_json:
        print(note)
    accepted = accept_night(folder, name, reason)
    if as_json:
        print_json({"baseline": accepted.id, "profile": accepted.profile, "reason": accepted.reason, "note": note})
        return
    print(f"{accepted.id} is the baseline of {accepted.profile}: {accepted.reason}")


def _cores() -> int:
    import os

    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


def _print_json(outcome: "Outcome") -> None:
    """Print the verdict as it stands in the folder of the last run, with the page."""
    import json

    from simtest.nightly.outputs import VERDICT

    told = json.loads((outcome.folder / VERDICT).read_text(encoding="utf-8"))
    print_files([outcome.folder / "index.html"], True, **told)


def _print(outcome: "Outcome") -> None:
    """Print what the gate says, a table by experiment, and where the page lies."""
    from simtest.nightly.phrases import headline
    from simtest.nightly.records import OUTCOMES

    judged, verdict = outcome.judged, outcome.judged.verdict
    counts = OUTCOMES if verdict.baseline is not None else ()
    columns = ("experiment", "rows", "answered", "missed", "false", *counts)
    rows = [
        ["" if value is None else str(value) for value in values]
        for values in judged.by_experiment().select(columns).iter_rows()
    ]
    print_table(columns, rows, title=f"{judged.run.record.profile}: {headline(verdict)}")
    # The cause first, then what else a reader must know.
    print(*verdict.causes, sep="\n", end="\n" * bool(verdict.causes))
    print(*verdict.notes, sep="\n", end="\n" * bool(verdict.notes))
    print(outcome.folder / "index.html")


bench = App(name="bench", help="Run the frozen benchmark, make a table of its certificates.")

BENCH_WIDTH = 170
"""Columns of the table of parts; in fewer its words would be cut."""

SuiteVersion = Annotated[str, Parameter(name="--suite", help="Version of the suite.")]
Core = Annotated[str | None, Parameter(help='Estimator by name, or a command: "command: ./core --flag".')]
Maps = Annotated[
    Path | None,
    Parameter(help="Folder of maps for the part dense, in place of a core; or shading.", converter=named_path),
]


@bench.command
def run(
    *,
    out: Out,
    core: Core = None,
    maps: Maps = None,
    name: Annotated[str | None, Parameter(help="Maps: name of the method; default that of the folder.")] = None,
    encoding: MapEncoding = None,
    frame: MapFrame = None,
    depth: MapDepth = None,
    unit_mm: MapUnit = None,
    parts: Annotated[
        list[str] | None, Parameter(name="--part", negative="", help="Run this part alone; may be repeated.")
    ] = None,
    suite: SuiteVersion = "v1",
    engine: EngineOptions = ONE_PROCESS,
    as_json: AsJson = False,
) -> None:
    """Run a core on the frozen cases; print its table and write certificate.json. A stopped run goes on."""
    from simtest.bench.run import run_bench, run_maps
    from simtest.bench.suite import load_suite
    from simtest.dataset.scoring.dense.conventions import MapOptions

    if (core is None) == (maps is None):
        raise InputError("--core and --maps: give one of them; --maps runs the part dense, --core all others")
    if core is None and parts not in (None, ["dense"]):
        raise InputError(f"--part {parts[0] if parts else ''}: maps are scored on the part dense alone")
    read, chosen = load_suite(suite), engine.make()
    with exclusive_folder(out), progress_bar() as progress:
        if core is None:
            options = MapOptions(name, encoding, frame, depth, unit_mm)
            try:
                made = run_maps(read, maps or "", out, options, chosen, progress)
            except KeyboardInterrupt:
                raise KeyboardInterrupt("finished frames are kept; the same command scores all maps anew") from None
        else:
            refuse_dense_options(name=name, encoding=encoding, frame=frame, depth=depth, unit_mm=unit_mm)
            made = run_bench(read, core, out, parts, chosen, progress)
    if as_json:
        print_files([made.certificate], True, **made.content)
        return
    _print_parts(made.content)
    print(made.certificate)


@bench.command
def table(
    folder: Path,
    /,
    *,
    out: Annotated[Path, Parameter(help="The page; or a folder, which gets index.html.", converter=named_path)],
    suite: SuiteVersion = "v1",
    as_json: AsJson = False,
) -> None:
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
    page = write_leaderboard(read, board, out)
    print_files([page], as_json, **(board.to_json() if as_json else {}))


@bench.command
def frames(
    *,
    out: Out,
    suite: SuiteVersion = "v1",
    engine: EngineOptions = ONE_PROCESS,
    as_json: AsJson = False,
) -> None:
    """Write the frames of the part dense without their truth, for methods that give maps."""
    from simtest.bench.run import export_frames
    from simtest.bench.suite import load_suite

    read = load_suite(suite)
    with exclusive_folder(out), progress_bar() as progress:
        folder = export_frames(read, out, engine.make(), progress)
    print_files([folder], as_json)


@bench.command
def cases(*, suite: SuiteVersion = "v1", as_json: AsJson = False) -> None:
    """List the frozen cases with their hashes."""
    from simtest.bench.suite import load_suite

    read = load_suite(suite)
    if as_json:
        print_json({"suite": read.spec.name, "version": suite, "sha256": read.digest, "cases": read.hashes})
        return
    rows = [
        (case.name, str(case.spec.draws), str(case.spec.draws * case.spec.realisations), case.digest[:16])
        for case in read.cases
    ]
    print_table(("case", "scenes", "frames", "sha256"), rows, title=f"{read.spec.title}: {read.digest}")


def _print_parts(content: dict[str, Any]) -> None:
    """Print a row for each part, the reasons of its refusals, and the headline."""
    from simtest.bench.table import COLUMNS, part_cells, refusals

    rows = [(part, *part_cells(told)) for part, told in content["parts"].items()]
    print_table(
        ("part", *COLUMNS), rows, title=f"{content['core']['name']} on {content['suite']['version']}", width=BENCH_WIDTH
    )
    print(*refusals(content["parts"]), sep="\n", end="\n" * bool(refusals(content["parts"])))
    overall = content["overall"]
    if overall["complete"]:
        print(f"overall: {overall['score_deg']:.3f} deg, the mean of the parts' scores")
