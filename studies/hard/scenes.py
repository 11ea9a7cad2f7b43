"""Scenes of the corpus, drawn from seeds: smooth and tissue surfaces, each with a base relief of its own.

A scene is a mapping of nested tables (`simtest.spec.scene_from_dict`); the rows of the corpus change it
(`studies.hard.rows`). Anatomies of the two splits have different seeds, and so have all other draws.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from simtest.runtime.seeds import Stage, generator

Tables = dict[str, Any]

SPLITS = {"train": 0, "test": 5000}
"""Where the numbers of the scenes begin; scenes of the first are for fitting, no figure is quoted on them."""

KINDS = ("plane", "colon", "cylinder", "liver", "gallbladder", "stomach")

WIDTH, HEIGHT = 480, 360

BASE_SLOPES_DEG = (0.0, 2.0)
"""Relief of the rows that speak of something else: every second scene of a kind is smooth."""

VIEWS_PER_ANATOMY = 4
"""Scenes that share one mesh: making it takes longer than a frame."""

STOMACH = {
    "length_mm": 200.0, "radius_mm": 38.0, "taenia_mm": 0.0, "fold_depth_mm": 4.0, "fold_edge_mm": 6.0,
    "fold_spacing_mm": 30.0, "fold_concentration": 1.0,
}  # fmt: skip
"""The gastric body of scenes/tissue_stomach.toml."""

VESSELS = {"colon": "colon_mucosa", "liver": "liver_capsule", "stomach": "stomach", "gallbladder": "gallbladder"}
"""Pattern of the tissue's colour, where a row shows it."""


def rng_of(number: int, name: str) -> np.random.Generator:
    """Return the generator of one aspect of a scene, so that an aspect drawn more does not move the others."""
    return generator(19, "hard", name, number, Stage.SWEEP)


def kind_of(number: int) -> str:
    """Return what kind of surface a scene shows."""
    return KINDS[number % len(KINDS)]


def base_slope_deg(number: int) -> float:
    """Return the slope of a scene's relief in the rows that do not set it."""
    return BASE_SLOPES_DEG[(number // len(KINDS)) % len(BASE_SLOPES_DEG)]


def relief(number: int, slope_deg: float) -> Tables | None:
    """Return the relief of a scene at a slope, isotropic and gaussian; None at 0."""
    if slope_deg <= 0:
        return None
    rng = rng_of(number, "relief")
    band = {"slope_deg": slope_deg, "wavelength_mm": _between(rng, 1.5, 5.0)}
    return {"bands": [band], "seed": int(rng.integers(2**31))}


def base_scene(number: int) -> Tables:
    """Return a scene without relief, light at the camera, with the sensor of the plain rows."""
    rng, kind = rng_of(number, "scene"), kind_of(number)
    focal = float(rng.uniform(260, 420))
    smooth = kind in ("plane", "cylinder")
    # Half of the anatomies shine as the smooth surfaces do, the others are wet.
    if smooth or rng.random() < 0.3:
        lobe: Tables = {"type": "phong", "exponent": _between(rng, 100, 800), "diffuse": 0.3}
    else:
        lobe = {"type": "tissue", "film": {"index": 1.34, "alpha": float(rng.uniform(0.025, 0.045))}, "diffuse": 0.3}
    if kind in VESSELS:
        lobe["colour"] = [0.85, 0.45, 0.40] if kind != "liver" else [0.5, 0.2, 0.15]
    surface = _SURFACES[kind](rng, number)
    return {
        "name": f"{kind} {number}",
        "surface": surface,
        "reflectance": lobe,
        "camera": {"width": WIDTH, "height": HEIGHT, "fx": focal, "fy": focal},
        "render": {"samples_per_pixel": 4},
        "sensor": {"point_spread_px": float(rng.uniform(0.6, 1.0)), "noise_sigma": 0.01, "exposure": {"gain": 0.8}},
    }


def at_distance(tables: Tables, distance_mm: float) -> Tables:
    """Return a scene of an analytic surface at another distance, its shape relative to the distance kept."""
    surface = dict(tables["surface"])
    if "distance_mm" not in surface:
        return tables
    share = distance_mm / surface["distance_mm"]
    surface["distance_mm"] = distance_mm
    for key, power in (("radius_mm", 1), ("k1_per_mm", -1), ("k2_per_mm", -1)):
        if key in surface:
            surface[key] *= share**power
    return tables | {"surface": surface}


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _placed(rng: np.random.Generator, low: float, high: float, most_deg: float) -> Tables:
    return {
        "distance_mm": _between(rng, low, high),
        "tilt_deg": float(rng.uniform(0, most_deg)),
        "azimuth_deg": float(rng.uniform(0, 360)),
    }


def _plane(rng: np.random.Generator, number: int) -> Tables:
    return {"type": "plane", **_placed(rng, 8, 50, 25)}


def _cylinder(rng: np.random.Generator, number: int) -> Tables:
    placed = _placed(rng, 8, 50, 15)
    inside = rng.random() < 0.4
    radius = placed["distance_mm"] * float(rng.uniform(1.5, 4) if inside else np.exp(rng.uniform(-1.0, 1.4)))
    spin = float(rng.uniform(0, 180))
    return {"type": "cylinder", **placed, "radius_mm": radius, "spin_deg": spin} | (
        {"side": "inside"} if inside else {}
    )


def _gallbladder(rng: np.random.Generator, number: int) -> Tables:
    placed = _placed(rng, 20, 60, 20)
    k = np.array([rng.uniform(0.8, 3.0), rng.uniform(0.1, 0.8)]) / placed["distance_mm"]
    return {"type": "quadric", **placed, "spin_deg": float(rng.uniform(0, 180)), "k1_per_mm": float(k[0]),
            "k2_per_mm": float(k[1])}  # fmt: skip


def _anatomy(path: str, **recipe: float) -> Callable[[np.random.Generator, int], Tables]:
    def made(rng: np.random.Generator, number: int) -> Tables:
        group = number // (len(KINDS) * VIEWS_PER_ANATOMY)
        seed = 700 + group + (0 if number < SPLITS["test"] else 5000)
        surface: Tables = {"type": "anatomy", "path": path, "seed": seed, "viewpoint": int(rng.integers(100_000))}
        if path == "colon":
            # A light at the camera shines back from the wall that the camera faces.
            view = ("wall", "wall", "off_axis")[int(rng.integers(3))]
            share, around = float(rng.uniform(0.1, 0.9)), float(rng.uniform(0, 360))
            surface |= {"view": view, "path_share": share, "around_deg": around}
        return surface | ({"recipe": recipe} if recipe else {})

    return made


_SURFACES: dict[str, Callable[[np.random.Generator, int], Tables]] = {
    "plane": _plane,
    "cylinder": _cylinder,
    "gallbladder": _gallbladder,
    "colon": _anatomy("colon"),
    "liver": _anatomy("liver"),
    "stomach": _anatomy("colon", **STOMACH),
}
