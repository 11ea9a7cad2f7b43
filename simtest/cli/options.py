"""Options that several commands share."""

import glob
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter, Token

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
        from simtest.cli.listing import names_of

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
Workers = Annotated[
    int, Parameter(help="Processes that work at once; each takes its share of the cores.", converter=whole_number)
]
EngineName = Annotated[Literal["local", "ray"], Parameter(name="--engine", help="Local processes, or a Ray cluster.")]
Address = Annotated[str | None, Parameter(help="Of the Ray cluster's head, HOST:PORT; default: one is started here.")]
