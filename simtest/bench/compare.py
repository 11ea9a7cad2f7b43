"""Compares the figures of two runs of the same cases: of a certificate, and of the run that verifies it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from simtest.runtime.files import JsonObject
from simtest.runtime.resources import shown
from simtest.validation.statistics import PENALTY_DEG

MEDIAN_DEG = 1e-3
"""How far medians of two processors may lie apart, deg."""

COUNTS = 0.01
"""Share of the highlights that may be answered by one processor and not by another: contours change their topology."""

FIGURES = 0.05
"""Share of itself by which any other figure may differ."""

SAME = 1e-9
"""Share by which figures of the same rows may differ: another library may add in another order."""

RESULTS = "results"
"""Key of the hash of a part's rows."""

_COUNTS = ("n", "answered", "missed", "false", "n_unanswered")
_MEDIANS = ("median_deg",)
_NOT_COMPARED = ("conventions",)
"""Texts for the reader, which hold figures."""

_SCENES = "scenes"
"""Key of the sums by scene, which are compared all together."""


@dataclass(frozen=True)
class Verified:
    """What a verification found.

    Parameters
    ----------
    problems : tuple of str
        What speaks against the certificate; none where it holds.
    notes : tuple of str
        What differs without speaking against it, and what was compared.
    """

    problems: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether nothing speaks against the certificate."""
        return not self.problems

    def to_json(self) -> JsonObject:
        """Return the finding as a JSON object."""
        return {"holds": self.holds, "problems": list(self.problems), "notes": list(self.notes)}


def compare(told: JsonObject, found: JsonObject) -> Verified:
    """Compare a certificate's content with that of another run of the same cases.

    Every figure of every part is compared: where the rows are the same, to rounding; else within what processors may
    differ by.
    """
    problems, notes = _compare_origin(told, found)
    for part, stated in told["parts"].items():
        again = found["parts"].get(part)
        if again is None:
            problems.append(f"{part}: was not run again")
        elif stated[RESULTS] == again[RESULTS]:
            notes.append(f"{part}: the same rows")
            problems += [f"{part}: {key} does not follow from the same rows" for key in differing(again, stated, SAME)]
        else:
            notes.append(f"{part}: other rows; every figure is compared within what processors may differ by")
            comparison = _Comparison(_changed(stated, again), [], [])
            comparison.tables(part, stated, again, max(again["n"], 1))
            problems += comparison.problems
            notes += comparison.notes
    return Verified(tuple(problems), tuple(notes))


def differing(first: JsonObject, second: JsonObject, tolerance: float) -> list[str]:
    """Return the keys whose values differ, numbers by more than a share of themselves."""
    keys = dict.fromkeys([*first, *second])
    return [key for key in keys if not alike(first.get(key), second.get(key), tolerance)]


def alike(first: object, second: object, tolerance: float) -> bool:
    """Return whether two values of JSON are the same, numbers up to a share of themselves."""
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(alike(first[key], second[key], tolerance) for key in first)
    if isinstance(first, list | tuple) and isinstance(second, list | tuple):
        return len(first) == len(second) and all(map(lambda a, b: alike(a, b, tolerance), first, second))
    if isinstance(first, float) and isinstance(second, int | float):
        return abs(first - second) <= tolerance * max(1.0, abs(first))
    return first == second


def _compare_origin(told: JsonObject, found: JsonObject) -> tuple[list[str], list[str]]:
    """Return what differs between two runs' cores, which is a problem, and between their machines, which is none."""
    problems = [
        f"core {key}: stated {shown(told['core'][key], 60)}, here {shown(found['core'][key], 60)}"
        for key in ("name", "version", "sha256")
        if told["core"][key] != found["core"][key]
    ]
    notes = [
        f"{key}: stated {shown(told['environment'].get(key), 80)}, here {shown(value, 80)}"
        for key, value in found["environment"].items()
        if told["environment"].get(key) != value and not isinstance(value, dict)
    ]
    programs = [core["core"].get("program") for core in (told, found)]
    if programs[0] != programs[1]:
        notes.append(f"core program: stated {shown(str(programs[0]), 120)}, here {shown(str(programs[1]), 120)}")
    stated = told["environment"]["versions"]
    notes += [
        f"{name}: stated {shown(stated.get(name), 40)}, here {version}"
        for name, version in found["environment"]["versions"].items()
        if stated.get(name) != version
    ]
    return problems, notes


def _changed(told: JsonObject, found: JsonObject) -> int:
    """Return how many highlights the counts of a part show to be answered by one run and not by the other."""
    return max(abs(int(told[key]) - int(found[key])) for key in ("n", "answered", "missed"))


@dataclass(frozen=True)
class _Comparison:
    """What a part's tables differ in: beyond what processors may differ by, and within.

    Parameters
    ----------
    changed : int
        Highlights that were answered by one run and not by the other: each may change a mean by 90 deg over its number.
    problems, notes : list of str
        Filled by `tables`.
    """

    changed: int
    problems: list[str]
    notes: list[str]

    def tables(self, where: str, told: JsonObject, found: JsonObject, n: int) -> None:
        """Compare two tables of figures about `n` highlights, key by key."""
        for key in dict.fromkeys([*found, *told]):
            if key == RESULTS or key in _NOT_COMPARED:
                continue
            stated: Any = told.get(key)
            again: Any = found.get(key)
            name = f"{where}.{shown(key, 60)}"
            if key == _SCENES and isinstance(stated, dict) and isinstance(again, dict):
                self._scenes(name, stated, again, found["score_deg"] or 0.0, n)
            elif key == "refused" and isinstance(stated, dict) and isinstance(again, dict):
                for reason in dict.fromkeys([*again, *stated]):
                    self._count(f"{name}.{shown(reason, 60)}", stated.get(reason, 0), again.get(reason, 0), n)
            elif isinstance(stated, dict) and isinstance(again, dict):
                self.tables(name, stated, again, max(int(again.get("n", n)), 1))
            elif key not in told or key not in found:
                self.problems.append(f"{name}: only {'here' if key in found else 'stated'}")
            elif key in _COUNTS:
                self._count(name, stated, again, n)
            else:
                self._value(name, key, stated, again, n)

    def _value(self, name: str, key: str, told: Any, found: Any, n: int) -> None:
        if _is_number(told) and _is_number(found):
            self._figure(name, key, told, found, self._allowed(key, found, n))
        elif _is_span(told) and _is_span(found):
            # A highlight more or less moves the ends farther than the figure.
            width = 0.1 * (found[1] - found[0])
            for end, stated, again in zip(("low", "high"), told, found, strict=True):
                self._figure(f"{name} {end}", key, stated, again, self._allowed(key, again, n) + width)
        elif told != found:
            self.problems.append(f"{name}: stated {shown(told, 60)}, here {shown(found, 60)}")

    def _allowed(self, key: str, found: float, n: int) -> float:
        if key in _MEDIANS:
            return MEDIAN_DEG
        if key in ("coverage", "interval"):
            return max(1.0, COUNTS * n) / n
        return MEDIAN_DEG + PENALTY_DEG * self.changed / n + FIGURES * abs(found)

    def _figure(self, name: str, key: str, told: float, found: float, allowed: float) -> None:
        if (apart := abs(told - found)) > allowed:
            unit = " deg" if "_deg" in key else ""
            self.problems.append(f"{name}: differs by {apart:.2g}{unit}; at most {allowed:.3g} is allowed")
        elif apart > SAME:
            self.notes.append(f"{name}: {told:.6g}, here {found:.6g}")

    def _scenes(self, name: str, told: JsonObject, found: JsonObject, score: float, n: int) -> None:
        """Compare scene by scene: the figures of all together say nothing of which scenes they come from."""
        if {case: len(held) for case, held in told.items()} != {case: len(held) for case, held in found.items()}:
            self.problems.append(f"{name}: other cases or another number of scenes")
            return
        pairs = [pair for case, held in found.items() for pair in zip(told[case], held, strict=True)]
        numbers = sum(abs(stated[0] - again[0]) for stated, again in pairs)
        if numbers > max(1.0, COUNTS * n):
            self.problems.append(f"{name}: the numbers of highlights differ by {numbers:g} over all scenes")
        apart, allowed = sum(abs(stated[1] - again[1]) for stated, again in pairs) / n, self._allowed(_SCENES, score, n)
        if apart > allowed:
            self.problems.append(f"{name}: differ by {apart:.2g} deg a highlight; at most {allowed:.3g} is allowed")

    def _count(self, name: str, told: int, found: int, n: int) -> None:
        most = max(1.0, COUNTS * n)
        if (apart := abs(told - found)) > most:
            self.problems.append(f"{name}: {told}, here {found}; at most {most:.3g} may differ")
        elif apart:
            self.notes.append(f"{name}: {told}, here {found}: contours changed their topology")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_span(value: Any) -> bool:
    return isinstance(value, Sequence) and len(value) == 2 and all(map(_is_number, value))
