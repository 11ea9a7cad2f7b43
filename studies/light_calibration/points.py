"""Plantings without pictures: outlines and highlight centres drawn about their true values, with stray highlights.

It tests solver, assignment and intervals on many rigs at a hundredth of the cost of pictures.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from simtest.calibration.lights.bundle import Highlights
from simtest.calibration.lights.mirrors import Balls
from simtest.calibration.lights.result import LightCalibration, judge
from simtest.calibration.lights.search import find_lights
from simtest.geometry.vectors import basis_across
from studies.light_calibration.pictures import Floats
from studies.light_calibration.plantings import Planting

CENTRE_PX, OUTLINE_PX = 0.05, 0.05
"""Standard deviations of a highlight's centre, of the outline's centre and of its radius."""

STRAY = 0.5
"""Mean number of highlights a picture that no light of the rig has made."""


def drawn(planting: Planting, moved: Callable[[int], Floats] | None = None) -> tuple[Balls, Highlights]:
    """Return the measured balls and highlights; `moved` gives the lights of a picture in place of the planted ones."""
    rng = np.random.default_rng([planting.seed, 77])
    camera, count = planting.camera, len(planting.centres)
    radii = np.full(count, planting.radius_mm)
    factors = np.array([_factor(planting, centre) for centre in planting.centres])
    true = Balls(planting.centres, factors, radii)
    errors = rng.standard_normal((count, 3))
    seen = replace(true, centres=planting.centres + np.einsum("vij,vj->vi", factors, errors))
    view, pixels = list[int](), list[Floats]()
    for i in range(count):
        lights = planting.lights if moved is None else moved(i)
        at = np.full(len(lights), i)
        own = true.predict(camera, at, lights, np.zeros_like(lights)) + rng.normal(0, CENTRE_PX, (len(lights), 2))
        reach = 0.6 * planting.radius_mm * camera.fx / np.linalg.norm(planting.centres[i])
        stray = camera.project(planting.centres[i]) + rng.uniform(-reach, reach, (rng.poisson(STRAY), 2))
        pixels += [*own, *stray]
        view += [i] * (len(own) + len(stray))
    covariance = np.broadcast_to(CENTRE_PX**2 * np.eye(2), (len(view), 2, 2)).copy()
    return seen, Highlights(np.array(view, dtype=np.intp), np.array(pixels), covariance)


def _factor(planting: Planting, centre: Floats) -> Floats:
    """Return the factor of a centre's covariance: of its direction, and of its distance by the outline's radius."""
    distance = float(np.linalg.norm(centre))
    direction, pixel = centre / distance, 1 / planting.camera.fx
    across = basis_across(direction) * (OUTLINE_PX * pixel * distance)
    along = direction * (OUTLINE_PX * pixel * distance**2 / planting.radius_mm)
    covariance = across.T @ across + np.outer(along, along)
    return np.asarray(np.linalg.cholesky(covariance))


def measured_points(planting: Planting, moved: Callable[[int], Floats] | None = None) -> LightCalibration | None:
    """Return what the solver says of a planting; None where no light explains the highlights."""
    balls, highlights = drawn(planting, moved)
    found = find_lights(planting.camera, balls, highlights)
    if found is None:
        return None
    size = 3 * len(found.bundle.lights)
    return judge(planting.camera, balls, highlights, found, 0.0, np.zeros((size, size)))


def about(result: LightCalibration) -> dict[str, Any]:
    """Return the figures of a fit."""
    return {"chi2": result.chi2, "freedom": result.freedom, "inflation": result.inflation, "rms_px": result.rms_px}
