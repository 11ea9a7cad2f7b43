"""`simtest realism`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from simtest.cli.options import Out, Seed, whole_number

if TYPE_CHECKING:
    from simtest.realism.comparison import Comparison


def realism(
    frames: list[Path],
    /,
    *,
    against: Annotated[str, Parameter(help="Generated frames: a dataset's folder, a folder of pictures, or a scene.")],
    out: Out,
    count: Annotated[
        int, Parameter(help="Generated frames that are taken or rendered, at most.", converter=whole_number)
    ] = 40,
    seed: Seed = None,
) -> None:
    """Measure how far generated frames are from real ones, statistic by statistic.

    Parameters
    ----------
    frames : list of Path
        Real colour frames: pictures, films, or folders of pictures. A film is one scene, and so is a folder whose name
        ends in .film; any other picture is a scene of its own.
    """
    from simtest.cli.progress import progress_bar
    from simtest.realism.comparison import compare, write_comparison
    from simtest.realism.frame_sets import open_frames, open_generated

    real, generated = open_frames(frames), open_generated(against, count)
    with progress_bar("writing") as progress:
        found = compare(real, generated, progress, seed or 0)
    path = write_comparison(found, out)
    _print_table(found)
    print(path)


def _print_table(found: "Comparison") -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("statistic", "distance", "95 % interval", "scenes, real / generated", "verdict")
    for d in found.distances:
        interval = f"{d.interval[0]:.2f} to {d.interval[1]:.2f}"
        table.add_row(d.statistic.title, f"{d.distance:.2f}", interval, f"{d.n_real} / {d.n_generated}", d.verdict)
    console = Console(width=125)
    console.print(table)
    for name, reason in found.left_out.items():
        console.print(f"left out: {name}: {reason}", highlight=False)
    console.print(found.verdict, highlight=False)
