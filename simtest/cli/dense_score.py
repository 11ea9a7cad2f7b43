"""`simtest score` of maps: normals or depths at every pixel."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.errors import InputError

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
    from simtest.cli.printing import print_files, print_lines, print_table
    from simtest.cli.progress import progress_bar
    from simtest.dataset.scoring.dense import MapOptions, score_maps
    from simtest.pages.style import number

    command = shlex.join(["simtest", *sys.argv[1:]])
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
