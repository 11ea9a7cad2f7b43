"""Plants faults: replacements in the source of functions, compiled into those very functions.

Whoever holds such a function runs the fault, wherever he has it from.
"""

import contextlib
import functools
import importlib
import inspect
import textwrap
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Mutation:
    """A change of one function's source.

    `function`: whose code is replaced; `old`, `new`: what of its source, found once, becomes what.
    """

    function: Callable[..., Any]
    old: str
    new: str

    def code(self) -> Any:
        """Compile the changed source; raise `LookupError` if it does not apply to the source as it is."""
        source, name = textwrap.dedent(inspect.getsource(self.function)), self.function.__qualname__
        if source.count(self.old) != 1:
            raise LookupError(f"{name}: {self.old!r} occurs {source.count(self.old)} times; must be found once")
        # The decorator of a property or class method would wrap what is wanted bare.
        lines = source.replace(self.old, self.new).splitlines()
        first = next(number for number, line in enumerate(lines) if line.startswith("def "))
        made: dict[str, Any] = {}
        text = "\n".join(lines[first:])
        exec(compile(text, f"<{name}, changed>", "exec"), self.function.__globals__.copy(), made)
        return made[self.function.__name__].__code__


def function_at(where: str) -> Callable[..., Any]:
    """Import a function, "package.module:Class.function"; raise `LookupError` if there is none.

    A property, a cached or a class-level function stands for what it wraps.
    """
    module, _, path = where.partition(":")
    try:
        found = functools.reduce(_attribute, path.split("."), importlib.import_module(module))
    except (AttributeError, ImportError) as error:
        raise LookupError(f"{where}: no such function ({error})") from None
    for inner in ("fget", "func", "__func__", "__wrapped__"):
        found = getattr(found, inner, None) or found
    return found  # type: ignore[no-any-return]


def _attribute(holder: Any, name: str) -> Any:
    """Return an attribute as it stands in a class, without calling what a property would call."""
    return vars(holder)[name] if isinstance(holder, type) and name in vars(holder) else getattr(holder, name)


def plant(mutations: Iterable[Mutation]) -> Callable[[], None]:
    """Plant changes, all or none; return what takes them out again."""
    made = [(mutation.function, mutation.function.__code__, mutation.code()) for mutation in mutations]
    for function, _, code in made:
        function.__code__ = code

    def take_out() -> None:
        for function, before, _ in made:
            function.__code__ = before

    return take_out


@contextlib.contextmanager
def planted(*mutations: Mutation) -> Iterator[None]:
    """Run with changes; sessions and pipelines that hold what was made before are let go."""
    from simtest.validation.case_work import forget
    from simtest.validation.paper.rows import pipeline_with

    def forget_all() -> None:
        forget()
        pipeline_with.cache_clear()

    take_out = plant(mutations)
    forget_all()
    try:
        yield
    finally:
        take_out()
        forget_all()
