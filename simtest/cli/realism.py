"""`simtest realism`."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from simtest.cli.options import AsJson, Out, Seed, whole_number

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
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.realism.comparison import compare
    from simtest.realism.frame_sets import open_frames, open_generated
    from simtest.realism.page import write_comparison
    from simtest.runtime.locks import exclusive_folder

    real, generated = open_frames(frames), open_generated(against, count, surfaces or ())
    command = shlex.join(["simtest", *sys.argv[1:]])
    try:
        with exclusive_folder(out), progress_bar("compared") as progress:
            found = compare(real, generated, progress, seed or 0)
            page = write_comparison(found, out, against, command, progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("an earlier page stays; the same command begins anew") from None
    if as_json:
        print_files([page], as_json, **found.to_json())
        return
    _print_table(found)
    print(page)


def _print_table(found: "Comparison") -> None:
    from simtest.cli.printing import print_lines, print_table
    from simtest.realism.distance import distance_text

    rows = []
    for d in found.distances:
        interval = f"{distance_text(d.interval[0])} to {distance_text(d.interval[1])}"
        counts = f"{d.n_real} / {d.n_generated}"
        rows.append((d.statistic.title, distance_text(d.distance), interval, counts, d.verdict))
    print_table(("statistic", "distance", "95 % interval", "scenes, real / generated", "verdict"), rows)
    print_lines([f"left out: {frame.frame}: {frame.reason}" for frame in found.left_out])
    print(found.verdict)
