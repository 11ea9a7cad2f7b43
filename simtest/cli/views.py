"""`simtest views`."""

from typing import Annotated

from cyclopts import Parameter

from simtest.cli.options import Out, Settings, Variant, whole_number


def views(
    scene: str,
    /,
    *,
    out: Out,
    count: Annotated[int, Parameter(help="Views wanted, 1 to 1000.", converter=whole_number)] = 50,
    settings: Settings = None,
    variant: Variant = None,
) -> None:
    """Pick viewpoints of an anatomy that show isolated highlights: views.json, and a picture of each.

    Parameters
    ----------
    scene : str
        A scene file, or the name of a shipped scene.
    """
    from simtest import api
    from simtest.cli.progress import progress_bar
    from simtest.files import refuse_file
    from simtest.spec import parse_settings

    refuse_file(out)
    with progress_bar("sampling views") as move:
        sampled = api.sample_views(scene, out, count, parse_settings(settings or []), variant, move)
    print(f"{len(sampled.places)} of {sampled.tried} views show an isolated highlight")
    for reason, number in sampled.rejected.items():
        print(f"left out: {number} ({reason})")
    print(out / "views.json")
