"""A covering array: rows of levels in which each allowed pair of levels of two factors occurs."""

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations

import numpy as np

Row = dict[str, str]
Level = tuple[str, str]
"""A factor and one of its levels."""

Pair = tuple[Level, Level]
Factors = Mapping[str, Sequence[str]]

TRIES = 12
"""Rows that are tried for each row of the array."""


def pairs_of(factors: Factors) -> list[Pair]:
    """Return all pairs of levels of two factors, in the order of the factors."""
    return [
        ((first, a), (second, b))
        for first, second in combinations(factors, 2)
        for a in factors[first]
        for b in factors[second]
    ]


def pairs_in(row: Row) -> list[Pair]:
    """Return the pairs of levels that a row holds, in the order of its factors."""
    return list(combinations(row.items(), 2))


def covering_array(factors: Factors, allowed: Callable[[Pair], bool], least: int, seed: int = 0) -> list[Row]:
    """Return rows, at least `least`, that hold each allowed pair, and none that is not allowed.

    Rows are grown level by level, so that each adds most of the pairs that are held least often; the best of `TRIES`
    rows in random orders is taken. Once all pairs are held, further rows hold rare pairs again.

    Raises `ValueError`: if an allowed pair fits in no row.
    """
    rng = np.random.default_rng(seed)
    counts = dict.fromkeys(filter(allowed, pairs_of(factors)), 0)
    rows: list[Row] = []
    while len(rows) < least or not all(counts.values()):
        open_pairs = [pair for pair, count in counts.items() if not count] or [min(counts, key=lambda p: counts[p])]
        tried = [_grown(factors, counts, open_pairs[rng.integers(len(open_pairs))], rng) for _ in range(TRIES)]
        whole = [row for row in tried if row is not None]
        if not whole:
            raise ValueError(f"no row holds {open_pairs[0]}")
        best = max(whole, key=lambda row: sum(_worth(counts[pair]) for pair in pairs_in(row)))
        rows.append(best)
        for pair in pairs_in(best):
            counts[pair] += 1
    return rows


def _worth(count: int) -> float:
    """Return what a pair adds that is held so often: a missing one more than all others of a row."""
    return 1.0 if count == 0 else 1e-3 / count


def _grown(factors: Factors, counts: Mapping[Pair, int], start: Pair, rng: np.random.Generator) -> Row | None:
    """Grow a row from a pair, the factors in random order; None where no level of a factor is left."""
    chosen, order = dict(start), list(factors)
    for factor in rng.permutation([name for name in factors if name not in chosen]).tolist():
        worths = {}
        for level in rng.permutation(list(factors[factor])).tolist():
            # Pairs are written in the order of the factors.
            own = (factor, level)
            meets: list[Pair] = [
                (own, other) if order.index(factor) < order.index(other[0]) else (other, own)
                for other in chosen.items()
            ]
            if all(pair in counts for pair in meets):
                worths[level] = sum(_worth(counts[pair]) for pair in meets)
        if not worths:
            return None
        chosen[factor] = max(worths, key=lambda level: worths[level])
    return {factor: chosen[factor] for factor in order}
