"""Trace the way of a picture through the packages of simtest, from the file to index.html, and count its climbs.

    python -m studies.picture_way FILE --fov DEG [options of simtest reconstruct]

One real `simtest reconstruct` is run under `sys.setprofile`. A step of the way is a call from one package below
simtest/ into another with the picture in hand: an argument is, or holds, its file, an array of its height and width, or
one of the records that earlier steps made of it (region, patch, highlight, estimate, specularity, description). Filling
a record is no step. Two kinds of packages are looked through:

- the doors, cli and api, which hold the file's name and call one stage after the other;
- the ground, geometry and runtime: mathematics and file writing on behalf of the stage that calls them.

Calls that follow each other from one package into the same other package are one step. The way climbs where a step
returns to a package of a higher layer, which then takes the next step; layers are those that import-linter checks.
"""

import sys
import tempfile
import tomllib
from collections import Counter
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from simtest.cli.commands import APP
from simtest.detection import Region
from simtest.detection.detector import Highlight
from simtest.estimators import Estimate
from simtest.geometry import Patch
from simtest.reconstruction import Specularities, Specularity
from simtest.reconstruction.images import read_picture

ROOT = Path(__file__).resolve().parents[1]
DOORS, GROUND = ("cli", "api"), ("geometry", "runtime", "errors", "conventions")
MADE_OF_IT = (Region, Patch, Highlight, Estimate, Specularity, Specularities)
CONSTRUCTORS = ("__init__", "__post_init__", "__new__")


def layers() -> dict[str, int]:
    """Return the height of each package's layer above the lowest, as the contract in pyproject.toml states it."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    return {
        name.strip().removeprefix("simtest."): len(rows) - i for i, row in enumerate(rows) for name in row.split("|")
    }


class Way:
    """The steps of a picture's way, recorded as a profile function.

    Parameters
    ----------
    file : Path
        The picture.
    page : Path
        Where the way ends: steps after this file is there do not count.
    """

    def __init__(self, file: Path, page: Path) -> None:
        self.file, self.page, self.size = file, page, read_picture(file).shape[:2]
        self.height = layers()
        self.steps: list[tuple[str, str]] = []
        self.ground: Counter[str] = Counter()
        # The package that holds the picture in each frame that is being run.
        self._stack = [""]

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """Follow a call or a return."""
        if event == "return" and len(self._stack) > 1:
            self._stack.pop()
        elif event == "call":
            self._stack.append(self._holder(frame, self._stack[-1]))

    def _holder(self, frame: FrameType, caller: str) -> str:
        root, _, rest = str(frame.f_globals.get("__name__")).partition(".")
        package, code = rest.partition(".")[0], frame.f_code
        if root != "simtest" or package in ("", caller, *DOORS) or code.co_name in CONSTRUCTORS:
            return caller
        # At a call, the local variables are the arguments. What an answer says of itself is no step of the picture.
        made = frame.f_locals.get("self")
        if isinstance(made, Estimate) and isinstance(getattr(Estimate, code.co_name, None), property):
            return caller
        if not any(self._holds(argument) for argument in frame.f_locals.values()) or self.page.exists():
            return caller
        if package in GROUND:
            self.ground[package] += 1
            return caller
        self.steps.append((caller, package))
        return package

    def _holds(self, value: Any, depth: int = 3) -> bool:
        """Check whether a value is the picture, was made of it, or holds such."""
        if isinstance(value, np.ndarray):
            return value.shape[:2] == self.size
        if isinstance(value, MADE_OF_IT) or (isinstance(value, Path) and value == self.file):
            return True
        if depth == 0:
            return False
        if isinstance(value, list | tuple):
            return any(self._holds(item, depth - 1) for item in value[:3])
        if isinstance(value, dict):
            return any(self._holds(item, depth - 1) for item in value.values())
        fields = getattr(value, "__dataclass_fields__", ())
        return any(self._holds(getattr(value, name, None), depth - 1) for name in fields)

    @property
    def passed(self) -> list[str]:
        """The packages in the order in which the picture passes from one to the next, returns included."""
        passed: list[str] = []
        before = ("", "")
        for caller, package in self.steps:
            # The same step again is one step.
            if (caller, package) != before:
                passed += [name for name in (caller, package) if name and name != (passed or [""])[-1]]
            before = (caller, package)
        return passed

    @property
    def climbs(self) -> int:
        """How often it passes to a package of a higher layer."""
        return sum(self.height[one] < self.height[other] for one, other in pairwise(self.passed))


def trace(file: Path, options: list[str]) -> Way:
    """Run `simtest reconstruct` on a picture and return its way."""
    with tempfile.TemporaryDirectory() as out:
        way = Way(file, Path(out, "index.html"))
        sys.setprofile(way)
        try:
            APP(
                ["reconstruct", str(file), "--out", out, *options],
                exit_on_error=False, print_error=False, result_action="return_value",
            )  # fmt: skip
        finally:
            sys.setprofile(None)
    return way


def main() -> None:
    """Trace the picture of the command line and print its way."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    way = trace(Path(sys.argv[1]), sys.argv[2:])
    print("\nway:", " > ".join(way.passed))
    print(f"packages: {len(set(way.passed))}, climbs: {way.climbs}")
    print("looked through, calls with the picture:", *(f"{name} {n}" for name, n in sorted(way.ground.items())))


if __name__ == "__main__":
    main()
