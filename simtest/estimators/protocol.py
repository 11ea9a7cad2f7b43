"""Estimator protocols, and the estimate that an estimator returns."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol, runtime_checkable

from simtest.calibration import Frame, Priors
from simtest.errors import Failure
from simtest.estimators.budget import STATED, Budget, bounded, total
from simtest.estimators.cloud_shape import CloudShape
from simtest.estimators.isophote_fit import FittedIsophote
from simtest.geometry import Array, Camera, Patch
from simtest.geometry.cones import PoseRegion
from simtest.geometry.vectors import deviation_deg
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
        from simtest.estimators.notebook import estimate_html

        return estimate_html(self)

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
class RegionEstimator(FrameEstimator, Protocol):
    """Answers for the regions of a frame by their numbers, as a table of answers made elsewhere does."""

    def estimate_regions(
        self, frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return what there is for each patch, None where there is nothing, and estimates that belong to no patch."""


AnyEstimator = Estimator | FrameEstimator


def laws_of(estimator: object) -> tuple[Law, ...]:
    """Return the laws that an estimator says it follows; none where it says nothing."""
    return tuple(getattr(estimator, "laws", ()))
