"""`simtest twin`."""

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from simtest.cli.options import AsJson, Out, Seed, named_path, whole_number
from simtest.cli.picture_options import DEFAULTS, PictureOptions
from simtest.cli.printing import MOST_ROWS, counted, print_files, print_table

if TYPE_CHECKING:
    from simtest.advice.twin.run import SpotTwins, TwinResult

FEWEST, MOST = 1, 1000


def twin(
    frame: Annotated[Path, Parameter(converter=named_path)],
    /,
    *,
    out: Out,
    known: PictureOptions = DEFAULTS,
    organ: Annotated[
        Literal["colon", "stomach", "liver", "gallbladder"] | None,
        Parameter(help="Organ in the picture, whose relief the twins have; default: any tissue's."),
    ] = None,
    frames: Annotated[
        int | None,
        Parameter(help="Rendered frames; default 48, fewer where the picture is large.", converter=whole_number),
    ] = None,
    seed: Seed = None,
    as_json: AsJson = False,
) -> None:
    """Render twins of a picture's highlights, and measure the error at each.

    Parameters
    ----------
    frame : Path
        PNG, JPEG, BMP or TIFF.
    """
    from simtest.advice.twin.run import twin_picture
    from simtest.advice.twin.writing import to_json, write_twins
    from simtest.cli.progress import progress_bar
    from simtest.errors import InputError
    from simtest.runtime.locks import exclusive_folder

    if frames is not None and not FEWEST <= frames <= MOST:
        raise InputError(f"--frames {frames}: must be {FEWEST} to {MOST}")
    options = known.checked()
    command = shlex.join(["simtest", *sys.argv[1:]])
    with exclusive_folder(out):
        with progress_bar("writing the page") as progress:
            result = twin_picture(frame, options, frames, seed or 0, progress, organ)
        files = write_twins(result, out, command)
    if as_json:
        print_files(files, as_json, **to_json(result, command))
        return
    _print(result)
    print_files(files, as_json)


def _print(result: "TwinResult") -> None:
    """Print the highlights, the bank and what was drawn."""
    columns = ("no.", "x (px)", "y (px)", "radius (px)", "best", "± deg", "twins deg", "95 % interval", "held")
    spots = sorted(result.spots, key=lambda each: -each.spot.radius_px)
    print_table(columns, [_cells(each) for each in spots[:MOST_ROWS]])
    if len(spots) > MOST_ROWS:
        print(f"the {MOST_ROWS} largest of {len(spots)}; twin.csv and index.html hold all")
    held = "" if result.coverage is None else f"; their 95 % regions hold the truth in {100 * result.coverage:.0f} %"
    print(f"twins: {result.rms_deg():.2f} deg RMS against the fine normal{held}")
    print(f"twins: {result.rms_deg('base_rms_deg'):.2f} deg RMS against the base's normal")
    drawn = f"{counted(len(result.bank), 'rendered frame')}, {counted(len(result.bank_spots), 'highlight')} in them"
    print(f"bank: {drawn}, {100 * result.share_of('near_miss'):.0f} % near misses")
    near, middle, far = result.distance_mm
    print(f"twins stand at {near:.0f} to {far:.0f} mm (80 %), half nearer than {middle:.0f} mm")
    unlike = sum(not each.twins.is_covered for each in result.spots)
    if unlike:
        print(f"note: the bank holds no highlight like {unlike} of {len(spots)}; their figures are of the nearest ones")
    for each in result.assumed:
        print(f"given: {each.what}: {each.distribution}" if each.given else f"drawn: {each.what}: {each.distribution}")


def _cells(each: "SpotTwins") -> list[str]:
    spot, twins = each.spot, each.twins
    x, y = spot.peak_px
    low, high = twins.interval_deg
    return [
        str(spot.index), f"{x:.1f}", f"{y:.1f}", f"{spot.radius_px:.1f}", spot.estimator,
        "" if each.stated_deg is None else f"{each.stated_deg:.2f}", f"{twins.rms_deg:.2f}",
        f"{low:.2f} to {high:.2f}", "" if twins.coverage is None else f"{100 * twins.coverage:.0f} %",
    ]  # fmt: skip
