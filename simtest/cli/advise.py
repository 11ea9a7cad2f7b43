"""`simtest advise`."""

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, Token

from simtest.cli.options import AsJson, Out, Seed, named_path, whole_number

if TYPE_CHECKING:
    from simtest.advice.advise import Advised


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
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.errors import InputError
    from simtest.runtime.locks import exclusive_folder

    if len(distances) != 2:
        raise InputError(f"--distances: {len(distances)} numbers; must be two, the nearest and the farthest, mm")
    scope = read_scope(rig, camera)
    question = Question(scope, organ, (distances[0], distances[1]), bound, frames, seed or 0)
    command = shlex.join(["simtest", *sys.argv[1:]])
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
    from simtest.cli.printing import print_lines, print_table
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
