"""Names that the manual of 0.1 documented, for one release more: each warns and leads to the new one."""

import sys
import warnings
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

GONE = "0.3.0"
"""Release without the old names."""

MODULES = {
    "simtest.colour": "simtest.reconstruction",
    "simtest.engines": "simtest.runtime.processes",
    "simtest.estimators.base": "simtest.estimators.protocol",
    "simtest.estimators.peak": "simtest.estimators.extrapolation",
    "simtest.gate.records": "simtest.nightly.records",
    "simtest.gate": "simtest.nightly.gate",
    "simtest.imaging.depth": "simtest.validation.depth_maps",
    "simtest.imaging": "simtest.reconstruction",
    "simtest.learn": "simtest.dataset.learn",
    "simtest.report.nightly": "simtest.nightly.page",
}
"""Old and new name of a module; its submodules follow it. The first that fits counts."""

NAMES = {
    "simtest.estimators.base.fit_isophotes": "simtest.estimators.isophote_fit.fit_isophotes",
    "simtest.gate.records.Night": "simtest.nightly.records.NightlyRun",
}
"""Old and new full name of what changed its own name."""


class RenamedModules:
    """The finder of old module names, last on `sys.meta_path`; each is a module that looks names up in the new one."""

    @classmethod
    def find_spec(cls, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Return the spec of an old name; None for every other name, and where the new module does not exist."""
        from importlib.util import find_spec

        for old, new in MODULES.items():
            if name == old or name.startswith(f"{old}."):
                moved = new + name.removeprefix(old)
                try:
                    there = find_spec(moved) is not None
                except ModuleNotFoundError:
                    there = False
                return ModuleSpec(name, cls, origin=moved, is_package=True) if there else None  # type: ignore[arg-type]
        return None

    @staticmethod
    def create_module(spec: ModuleSpec) -> None:
        """Leave it to Python to make an empty module."""

    @staticmethod
    def exec_module(module: ModuleType) -> None:
        """Have the module look its names up in the new one."""
        old, new = module.__name__, str(module.__spec__ and module.__spec__.origin)
        _warn(old, new)
        module.__getattr__ = lambda name: lookup(old, name, new)  # type: ignore[method-assign]


def lookup(module: str, name: str, home: str | None = None) -> Any:
    """Return what a module calls by an old name, or else the attribute of that name in the module's new home."""
    if name.startswith("__"):
        # Python and its tools ask every module for such names; none of them was ever documented.
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    if (new := NAMES.get(f"{module}.{name}")) is not None:
        _warn(f"{module}.{name}", new)
        home, _, name = new.rpartition(".")
    if home is None:
        raise AttributeError(f"module {module!r} has no attribute {name!r}")
    return getattr(import_module(home), name)


def _warn(old: str, new: str) -> None:
    warnings.warn(f"{old} is now {new}; the old name goes in {GONE}", DeprecationWarning, stacklevel=3)


def install() -> None:
    """Let old module names be imported."""
    sys.meta_path.append(RenamedModules)
