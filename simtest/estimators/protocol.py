"""What estimators are, and the estimate that they return: its parts, and what it may hold wherever it was made."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from simtest.calibration import Frame, Priors
from simtest.errors import Failure, Reason
from simtest.estimators.budget import LARGEST_VARIANCE, STATED, Budget, bounded, deviations, total
from simtest.estimators.cloud_shape import CloudShape
from simtest.estimators.isophotes import FittedIsophote
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.cones import PoseRegion
from simtest.geometry.vectors import covariance_across, deviation_deg, tilt_deg
from simtest.runtime import chi_squared
from simtest.runtime.arrays import LONGEST, clipped, vector

Target = Literal["fine", "base"]

Law = Literal["sightline", "bisector", "circle_pose", "axis_ratio_seen"]
"""What an estimator may say of its answers in an attribute `laws`, so that results hold the errors that theory.md
section 4 predicts: the normal is the reversed sightline through the BP, or bisects the directions to camera and light,
or is a pose of one isophote taken for a circle; the axis ratio is that of the isophotes as they are."""


@dataclass(frozen=True)
class EstimatedCurvature:
    """The surface's curvature at a highlight.

    Parameters
    ----------
    directions : ndarray, shape (2, 3)
        Principal directions, unit, camera frame: of the smaller and of the larger abs(1 + d k); of either sign.
    axis_ratio : float
        abs(1 + d k) of the first over that of the second, in (0, 1].
    hypotheses : ndarray, shape (H, 2), optional
        1 + d k along both directions: all that the data allow, the most plausible first; None where the lobe's width is
        not known.
    """

    directions: Array
    axis_ratio: float
    hypotheses: Array | None = None

    @property
    def gains(self) -> Array | None:
        """The most plausible 1 + d k along both directions, shape (2,)."""
        return None if self.hypotheses is None else self.hypotheses[0]


@dataclass(frozen=True)
class CalibratedRegion:
    """How far off 68 and 95 % of such answers are at most, deg, and what says so (`simtest calibrate core`)."""

    radius_68_deg: float
    radius_95_deg: float
    region_source: str


@dataclass(frozen=True)
class Estimate:
    """A reconstructed normal.

    Parameters
    ----------
    normal : ndarray, shape (3,)
        The proposed normal, unit, facing the camera, camera frame.
    candidates : ndarray, shape (K, 3)
        All normals that the data allow, the proposed one first.
    look_px : ndarray, shape (2,)
        Pixel at whose surface point the normal is proposed.
    axis_ratio : float, optional
        Smaller over larger half-axis of the back-projected cone.
    axis_ratio_deviation : float, optional
        Standard deviation of `axis_ratio`, where it is stated.
    isophotes : tuple of FittedIsophote
        The fitted isophotes.
    choice_margin : float, optional
        How clearly the proposed candidate won, in standard deviations.
    covariance : ndarray, shape (2, 2), optional
        Of the normal in the basis `simtest.geometry.vectors.tangent_basis(normal)`, rad^2; default the budget's sum.
    flags : tuple of str
        Warnings.
    curvature : EstimatedCurvature, optional
        Of the surface.
    region : PoseRegion, optional
        Instead of a covariance, where the normals that the data allow are no ellipse about the proposed one.
    budget : mapping of str to ndarray, optional
        The parts of the covariance by name (`simtest.estimators.budget`). A covariance without a budget is one part.
    target : {"fine", "base"}
        Which surface's normal is stated: that of the fine one with its relief, or of the base without (theory.md
        section 7).
    cloud : CloudShape, optional
        The cloud of highlights that the estimate stands on, where it is not that of a single one.
    calibrated : CalibratedRegion, optional
        Regions by the core's calibration, where one was given.

    Examples
    --------
    >>> import numpy as np, simtest
    >>> normal = np.array([0.0, 0.0, -1.0])
    >>> simtest.Estimate(normal, normal[None], np.array([320.0, 240.0]), covariance=1e-4 * np.eye(2))
    Estimate(normal=(0, 0, -1), look_px=(320, 240), deviation_deg=0.81)
    """

    normal: Array
    candidates: Array
    look_px: Array
    axis_ratio: float | None = None
    isophotes: tuple[FittedIsophote, ...] = ()
    choice_margin: float | None = None
    covariance: Array | None = None
    flags: tuple[str, ...] = field(default=())
    curvature: EstimatedCurvature | None = None
    region: PoseRegion | None = None
    budget: Budget | None = None
    target: Target = "fine"
    cloud: CloudShape | None = None
    axis_ratio_deviation: float | None = None
    calibrated: CalibratedRegion | None = None

    def __post_init__(self) -> None:
        if self.budget is not None and self.covariance is None:
            object.__setattr__(self, "covariance", total(self.budget))
        elif self.budget is None and self.covariance is not None:
            object.__setattr__(self, "budget", {STATED: self.covariance})

    @property
    def deviation_deg(self) -> float | None:
        """Standard deviation of the normal, deg: the square root of the covariance's trace, where one is reported."""
        return None if self.covariance is None else deviation_deg(self.covariance)

    def __repr__(self) -> str:
        deviation = self.deviation_deg
        parts = [f"normal={vector(self.normal)}", f"look_px={vector(self.look_px)}"]
        parts += [] if deviation is None else [f"deviation_deg={deviation:.3g}"]
        parts += [] if self.axis_ratio is None else [f"axis_ratio={self.axis_ratio:.3g}"]
        parts += [f"{len(self.candidates)} candidates"] if len(self.candidates) > 1 else []
        parts += ["target=base"] if self.target == "base" else []
        parts += [f"cloud of {len(self.cloud.points_px)}"] if self.cloud is not None else []
        parts += [f"flags={' '.join(self.flags)}"] if self.flags else []
        return f"Estimate({clipped(', '.join(parts), LONGEST - 10)})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the normal in the view with its 95 % ellipse, and the budget."""
        from simtest.pages.notebook import normal_html, note_html, table_html

        x, y, z = self.normal
        tilt = tilt_deg(self.normal)
        lines = [f"normal ({x:.4f}, {y:.4f}, {z:.4f}), camera frame; {tilt:.2f} deg from the optical axis"]
        if self.deviation_deg is not None:
            lines.append(f"standard deviation {self.deviation_deg:.3g} deg; the ellipse holds 95 % of the errors")
        if len(self.candidates) > 1:
            lines.append(f"{len(self.candidates)} candidates; the proposed one is shown")
        if self.flags:
            lines.append("flags: " + ", ".join(self.flags))
        parts = sorted(deviations(self.budget or {}).items(), key=lambda part: -part[1])
        table = table_html(("part", "standard deviation (deg)"), [(n, f"{np.degrees(v):.3g}") for n, v in parts])
        region = None
        if self.covariance is not None:
            region = chi_squared.quantile(0.95, 2) * covariance_across(self.normal, self.covariance)
        return normal_html(self.normal[:2], region) + "".join(map(note_html, lines)) + (table if parts else "")

    def with_parts(self, **parts: Array) -> "Estimate":
        """Return the estimate with more parts in its budget, rad^2; one that is there already is added to.

        No part says less than that nothing is known of the direction (`simtest.estimators.budget.bounded`).
        """
        own = dict(self.budget or {})
        for name, part in parts.items():
            own[name] = own[name] + part if name in own else part
        return replace(self, budget={name: bounded(part) for name, part in own.items()}, covariance=None)

    def without_uncertainty(self) -> "Estimate":
        """Return the estimate without covariance and budget: it states no uncertainty."""
        return replace(self, budget=None, covariance=None)

    def contours(self, patch: Patch | Failure) -> list[tuple[float, Array]]:
        """Return the isophotes that were used on a patch: isovalue and closed polygon, shape (N, 2), px."""
        isovalues = [isophote.isovalue for isophote in self.isophotes]
        return [] if isinstance(patch, Failure) else patch.contours(isovalues)


@runtime_checkable
class Estimator(Protocol):
    """Estimates the normal at one highlight; other packages register theirs in the group ``simtest.estimators``."""

    def estimate(self, patch: Patch, camera: Camera, priors: Priors, /) -> Estimate | Failure:
        """Estimate the normal at a highlight.

        Parameters
        ----------
        patch : Patch
            Region of interest.
        camera : Camera
            Geometry of the camera.
        priors : Priors
            What is known of lights, distance and lobe.
        """


@runtime_checkable
class BatchEstimator(Estimator, Protocol):
    """Estimates the normals at several highlights of one camera faster than one by one."""

    def estimate_batch(
        self, patches: Sequence[Patch], camera: Camera, priors: Priors, /
    ) -> Sequence[Estimate | Failure]:
        """Return for each patch what `estimate` returns."""


@runtime_checkable
class PreparedEstimator(Estimator, Protocol):
    """Estimates the normal at one highlight from fits that it makes of several at once, kept with their patches."""

    def prepare(self, patches: Sequence[Patch], camera: Camera, /) -> None:
        """Fit patches at once; `estimate` then finds the fit with its patch."""


@runtime_checkable
class FrameEstimator(Protocol):
    """Estimates normals from the whole frame, as clouds of highlights, networks and foreign cores do."""

    def estimate_frame(self, frame: Frame, camera: Camera, priors: Priors, /) -> Sequence[Estimate | Failure] | Failure:
        """Estimate the normals in a frame.

        Parameters
        ----------
        frame : Frame
            Values as encoded, linear light with the known falloff undone, smoothed light, noise, view and clipped
            pixels.
        camera : Camera
            The frame's camera.
        priors : Priors
            What is known of lights, distance and lobe.

        Returns
        -------
        sequence of Estimate or Failure, or Failure
            In any order and number, each looking at a pixel of the frame (`Estimate.look_px`), or why there is none.
        """


@runtime_checkable
class CloudEstimator(FrameEstimator, Protocol):
    """Estimates the base's normal from clouds of highlights: its estimates have a `cloud` each, and are of no patch."""

    @property
    def least_spots(self) -> int:
        """Fewest highlights of a cloud."""


@runtime_checkable
class RegionEstimator(Protocol):
    """Answers for the regions of a frame by their numbers, as a table of answers made elsewhere does."""

    def estimate_regions(
        self, frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return what there is for each patch, None where there is nothing, and estimates that belong to no patch."""


AnyEstimator = Estimator | FrameEstimator | RegionEstimator


def laws_of(estimator: object) -> tuple[Law, ...]:
    """Return the laws that an estimator says it follows; none where it says nothing."""
    return tuple(getattr(estimator, "laws", ()))


ROUNDED, EXACT = 1e-3, 1e-9
"""A unit vector or covariance that is off by less than the first was printed with few digits, and is made exact; one
that is off by less than the second keeps its last digits. Shares of the length and of the largest element."""

LEAST_VARIANCE = 1e-24  # rad^2; below it a normal is more certain than its own digits
LEAST_SHARE = 1e-12  # of the largest variance squared: a determinant below it is rounding

OUTSIDE = 0.5
"""An estimate looks at a pixel at most this share of the frame outside: the border may cut off a highlight's peak."""

MAX_CANDIDATES, MAX_FLAGS, MAX_PARTS, LONGEST_FLAG = 64, 16, 16, 60


class Refused(Exception):
    """What is wrong with an estimate, as a failure."""

    def __init__(self, detail: str, reason: Reason = Reason.ESTIMATOR_ERROR) -> None:
        super().__init__(detail)
        self.failure = Failure(reason, detail)


def check(result: object, camera: Camera) -> Estimate | Failure:
    """Return an estimator's result, or a Failure where it is not what `Estimate` describes.

    Malformed parts are a Failure ``estimator_error``, values that are not finite a Failure ``not_finite``. Unit vectors
    and covariances that were printed with few digits are made exact.
    """
    if isinstance(result, Failure):
        return result
    try:
        return _checked(result, camera)
    except Refused as refused:
        return refused.failure


def unit_vector(vector: Array, name: str) -> Array:
    """Return a vector of unit length but for rounding, shape (3,), made exact; raise `Refused` for another."""
    length = math.sqrt(sum(part * part for part in vector.tolist()))
    if abs(length - 1) > ROUNDED:
        raise Refused(f"{name} of length {length:.6g}: must be a unit vector")
    return vector if abs(length - 1) < EXACT else vector / length


def _checked(result: object, camera: Camera) -> Estimate:
    """Return an estimate with exact unit vectors and covariances; raise `Refused` where it is malformed."""
    if not isinstance(result, Estimate):
        raise Refused(f"gave a {type(result).__name__}; must be an Estimate or a Failure")
    if result.target not in ("fine", "base"):
        raise Refused(f"target {result.target!r:.60}; must be fine or base")
    changed: dict[str, object] = {}
    budget = _budget(result)
    if any(part is not result.budget[name] for name, part in budget.items()):  # type: ignore[index]
        changed |= {"budget": budget, "covariance": None}
    # unit vectors, the proposed one first
    normal = unit_vector(_numbers(result.normal, "normal", (3,)), "normal")
    given = [*_numbers(result.candidates, "candidates", (None, 3))]
    if not 1 <= len(given) <= MAX_CANDIDATES:
        raise Refused(f"{len(given)} candidates; must be 1 to {MAX_CANDIDATES}")
    candidates = [unit_vector(each, "candidate") for each in given]
    apart = max(map(abs, (candidates[0] - normal).tolist()))
    if apart > ROUNDED:
        raise Refused("the first candidate must be the proposed normal")
    rounded = any(exact is not each for exact, each in zip(candidates, given, strict=True))
    if normal is not result.normal or rounded or apart > EXACT:
        changed |= {"normal": normal, "candidates": np.array([normal, *candidates[1:]])}
    _check_look(_numbers(result.look_px, "look_px", (2,)), normal, camera)
    # numbers
    _check_ratio(result.axis_ratio, "axis_ratio")
    if result.axis_ratio_deviation is not None and not _number(result.axis_ratio_deviation, "axis_ratio_deviation") > 0:
        raise Refused(f"axis_ratio_deviation: {result.axis_ratio_deviation:g}; must be above 0")
    if result.choice_margin is not None:
        _number(result.choice_margin, "choice_margin")
    if result.region is not None and not np.isfinite(result.region.statistic(result.candidates)).all():
        raise Refused("region: the statistic of a candidate is not finite", Reason.NOT_FINITE)
    if result.curvature is not None:
        _check_curvature(result.curvature)
    if not isinstance(result.flags, tuple) or len(result.flags) > MAX_FLAGS or not all(map(_is_flag, result.flags)):
        allowed = f"a tuple of at most {MAX_FLAGS} texts of at most {LONGEST_FLAG} printable characters without a comma"
        raise Refused(f"flags: {result.flags!r:.60}; must be {allowed}")
    return replace(result, **changed) if changed else result  # type: ignore[arg-type]


def _budget(result: Estimate) -> Mapping[str, Array]:
    """Return the parts of an estimate's budget, each a covariance, whose sum is its covariance."""
    if result.budget is None:
        return {}
    if not isinstance(result.budget, Mapping) or not 1 <= len(result.budget) <= MAX_PARTS:
        raise Refused(f"budget: must be 1 to {MAX_PARTS} parts by name")
    if bad := [name for name in result.budget if not (isinstance(name, str) and name.isidentifier())]:
        raise Refused(f"budget: part {bad[0]!r:.60}; must be a word")
    budget = {
        name: _covariance(part, "covariance" if name == STATED else f"budget {name}")
        for name, part in result.budget.items()
    }
    whole = total(budget)
    # Plain numbers: this is done for each estimate.
    stated = _numbers(result.covariance, "covariance", (2, 2))
    pairs = zip(total(result.budget).ravel().tolist(), stated.ravel().tolist(), strict=True)
    if any(abs(one - other) > 1e-6 * abs(other) + 1e-18 for one, other in pairs):
        raise Refused("covariance: must be the sum of the budget's parts")
    (first, mixed), (_, second) = whole.tolist()
    largest = max(first, second)
    if min(first, second) <= LEAST_VARIANCE or first * second - mixed * mixed <= LEAST_SHARE * largest * largest:
        raise Refused("covariance: singular; must have a variance in each direction")
    return budget


def _covariance(part: object, name: str) -> Array:
    """Return a covariance, rad^2, symmetric but for rounding, as it is or made exact."""
    values = _numbers(part, name, (2, 2))
    (first, mixed), (other, second) = values.tolist()
    size = max(abs(first), abs(mixed), abs(other), abs(second))
    least = (first + second) / 2 - math.hypot((first - second) / 2, (mixed + other) / 2)
    if abs(mixed - other) > ROUNDED * size or least < -ROUNDED * size:
        shown = f"[[{first:g}, {mixed:g}], [{other:g}, {second:g}]]"
        raise Refused(f"{name} {shown}: must be symmetric and have no negative eigenvalue")
    if size > LARGEST_VARIANCE:
        allowed = f"at most {LARGEST_VARIANCE:.4g} rad^2 (deg^2 times (pi / 180)^2 is rad^2)"
        raise Refused(f"{name}: holds {size:g}; must be {allowed}")
    return values if abs(mixed - other) <= EXACT * size else (values + values.T) / 2


def _check_look(look: Array, normal: Array, camera: Camera) -> None:
    """Raise `Refused` where an estimate looks far outside the frame, or sees its surface from behind."""
    (x, y), (width, height) = look.tolist(), (camera.width, camera.height)
    if not (-OUTSIDE * width <= x <= (1 + OUTSIDE) * width and -OUTSIDE * height <= y <= (1 + OUTSIDE) * height):
        raise Refused(
            f"look_px: looks at the pixel ({x:g}, {y:g}); must lie in the frame of {width} x {height} px, or near it"
        )
    towards = float(normal @ camera.unproject(look))
    if math.isnan(towards):
        raise Refused(f"look_px: the lens sees nothing at the pixel ({x:g}, {y:g})", Reason.NOT_FINITE)
    if towards >= 0:
        shown = " ".join(f"{value:.4g}" for value in normal.tolist())
        raise Refused(f"the normal faces away from the camera: ({shown}); z points forward, so it is below 0 in front")


def _check_curvature(curvature: EstimatedCurvature) -> None:
    """Raise `Refused` where a curvature is malformed."""
    for direction in _numbers(curvature.directions, "curvature directions", (2, 3)):
        unit_vector(direction, "curvature direction")
    _check_ratio(curvature.axis_ratio, "curvature axis_ratio")
    if curvature.hypotheses is not None:
        count = len(_numbers(curvature.hypotheses, "curvature hypotheses", (None, 2)))
        if not 1 <= count <= MAX_CANDIDATES:
            raise Refused(f"curvature hypotheses: must be 1 to {MAX_CANDIDATES} pairs")


def _check_ratio(value: object, name: str) -> None:
    if value is not None and not 0 < (ratio := _number(value, name)) <= 1:
        raise Refused(f"{name}: {ratio:g}; must be in (0, 1]")


def _is_flag(flag: object) -> bool:
    """Whether a flag can stand in the results, which list several between commas."""
    return isinstance(flag, str) and 0 < len(flag) <= LONGEST_FLAG and flag.isprintable() and "," not in flag


def _number(value: object, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise Refused(f"{name}: must be a number")
    if not math.isfinite(value):
        raise Refused(f"{name} is {value}", Reason.NOT_FINITE)
    return float(value)


def _numbers(values: Any, name: str, shape: tuple[int | None, ...]) -> Array:
    """Return an array of finite numbers of this shape, None standing for any length; raise `Refused` for another."""
    is_array = isinstance(values, np.ndarray) and values.ndim == len(shape) and values.dtype.kind in "fiu"
    if not is_array or any(n not in (None, m) for n, m in zip(shape, values.shape, strict=True)):
        raise Refused(f"{name}: must be an array of shape ({', '.join('n' if n is None else str(n) for n in shape)})")
    # `np.isfinite` takes three times as long for a few numbers.
    if not all(map(math.isfinite, values.ravel().tolist())):
        raise Refused(f"{name} holds NaN or infinity", Reason.NOT_FINITE)
    return values
