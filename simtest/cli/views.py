"""`simtest views`."""

from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import AsJson, Out, SceneName, Settings, Variant, whole_number
from simtest.errors import InputError


def views(
    scene: SceneName,
    /,
    *,
    out: Out,
    count: Annotated[int, Parameter(help="Views wanted, 1 to 1000.", converter=whole_number)] = 50,
    along: Annotated[
        str | None,
        Parameter(
            help="First,last share of the camera path: a sequence of views in order, none left out.",
            allow_leading_hyphen=True,
        ),
    ] = None,
    fps: Annotated[float | None, Parameter(help="Frames a second of the sequence; default 25.")] = None,
    labels: Annotated[
        bool,
        Parameter(help="Write the sequence's optical flow and co-visibility.", negative=""),
    ] = False,
    settings: Settings = None,
    variant: Variant = None,
    as_json: AsJson = False,
) -> None:
    """Pick viewpoints of an anatomy that show isolated highlights: views.json, a picture of each, a sheet of all.

    With --along, a film along the camera path instead. The poses are written for other programs, too.
    """
    from simtest import api
    from simtest.cli.printing import print_files
    from simtest.cli.progress import progress_bar
    from simtest.spec import parse_settings

    ends = None if along is None else _ends(along)
    with progress_bar("sampling views") as move:
        sampled = api.sample_views(scene, out, count, parse_settings(settings or []), variant, move, ends, fps, labels)
    with_one = sum(view.isolated_highlights > 0 for view in sampled.views)
    if as_json:
        told = {"tried": sampled.tried, "kept": len(sampled.views), "with_isolated_highlight": with_one}
        print_files([out / "views.json"], as_json, **told, left_out=sampled.rejected)
        return
    print(f"{with_one} of {sampled.tried} views show an isolated highlight")
    for reason, number in sampled.rejected.items():
        print(f"left out: {number} ({reason})")
    for reason in sampled.poses_left_out:
        print(f"not written: {reason}")
    print(out / "views.json")


def _ends(text: str) -> tuple[float, float]:
    try:
        first, last = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--along {text}: must be two shares of the path, such as 0.2,0.8") from None
    return first, last
