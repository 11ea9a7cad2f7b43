"""Trace what a picture or an experiment passes through on its way to its page, and count files, climbs and names.

    python -m studies.ways reconstruct FILE --fov DEG [options of simtest reconstruct]
    python -m studies.ways validate EXPERIMENT [options of simtest validate]

One real command is run under `sys.setprofile`. A step of the way is a call from one package below simtest/ into another
with the thing in hand: an argument is, or holds, the picture or the experiment itself, or a record that earlier steps
made of it. Of a picture these are its file, arrays of its height and width, regions, patches, highlights, estimates and
specularities; of an experiment `Experiment`, the records of validation and report, and tables of rows. Filling a
record is no step. Two kinds of packages are looked through:

- the doors, cli and api, which hold the file's name and call one stage after the other;
- the ground, geometry and runtime: mathematics and file writing on behalf of the stage that calls them.

Calls that follow each other from one package into the same other package are one step. The way climbs where a step
returns to a package of a higher layer, which then takes the next step; layers are those that import-linter checks.
Files and names count all calls that pass the thing on, inside a package too: the files of the functions that take it,
and the names of the parameters that hold it.
"""

import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import polars as pl

from simtest.cli.commands import APP
from simtest.detection import Region
from simtest.detection.detector import Highlight
from simtest.estimators import Estimate
from simtest.geometry import Patch
from simtest.reconstruction import Specularities, Specularity
from simtest.reconstruction.images import read_picture
from simtest.spec import Experiment

ROOT = Path(__file__).resolve().parents[1]
DOORS, GROUND = ("cli", "api"), ("geometry", "runtime", "errors", "conventions")
OF_A_PICTURE = (Region, Patch, Highlight, Estimate, Specularity, Specularities)
OF_AN_EXPERIMENT = ("simtest.validation.", "simtest.report.")
CONSTRUCTORS = ("__init__", "__post_init__", "__new__")
BELOW = ("<lambda>", "<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")
"""Frames of parts of a function, which take nothing by a name of their own."""

Is = Callable[[Any], bool]


def layers() -> dict[str, int]:
    """Return the height of each package's layer above the lowest, as the contract in pyproject.toml states it."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    return {
        name.strip().removeprefix("simtest."): len(rows) - i for i, row in enumerate(rows) for name in row.split("|")
    }


def picture(file: Path) -> Is:
    """Return the test whether a value is a picture or was made of it."""
    size = read_picture(file).shape[:2]

    def is_it(value: Any) -> bool:
        if isinstance(value, np.ndarray):
            return bool(value.shape[:2] == size)
        return isinstance(value, OF_A_PICTURE) or (isinstance(value, Path) and value == file)

    return is_it


def experiment(value: Any) -> bool:
    """Check whether a value is an experiment or was made of it."""
    return isinstance(value, Experiment | pl.DataFrame) or type(value).__module__.startswith(OF_AN_EXPERIMENT)


class Way:
    """The steps of a way, recorded as a profile function.

    `is_it`: whether a value is what is followed, or was made of it; `page`: where the way ends: steps after this
    file is there do not count.
    """

    def __init__(self, is_it: Is, page: Path) -> None:
        self.is_it, self.page = is_it, page
        self.height = layers()
        self.steps: list[tuple[str, str]] = []
        self.ground: Counter[str] = Counter()
        self.files: Counter[str] = Counter()
        self.names: Counter[str] = Counter()
        # The package that holds the thing in each frame that is being run.
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
        if root != "simtest" or package in ("", *DOORS) or code.co_name in (*CONSTRUCTORS, *BELOW):
            return caller
        # At a call, the local variables are the arguments. What an answer says of itself is no step of the picture.
        owner = frame.f_locals.get("self")
        if isinstance(owner, Estimate) and isinstance(getattr(Estimate, code.co_name, None), property):
            return caller
        held = [name for name, value in frame.f_locals.items() if self._holds(value)]
        if not held or self.page.exists():
            return caller
        if package in GROUND:
            self.ground[package] += 1
            return caller
        self.files[rest] += 1
        self.names.update(name for name in held if name != "self")
        if package != caller:
            self.steps.append((caller, package))
        return package

    def _holds(self, value: Any, depth: int = 3) -> bool:
        """Check whether a value is the thing, was made of it, or holds such."""
        if self.is_it(value):
            return True
        if depth == 0 or isinstance(value, type):
            return False
        if isinstance(value, list | tuple):
            return any(self._holds(item, depth - 1) for item in value[:3])
        if isinstance(value, dict):
            return any(self._holds(item, depth - 1) for item in value.values())
        fields = getattr(value, "__dataclass_fields__", ())
        return any(self._holds(getattr(value, name, None), depth - 1) for name in fields)

    @property
    def passed(self) -> list[str]:
        """The packages in the order in which the thing passes from one to the next, returns included."""
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


def trace(command: str, thing: str, options: list[str]) -> Way:
    """Run a command on a picture or an experiment and return its way."""
    with tempfile.TemporaryDirectory() as out:
        way = Way(picture(Path(thing)) if command == "reconstruct" else experiment, Path(out, "index.html"))
        sys.setprofile(way)
        try:
            APP(
                [command, thing, "--out", out, *options],
                exit_on_error=False, print_error=False, result_action="return_value",
            )  # fmt: skip
        finally:
            sys.setprofile(None)
    return way


def main() -> None:
    """Trace the way of the command line's picture or experiment and print it."""
    if len(sys.argv) < 3 or sys.argv[1] not in ("reconstruct", "validate"):
        sys.exit(__doc__)
    way = trace(sys.argv[1], sys.argv[2], sys.argv[3:])
    print("\nway:", " > ".join(way.passed))
    print(f"packages: {len(set(way.passed))}, climbs: {way.climbs}, files: {len(way.files)}, names: {len(way.names)}")
    print("looked through, calls with it:", *(f"{name} {n}" for name, n in sorted(way.ground.items())))
    print("files:", *sorted(way.files))
    print("names:", *sorted(way.names))


if __name__ == "__main__":
    main()
