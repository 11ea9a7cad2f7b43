"""What the commands share: options, and how results are printed."""

import glob
import json
import shlex
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter, Token

from simtest.cli.main import MANNERS
from simtest.runtime.files import as_json

if TYPE_CHECKING:
    from simtest.reconstruction.picture import Options
    from simtest.runtime.processes import Engine


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
AsJson = Annotated[bool, Parameter(name="--json", negative="", help="Print JSON.")]
Settings = Annotated[list[str] | None, replacing("surface.radius_mm=5")]
Variant = Annotated[
    str | None,
    Parameter(
        help="llvm, cuda on an NVIDIA GPU, or a Mitsuba variant by name; default SIMTEST_VARIANT, else llvm. A device "
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
Out = Annotated[Path, Parameter(help="Folder for the results; made if need be.", converter=named_path)]
Realisations = Annotated[int | None, Parameter(help="Realisations of each setting.", converter=whole_number)]
Views = Annotated[
    int | None,
    Parameter(help="Viewpoints of each group that varies them, the first ones; default all.", converter=whole_number),
]
Seed = Annotated[int | None, Parameter(help="Seed of the run.", converter=seed_number)]
EngineName = Annotated[Literal["local", "ray"], Parameter(name="--engine", help="Local processes, or a Ray cluster.")]
Address = Annotated[str | None, Parameter(help="Of the Ray cluster's head, HOST:PORT; default: one is started here.")]


@Parameter(name="*")
@dataclass(frozen=True)
class EngineOptions:
    """What runs the work."""

    engine: EngineName = "local"
    workers: Annotated[
        int, Parameter(help="Processes that work at once; each takes its share of the cores.", converter=whole_number)
    ] = 1
    address: Address = None

    def make(self, gpu: bool = False, renew_after: int | None = None) -> "Engine":
        """Return the engine, of processes that need a GPU or are replaced after so many tasks."""
        from simtest.runtime.processes import make_engine

        return make_engine(self.engine, self.workers, self.address, gpu, renew_after)


ONE_PROCESS = EngineOptions()


@Parameter(name="*")
@dataclass(frozen=True)
class PictureOptions:
    """The options that `reconstruct` and `twin` share; twins are reconstructed as the picture is."""

    camera: Annotated[
        Path | None,
        Parameter(help="Calibration: the camera and what else is known of it; TOML, or a file of OpenCV, ROS, MATLAB."),
    ] = None
    fov: Annotated[
        float | None,
        Parameter(help="Field of view in deg across the whole picture, where there is no calibration; see --fov-of."),
    ] = None
    fov_of: Annotated[
        Literal["width", "height", "diagonal", "view"],
        Parameter(
            help="What --fov spans: a side or the diagonal of the whole picture, or the round view found in it. "
            "Makers of endoscopes mostly state the diagonal."
        ),
    ] = "width"
    estimators: Estimators = None
    encoding: Annotated[
        Literal["srgb", "linear"] | None,
        Parameter(help="How the picture's values are encoded, where the calibration does not say; default srgb."),
    ] = None
    detector: Annotated[
        str,
        named(
            "detectors",
            help="colour: by the tissue's colour; peaks; or the name of another package's. "
            "auto: by colour where there is any.",
        ),
    ] = "auto"
    smoothing: Annotated[float | None, Parameter(help="Smoothing in px; default 1 where found by colour, else 2.")] = (
        None
    )
    target: Annotated[
        Literal["fine", "base"],
        Parameter(help="Whose normals: the fine surface's, or the base's, with the relief's slope in the uncertainty."),
    ] = "fine"
    every: Annotated[
        bool,
        Parameter(
            name="--all",
            negative="",
            help="Take peaks too that the border cuts or whose shape is not that of one point highlight.",
        ),
    ] = False

    def checked(self, roi: tuple[int, int, int, int] | None = None, poses: Path | None = None) -> "Options":
        """Return them as the reconstruction takes them; raise `InputError` where they are malformed."""
        from simtest.reconstruction.picture import Options

        names = None if self.estimators is None else tuple(self.estimators)
        return Options(
            self.camera, self.fov, names, roi, self.encoding, self.every, self.detector, self.smoothing, self.target,
            self.fov_of, poses,
        )  # fmt: skip


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


def print_run(folder: Path, **told: Any) -> None:
    """Print a run as one JSON document: its files, what guide.json and summary.json hold, and what else is told."""
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    files = {"page": folder / "index.html", "results": folder / "results.parquet"}
    print_json({**files, **told, "guide": read_guide(folder), **summary})


def read_guide(folder: Path) -> dict[str, Any] | None:
    """Read which method to use, and where each breaks, from a run's guide.json; None where there is none."""
    try:
        guide: dict[str, Any] = json.loads((folder / "guide.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return guide


def print_files(files: Iterable[object], as_json: bool, **told: Any) -> None:
    """Print the files that a command has written: a line each, or as JSON with what else is told."""
    if as_json:
        print_json({**told, "files": [str(file) for file in files]})
    else:
        for file in files:
            print(file)


def print_lines(lines: Sequence[str]) -> None:
    """Print lines, at most `MOST_ROWS` of them unless --verbose is given."""
    kept = lines if MANNERS.verbose else lines[:MOST_ROWS]
    for line in kept:
        print(line)
    print_rest(len(lines) - len(kept))


def print_rest(count: int, rest: str = "", tell: Callable[[str], object] = print) -> None:
    """Report through `tell` how many rows are left out, if any, and where else they can be read."""
    if count:
        tell(f"and {count} more; --verbose prints them all{rest and f', {rest}'}")


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None, rest: str = "", width: int = 0
) -> None:
    """Print a table of at most `MOST_ROWS` rows, all with --verbose; `rest` says where the others can be read.

    A terminal of fewer columns than `width` (default `TABLE_WIDTH`) counts as that wide, or cells would be cut off.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    class Lines(Console):
        def on_broken_pipe(self) -> None:
            # A reader that has gone is answered in one place.
            raise BrokenPipeError

    # Without the names of emojis, which take as long to load as the table to print.
    console = Lines(emoji=False)
    console.width = max(console.width, width or TABLE_WIDTH)
    table = Table(*columns, title=title, title_justify="left")
    kept = rows if MANNERS.verbose else rows[:MOST_ROWS]
    for row in kept:
        table.add_row(*(escape(cell) for cell in row))
    console.print(table)
    print_rest(len(rows) - len(kept), rest)


def counted(number: int, one: str, many: str = "") -> str:
    """Return a number with its noun: 1 frame, 2 frames."""
    return f"{number} {one if number == 1 else many or one + 's'}"
