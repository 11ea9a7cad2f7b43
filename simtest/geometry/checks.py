"""Checks of the numbers and parts that a user hands to a constructor."""

import math
from numbers import Integral, Real
from typing import Any

from simtest.errors import InputError


def check_number(name: str, value: Any, least: float | None = None, above: float | None = None) -> None:
    """Raise `InputError` where a value is no finite number, is less than `least`, or not more than `above`."""
    fits = is_finite_number(value)
    fits = fits and (least is None or value >= least) and (above is None or value > above)
    if not fits:
        bound = "" if least is None else f" >= {least:g}"
        bound += "" if above is None else f" > {above:g}"
        raise InputError(f"{name} = {value!r:.80}: must be a finite number{bound}")


def check_integer(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Raise `InputError` where a value is no integer from `least` to `most`."""
    fits = isinstance(value, Integral) and not isinstance(value, bool)
    if not (fits and value >= least and (most is None or value <= most)):
        bound = f">= {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{name} = {value!r:.80}: must be an integer {bound}")


def check_numbers(name: str, values: Any) -> None:
    """Raise `InputError` where a value is no sequence of finite numbers."""
    try:
        fits = not isinstance(values, str) and all(is_finite_number(value) for value in values)
    except TypeError:
        fits = False
    if not fits:
        raise InputError(f"{name} = {values!r:.80}: must be a sequence of finite numbers")


def check_kind(name: str, value: Any, kind: type) -> None:
    """Raise `InputError` where a value is no instance of a simtest type."""
    if not isinstance(value, kind):
        raise InputError(f"{name} is a {type(value).__name__}: must be a simtest {kind.__name__}")


def is_finite_number(value: Any) -> bool:
    """Return whether a value is a finite real number, of Python's or NumPy's; a truth value is none."""
    if not isinstance(value, Real) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:
        return False
