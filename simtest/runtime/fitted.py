"""Numbers that were fitted to data: fitted.toml holds each with its unit, what it is, and the study that fits it."""

import tomllib
from functools import cache
from pathlib import Path

FILE = Path(__file__).parents[1] / "fitted.toml"


def fitted_number(name: str) -> float:
    """Return a number by its name, "fit.number"; raise `LookupError` for a name that the file does not hold."""
    try:
        return _numbers()[name]
    except KeyError:
        raise LookupError(f"{FILE.name}: no {name!r}; must be one of {', '.join(_numbers())}") from None


@cache
def _numbers() -> dict[str, float]:
    fits = tomllib.loads(FILE.read_text(encoding="utf-8"))
    return {
        f"{fit}.{name}": entry["value"] for fit, own in fits.items() for name, entry in own.items() if name != "study"
    }
