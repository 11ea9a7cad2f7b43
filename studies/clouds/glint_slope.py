"""Slope of a relief where it shines, over that of all its surface: python -m studies.clouds.glint_slope.

Glints lie with the weight abs(det(M/d - H)), H the relief's Hessian (theory.md 7.1). For a Gaussian relief slope and H
at a point are independent; pits and ridges are steep where they bend, so a cloud of theirs is wider than their slope.
"""

import sys

import numpy as np

from simtest.spec import load_scene
from simtest.surfaces.relief_field import make_relief

POINTS, REACH_MM, SEEDS = 4000, 60.0, (1, 2, 3)

BASE_PER_MM = 0.04
"""(1 + d k) / d of the base: small beside H."""


def slopes_deg(organ: str, seed: int) -> tuple[float, float]:
    """Return the slope along one direction of a shipped organ's relief, and that of its glints, deg."""
    relief = load_scene(f"tissue_{organ}", {"surface.relief.seed": seed}).surface.relief
    assert relief is not None
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-REACH_MM, REACH_MM, (POINTS, 2)), np.zeros(POINTS)])
    jets = make_relief(relief).tissue_jets(points)
    squares = (jets.gradient[:, :2] ** 2).sum(axis=1) / 2
    weights = np.abs(np.linalg.det(BASE_PER_MM * np.eye(2) - jets.hessian[:, :2, :2]))
    everywhere, shining = squares.mean(), np.average(squares, weights=weights)
    return float(np.degrees(np.sqrt(everywhere))), float(np.degrees(np.sqrt(shining)))


def main() -> int:
    """Run the study."""
    for organ in ("colon", "liver", "stomach"):
        every, shining = np.mean([slopes_deg(organ, seed) for seed in SEEDS], axis=0)
        print(f"{organ}: slope {every:.1f} deg, of its glints {shining:.1f} deg, {shining / every:.2f} times")
    return 0


if __name__ == "__main__":
    sys.exit(main())
