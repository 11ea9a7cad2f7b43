"""`simtest nightly`: measure a night, judge it, accept it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from simtest.cli.options import Address, AsJson, EngineName, Variant, named, named_path, whole_number

if TYPE_CHECKING:
    from simtest.nightly.run import Outcome

nightly = App(name="nightly", help="Run the fixed experiments, compare with the baseline, write the page.")

ProfileName = Annotated[
    str, named("profiles", files=True, help="A profile file, or the name of a shipped one: quick, full.")
]
ReportsFolder = Annotated[
    Path, Parameter(name="--reports", help="Folder of history, baselines and pages.", converter=named_path)
]
DEFAULT_REPORTS = Path("reports")


@nightly.default
def run(
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
    import shlex
    import sys

    from simtest.cli.progress import progress_bar
    from simtest.nightly.run import RunOptions, run_nightly
    from simtest.nightly.store import Reports
    from simtest.rendering.backend import needs_gpu
    from simtest.runtime.engines import make_engine
    from simtest.spec import load_profile

    described = load_profile(profile)
    command = shlex.join(["simtest", *sys.argv[1:]])
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
    from simtest.cli.printing import print_json
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

    from simtest.cli.printing import print_files
    from simtest.nightly.outputs import VERDICT

    told = json.loads((outcome.folder / VERDICT).read_text(encoding="utf-8"))
    print_files([outcome.folder / "index.html"], True, **told)


def _print(outcome: "Outcome") -> None:
    """Print what the gate says, a table by experiment, and where the page lies."""
    from simtest.cli.printing import print_table
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
