"""`simtest list`."""

import textwrap
from typing import Literal

from simtest.cli.manners import MANNERS
from simtest.cli.options import AsJson
from simtest.cli.printing import print_json

Kind = Literal["scenes", "experiments", "datasets", "profiles", "estimators", "detectors", "sensors", "rigs"]

HEADINGS = {
    "scenes": "for render, views, view, export",
    "experiments": "for validate",
    "datasets": "for dataset, fit --recipe",
    "profiles": "for nightly --profile",
    "estimators": "for --estimator",
    "detectors": "for reconstruct --detector",
    "sensors": "camera presets, for --set sensor.preset=NAME",
    "rigs": "presets of lights, for --set rig.preset=NAME",
}

LONGEST = 110
"""Characters about a name; --verbose and --json tell all."""


def listing(kind: Kind | None = None, /, *, as_json: AsJson = False) -> None:
    """List what is shipped and installed, by the names that commands take, with a line about each.

    Parameters
    ----------
    kind : str
        What to list; default everything.
    """
    found = {each: names_of(each) for each in HEADINGS if kind in (None, each)}
    if as_json:
        print_json(found)
        return
    for each, names in found.items():
        if kind is None:
            print(f"{each} ({HEADINGS[each]})")
        width = max(map(len, names), default=0)
        for name, about in names.items():
            line = about if MANNERS.verbose else textwrap.shorten(about, LONGEST, placeholder=" ...")
            print(f"{'  ' * (kind is None)}{name:<{width}}  {line}".rstrip())


def names_of(kind: str) -> dict[str, str]:
    """Return the names of a kind, with a line about each."""
    from simtest.runtime.entry_points import EntryPointGroup
    from simtest.spec import shipped

    if kind in shipped.FOLDERS:
        return shipped.shipped_files(kind)
    if kind in ("estimators", "detectors"):
        from simtest.estimators.descriptions import DESCRIPTIONS

        return EntryPointGroup(f"simtest.{kind}", kind[:-1]).described(DESCRIPTIONS if kind == "estimators" else None)
    return shipped.sensor_presets() if kind == "sensors" else shipped.rig_presets()
