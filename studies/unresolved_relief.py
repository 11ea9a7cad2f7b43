"""Print how relief below a pixel widens a film's highlight (theory.md, 7.6): `python -m studies.unresolved_relief`.

A plane under a light at the camera, with relief of waves far below a third of a pixel, seen through many samples. Half
the width of its highlight at half height, as an angle between normal and sightline, is compared with that of a smooth
plane: Beckmann's with a rougher film, alpha^2 + 2 s^2, rendered too; GGX's with the film's own lobe convolved
numerically with the Gaussian slopes. Printed beside them is what the rule of variances alone would say of GGX.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from simtest.rendering import Session
from simtest.runtime.arrays import Array
from simtest.spec import Scene, scene_from_dict
from simtest.spec.reflectance import TissueReflectance

DISTANCE_MM = 40.0
FOCAL_PX = 160.0
WAVELENGTH_MM = 0.02
"""A pixel is 0.25 mm wide: more than twelve waves."""

SIZE_PX = 65
SAMPLES = 512
INDEX = 1.36
ALPHA = 0.05
SLOPES_DEG = (2.0, 4.0)
DISTRIBUTIONS = ("beckmann", "ggx")

REACH = 1.7
"""Pixels up to so many half-widths of a Gaussian lobe are used."""

TERMS = 6
"""Of the polynomial in the squared slope that is fitted to the logarithm of the radiance."""


@dataclass(frozen=True)
class Widening:
    """One comparison.

    `distribution`: of the film's slopes; `slope_deg`: standard deviation of the relief's slope along one direction,
    deg; `seen_deg`, `expected_deg`: half-width at half height, deg: rendered with relief; of the rougher film, or
    by convolution; `smooth_deg`: by closed form, of the film without relief; `variances_deg`: by closed form, of a
    film of the same distribution with alpha^2 + 2 s^2.
    """

    distribution: str
    slope_deg: float
    seen_deg: float
    expected_deg: float
    smooth_deg: float
    variances_deg: float

    @property
    def error(self) -> float:
        """Share by which the rendered width differs from the expected one."""
        return self.seen_deg / self.expected_deg - 1


def scene(alpha: float, distribution: str, slope_deg: float, samples: int = SAMPLES, seed: int = 0) -> Scene:
    """Return the plane with a film, and with relief if its slope is above 0."""
    film = {"index": INDEX, "alpha": ALPHA, "distribution": distribution}
    surface: dict[str, object] = {"type": "plane", "distance_mm": DISTANCE_MM}
    if slope_deg > 0:
        band = {"slope_deg": slope_deg, "wavelength_mm": WAVELENGTH_MM}
        surface["relief"] = {"bands": [band], "seed": seed}
    described = scene_from_dict(
        {
            "surface": surface,
            "reflectance": {"type": "tissue", "film": film, "diffuse": 0.0},
            "camera": {"width": SIZE_PX, "height": SIZE_PX, "fx": FOCAL_PX, "fy": FOCAL_PX},
            "render": {"samples_per_pixel": samples},
        }
    )
    # Set past the check: the rougher film of the comparison may be rougher than a film in a scene file.
    reflectance = described.reflectance
    assert isinstance(reflectance, TissueReflectance)
    rough = reflectance.model_copy(update={"film": reflectance.film.model_copy(update={"alpha": alpha})})
    return described.model_copy(update={"reflectance": rough})


@cache
def half_width_deg(alpha: float, distribution: str, slope_deg: float) -> float:
    """Render a plane and return the half-width of its highlight at half height, deg."""
    radiance = Session(scene(alpha, distribution, slope_deg)).radiance().specular.astype(float)
    x, y = np.meshgrid(*2 * [(np.arange(SIZE_PX) + 0.5 - SIZE_PX / 2) / FOCAL_PX])
    squared = (x**2 + y**2).ravel()
    rough = math.sqrt(alpha**2 + 2 * math.radians(slope_deg) ** 2)
    near = squared < REACH**2 * math.log(2) * rough**2
    # The logarithm of the radiance is a smooth function of the squared slope; every pixel weighs the same.
    scaled = squared[near] / squared[near].max()
    values = np.polynomial.Polynomial.fit(scaled, np.log(radiance.ravel()[near]), TERMS, domain=[0, 1])
    fine = np.linspace(0, 1, 20_001)
    fallen = values(fine) - values(0.0)
    return math.degrees(math.atan(math.sqrt(_crossing(fine, fallen) * squared[near].max())))


def _crossing(at: Array, logarithm: Array) -> float:
    """Return where a falling logarithm passes one half first."""
    first = int(np.argmax(logarithm < -math.log(2)))
    share = (logarithm[first - 1] + math.log(2)) / (logarithm[first - 1] - logarithm[first])
    return float(at[first - 1] + share * (at[first] - at[first - 1]))


def lobe(squared: Array, alpha: float, distribution: str) -> Array:
    """Return the radiance of a film with the light at the camera over the squared tangent of the normal's angle.

    D G1^2 / (4 cos); Fresnel's factor is that of straight incidence on the facets everywhere.
    """
    cosine = 1 / np.sqrt(1 + squared)
    if distribution == "beckmann":
        # Smith's function differs from 1 by less than 1e-9 below 45 deg for alpha up to 0.2.
        return np.exp(-squared / alpha**2) / alpha**2 / cosine**5
    hidden = (np.sqrt(1 + alpha**2 * squared) - 1) / 2
    return 1 / (1 + squared / alpha**2) ** 2 / alpha**2 / cosine**5 / (1 + hidden) ** 2


def convolved_half_width_deg(alpha: float, distribution: str, slope_deg: float, nodes: int = 201) -> float:
    """Return the half-width of a lobe averaged over Gaussian slopes of a plane, with the falloff of the light, deg."""
    s = math.radians(slope_deg)
    grid = np.linspace(-5, 5, nodes) * s
    weights = np.exp(-(grid**2) / 2 / s**2) if s > 0 else np.ones(nodes)
    # A normal turned by slopes (p, q) and a sightline at tangent t: its angle's cosine is (1 + p t)/(|n| |v|).
    p, q = np.meshgrid(grid, grid, indexing="ij")
    tangents = np.linspace(0, 4 * math.sqrt(alpha**2 + 2 * s**2), 400)
    values = []
    for t in tangents:
        cosine = (1 + p * t) / np.sqrt((1 + p**2 + q**2) * (1 + t**2))
        mean = np.average(lobe(1 / cosine**2 - 1, alpha, distribution), weights=weights[:, None] * weights)
        # The light falls off with the squared distance, which grows as 1 + t^2 on a plane.
        values.append(mean / (1 + t**2))
    return math.degrees(math.atan(_crossing(tangents, np.log(values) - math.log(values[0]))))


def widening(distribution: str, slope_deg: float, alpha: float = ALPHA) -> Widening:
    """Compare one film over relief with what theory expects."""
    rougher = math.sqrt(alpha**2 + 2 * math.radians(slope_deg) ** 2)
    if distribution == "beckmann":
        expected = half_width_deg(rougher, distribution, 0.0)
    else:
        expected = convolved_half_width_deg(alpha, distribution, slope_deg)
    smooth, variances = (convolved_half_width_deg(a, distribution, 0.0) for a in (alpha, rougher))
    seen = half_width_deg(alpha, distribution, slope_deg)
    return Widening(distribution, slope_deg, seen, expected, smooth, variances)


def main() -> None:
    """Print a row for each film and slope."""
    print("| film | s, deg | half-width without relief, deg | rendered with relief | expected | error | by variances |")
    print("|---|---|---|---|---|---|---|")
    for distribution in DISTRIBUTIONS:
        for slope_deg in SLOPES_DEG:
            row = widening(distribution, slope_deg)
            print(
                f"| {distribution}, {ALPHA:g} | {slope_deg:g} | {row.smooth_deg:.3f} | {row.seen_deg:.3f} "
                f"| {row.expected_deg:.3f} | {100 * row.error:+.2f} % | {row.variances_deg:.3f} "
                f"({100 * (row.variances_deg / row.seen_deg - 1):+.1f} %) |"
            )


if __name__ == "__main__":
    main()
