"""The tissue before a scope: curvature, relief and film of each organ, walls of it for an advice, and ranges for twins.

The wall is the quadric at the highlight, so that its distance can be set: its principal curvatures are drawn from those
of the highlights of the generated anatomies (middle 80 %, `simtest validate mesh` with all highlight points), and its
relief and film from the ranges of the dataset recipe `endoscopy_close`. Twins widen these, as patients are not alike.
The wavelengths matter most to them: they are the only scale of length that a picture shows, so they decide at which
distance a twin looks like the real highlight, and the error from a light beside the lens goes with 1 / distance.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from simtest.advice.scope import Interval, ReliefPrior, ends
from simtest.errors import InputError
from simtest.runtime.resources import find
from simtest.spec.recipes import load_dataset
from simtest.spec.toml_files import read_toml

MOST_TILT_DEG = 35.0
"""The wall is tilted by up to so much against the picture's plane, towards any side."""

RECIPE = "endoscopy_close"
"""Dataset recipe whose ranges of relief and film are drawn from."""

MESHES_IN_VIEW = 8.0
"""Of the net of vessels that have no colour, over the nearest view: so few are grown at once, and some must be."""

BANDS, FILM = "surface.relief.bands", "reflectance.film"
"""Keys of the recipe that matter to a normal; colours stay as in the scene."""

WIDER = 1.25
"""An organ's ranges reach so many times farther to both sides for twins; the level of the film, `WIDER_LEVEL`."""

WIDER_LEVEL = 0.3

CURVED_PER_MM, MOST_CURVED = 0.03, (-0.1, 0.2)
"""Scale of the curvatures of a tissue that nobody told, 1/mm: half are beyond 0.7 times it, as on folds and in lumens
of 2 to 8 cm across; and their bounds."""


@dataclass(frozen=True)
class Organ:
    """An organ: where its tissue stands, who looks at it, and how it is curved."""

    scene: str  # shipped scene whose tissue it is
    sensor: str  # preset that usually looks at it
    k1_per_mm: Interval  # range of a principal curvature, 1/mm, convex positive
    k2_per_mm: Interval
    smooth: bool = False  # whether it has no relief unless one is stated


ORGANS: dict[str, Organ] = {
    "colon": Organ("tissue_colon", "colonoscope_hd", (-0.12, 0.05), (-0.04, 0.16)),
    "stomach": Organ("tissue_stomach", "colonoscope_hd", (-0.05, -0.026), (-0.026, 0.22)),
    "liver": Organ("tissue_liver", "laparoscope_hd", (-0.045, 0.022), (0.016, 0.1)),
    "gallbladder": Organ("tissue_gallbladder", "laparoscope_hd", (0.045, 0.07), (0.006, 0.016)),
    "plane": Organ("tissue_gallbladder", "laparoscope_hd", (0.0, 0.0), (0.0, 0.0), smooth=True),
}
"""Organs by name; `plane` is a flat wet phantom."""

NAMES = tuple(name for name, organ in ORGANS.items() if not organ.smooth)
"""Organs whose highlights can have twins."""


@dataclass(frozen=True)
class Band:
    """A band of relief."""

    kinds: tuple[tuple[Mapping[str, Any], float], ...]  # keys of a scene's band but for the others, each with its share
    slope_deg: Interval  # drawn evenly
    wavelength_mm: Interval  # drawn evenly in the logarithm

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """Draw a band of a scene's relief."""
        number = int(rng.choice(len(self.kinds), p=[share for _, share in self.kinds]))
        drawn = {"slope_deg": float(rng.uniform(*self.slope_deg)), "wavelength_mm": between(rng, self.wavelength_mm)}
        return {**self.kinds[number][0], **drawn}


@dataclass(frozen=True)
class Surroundings:
    """What is set and drawn of a surface, by key path of a scene; a relief that is set is the whole table of it."""

    set: dict[str, Any]
    random: dict[str, Interval]

    @property
    def bands(self) -> list[Band]:
        """The bands of the relief; none of a smooth wall."""
        bands = []
        for number, band in enumerate(self.set.get("surface.relief", {"bands": []})["bands"]):
            fixed = {key: value for key, value in band.items() if key not in ("slope_deg", "wavelength_mm")}
            slope, wavelength = (
                self.random.get(f"{BANDS}.{number}.{key}", ends(band[key])) for key in ("slope_deg", "wavelength_mm")
            )
            bands.append(Band(((fixed, 1.0),), slope, wavelength))
        return bands

    def film(self, key: str) -> Interval:
        """Return both ends of a number of the film."""
        return self.random.get(f"{FILM}.{key}", ends(self.set[FILM][key]))


@cache
def _family(scene: str) -> tuple[Mapping[str, Any], Mapping[str, Interval]]:
    """Return what the recipe sets of a scene's relief, and what it draws of relief and film."""
    family = next(each for each in load_dataset(RECIPE).families if each.scene == scene)
    drawn = {**family.per_anatomy, **family.per_sample}
    held = {key: value for key, value in family.set.items() if key.startswith(BANDS)}
    return held, {key: (d.ends[0], d.ends[1]) for key, d in drawn.items() if key.startswith((BANDS, FILM))}


def rough(organ: Organ, relief: ReliefPrior | None) -> Surroundings:
    """Return relief and film of an organ, with the relief that is stated in place of its own."""
    base = read_toml(find(organ.scene, "scenes"))
    changes, drawn = _family(organ.scene)
    film = dict(base["reflectance"]["film"])
    if is_smooth(organ, relief):
        # Without valleys a film has no level.
        film.pop("level", None)
        return Surroundings({FILM: film}, {f"{FILM}.alpha": drawn[f"{FILM}.alpha"]})
    if relief is None:
        random, bands = dict(drawn), [dict(band) for band in base["surface"]["relief"]["bands"]]
        for key, value in changes.items():
            *_, number, name = key.split(".")
            bands[int(number)][name] = value
    else:
        stated = {name: ends(getattr(relief, name)) for name in ("slope_deg", "wavelength_mm")}
        random = {key: value for key, value in drawn.items() if not key.startswith(BANDS)}
        random |= {f"{BANDS}.0.{name}": (low, high) for name, (low, high) in stated.items() if high > low}
        bands = [{name: low for name, (low, _) in stated.items()}]
    return Surroundings({FILM: film, "surface.relief": {"bands": bands}}, random)


def is_smooth(organ: Organ, relief: ReliefPrior | None) -> bool:
    """Return whether the wall has no relief."""
    return organ.smooth if relief is None else ends(relief.slope_deg) == (0.0, 0.0)


def wall(organ: Organ, relief: ReliefPrior | None, view_mm: float) -> Surroundings:
    """Return the wall of an organ, seen over `view_mm` at least; its distance is left to the experiment."""
    own = rough(organ, relief)
    held = {**own.set, "reflectance.albedo": _pale(organ, view_mm)}
    # A whole table in place of the scene's: an anatomy's keys are none of a quadric's.
    bands = held.pop("surface.relief", None)
    surface: dict[str, Any] = {"type": "plane"}
    form: dict[str, Interval] = {"surface.tilt_deg": (0.0, MOST_TILT_DEG), "surface.azimuth_deg": (0.0, 360.0)}
    if not organ.k1_per_mm == organ.k2_per_mm == (0.0, 0.0):
        surface = {"type": "quadric", "k1_per_mm": organ.k1_per_mm[0], "k2_per_mm": organ.k2_per_mm[0]}
        form |= {"surface.spin_deg": (0.0, 180.0), "surface.k1_per_mm": organ.k1_per_mm}
        form |= {"surface.k2_per_mm": organ.k2_per_mm}
    if bands is not None:
        surface["relief"] = bands
    return Surroundings({"surface": surface, **held}, {**form, **own.random})


def _pale(organ: Organ, view_mm: float) -> dict[str, Any]:
    """Return the organ's colour without vessels: they take as long to grow as a frame, and lie below the film."""
    spacing = min(max(view_mm / MESHES_IN_VIEW, 0.2), 50.0)
    largest = min(spacing / 2, 5.0)
    vessels = {"largest_mm": largest, "smallest_mm": largest / 2, "spacing_mm": spacing, "strength": 0.0}
    preset = read_toml(find(organ.scene, "scenes"))["reflectance"]["albedo"]["preset"]
    return {"preset": preset, "vessels": vessels}


# Twins ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tissue:
    """What is known of a tissue that twins are made of."""

    bands: tuple[Band, ...]
    alpha: Interval  # ranges of the film's roughness and of its level
    level: Interval
    organ: Organ | None = None  # without it, curvatures have a Laplace distribution, and the colour is the nearest

    def draw_curvatures(self, rng: np.random.Generator) -> tuple[float, float]:
        """Draw the principal curvatures of the base, 1/mm."""
        if self.organ is None:
            # Most patches are nearly flat over a highlight, some are folds.
            k1, k2 = np.clip(rng.laplace(0.0, CURVED_PER_MM, 2), *MOST_CURVED).tolist()
            return k1, k2
        return float(rng.uniform(*self.organ.k1_per_mm)), float(rng.uniform(*self.organ.k2_per_mm))

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


def tissue_of(name: str | None) -> Tissue:
    """Return what is known of an organ's tissue; `ANY` of none."""
    if name is None:
        return ANY
    if name not in NAMES:
        raise InputError(f"--organ {name}: must be one of {', '.join(NAMES)}")
    own = rough(ORGANS[name], None)
    bands = tuple(Band(each.kinds, _wider(each.slope_deg), _wider(each.wavelength_mm)) for each in own.bands)
    low, high = own.film("level")
    return Tissue(bands, _wider(own.film("alpha")), (low - WIDER_LEVEL, high + WIDER_LEVEL), ORGANS[name])


def _wider(interval: Interval) -> Interval:
    return interval[0] / WIDER, interval[1] * WIDER


def between(rng: np.random.Generator, interval: Interval) -> float:
    """Draw a number that is log-uniform in an interval."""
    return float(math.exp(rng.uniform(math.log(interval[0]), math.log(interval[1]))))
