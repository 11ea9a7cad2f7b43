"""Shipped files found by name, in a checkout or an installed wheel, and objects that packages register by name."""

import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import Distribution, EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.runtime.boundary import suggestion
from simtest.runtime.files import as_path, require_plain
from simtest.runtime.messages import LOGGER
from simtest.runtime.provenance import file_hash

_PACKAGE = Path(__file__).resolve().parents[1]


def data_root(kind: str) -> Path:
    """Return the folder of the shipped data, "scenes" or "meshes": of the checkout, or inside a wheel."""
    installed = _PACKAGE / "_data" / kind
    return installed if installed.is_dir() else _PACKAGE.parent / kind


def find(name: str | Path, kind: str, folder: str = "", suffixes: tuple[str, ...] = (".toml",)) -> Path:
    """Find a file by its path, or a shipped one in ``data_root(kind) / folder`` by its name without the suffix.

    Raises `InputError` if there is no such file; the message lists the names that exist.
    """
    try:
        path = as_path(name, "file").expanduser()
        if path.is_file():
            return path
    except RuntimeError as error:
        raise InputError(f"{name}: no such home folder") from error
    # a shipped file, by its bare name
    root = data_root(kind) / folder
    if path.name == str(name):
        for suffix in suffixes:
            if (shipped := root / f"{path.name}{suffix}").is_file():
                LOGGER.debug("%s is %s", name, shipped)
                return shipped
    if path.exists():
        require_plain(path)
    names = sorted({p.stem for s in suffixes for p in root.glob(f"*{s}")})
    meant = suggestion(path.name, names)
    if root != data_root("scenes"):
        # A stomach is a scene, tissue_stomach, where colon and liver are meshes and experiments too.
        scenes = sorted(p.stem for p in data_root("scenes").glob("*.toml"))
        meant += "".join(f"; {each} is a scene" for each in scenes if path.name in (each, each.rpartition("_")[2]))
    raise InputError(f"{name or repr(name)}: no such file; shipped by name: {', '.join(names)}{meant}")


SUFFIX = ".onnx"

_NAMED = re.compile(rf"(?P<runner>[A-Za-z0-9_.-]+):(?P<file>\S.*{re.escape(SUFFIX)})", re.DOTALL)
"""A command, ``command: python core.py net.onnx``, is none: a blank follows its colon."""


@dataclass(frozen=True)
class ModelName:
    """A name of this form: the registered name of what runs the network, and the network's file."""

    runner: str
    file: Path

    @property
    def short(self) -> str:
        """The name in results: the runner's, with the file's, or its folder's where the file is called model.onnx."""
        label = self.file.stem if self.file.stem != "model" else self.file.absolute().parent.name
        return f"{self.runner}_{re.sub('[^A-Za-z0-9_.-]+', '_', label)[:40] or 'model'}"

    @property
    def absolute(self) -> str:
        """The same name in every folder."""
        return f"{self.runner}:{self.file.absolute()}"

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of the file, by path; raise `InputError` if it cannot be read."""
        return {str(self.file.absolute()): file_hash(self.file)}


def parse_model(text: str) -> ModelName | None:
    """Return the parts of a name of this form; None for all others."""
    found = _NAMED.fullmatch(text)
    return ModelName(found["runner"], Path(found["file"])) if found and found["runner"] != "command" else None


OWN = "simtest"
"""This package's name, and that of its top module."""


@dataclass(frozen=True)
class EntryPointGroup:
    """An entry-point group, and what its members are called in messages.

    A name that two packages register is refused, unless the package is named too: "package:name", which is accepted for
    every name. "name:FILE.onnx" is the member with a network of the user's own; the member must have a method
    ``with_model(path)``, which returns it.
    """

    group: str
    kind: str

    def names(self) -> list[str]:
        """Return the names of all installed members, sorted; of a name that several packages register each full one."""
        points = list(self._members())
        plain = [point.name for point in points]
        return sorted(p.name if plain.count(p.name) == 1 else f"{_package(p)}:{p.name}" for p in points)

    def load(self, name: str) -> Any:
        """Import a member; raise `InputError` where that cannot be, or it refuses the file in its name."""
        if model := parse_model(name):
            return self._with_model(model, name)
        found = self._registered(name)
        if not found:
            names, meant = self.names(), suggestion(name, self.names())
            raise InputError(f"{self.kind} {name!r}: not installed; allowed: {', '.join(names)}{meant}")
        if len(found) > 1:
            full = " or ".join(sorted(f"{_package(point)}:{point.name}" for point in found))
            raise InputError(f"{self.kind} {name!r}: registered by {len(found)} packages; name one of them: {full}")
        # Of two packages of one name the first on the path is seen alone, so it could stand for this one.
        if _normalised(_package(found[0])) == OWN and found[0].module.partition(".")[0] != OWN:
            raise InputError(
                f"{self.kind} {name!r}: another package that is called {OWN} registers {found[0].value}; remove it"
            )
        try:
            return found[0].load()
        except Exception as error:
            raise InputError(f"{self.kind} {name!r}: {found[0].value} cannot be imported ({error})") from error

    def _with_model(self, model: ModelName, name: str) -> Any:
        """Return a member with a user's network, which is read here, so that errors come before any work."""
        with_model = getattr(self.load(model.runner), "with_model", None)
        if with_model is None:
            raise InputError(f"{self.kind} {name!r}: {model.runner} runs no network; must stand alone")
        return with_model(model.file)

    def described(self, own: Mapping[str, str] | None = None) -> dict[str, str]:
        """Return a line about each member: of `own`, or the first of the module, which is read, not imported."""
        points = {name: point for name in self.names() for point in self._registered(name)[:1]}
        lines = {n: (own or {}).get(p.name, "") if _normalised(_package(p)) == OWN else "" for n, p in points.items()}
        return {name: line.rstrip(".") or _first_line(points[name]) for name, line in lines.items()}

    def distributions(self, names: Sequence[str]) -> dict[str, str]:
        """Return package and version of each installed name, by "kind NAME"."""
        runners = {name: model.runner if (model := parse_model(name)) else name for name in names}
        found = {name: self._registered(runner) for name, runner in runners.items()}
        dists = {name: points[0].dist for name, points in found.items() if points}
        return {f"{self.kind} {name}": f"{dist.name} {dist.version}" if dist else "" for name, dist in dists.items()}

    def _members(self) -> EntryPoints:
        return _installed(self.group, tuple(sys.path))

    def _registered(self, name: str) -> list[EntryPoint]:
        package, _, plain = name.rpartition(":")
        points = [point for point in self._members() if point.name == plain]
        return [point for point in points if not package or _normalised(package) == _normalised(_package(point))]


@lru_cache(maxsize=8)
def _installed(group: str, _path: tuple[str, ...]) -> EntryPoints:
    """Return a group's entry points of all packages on the path; reading them takes 10 ms each time."""
    return entry_points(group=group)


def _first_line(point: EntryPoint) -> str:
    """Return the first line of what a member's module says of itself, without its own name and references."""
    import ast
    from importlib.util import find_spec

    try:
        spec = find_spec(point.module)
        if spec is None or spec.origin is None:
            return ""
        text = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    except (ImportError, OSError, ValueError, SyntaxError):
        # A package that is broken is told of where it is used.
        return ""
    line = text.partition("\n")[0].removeprefix(f"`{point.name}`: ")
    return re.sub(r" [(\[][^()\[\]]*(section|theory)[^()\[\]]*[)\]]", "", line).rstrip(".")


def _package(point: EntryPoint) -> str:
    return _package_name(point.dist) if point.dist else ""


@lru_cache(maxsize=128)
def _package_name(dist: Distribution) -> str:
    """Return a package's name; its metadata are parsed for it, which takes 1 ms each time."""
    return dist.name


def _normalised(package: str) -> str:
    """Return a package's name as indexes compare it: my_core, My-Core and my.core are one."""
    return re.sub(r"[-_.]+", "-", package).lower()
