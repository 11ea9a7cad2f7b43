"""`simtest bench`: run the frozen benchmark, verify a certificate, make the table, seal seeds."""

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter

from simtest.cli.dense_score import MapDepth, MapEncoding, MapFrame, MapUnit, refuse_dense_options
from simtest.cli.options import Address, AsJson, EngineName, Out, Workers, named_path
from simtest.errors import InputError

if TYPE_CHECKING:
    from simtest.bench.draws import Seeds
    from simtest.bench.suite import Suite

bench = App(name="bench", help="Run the frozen benchmark, verify its certificates, make a table of them.")

WIDTH = 170
"""Columns of the table of parts; in fewer its words would be cut."""

SuiteVersion = Annotated[str, Parameter(name="--suite", help="Version of the suite.")]
Sealed = Annotated[
    Path | None,
    Parameter(help="File of sealed seeds, - for standard input; default the public seeds.", converter=named_path),
]
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
    sealed: Sealed = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Run a core on the frozen cases; print its table and write certificate.json. A stopped run goes on."""
    from simtest.bench.certificate import CERTIFICATE
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
    read = load_suite(suite)
    seeds, chosen = _seeds(read, sealed), make_engine(engine, workers, address)
    with exclusive_folder(out), progress_bar() as progress:
        if core is None:
            options = MapOptions(name, encoding, frame, depth, unit_mm)
            with _told_when_stopped("finished frames are kept; the same command scores all maps anew"):
                made = run_maps(read, maps or "", out, seeds, options, chosen, progress)
        else:
            refuse_dense_options(name=name, encoding=encoding, frame=frame, depth=depth, unit_mm=unit_mm)
            made = run_bench(read, core, out, seeds, parts, chosen, progress)
    if as_json:
        print_files([made.certificate], True, **made.content)
        return
    _print_parts(made.content)
    print(made.certificate)
    if sealed is not None:
        print(f"sealed: the folders in {out} tell what the seeds draw; publish {CERTIFICATE} alone until they are open")


@bench.command
def verify(
    certificate: Path,
    /,
    *,
    out: Annotated[
        Path | None, Parameter(help="Folder of the run; default one that is removed afterwards.", converter=named_path)
    ] = None,
    core: Annotated[
        str | None, Parameter(help="How the core is started here; default the name in the certificate.")
    ] = None,
    maps: Annotated[
        Path | None, Parameter(help="Folder of the maps that the certificate is of.", converter=named_path)
    ] = None,
    sealed: Sealed = None,
    verified: Annotated[
        Path | None, Parameter(help="List that gets the finding, for bench table.", converter=named_path)
    ] = None,
    quick: Annotated[bool, Parameter(negative="", help="Check hashes and consistency alone; run nothing.")] = False,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> int:
    """Run the core of a certificate again and compare; exit 0 where it holds, 1 where not.

    Parameters
    ----------
    certificate : Path
        certificate.json, or its folder.
    """
    from tempfile import TemporaryDirectory

    from simtest.bench.certificate import read_certificate
    from simtest.bench.suite import load_suite
    from simtest.bench.verified import keep_verified
    from simtest.bench.verify import check_quick, check_seeds, verify_run
    from simtest.cli.printing import print_json
    from simtest.cli.progress import progress_bar
    from simtest.runtime.engines import make_engine

    if quick and verified is not None:
        raise InputError("--verified: lists certificates that were run again; leave out --quick")
    told = read_certificate(certificate)
    suite = load_suite(str(told.content["suite"].get("version")))
    if quick:
        if sealed is not None:
            check_seeds(told, suite, _seeds(suite, sealed))
        found = check_quick(told, suite)
    else:
        seeds = _seeds(suite, sealed)
        with TemporaryDirectory() if out is None else nullcontext(str(out)) as folder, progress_bar() as progress:
            chosen = make_engine(engine, workers, address)
            with nullcontext() if out else _told_when_stopped("without --out nothing is kept"):
                found = verify_run(told, suite, Path(folder), seeds, core, maps, chosen, progress)
        if verified is not None:
            keep_verified(verified, told, found)
    if as_json:
        print_json({**found.to_json(), "run_again": not quick})
    else:
        print(*found.notes, *found.problems, sep="\n")
        holds = "the certificate is consistent; nothing was run" if quick else "the certificate holds: it was run again"
        print(holds if found.holds else f"{len(found.problems)} things speak against it")
    return 0 if found.holds else 1


@bench.command
def table(
    folder: Path,
    /,
    *,
    out: Annotated[Path, Parameter(help="The page; or a folder, which gets index.html.", converter=named_path)],
    suite: SuiteVersion = "v1",
    verified: Annotated[
        Path | None, Parameter(help="List of the certificates that bench verify has run again.", converter=named_path)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a page that ranks the certificates below a folder.

    Parameters
    ----------
    folder : Path
        Holds certificates, at any depth.
    """
    from simtest.bench.leaderboard import read_entries, write_leaderboard
    from simtest.bench.suite import load_suite
    from simtest.bench.verified import read_verified
    from simtest.cli.printing import print_files

    read = load_suite(suite)
    boards = read_entries(folder, read, None if verified is None else read_verified(verified, required=True))
    page = write_leaderboard(read, boards, out)
    print_files([page], as_json, **({"boards": [board.to_json() for board in boards]} if as_json else {}))


@bench.command
def seal(*, out: Out, suite: SuiteVersion = "v1", as_json: AsJson = False) -> None:
    """Draw sealed seeds: a file that you keep secret, and the commitment that you publish."""
    from simtest.bench.seal import COMMITMENT, SEALED
    from simtest.bench.seal import seal as draw
    from simtest.bench.suite import load_suite
    from simtest.cli.printing import print_files

    commitment = draw(load_suite(suite), out)
    if not as_json:
        print(f"commitment {commitment}")
    print_files([out / SEALED, out / COMMITMENT], as_json, **({"commitment": commitment} if as_json else {}))


@bench.command
def frames(
    *,
    out: Out,
    suite: SuiteVersion = "v1",
    sealed: Sealed = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    as_json: AsJson = False,
) -> None:
    """Write the frames of the part dense without their truth, for methods that give maps."""
    from simtest.bench.maps import export_frames
    from simtest.bench.suite import load_suite
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.runtime.engines import make_engine
    from simtest.runtime.locks import exclusive_folder

    read = load_suite(suite)
    with exclusive_folder(out), progress_bar() as progress:
        folder = export_frames(read, out, _seeds(read, sealed), make_engine(engine, workers, address), progress)
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


def _seeds(suite: "Suite", sealed: Path | None) -> "Seeds":
    from simtest.bench.draws import public_seeds
    from simtest.bench.seal import open_seal

    return public_seeds(suite) if sealed is None else open_seal(suite, sealed)


@contextmanager
def _told_when_stopped(kept: str) -> Iterator[None]:
    """Raise a KeyboardInterrupt that states what was kept, where the same command does not go on."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(kept) from None


def _print_parts(content: dict[str, Any]) -> None:
    """Print a row for each part, the reasons of its refusals, and the headline."""
    from simtest.bench.phrases import COLUMNS, part_cells, refusals
    from simtest.cli.printing import print_table

    rows = [(part, *part_cells(told)) for part, told in content["parts"].items()]
    print_table(
        ("part", *COLUMNS), rows, title=f"{content['core']['name']} on {content['suite']['version']}", width=WIDTH
    )
    print(*refusals(content["parts"]), sep="\n", end="\n" * bool(refusals(content["parts"])))
    request = content["timing"]["request"]
    if request["median_ms"] is not None:
        print(f"a {request['unit']} takes {request['median_ms']:.3g} ms")
    overall = content["overall"]
    if overall["complete"]:
        print(f"overall: {overall['score_deg']:.3f} deg, the mean of the parts' scores")
