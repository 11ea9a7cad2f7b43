"""Priors: what is known beside the picture of lights, distance, lobe, camera and relief, each with its distribution.

What nobody told is not zero: it has a distribution too, which enters the budget of every estimate that depends on it
(`simtest.estimators.prior_parts`). The defaults are those of an endoscope of which nothing is known.
"""

import math
from dataclasses import dataclass, field, fields
from functools import cache, cached_property
from statistics import NormalDist

import numpy as np

from simtest.errors import InputError
from simtest.geometry.checks import check_kind, check_number
from simtest.runtime.arrays import Array, short_repr
from simtest.runtime.fitted import fitted_number

LEAST_SHARE = 0.05
"""A Normal that stands for something positive is cut off at this share of its mean."""


@dataclass(frozen=True)
class _Interval:
    """Two ends, the lower one first; `InputError` where they are not finite or not in order."""

    low: float
    high: float

    def __post_init__(self) -> None:
        for end in fields(self):
            check_number(f"{type(self).__name__} {end.name}", getattr(self, end.name))
        if not self.low < self.high:
            raise InputError(f"{type(self).__name__}({self.low!r}, {self.high!r}): low must be less than high")


@dataclass(frozen=True)
class Uniform(_Interval):
    """Anywhere from low to high, alike."""

    @property
    def mean(self) -> float:
        """Middle of the interval."""
        return (self.low + self.high) / 2

    @property
    def sd(self) -> float:
        """Standard deviation."""
        return (self.high - self.low) / math.sqrt(12)

    @property
    def least(self) -> float:
        """The lower end."""
        return self.low

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape."""
        return self.low + (self.high - self.low) * share

    def __str__(self) -> str:
        return f"uniform from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Assumed(Uniform):
    """A uniform distribution for what nobody gave; it equals no given one, not even of the same ends."""


@dataclass(frozen=True)
class LogUniform(_Interval):
    """From low > 0 to high, the logarithm uniform: a scale of which only the order of magnitude is known."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("LogUniform low", self.low, above=0)

    @property
    def mean(self) -> float:
        """Mean."""
        return (self.high - self.low) / math.log(self.high / self.low)

    @property
    def sd(self) -> float:
        """Standard deviation."""
        square = (self.high**2 - self.low**2) / (2 * math.log(self.high / self.low))
        return math.sqrt(max(square - self.mean**2, 0.0))

    @property
    def least(self) -> float:
        """The lower end."""
        return self.low

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape."""
        return np.asarray(self.low * (self.high / self.low) ** share)

    def __str__(self) -> str:
        return f"log-uniform from {self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class Normal:
    """About mean with the standard deviation sd >= 0; with sd = 0 the value is exact (see `exactly`)."""

    mean: float
    sd: float

    def __post_init__(self) -> None:
        check_number("Normal mean", self.mean)
        check_number("Normal sd", self.sd, least=0)

    @property
    def least(self) -> float:
        """The mean, which must be positive where the value must be: a Normal has no lower end."""
        return self.mean

    def quantile(self, share: Array) -> Array:
        """Return the values below which the given shares, in (0, 1), of the draws lie; any shape.

        Lengths and the like are positive: values below a twentieth of a positive mean are cut off there.
        """
        values = self.mean + self.sd * np.reshape([_deviate(s) for s in np.ravel(share).tolist()], np.shape(share))
        return np.maximum(values, LEAST_SHARE * self.mean) if self.mean > 0 else np.asarray(values)

    def __str__(self) -> str:
        return f"{self.mean:g} exactly" if self.sd == 0 else f"normal, {self.mean:g} ± {self.sd:g}"


Distribution = Uniform | Normal | LogUniform


def exactly(value: float) -> Normal:
    """Return the distribution of a value that is known exactly."""
    return Normal(value, 0.0)


def check_distribution(name: str, prior: object, above: float | None = None, least: float | None = None) -> None:
    """Raise `InputError` where a prior is no distribution, or does not lie above `above` or from `least` on."""
    if not isinstance(prior, Distribution):
        raise InputError(f"{name} = {prior!r}: must be a Uniform, Normal or LogUniform, or exactly({prior!r})")
    check_number(name, prior.least, least, above)


@cache
def _deviate(share: float) -> float:
    return NormalDist().inv_cdf(share)


MAX_LIGHTS = 32

AT_CAMERA_MM = 1e-9
"""A light nearer than this is at the camera, or on a sightline."""

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Rows of a matrix, shape (3, 3)."""

ROUNDING = 1e-9
"""Rounding of a covariance that is written in decimals, as a share of its largest entry."""

MOST_COVARIANCE_MM2 = 1e6
"""Of a light, which is within 1000 mm of the camera along each axis."""

UNTOLD_OFFSET_MM = Assumed(0.0, 6.0)
"""Distance of a light from the camera across the optical axis, mm, where no rig is told; every azimuth is as likely."""

UNTOLD_DISTANCE_MM = Uniform(5.0, 80.0)
"""Distance of the tissue along the sightline, mm, where none is told: the working range of endoscopes."""

UNTOLD_FALLOFF_POWER = Assumed(0.0, 4.0)
"""Power k of the falloff cos^k of lens and lights over the angle from the optical axis, where none is told."""

UNTOLD_SLOPE_RAD = Assumed(math.radians(3.0), math.radians(20.0))
"""Slope of the relief an axis, rad, where none is told: one frame hardly tells it. The recipes have 1.4 to 9 deg
(scenes/datasets/endoscopy_close.toml), and highlights of a colon's phantom lie wider than such slopes make them."""


@dataclass(frozen=True)
class CameraPrior:
    """How far the camera's geometry may be off; the default is an exact calibration.

    Parameters
    ----------
    focal_sd : float
        Standard deviation of the focal length, as a share of it.
    centre_sd_px : float
        Standard deviation of the principal point along each axis, px.
    distortion_sd : float
        Standard deviation of the radial distortion k1, about that of a given lens or none: an error of it moves a point
        at r focal lengths from the principal point by k1 r^3 focal lengths.
    edge_reach : float
        r at which the picture is where the lens has it, whatever its k1, such as the edge of a given field of view: an
        error moves other points by k1 r (r^2 - edge_reach^2).
    guessed : bool
        Whether these are guesses, because nobody stated them. It changes no estimate and does not count in comparisons.

    Raises
    ------
    InputError
        If a number is not finite or negative.
    """

    focal_sd: float = 0.0
    centre_sd_px: float = 0.0
    distortion_sd: float = 0.0
    edge_reach: float = 0.0
    guessed: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        for name, deviation in self.deviations.items():
            check_number(name, deviation, least=0)

    @property
    def deviations(self) -> dict[str, float]:
        """The standard deviations by name, and `edge_reach` where it is not 0."""
        names = ("focal_sd", "centre_sd_px", "distortion_sd", *(("edge_reach",) if self.edge_reach else ()))
        return {name: getattr(self, name) for name in names}

    @property
    def is_exact(self) -> bool:
        """Whether the camera's geometry is exact."""
        return self.focal_sd == self.centre_sd_px == self.distortion_sd == 0


@dataclass(frozen=True)
class Floors:
    """What is left open of a picture however well it is calibrated; the default is nothing, as of a smooth render.

    Parameters
    ----------
    light_sd_mm, light_sd : float
        Standard deviation an axis of the position of a light that is given without a covariance: mm, and rad as seen
        from the camera.
    distance_sd : float
        Least standard deviation of a given distance, as a share of it.
    feature_sd : float
        Standard deviation an axis of the normal by features finer than a pixel, rad.
    response_sd : float
        Standard deviation of a highlight's centre by a response that is not the assumed one, such as sharpening, as a
        share of the highlight's size.
    near_miss_sd : float
        Standard deviation an axis of the normal, rad, by the chance that a highlight of a frame of few is a near miss,
        where it is as high as the diffuse light beside it (`simtest.estimators.prior_parts.near_miss_variance`).
    off_peak : float
        An answer that looks farther off its peak than this share of its highlight's size, beyond pixels and noise, is
        given at the peak, with the distance in its budget, or refused; 0: none is. Above 0 the chance that a highlight
        is the maximum of a body's shading, which faces a given light, counts too: the lower its score, the more.

    Raises
    ------
    InputError
        If a number is not finite or negative.
    """

    light_sd_mm: float = 0.0
    light_sd: float = 0.0
    distance_sd: float = 0.0
    feature_sd: float = 0.0
    response_sd: float = 0.0
    near_miss_sd: float = 0.0
    off_peak: float = 0.0

    def __post_init__(self) -> None:
        for each in fields(self):
            check_number(each.name, getattr(self, each.name), least=0)


NO_FLOORS = Floors()

OF_PICTURES = Floors(
    fitted_number("floors.light_mm"),
    math.radians(fitted_number("floors.light_deg")),
    fitted_number("floors.distance"),
    math.radians(fitted_number("floors.feature_deg")),
    fitted_number("floors.response"),
    math.radians(fitted_number("near_misses.widest")),
    fitted_number("off_peak.share"),
)
"""The floors of pictures that give none."""


@dataclass(frozen=True)
class Priors:
    """What estimators are told beside the picture and the camera, and how what they are not told is distributed.

    Parameters
    ----------
    lights_mm : tuple of tuple of float
        Nominal positions of the lights, camera frame, mm; empty: nobody told, and `light_offset_mm` holds.
    distance_mm : Uniform, Normal or LogUniform, optional
        Working distance along the sightline, mm; None: nobody told, and `UNTOLD_DISTANCE_MM` holds.
    lobe_curvature : Uniform, Normal or LogUniform, optional
        c = -(log f)''(0) of the reflectance f as a function of the angle between normal and view, rad; 4 n for Phong.
        Estimators use its mean.
    light_offset_mm : Uniform, Normal or LogUniform
        Distance of a light that nobody told from the camera, mm, across the optical axis, in any direction.
    camera : CameraPrior
        How far the camera's geometry may be off.
    falloff_power : Uniform, Normal or LogUniform, optional
        k of a falloff cos^k over the angle from the axis of lens or light that is still in the frame; None: there is
        none, since the falloff of lens *and* lights is uniform, or known and undone.
    relief_slope : Uniform, Normal or LogUniform
        Slope of the relief an axis, rad: how far a single highlight may be off the base's normal (theory.md 7.4).
    plane : bool
        Whether the surface is known to be a plane, as `circle_pose` takes it to be.
    lights_covariance_mm2 : tuple
        Covariance of each light's position, three rows of three numbers a light, mm^2; empty: not given, so that the
        floor holds, or else the positions are exact.
    floors : Floors, optional
        What stays open whatever else is given; None: not given, which is `OF_PICTURES` in pictures, and nothing else.

    Raises
    ------
    InputError
        If a light is no finite position, a covariance is none, or a distribution is none or does not lie above 0.
    """

    lights_mm: tuple[tuple[float, float, float], ...] = ()
    distance_mm: Distribution | None = None
    lobe_curvature: Distribution | None = None
    light_offset_mm: Distribution = UNTOLD_OFFSET_MM
    camera: CameraPrior = field(default_factory=CameraPrior)
    falloff_power: Distribution | None = UNTOLD_FALLOFF_POWER
    relief_slope: Distribution = UNTOLD_SLOPE_RAD
    plane: bool = False
    lights_covariance_mm2: tuple[Matrix, ...] = ()
    floors: Floors | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if len(self.lights_mm) > MAX_LIGHTS or not all(
            len(light) == 3 and np.isfinite(light).all() for light in self.lights_mm
        ):
            raise InputError(f"lights_mm: must be at most {MAX_LIGHTS} positions of three finite numbers, mm")
        check_light_covariances(self.lights_covariance_mm2, len(self.lights_mm))
        for name in ("distance_mm", "lobe_curvature"):
            if (prior := getattr(self, name)) is not None:
                check_distribution(name, prior, above=0)
        for name in ("light_offset_mm", "falloff_power", "relief_slope"):
            if (prior := getattr(self, name)) is not None or name != "falloff_power":
                check_distribution(name, prior, least=0)
        check_kind("priors camera", self.camera, CameraPrior)
        if self.floors is not None:
            check_kind("priors floors", self.floors, Floors)

    @cached_property
    def lights(self) -> Array:
        """Nominal positions of the lights, shape (L, 3), camera frame, mm."""
        return np.array(self.lights_mm, dtype=float).reshape(-1, 3)

    @cached_property
    def has_light_beside(self) -> bool:
        """Whether a light is given that is not at the camera."""
        return bool((np.linalg.norm(self.lights, axis=1) > AT_CAMERA_MM).any())

    @cached_property
    def lights_covariance(self) -> Array | None:
        """Covariances of the lights' positions, shape (L, 3, 3), mm^2; None where the positions are exact."""
        covariances = np.array(self.lights_covariance_mm2, dtype=float)
        if not self.lights_covariance_mm2:
            # a light that is given without a covariance has that of the floors
            across = self.open.light_sd * np.linalg.norm(self.lights, axis=1)
            covariances = (self.open.light_sd_mm**2 + across**2)[:, None, None] * np.eye(3)
        return covariances if covariances.any() else None

    @cached_property
    def distance(self) -> Distribution:
        """The working distance along the sightline, mm: as given, no surer than its floor, or that of endoscopes."""
        given = UNTOLD_DISTANCE_MM if self.distance_mm is None else self.distance_mm
        least = self.open.distance_sd * given.mean
        return Normal(given.mean, least) if given.sd < least else given

    @property
    def open(self) -> Floors:
        """The floors, 0 where none are given."""
        return self.floors or NO_FLOORS


def check_light_covariances(covariances: tuple[Matrix, ...], count: int) -> None:
    """Raise `InputError` where covariances of light positions, mm^2, are not one for each of `count` lights."""
    name = "lights_covariance_mm2"
    if not covariances:
        return
    if len(covariances) != count:
        raise InputError(f"{name}: {len(covariances)} matrices; must be one for each of the {count} lights_mm")
    for matrix in covariances:
        # Rows of other lengths make no array.
        if len(matrix) != 3 or any(len(row) != 3 for row in matrix) or not np.isfinite(np.array(matrix)).all():
            raise InputError(f"{name}: each must be three rows of three finite numbers, mm^2")
        values = np.array(matrix, dtype=float)
        if np.abs(values).max() > MOST_COVARIANCE_MM2:
            raise InputError(f"{name}: {values.tolist()}: must be at most {MOST_COVARIANCE_MM2:g} mm^2")
        slack = ROUNDING * float(np.abs(values).max())
        if not np.allclose(values, values.T, rtol=0.0, atol=slack) or np.linalg.eigvalsh(values)[0] < -slack:
            raise InputError(f"{name}: {values.tolist()} is no covariance; must be symmetric, no eigenvalue below 0")


NO_PRIORS = Priors()
"""Nothing is told beside the picture and the camera."""

LIGHT_AT_CAMERA = Priors(lights_mm=((0.0, 0.0, 0.0),), falloff_power=None)
"""The light is at the camera's position, and no falloff is left in the frame."""
