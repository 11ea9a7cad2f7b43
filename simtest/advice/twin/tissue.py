"""What is known of the tissue that twins are made of: ranges of its curvature, its relief and its liquid film.

Where the organ is told, the curvatures are those of the generated anatomy, and relief and film have the ranges of the
dataset recipe `endoscopy`, widened, since no two patients are alike. The wavelengths matter most: they are the only
scale of length that a picture shows, so they decide at which distance a twin looks like the real highlight, and the
error from a light beside the lens goes with 1 / distance.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.advice.organs import ORGANS, rough
from simtest.advice.scope import Interval
from simtest.errors import InputError

WIDER = 1.25
"""An organ's ranges reach so many times farther to both sides; the level of the film, `WIDER_LEVEL` farther."""

WIDER_LEVEL = 0.3

CURVED_PER_MM, MOST_CURVED = 0.03, (-0.1, 0.2)
"""Scale of the curvatures of a tissue that nobody told, 1/mm: half are beyond 0.7 times it, as on folds and in lumens
of 2 to 8 cm across; and their bounds."""

NAMES = tuple(name for name, organ in ORGANS.items() if not organ.smooth)
"""Organs that can be told."""


@dataclass(frozen=True)
class Band:
    """A band of relief.

    Parameters
    ----------
    kinds : tuple of (dict, float)
        Keys of a scene's band but for slope and wavelength, each with its share.
    slope_deg, wavelength_mm : (float, float)
        Ranges: drawn evenly, and evenly in the logarithm.
    """

    kinds: tuple[tuple[Mapping[str, Any], float], ...]
    slope_deg: Interval
    wavelength_mm: Interval

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw a band of a scene's relief."""
        number = int(rng.choice(len(self.kinds), p=[share for _, share in self.kinds]))
        drawn = {"slope_deg": float(rng.uniform(*self.slope_deg)), "wavelength_mm": between(rng, self.wavelength_mm)}
        return {**self.kinds[number][0], **drawn}


@dataclass(frozen=True)
class Tissue:
    """What is known of a tissue.

    Parameters
    ----------
    bands : tuple of Band
        Its relief.
    alpha, level : (float, float)
        Ranges of the film's roughness and of its level.
    k1_per_mm, k2_per_mm : (float, float), optional
        Ranges of the base's principal curvatures, 1/mm, convex positive; without them, draws have a Laplace
        distribution: most patches are nearly flat over a highlight, some are folds.
    scene : str, optional
        Shipped scene whose colour and translucency it has; without it, that of the nearest colour.
    """

    bands: tuple[Band, ...]
    alpha: Interval
    level: Interval
    k1_per_mm: Interval | None = None
    k2_per_mm: Interval | None = None
    scene: str | None = None

    def draw_curvatures(self, rng: np.random.Generator) -> tuple[float, float]:
        """Draw the principal curvatures of the base, 1/mm."""
        if self.k1_per_mm is None or self.k2_per_mm is None:
            k1, k2 = np.clip(rng.laplace(0.0, CURVED_PER_MM, 2), *MOST_CURVED).tolist()
            return k1, k2
        return float(rng.uniform(*self.k1_per_mm)), float(rng.uniform(*self.k2_per_mm))

    def __str__(self) -> str:
        waves = " and ".join("{:.2g} to {:.2g}".format(*band.wavelength_mm) for band in self.bands)
        slopes = " and ".join("{:.2g} to {:.2g}".format(*band.slope_deg) for band in self.bands)
        return f"wavelengths {waves} mm, slopes {slopes} deg"


ANY = Tissue(
    bands=(
        Band((({"kind": "ridged", "width": 0.4}, 0.25), ({"kind": "gaussian", "width": 0.4}, 0.75)), (1.5, 6.0),
             (1.2, 3.5)),
        Band(tuple(({"kind": kind}, 1 / 3) for kind in ("ridged", "pits", "gaussian")), (1.5, 7.0), (0.5, 1.25)),
    ),
    alpha=(0.018, 0.05),
    level=(-2.0, 0.3),
)  # fmt: skip
"""Of an organ that nobody told."""


def tissue_of(organ: str | None) -> Tissue:
    """Return what is known of an organ's tissue; `ANY` of none."""
    if organ is None:
        return ANY
    if organ not in NAMES:
        raise InputError(f"--organ {organ}: must be one of {', '.join(NAMES)}")
    form = ORGANS[organ]
    held, drawn = rough(form, None)
    bands = []
    for number, band in enumerate(held["surface.relief"]["bands"]):
        fixed = {key: value for key, value in band.items() if key not in ("slope_deg", "wavelength_mm")}
        slope, wavelength = (
            _wider(drawn.get(f"surface.relief.bands.{number}.{key}", (band[key], band[key])))
            for key in ("slope_deg", "wavelength_mm")
        )
        bands.append(Band(((fixed, 1.0),), slope, wavelength))
    film = held["reflectance.film"]
    level = drawn.get("reflectance.film.level", (film["level"], film["level"]))
    alpha = drawn.get("reflectance.film.alpha", (film["alpha"], film["alpha"]))
    film_level = level[0] - WIDER_LEVEL, level[1] + WIDER_LEVEL
    return Tissue(tuple(bands), _wider(alpha), film_level, form.k1_per_mm, form.k2_per_mm, form.scene)


def _wider(ends: Interval) -> Interval:
    return ends[0] / WIDER, ends[1] * WIDER


def between(rng: np.random.Generator, ends: Interval) -> float:
    """Draw a number that is log-uniform between two ends."""
    return float(math.exp(rng.uniform(math.log(ends[0]), math.log(ends[1]))))
