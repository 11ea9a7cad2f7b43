"""Names of a package that are imported at first use: loading the package loads none of its modules."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any


def lazy_names(
    package: str, homes: Mapping[str, Sequence[str]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names live in other modules.

    Parameters
    ----------
    package : str
        Full name of the package, for the error of an unknown name.
    homes : mapping
        Full name of a module, and the names that it defines.
    """
    home = {name: module for module, names in homes.items() for name in names}

    def lookup(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        import importlib
        import sys

        value = getattr(importlib.import_module(home[name]), name)
        # Found by itself from now on.
        setattr(sys.modules[package], name, value)
        return value

    return lookup, lambda: sorted(home)
