"""A mutant: one fault in the source of the code that runs, by the mechanism of `studies.gate.faults`."""

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from simtest.runtime.kept_arrays import SOURCES
from studies.gate.faults import Mutation


@dataclass(frozen=True)
class Change:
    """A change of one function's source.

    Parameters
    ----------
    where : str
        "package.module:Class.function". A property, a cached or a class-level function stands for what it wraps.
    old, new : str
        What of its source, found once, becomes what.
    """

    where: str
    old: str
    new: str

    def mutation(self) -> Mutation:
        """Import the function, and return the change as it is planted; raise `LookupError` if there is none."""
        module, _, path = self.where.partition(":")
        try:
            found = functools.reduce(_attribute, path.split("."), importlib.import_module(module))
        except (AttributeError, ImportError) as error:
            raise LookupError(f"{self.where}: no such function ({error})") from None
        return Mutation(_bare(found), self.old, self.new)


@dataclass(frozen=True)
class Mutant:
    """A planted fault.

    Parameters
    ----------
    name : str
        What is wrong, in words.
    kind : str
        A key of `studies.mutants.kinds.KINDS`, which says what names the fault.
    changes : tuple of Change
        Of the source; none: the code as it is.
    """

    name: str
    kind: str
    changes: tuple[Change, ...]

    def mutations(self) -> tuple[Mutation, ...]:
        """Return the changes as they are planted; raise `LookupError` where one does not apply to today's source."""
        made = tuple(change.mutation() for change in self.changes)
        for mutation in made:
            mutation.code()
        return made

    @property
    def spoils_kept_arrays(self) -> bool:
        """Whether arrays that are kept from process to process would be others under the fault."""
        below = tuple(f"simtest.{source.removesuffix('.py').replace('/', '.')}" for source in SOURCES)
        return any(change.where.startswith(below) for change in self.changes)


def mutant(name: str, kind: str, where: str, old: str, new: str) -> Mutant:
    """Return a mutant of one change."""
    return Mutant(name, kind, (Change(where, old, new),))


def _attribute(holder: Any, name: str) -> Any:
    """Return an attribute as it stands in a class, without calling what a property would call."""
    return vars(holder)[name] if isinstance(holder, type) and name in vars(holder) else getattr(holder, name)


def _bare(found: Any) -> Callable[..., Any]:
    """Return the function behind a property, a class method or a cache."""
    for inner in ("fget", "func", "__func__", "__wrapped__"):
        found = getattr(found, inner, None) or found
    return found  # type: ignore[no-any-return]
