"""Which cases of a parametrisation bear a mark."""

from collections.abc import Iterable
from typing import Any

import pytest


def marked(cases: Iterable[Any], **marks: Iterable[Any]) -> list[Any]:
    """Return the cases of a parametrisation, with the marks of those that are listed under a mark's name."""
    known, listed = list(cases), {name: list(chosen) for name, chosen in marks.items()}
    assert all(case in known for chosen in listed.values() for case in chosen), listed

    def with_marks(case: Any) -> Any:
        names = [name for name, chosen in listed.items() if case in chosen]
        values = case if isinstance(case, tuple) else (case,)
        return pytest.param(*values, marks=[getattr(pytest.mark, name) for name in names])

    return [with_marks(case) for case in known]
