"""The page of the Python API: every public name, with its docstring, which Sphinx's autodoc reads."""

import importlib
import inspect
import re
from collections.abc import Iterable
from types import GenericAlias, UnionType

import simtest

SECTIONS = {
    "simtest.calibration": (
        "Priors and calibration",
        "What is known of a camera and of a picture beforehand, with its uncertainty.",
    ),
    "simtest.estimators": ("Estimators", "What an estimator is given and returns; see :doc:`estimators`."),
    "simtest.detection": ("Detectors", "What a detector is given and returns; see :doc:`../concepts/detection`."),
    "simtest.geometry": ("Geometry", "Cameras, isophotes, conics and poses; NumPy alone."),
    "simtest.spec": (
        "Models of files",
        "Scenes, experiments, datasets and profiles, as they are read from TOML. :doc:`keys` lists their keys.",
    ),
    "simtest.dataset": ("Datasets", "Made, read and checked; see :doc:`../howto/datasets`."),
}
"""Packages whose public names stand on the page, with a title and a line each."""

MORE = {"simtest.estimators": ("simtest.estimators.protocol:PreparedEstimator",
                               "simtest.estimators.protocol:CloudEstimator")}  # fmt: skip
"""Protocols that are not among the names of their package."""


def entries() -> dict[str, object]:
    """Return every name that the page documents, by its path of import; each object once."""
    found: dict[str, object] = {f"simtest.{name}": getattr(simtest, name) for name in simtest.__all__}
    for package in SECTIONS:
        module = importlib.import_module(package)
        for name in module.__all__:
            thing = getattr(module, name)
            if not any(thing is other for other in found.values()):
                found[f"{package}.{name}"] = thing
        for path in MORE.get(package, ()):
            home, name = path.split(":")
            found[f"{home}.{name}"] = getattr(importlib.import_module(home), name)
    return found


def directive(path: str, thing: object) -> str:
    """Return the autodoc directive of a name."""
    if isinstance(thing, GenericAlias | UnionType):
        return f".. py:data:: {path}\n\n   The type ``{_alias(thing)}``.\n"
    if inspect.isclass(thing):
        # A model's fields are keys of a file, which the page of keys lists; an error's methods are Python's.
        bare = issubclass(thing, Exception) or hasattr(thing, "model_fields")
        return f".. autoclass:: {path}\n" + ("" if bare else "   :members:\n")
    if inspect.isroutine(thing):
        return f".. autofunction:: {path}\n"
    return f".. autodata:: {path}\n   :no-value:\n"


def _alias(thing: GenericAlias | UnionType) -> str:
    """Return an alias as it is written, without the modules of its parts."""
    return re.sub(r"(?:\w+\.)+(?=\w)", "", str(thing))


def _group(title: str, line: str, names: Iterable[tuple[str, object]]) -> str:
    rule = "-" * len(title)
    body = "\n".join(directive(path, thing) for path, thing in names)
    return f"{title}\n{rule}\n\n{line}\n\n{body}\n"


def api_page() -> str:
    """Return the page as reStructuredText, which autodoc's docstrings are written in."""
    found = entries()
    own = {path: thing for path, thing in found.items() if path.count(".") == 1}
    functions = {path: thing for path, thing in own.items() if not inspect.isclass(thing)}
    errors = {path: thing for path, thing in own.items() if path not in functions and _is_error(thing)}
    classes = {path: thing for path, thing in own.items() if path not in functions and path not in errors}
    text = "Python API\n==========\n\nEvery public name, from the docstrings. The names of ``simtest`` are loaded "
    text += "at first use: importing the package loads neither the renderer nor the viewers.\n\n"
    text += _group("Functions", "What the commands do, as functions.", functions.items())
    text += _group("Classes", "What the functions take and return.", classes.items())
    text += _group("Errors and failures", "What is raised, and what is returned instead of a normal.", errors.items())
    for package, (title, line) in SECTIONS.items():
        inside = {path: thing for path, thing in found.items() if path.startswith(f"{package}.")}
        text += _group(title, f"{line} In ``{package}``.", inside.items())
    return text


def _is_error(thing: object) -> bool:
    return inspect.isclass(thing) and (issubclass(thing, Exception) or thing.__name__ in ("Failure", "Reason"))
