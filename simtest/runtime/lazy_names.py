"""Names of a package that are imported at first use: loading the package loads none of its modules."""

import importlib
import re
import sys
from collections.abc import Callable
from typing import Any

_BLOCK = re.compile(r"^if TYPE_CHECKING:\n((?:    .*\n|\n)+)", re.MULTILINE)
_IMPORT = re.compile(r"^    from ([\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package.

    Its names are stated once, as it imports them for type checkers: under ``if TYPE_CHECKING``, each from the module
    that defines it.
    """
    loader: Any = sys.modules[package].__spec__.loader  # type: ignore[union-attr]
    block = _BLOCK.search(loader.get_source(package))
    imports = _IMPORT.findall(block[1] if block else "")
    home = {name: module for module, names in imports for name in re.findall(r"\w+", names)}

    def lookup(name: str) -> Any:
        if name not in home:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(home[name]), name)
        # Found by itself from now on.
        setattr(sys.modules[package], name, value)
        return value

    return lookup, lambda: sorted(home), sorted(home)
