"""`simtest bench`: run the frozen benchmark, make the table."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from simtest.cli.dense_score import MapDepth, MapEncoding, MapFrame, MapUnit, refuse_dense_options
from simtest.cli.options import Address, AsJson, EngineName, Out, Workers, named_path
from simtest.errors import InputError

bench = App(name="bench", help="Run the frozen benchmark, make a table of its certificates.")

WIDTH = 170
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
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Run a core on the frozen cases; print its table and write certificate.json. A stopped run goes on."""
    from simtest.bench.run import run_bench, run_maps
    from simtest.bench.suite import load_suite
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.dataset.scoring.dense.conventions import MapOptions
    from simtest.runtime.engines import make_engine
    from simtest.runtime.locks import exclusive_folder

    if (core is None) == (maps is None):
        raise InputError("--core and --maps: give one of them; --maps runs the part dense, --core all others")
    if core is None and parts not in (None, ["dense"]):
        raise InputError(f"--part {parts[0] if parts else ''}: maps are scored on the part dense alone")
    read, chosen = load_suite(suite), make_engine(engine, workers, address)
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
    from simtest.cli.printing import print_files

    read = load_suite(suite)
    board = read_entries(folder, read)
    page = write_leaderboard(read, board, out)
    print_files([page], as_json, **(board.to_json() if as_json else {}))


@bench.command
def frames(
    *,
    out: Out,
    suite: SuiteVersion = "v1",
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Write the frames of the part dense without their truth, for methods that give maps."""
    from simtest.bench.run import export_frames
    from simtest.bench.suite import load_suite
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.runtime.engines import make_engine
    from simtest.runtime.locks import exclusive_folder

    read = load_suite(suite)
    with exclusive_folder(out), progress_bar() as progress:
        folder = export_frames(read, out, make_engine(engine, workers, address), progress)
    print_files([folder], as_json)


@bench.command
def cases(*, suite: SuiteVersion = "v1", as_json: AsJson = False) -> None:
    """List the frozen cases with their hashes."""
    from simtest.bench.suite import load_suite
    from simtest.cli.printing import print_json, print_table

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
    from simtest.cli.printing import print_table

    rows = [(part, *part_cells(told)) for part, told in content["parts"].items()]
    print_table(
        ("part", *COLUMNS), rows, title=f"{content['core']['name']} on {content['suite']['version']}", width=WIDTH
    )
    print(*refusals(content["parts"]), sep="\n", end="\n" * bool(refusals(content["parts"])))
    overall = content["overall"]
    if overall["complete"]:
        print(f"overall: {overall['score_deg']:.3f} deg, the mean of the parts' scores")
