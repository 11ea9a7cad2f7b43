"""What the commands share: options, and the record that each returns, which `command` prints."""

import glob
import inspect
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from cyclopts import Parameter, Token

from simtest.cli.main import MANNERS
from simtest.errors import InputError
from simtest.runtime.files import as_json

if TYPE_CHECKING:
    from simtest.reconstruction.options import Options
    from simtest.runtime.processes import Engine
    from simtest.spec.recipes import CoreRegions


Row = TypeVar("Row")

_SEPARATOR = "\0"
"""No argument of a command can hold it."""


def whole_number(_: Any, tokens: Sequence[Token]) -> int:
    """Convert an option to an integer; 2.7 is not rounded."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"{tokens[0].value} is not a whole number") from None


def seed_number(_: Any, tokens: Sequence[Token]) -> int:
    """Convert an option to a seed, which files hold in signed 64 bits."""
    seed = whole_number(_, tokens)
    if not 0 <= seed < 2**63:
        raise ValueError(f"{seed} is no seed; must be a whole number from 0 to {2**63 - 1}")
    return seed


def named_path(_: Any, tokens: Sequence[Token]) -> Path:
    """Convert an option to a path; an empty one would be the current folder, which nobody has named."""
    if not tokens[0].value.strip():
        raise ValueError("is empty; must name a file or folder")
    try:
        tokens[0].value.encode()
    except UnicodeEncodeError:
        # Such names cannot be printed, nor stand in JSON, and libraries that write pictures break down over them.
        raise ValueError(f"is no UTF-8 name: {tokens[0].value!a}; must be one (and LC_ALL a UTF-8 locale)") from None
    return Path(tokens[0].value)


def two_numbers(_: Any, tokens: Sequence[Token]) -> tuple[float, float]:
    """Convert an option to two numbers separated by a comma."""
    try:
        first, last = (float(part) for part in tokens[0].value.split(","))
    except ValueError:
        raise ValueError(f"{tokens[0].value!r}: must be two numbers separated by a comma, such as 20,60") from None
    return first, last


Names = str | tuple[str, ...] | None
"""Of an option, where they are not the argument's."""

OUT = ("--out", "-o")


def about(text: str, name: Names = None) -> Parameter:
    """Return an option with its line of help, and its name where that is not the argument's."""
    return Parameter(name=name, help=text)


def whole(text: str, name: Names = None) -> Parameter:
    """Return the option for a whole number."""
    return Parameter(name=name, help=text, converter=whole_number)


def path(text: str, name: Names = None) -> Parameter:
    """Return the option for a file or folder that must have a name."""
    return Parameter(name=name, help=text, converter=named_path)


def flag(text: str, name: Names = None) -> Parameter:
    """Return the option that takes no value, and has no opposite."""
    return Parameter(name=name, help=text, negative="")


def replacing(example: str) -> Parameter:
    """Return the option that replaces values of a file, with an example of one in its help."""
    text = f"Replace a value: key=value, such as {example}; may be repeated."
    return Parameter(name="--set", negative="", help=text, converter=_gathered)


def gather_settings(words: Sequence[str]) -> list[str]:
    """Join the values of all ``--set`` of a command line in one: parsing takes time with the square of their number."""
    end = list(words).index("--") if "--" in words else len(words)
    others, values, first, i = list[str](), list[str](), -1, 0
    while i < len(words):
        is_pair = words[i] == "--set" and i + 1 < end and not words[i + 1].startswith("-")
        if is_pair:
            first = len(others) if first < 0 else first
            values.append(words[i + 1])
        else:
            others.append(words[i])
        i += 1 + is_pair
    return [*others[:first], "--set", _SEPARATOR.join(values), *others[first:]] if values else others


def _gathered(_: Any, tokens: Sequence[Token]) -> list[str]:
    return [value for token in tokens for value in token.value.split(_SEPARATOR)]


def values_of(settings: Sequence[str] | None, **own: Any) -> dict[str, Any]:
    """Return the values of --set, and those of options of their own where they are given."""
    from simtest.spec import parse_settings

    return parse_settings(list(settings or [])) | {key: value for key, value in own.items() if value is not None}


def named(kind: str, files: bool = False, **options: Any) -> Parameter:
    """Return the parameter of a name that `simtest list` knows, which a shell completes; or of a TOML file."""

    def names(context: Any) -> dict[str, str]:
        from simtest.cli.scenes import names_of

        return names_of(kind) | (_toml_files(context.incomplete) if files else {})

    # Older releases of cyclopts complete no names.
    if hasattr(Parameter, "completer"):
        options["completer"] = names
    return Parameter(**options)


def _toml_files(begun: str) -> dict[str, str]:
    """Return the folders and TOML files whose path begins so."""
    folder, _, start = begun.rpartition("/")
    found = sorted(Path(folder or ("/" if begun.startswith("/") else ".")).glob(f"{glob.escape(start)}*"))
    head = begun[: len(begun) - len(start)]
    return {f"{head}{path.name}{'/' * path.is_dir()}": "" for path in found if path.is_dir() or path.suffix == ".toml"}


SceneName = Annotated[str, named("scenes", files=True, help="A scene file, a sample's JSON, or a shipped scene.")]
NamedPath = Annotated[Path, Parameter(converter=named_path)]
AsJson = Annotated[bool, flag("Print JSON.", "--json")]
Settings = Annotated[list[str] | None, replacing("surface.radius_mm=5")]
Variant = Annotated[
    str | None,
    about(
        "llvm, cuda on an NVIDIA GPU, or a Mitsuba variant by name; default SIMTEST_VARIANT, else llvm. A device "
        "renders one channel, or three for the colours of tissue."
    ),
]
Estimators = Annotated[
    list[str] | None,
    named(
        "estimators",
        files=True,
        name="--estimator",
        negative="",
        help="Estimator by name, a network of your own, learned_spot:FILE.onnx, or a core of your own: "
        "'command: PROGRAM ARGUMENT...' or FILE.toml; may be repeated.",
    ),
]
Distances = Annotated[
    tuple[float, float],
    Parameter(
        help="Nearest and farthest distance of the wall, mm: 20,60.",
        negative="", converter=two_numbers, n_tokens=1, allow_leading_hyphen=True,
    ),
]  # fmt: skip
Out = Annotated[Path, path("Folder for the results; made if need be.", OUT)]
Realisations = Annotated[int | None, whole("Realisations of each setting.", ("--realisations", "-n"))]
Views = Annotated[int | None, whole("Viewpoints of each group that varies them, the first ones; default all.")]
Seed = Annotated[int | None, Parameter(help="Seed of the run.", converter=seed_number)]
EngineName = Annotated[Literal["local", "ray"], about("Local processes, or a Ray cluster.", "--engine")]
Address = Annotated[str | None, about("Of the Ray cluster's head, HOST:PORT; default: one is started here.")]


@Parameter(name="*")
@dataclass(frozen=True)
class EngineOptions:
    """What runs the work."""

    engine: EngineName = "local"
    workers: Annotated[int, whole("Processes that work at once; each takes its share of the cores.")] = 1
    address: Address = None

    def make(self, gpu: bool = False, renew_after: int | None = None) -> "Engine":
        """Return the engine, of processes that need a GPU or are replaced after so many tasks."""
        from simtest.runtime.processes import make_engine

        return make_engine(self.engine, self.workers, self.address, gpu, renew_after)


ONE_PROCESS = EngineOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class RegionOptions:
    """Calibrations of cores, and what is refused by them."""

    regions: Annotated[list[Path] | None, flag("A core's calibration: its answers get regions; may be repeated.")] = (
        None
    )
    refuse_above: Annotated[float | None, about("Refuse answers whose calibrated 95 % radius is larger, deg.")] = None
    shifted: Annotated[Literal["widen", "refuse"], about("In unlike frames: the worst region, or none.")] = "widen"

    def refuse(self) -> None:
        """Raise `InputError` if any is given, where maps are scored."""
        if self != NO_REGIONS:
            raise InputError("--regions, --refuse-above, --shifted: are for answers at highlights, not for maps")

    def read(self) -> "CoreRegions | None":
        """Return them; None where no calibration is given."""
        if self.regions is None:
            if self != NO_REGIONS:
                raise InputError("--refuse-above and --shifted need --regions")
            return None
        from simtest.reconstruction.regions import read_calibrations
        from simtest.spec.recipes import CoreRegions
        from simtest.spec.spec_model import validate

        # Files before the work; workers may have another current folder.
        files = [str(file.resolve()) for file in self.regions]
        read_calibrations(files)
        given = {"files": files, "refuse_above_deg": self.refuse_above, "shifted": self.shifted}
        return validate(CoreRegions, given, "--regions")


NO_REGIONS = RegionOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class PictureOptions:
    """The options that `reconstruct` and `twin` share; twins are reconstructed as the picture is."""

    camera: Annotated[
        Path | None,
        about("Calibration: the camera and what else is known of it; TOML, or a file of OpenCV, ROS, MATLAB."),
    ] = None
    fov_deg: Annotated[
        float | None,
        about("Field of view in deg across the whole picture, where there is no calibration; see --fov-of.", "--fov"),
    ] = None
    fov_of: Annotated[
        Literal["width", "height", "diagonal", "view"],
        about(
            "What --fov spans: a side or the diagonal of the whole picture, or the round view found in it. "
            "Makers of endoscopes mostly state the diagonal."
        ),
    ] = "width"
    estimators: Estimators = None
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        about("How the picture's values are encoded, where the calibration does not say; default srgb."),
    ] = None
    detector: Annotated[
        str,
        named(
            "detectors",
            help="colour: by the tissue's colour; peaks; or the name of another package's. "
            "auto: by colour where there is any.",
        ),
    ] = "auto"
    smoothing_px: Annotated[
        float | None, about("Smoothing in px; default 1 where found by colour, else 2.", "--smoothing")
    ] = None
    target: Annotated[
        Literal["fine", "base"],
        about("Whose normals: the fine surface's, or the base's, with the relief's slope in the uncertainty."),
    ] = "fine"
    every: Annotated[
        bool, flag("Take peaks too that the border cuts or whose shape is not that of one point highlight.", "--all")
    ] = False
    keep_overlays: Annotated[
        bool, flag("Found by colour: take text and squares that are drawn on the picture for tissue.")
    ] = False
    least_score: Annotated[
        float | None,
        about(
            "Highlights with a smaller score, in [0, 1], may be none and have no best normal; 0 keeps all. "
            "The score is no probability; its default was fitted on rendered foolers."
        ),
    ] = None

    def checked(self, **others: Any) -> "Options":
        """Return them, and others, as the reconstruction takes them; raise `InputError` where they are malformed."""
        from simtest.reconstruction.options import Options

        names = None if self.estimators is None else tuple(self.estimators)
        options = Options(**vars(self) | {"estimators": names} | others)
        options.require_camera()
        return options


DEFAULTS = PictureOptions()
"""None of them given."""


MOST_ROWS = 20
"""A longer table is cut, or replaced by a summary, unless --verbose is given."""

TABLE_WIDTH = 125


def command_line() -> str:
    """Return this command as a shell takes it."""
    return shlex.join(["simtest", *sys.argv[1:]])


def print_json(value: Any) -> None:
    """Print a value as one JSON document; records and arrays as in files, and null for NaN and infinity."""
    text = json.dumps(value, default=lambda item: str(item) if hasattr(item, "__fspath__") else as_json(item))
    print(json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2, allow_nan=False))


def run_record(folder: Path, **others: Any) -> dict[str, Any]:
    """Return what --json prints of a run: its files, what guide.json and summary.json hold, and what else is known."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    files = {"page": folder / "index.html", "results": folder / "results.parquet"}
    return {**files, **others, "guide": read_guide(folder), **summary}


def read_guide(folder: Path) -> dict[str, Any] | None:
    """Read which method to use, and where each breaks, from a run's guide.json; None where there is none."""
    try:
        guide: dict[str, Any] = json.loads((folder / "guide.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return guide


@dataclass(frozen=True)
class Table:
    """A table for the terminal; one of fewer columns than `width` counts as that wide, or cells would be cut off."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str | None = None
    width: int = TABLE_WIDTH

    def print(self) -> None:
        """Print at most `MOST_ROWS` rows, or all with --verbose."""
        from rich.console import Console
        from rich.markup import escape
        from rich.table import Table as Drawn

        class Lines(Console):
            def on_broken_pipe(self) -> None:
                # A reader that has gone is answered in one place.
                raise BrokenPipeError

        # Without the names of emojis, which take as long to load as the table to print.
        console = Lines(emoji=False)
        console.width = max(console.width, self.width)
        drawn = Drawn(*self.columns, title=self.title and escape(self.title), title_justify="left")
        rows, more = first(self.rows)
        for row in rows:
            drawn.add_row(*(escape(cell) for cell in row))
        console.print(drawn)
        print(*more, sep="\n", end="\n" * len(more))


def first(rows: Sequence[Row], where: str = "") -> tuple[Sequence[Row], list[str]]:
    """Return `MOST_ROWS` rows, or all with --verbose; and a line, if any, on those left out and `where` they stand."""
    kept = rows if MANNERS.verbose else rows[:MOST_ROWS]
    count = len(rows) - len(kept)
    return kept, [f"and {count} more; --verbose prints them all{where and f', {where}'}"] if count else []


def few(lines: Sequence[str]) -> list[str]:
    """Return at most `MOST_ROWS` lines and one on those left out, or all lines with --verbose."""
    kept, more = first(lines)
    return [*kept, *more]


@dataclass(frozen=True)
class Told:
    """What a command has done: files that it wrote, the record for --json, parts for the terminal, the exit code.

    A record and a part may be a function that makes it, or prints it: what is not printed is not made. The files are
    the last lines of the terminal, and the last key of the JSON document.
    """

    files: Sequence[object] = ()
    data: Any = None
    parts: "Iterable[str | Path | Table | Callable[[], None]]" = ()
    code: int = 0

    def print(self, as_json: bool) -> None:
        """Print it as one JSON document, or for people."""
        if as_json:
            data = self.data() if callable(self.data) else self.data
            if self.files:
                data = {**(data or {}), "files": [str(file) for file in self.files]}
            if data is not None:
                print_json(data)
            return
        for part in (*self.parts, *self.files):
            if MANNERS.quiet and str(part).startswith("note: "):
                continue
            if isinstance(part, Table):
                part.print()
            elif callable(part):
                part()
            else:
                print(part)


def command(function: Callable[..., Told]) -> Callable[..., int]:
    """Return a command with the option --json that prints what it returns, and returns its exit code."""

    @wraps(function)
    def run(*arguments: Any, as_json: bool = False, **options: Any) -> int:
        told = function(*arguments, **options)
        told.print(as_json)
        return told.code

    given = inspect.signature(function)
    option = inspect.Parameter("as_json", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=AsJson)
    vars(run)["__signature__"] = given.replace(parameters=[*given.parameters.values(), option])
    return run


def fixed(value: float | None, digits: int = 2, missing: str = "") -> str:
    """Return a number with so many digits behind the point, or what stands for none."""
    return missing if value is None else f"{value:.{digits}f}"


def counted(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{number} {one if number == 1 else many or one + 's'}"
