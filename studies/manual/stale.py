"""Find commands and Python in the manual that cannot work any more, without running them.

A command's options must parse, and the scenes, experiments, datasets, profiles and estimators that it names must
exist; a module that `python -m` runs must exist, and a target of `make`; Python must compile, and what it takes from
simtest must be there; TOML must parse.
"""

import ast
import importlib
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cyclopts import CycloptsError

from simtest.cli.commands import APP
from simtest.cli.main import FLAGS
from simtest.dataset.plan import Plan
from simtest.errors import InputError
from simtest.estimators import load_estimators
from simtest.spec import load_dataset, load_experiment, load_profile, load_scene, parse_settings
from simtest.validation.cases import expand
from studies.manual.blocks import ROOT, Block, blocks_of, manual_pages

SHELL = ("sh", "console", "indented")
JOINTS = ("&&", "||", "|", ";", "&")


def stale(paths: list[Path] | None = None) -> Iterator[str]:
    """Yield a line for each command or block that cannot work, with its place."""
    for path in manual_pages() if paths is None else paths:
        for block in blocks_of(path):
            yield from (f"{block.place}: {fault}" for fault in faults(block))


def faults(block: Block) -> Iterator[str]:
    """Yield what is wrong with a block."""
    if block.language in SHELL and not block.shows_refusal:
        for line in block.lines:
            yield from (f"{line}: {fault}" for command in _commands(line) if (fault := _fault(command, block.runs)))
    elif block.language == "python":
        yield from _python_faults(block.code)
    elif block.language == "toml":
        try:
            tomllib.loads(block.code)
        except tomllib.TOMLDecodeError as error:
            yield f"TOML: {error}"


def _commands(line: str) -> Iterator[list[str]]:
    """Yield the commands of a line, without environment, redirection and what follows the command."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=True)
    lexer.whitespace_split, lexer.commenters = True, "#"
    command: list[str] = []
    for token in [*lexer, ";"]:
        if token in JOINTS:
            if command:
                yield command
            command = []
        elif not (not command and re.match(r"\w+=", token)):
            command.append(token)


def _fault(command: list[str], runs: bool) -> str | None:
    """Return what is wrong with a command; None where nothing is, or where it is none of ours."""
    if ">" in command:
        command = command[: command.index(">")]
    program = Path(command[0]).name
    if program == "simtest":
        return _simtest_fault(command[1:], runs)
    if program == "make":
        targets = [word for word in command[1:] if not word.startswith("-") and "=" not in word]
        known = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
        return next((f"no target {word} in the Makefile" for word in targets if word not in known), None)
    module = command[2] if program.startswith("python") and command[1:2] == ["-m"] else ""
    if module.startswith(("studies", "benchmarks")):
        return None if importlib.util.find_spec(module) else f"no module {module}"
    return None


def _simtest_fault(arguments: list[str], runs: bool) -> str | None:
    arguments = [word for word in arguments if word not in FLAGS]
    # Flags of the program itself.
    if not arguments or arguments[0].startswith("-"):
        return None
    try:
        function, bound, _ = APP.parse_args(arguments, print_error=False, exit_on_error=False)
    except CycloptsError as error:
        return " ".join(str(error).split())
    given = bound.arguments
    try:
        _check_names(arguments[0], function.__name__, given, bound.args, runs)
    except InputError as error:
        return str(error)
    return None


def _check_names(command: str, function: str, given: dict[str, Any], positional: tuple[Any, ...], runs: bool) -> None:
    """Raise InputError where a command names a scene, an experiment, a recipe, a profile or an estimator amiss."""
    settings = parse_settings(given.get("settings") or [])
    # A mesh of the reader's is not there to be read, nor checked with the other settings.
    absent = any(isinstance(value, str) and _is_file(value) and not Path(value).exists() for value in settings.values())
    # What a command itself checks before it renders.
    loaders: dict[tuple[str, str], Callable[[str, dict[str, Any]], object]] = {
        ("render", "render"): load_scene,
        ("views", "views"): load_scene,
        ("view", "view"): load_scene,
        ("export", "export"): load_scene,
        ("validate", "validate"): lambda name, values: expand(load_experiment(name, values)),
        ("dataset", "make"): lambda name, values: Plan(load_dataset(name, values)),
    }
    loader = loaders.get((command, function))
    if loader and positional and not _is_file(positional[0]):
        loader(positional[0], {} if absent else settings)
    if command == "nightly" and given.get("profile") and not _is_file(given["profile"]):
        load_profile(given["profile"])
    if runs and (names := given.get("estimators") or given.get("estimator")):
        load_estimators(names)


def _is_file(name: str) -> bool:
    return "/" in name or "." in Path(name).name or name.isupper()


def _python_faults(code: str) -> Iterator[str]:
    """Yield names of simtest that do not exist, and errors of syntax; doctest prompts are taken off."""
    if ">>> " in code:
        code = "\n".join(line[4:] for line in code.splitlines() if line.startswith((">>> ", "... ")))
    try:
        tree = ast.parse(code)
    except SyntaxError as error:
        yield f"Python: {error}"
        return
    for node in ast.walk(tree):
        home = (node.module or "") if isinstance(node, ast.ImportFrom) else ""
        if home.split(".")[0] in ("simtest", "studies"):
            module = importlib.import_module(home)
            yield from (f"no {name.name} in {home}" for name in node.names if not _has(module, home, name.name))
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "simtest":
            module = importlib.import_module("simtest")
            if not _has(module, "simtest", node.attr):
                yield f"no simtest.{node.attr}"


def _has(module: Any, path: str, name: str) -> bool:
    # The list first: what an extra brings is there by name and cannot be imported without it.
    return (
        name in getattr(module, "__all__", ())
        or hasattr(module, name)
        or importlib.util.find_spec(f"{path}.{name}") is not None
    )
