"""The cells that pixels are sorted into: zones, and bins of what makes normals hard."""

import itertools
from dataclasses import dataclass

import numpy as np

from simtest.dataset.scoring.dense.frame_truth import SURFACES, FrameTruth
from simtest.dataset.scoring.dense.zones import RINGS, ZONES
from simtest.runtime.arrays import Array, IntArray

_INF = np.inf

BINS = {
    "d_k": (-_INF, -1.0, -0.3, -0.1, 0.1, 0.3, 1.0, 3.0, _INF),
    "eps_over_d": (0.0, 0.01, 0.03, 0.1, 0.3, _INF),
    "distance_mm": (0.0, 5.0, 10.0, 20.0, 40.0, 80.0, _INF),
}
"""Edges of the bins; a value on an edge lies in the bin above it.

d_k is the distance times the principal curvature of the larger size, of the surface that is scored."""

SCOPES = ("everywhere", "highlights")
"""Where the bins count: at all scored pixels, and at those of highlights alone."""


@dataclass(frozen=True)
class Cell:
    """A cell: its way of sorting (zone, d_k, ...), its label, and where it counts."""

    group: str
    label: str
    scope: str = "everywhere"


def _bin_names(edges: tuple[float, ...]) -> list[str]:
    names = []
    for low, high in itertools.pairwise(edges):
        lowest = low in (-_INF, 0.0) and low == edges[0]
        names.append(f"< {high:g}" if lowest else f">= {low:g}" if high == _INF else f"{low:g} to {high:g}")
    return names


ZONE_CELLS = (Cell("zone", "all"), *(Cell("zone", name) for name in ZONES))
CELLS = (
    *ZONE_CELLS,
    *(Cell(group, name, scope) for scope in SCOPES for group, edges in BINS.items() for name in _bin_names(edges)),
)
"""All cells, in the order of the tallies."""

ZONE_MEANINGS = {
    "all": "every scored pixel",
    "highlight": "visible highlights of the noise-free frame, down to half of each one's height",
    **{
        f"ring_{outer:g}": f"{inner:g} to {outer:g} radii outside a highlight's edge"
        for inner, outer in zip((0.0, *RINGS[:-1]), RINGS, strict=True)
    },
    "elsewhere": f"more than {RINGS[-1]:g} radii from every highlight",
}


def labels(truth: FrameTruth, surface: str) -> list[IntArray]:
    """Return the cells of the scored pixels, shape (N,), -1 for none: an array for each way of sorting them.

    `surface` is the one of `SURFACES` against which is scored.
    """
    scored = truth.scored
    zone = truth.zone[scored].astype(np.int64)
    at_highlight = zone == ZONES.index("highlight")
    sorted_in = [np.zeros(len(zone), dtype=np.int64), 1 + zone]
    first = len(ZONE_CELLS)
    values = _quantities(truth, surface)
    for scope in SCOPES:
        for group, edges in BINS.items():
            own = values[group]
            number = np.clip(np.searchsorted(edges, own, side="right") - 1, 0, len(edges) - 2)
            counts = np.isfinite(own) & (at_highlight if scope == "highlights" else True)
            sorted_in.append(np.where(counts, first + number, -1))
            first += len(edges) - 1
    return sorted_in


def _quantities(truth: FrameTruth, surface: str) -> dict[str, Array]:
    """Return what the bins sort by, at the scored pixels."""
    assert surface in SURFACES
    distance = truth.distance[truth.scored]
    return {
        "d_k": distance * truth.curvature[surface][truth.scored],
        "eps_over_d": truth.eps / distance,
        "distance_mm": distance,
    }
