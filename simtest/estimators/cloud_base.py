"""What the diffuse light says of a cloud: whether the base has a highlight point there at all, and where.

Spots alone do not tell a highlight point from a fold that nearly faces the camera, nor how far changes of the base's
gains move their centroid. The diffuse light does (`cloud_shading`), as well as the albedo lets it.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from simtest.calibration import Priors
from simtest.estimators.cloud_mixture import Cloud
from simtest.estimators.cloud_shading import DiffuseLight, Shading
from simtest.estimators.prior_parts import light_offset_part
from simtest.geometry import Array, chi_squared
from simtest.geometry.vectors import basis_across
from simtest.runtime.fitted import fitted_number

ALBEDO_SLOPE, JACKKNIFE_CUBIC = fitted_number("clouds.albedo_slope"), fitted_number("clouds.jackknife_cubic")
MOST_MISFIT = math.radians(fitted_number("clouds.most_misfit"))
MOST_EXTENT = math.radians(fitted_number("clouds.most_extent"))
LEAST_GAIN = fitted_number("clouds.least_gain")

REFUSED, DOUBTED = 0.95, 0.68
"""A misfit that a base with a highlight point there exceeds with less than the rest gets no answer, or a flag."""


@dataclass(frozen=True)
class BaseEvidence:
    """What the diffuse light says of a cloud, in ``basis_across(cloud.centre)``.

    Parameters
    ----------
    shows : bool
        Whether the frame shows diffuse light: the base is tissue.
    statistic : float
        Chi-squared with 2 degrees of freedom where the cloud's centre is at a highlight point; 0 where nothing is told.
    misfit : float
        Turn of the base at the cloud's centre from where it would face the lights, rad.
    told : bool
        Whether the misfit is known to about `MOST_MISFIT`.
    information : ndarray, shape (2, 2)
        Inverse covariance of `shift`, rad^-2; zero where nothing is told.
    shift : ndarray, shape (2,)
        From the cloud's centre to the highlight point.
    """

    shows: bool
    statistic: float = 0.0
    misfit: float = 0.0
    told: bool = False
    information: Array = field(default_factory=lambda: np.zeros((2, 2)))
    shift: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def refutes(self) -> bool:
        """Whether the base has no highlight point at the cloud's centre."""
        return self.statistic > chi_squared.quantile(REFUSED, 2)

    @property
    def doubts(self) -> bool:
        """Whether the base is likely not to have a highlight point there."""
        return self.statistic > chi_squared.quantile(DOUBTED, 2)


def evidence_of(cloud: Cloud, light: DiffuseLight, sampling: Array, priors: Priors) -> BaseEvidence:
    """Return what the diffuse light says of a cloud.

    Parameters
    ----------
    cloud : Cloud
        As the spots tell it.
    light : DiffuseLight
        Of its frame.
    sampling : ndarray, shape (2, 2)
        Covariance of its centre by the number of its spots, in ``basis_across(cloud.centre)``, rad^2.
    priors : Priors
        What is told of the lights and the falloff.
    """
    fits = light.around(cloud.sightline, cloud.covariance) if light.shows else None
    if fits is None:
        return BaseEvidence(light.shows)
    turn = basis_across(cloud.centre) @ basis_across(cloud.sightline).T
    quadric, cubic = (_turned(fit, turn) for fit in fits)
    # The lights' mean turns the light by m = L / d, and the normal at the cloud by m / 2: the misfit is -m / 2.
    expected = -cloud.turns.mean(axis=0)
    off = quadric.gradient + quadric.steepness @ expected
    fitted = quadric.covariance + _untold(cloud, quadric, priors)
    centre = quadric.steepness @ quadric.gains @ sampling @ quadric.gains @ quadric.steepness
    statistic = float(off @ np.linalg.solve(fitted + ALBEDO_SLOPE**2 * np.eye(2) + centre, off))
    back = np.linalg.inv(quadric.steepness)
    told = bool(np.linalg.eigvalsh(back @ fitted @ back)[-1] < MOST_MISFIT**2)
    information, shift = np.zeros((2, 2)), np.zeros(2)
    if priors.lights_mm:
        information, shift = _highlight_point(cubic, expected, _untold(cloud, cubic, priors))
    return BaseEvidence(light.shows, statistic, float(np.linalg.norm(back @ off)), told, information, shift)


def _turned(fit: Shading, turn: Array) -> Shading:
    """Return a fit in another basis."""
    return Shading(turn @ fit.gradient, turn @ fit.covariance @ turn.T, turn @ fit.gains @ turn.T)


def _untold(cloud: Cloud, fit: Shading, priors: Priors) -> Array:
    """Return the covariance of grad ln L by a light and a falloff that nobody told, shape (2, 2), per rad^2."""
    half, covariance = basis_across(cloud.centre), np.zeros((2, 2))
    if not priors.lights_mm:
        turn = fit.steepness @ half @ basis_across(-cloud.centre).T
        covariance = turn @ light_offset_part(-cloud.centre, priors) @ turn.T
    if (power := priors.falloff_power) is not None:
        # Light that falls as cos^k of the angle from the axis.
        slope = half[:, 2] / max(float(cloud.centre[2]), 1e-3)
        covariance = covariance + (power.mean**2 + power.sd**2) * np.outer(slope, slope)
    return covariance


def _highlight_point(fit: Shading, expected: Array, untold: Array) -> tuple[Array, Array]:
    """Return the inverse covariance of where the misfit is as expected, rad^-2, and that place from the centre."""
    gains, directions = np.linalg.eigh(fit.gains)
    covariance = JACKKNIFE_CUBIC**2 * fit.covariance + ALBEDO_SLOPE**2 * np.eye(2) + untold
    information, shift = np.zeros((2, 2)), np.zeros(2)
    for gain, direction in zip(gains, directions.T, strict=True):
        if gain < LEAST_GAIN:
            continue
        slope = gain * (2 + gain)
        information += slope**2 / (direction @ covariance @ direction) * np.outer(direction, direction)
        shift += (direction @ fit.gradient / slope + direction @ expected / gain) * direction
    return information, shift
