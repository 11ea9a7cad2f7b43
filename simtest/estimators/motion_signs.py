"""Pictures of a highlight from several known positions distinguish convex from concave [Z89].

With light and camera at one position the highlight follows the camera over the surface: with a motion delta across the
sightline the BP moves by u = (I + dS)^-1 delta, and its normal, hence its sightline, by dS u / d. One picture gives the
sizes of 1 + d k (theory.md section 3, item 3), the motion their signs.

Each curvature hypothesis is a quadric patch, whose normal a camera elsewhere sees at another place.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from simtest.calibration import Priors
from simtest.errors import Failure, InputError, Reason
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array
from simtest.geometry.vectors import basis_across, tangent_coordinates
from simtest.runtime import chi_squared

STEPS = 30
STEP = 1e-5
UNCHANGED = np.zeros(6)

SOURCES = ("rotation", "rotation", "log distance", "log gain", "log gain", "turn of the principal directions")
"""What predictions of one first picture share, in the order of `FirstPicture.jacobian`; rad, or shares."""

MOST_TURN = 0.5
"""Greatest standard deviation of the principal directions, rad; those of a round highlight are not known at all."""


@dataclass(frozen=True)
class Prediction:
    """What a patch shows to a camera at another position."""

    position: Array  # (3,): of the camera, mm, first camera's frame
    normal: Array  # (3,): that points at it, unit, first camera's frame
    place: Array  # (2,): of its point along the principal directions, in units of the first picture's distance
    curvatures: Array  # (2,): d k of the patch

    def shape_sd(self, change_sd: float) -> float:
        """Return how far a surface's normal may be from the patch's at the predicted place, rad per axis.

        The curvatures may change by a share of `change_sd` over the distance d (third order), and a sphere's normal
        differs from its paraboloid's by (k u)^3 / 2 (fourth order).
        """
        bend, reach = float(np.abs(self.curvatures).max()), float(np.linalg.norm(self.place))
        return change_sd * bend * reach**2 / 2 + (bend * reach) ** 3 / 2


@dataclass(frozen=True)
class FirstPicture:
    """The first picture's highlight under one hypothesis."""

    first: Estimate  # with curvature
    distance: float  # of the surface, mm
    gains: Array  # (2,): 1 + d k along its principal directions

    def jacobian(self, at: Prediction) -> Array | None:
        """Differentiate a predicted normal, in its tangent basis, by `SOURCES`, shape (2, 6)."""
        basis, columns = basis_across(at.normal), []
        for step in STEP * np.eye(6):
            moved = self.predict(at.position, step)
            if moved is None:
                return None
            columns.append(basis @ (moved.normal - at.normal) / STEP)
        return np.stack(columns, axis=1)

    def by_position(self, at: Prediction) -> Array:
        """Differentiate a predicted normal, in its tangent basis, by the camera's position, 1/mm, shape (2, 3)."""
        basis, columns = basis_across(at.normal), []
        for step in STEP * self.distance * np.eye(3):
            moved = self.predict(at.position + step)
            columns.append(np.zeros(2) if moved is None else basis @ (moved.normal - at.normal))
        return np.stack(columns, axis=1) / (STEP * self.distance)

    def sources(self, covariance: Array, distance_sd: float, gain_sd: float, lobe_sd: float = 0.0) -> Array:
        """Return the covariance of `SOURCES`, shape (6, 6).

        Noise that changes the gains by `gain_sd` turns the axes of the highlight's second moments by
        sqrt(2) gain_sd r / (1 - r^2), with r the axis ratio: those of a round highlight are not known. A lobe that is
        not known exactly changes both gains alike, by `lobe_sd`.
        """
        low, high = np.sort(np.abs(self.gains))
        ratio = float(low / high)
        turn = min(MOST_TURN, np.sqrt(2) * gain_sd * ratio / max(1 - ratio**2, 1e-9))
        made = np.diag([0.0, 0.0, distance_sd, gain_sd, gain_sd, turn]) ** 2
        made[:2, :2] = covariance
        made[3:5, 3:5] += lobe_sd**2
        return made

    def predict(self, position: Array, change: Array = UNCHANGED) -> Prediction | None:
        """Solve for the patch's normal that points at a position; None where Newton's method finds none.

        `change`, (6,): of the sources, in the order of `SOURCES`.
        """
        assert self.first.curvature is not None
        distance, gains = self.distance * (1 + change[2]), self.gains * (1 + change[3:5])
        N = self.first.normal + change[:2] @ basis_across(self.first.normal)
        N /= np.linalg.norm(N)
        e = self.first.curvature.directions[0] - (self.first.curvature.directions[0] @ N) * N
        e /= np.linalg.norm(e)
        e = np.cos(change[5]) * e + np.sin(change[5]) * np.cross(N, e)
        across = np.stack([e, np.cross(N, e)])
        # In units of the distance the first camera is at (0, 0, 1), the other one at v.
        v = np.append(across @ position, N @ position) / distance + [0.0, 0.0, 1.0]
        K = gains - 1
        x = _place(K, v)
        if x is None:
            return None
        normal = np.append(K * x, 1.0) @ np.concatenate([across, N[None]])
        return Prediction(position, normal / np.linalg.norm(normal), x, K)


def _place(K: Array, v: Array) -> Array | None:
    """Solve for the point of the patch z = -x^T diag(K) x / 2 whose normal points at v, shape (2,)."""
    x = v[:2] / (1 + K)
    # Newton's method, from the linear solution
    for _ in range(STEPS):
        height = v[2] + np.sum(K * x * x) / 2
        off = v[:2] - x - height * K * x
        slope = -np.diag(1 + height * K) - np.outer(K * x, K * x)
        try:
            step = np.linalg.solve(slope, off)
        except np.linalg.LinAlgError:
            return None
        x = x - step
        if not np.isfinite(x).all() or np.abs(x).max() > 10:  # diverged, or far off the patch
            return None
        if np.abs(step).max() < 1e-12:
            return np.asarray(x)
    return None


GAIN_SD = 0.03  # default relative standard deviation of the first picture's abs(1 + d k)
LEAST_SD = 1e-4  # least allowance for the patch's third order, rad

CHANGE_SD = 0.3
"""Standard deviation of the relative change of the curvatures over one working distance along the surface."""

WRONG_SHARE = 0.02  # stated probability that a sign is told, and is wrong
RIVALS = 2  # hypotheses, of four, whose sign along a direction is wrong

CLEAR = -2 * float(np.log(WRONG_SHARE / RIVALS))
"""Least difference of two deviances for the better one to be told.

Under a hypothesis, the likelihood of a given other one exceeds its own by a factor of 1/p with a probability of p at
most (Markov's inequality), whatever the number of pictures; that of one of two others does with 2 p at most.
"""

FITS_SHARE = 0.999
"""The best hypothesis explains the pictures unless its distance is beyond this quantile of chi-squared."""


@dataclass(frozen=True)
class PoseError:
    """Standard deviations of a camera's motion from one picture to another, independent between motions."""

    translation: float = 0.0  # of the translation along each axis, as a share of its length
    rotation: float = 0.0  # about each axis, rad


EXACT = PoseError()


@dataclass(frozen=True)
class MovedView:
    """A further picture of a highlight, from another position."""

    # Of what may be the same highlight, of any estimator for a light at the camera. Each hypothesis takes the one that
    # it explains best, so that a false one is no evidence.
    estimates: Sequence[Estimate]
    view_from_first: npt.ArrayLike  # (4, 4): the camera's motion, from the first camera's frame to this one's, mm
    error: PoseError = EXACT  # of the motion


@dataclass(frozen=True)
class RankedHypotheses:
    """The curvatures that one picture allows, ordered by how well they explain the others."""

    hypotheses: Array  # (H, 2): 1 + d k along the first picture's principal directions, the best first
    distance2: Array  # (H,): squared Mahalanobis distance of the other pictures' normals from the predicted ones
    predicted: Array  # (H, 3): predicted normals in the frame of the first other picture that was used
    # (H,): twice the negative log-likelihood, up to a constant: `distance2` and the log of the covariance's determinant
    deviance: Array
    freedom: int = 2  # degrees of freedom of `distance2`: 2 for each further picture
    gain_sd: float = GAIN_SD  # relative standard deviation of the sizes of the hypotheses

    @property
    def margin(self) -> float:
        """By how much the best one is preferred to all others, >= 0 (see `sign_margins`)."""
        return float(self._preferred[1:].min())

    @property
    def fits(self) -> bool:
        """Whether the best hypothesis explains the other pictures; false too where poses are wrong or tissue moved."""
        return bool(self.distance2[0] <= chi_squared.quantile(FITS_SHARE, self.freedom))

    @property
    def is_clear(self) -> bool:
        """Whether the best one explains the other pictures, and stands clear of all others."""
        return self.fits and self.margin > CLEAR

    @cached_property
    def sign_margins(self) -> Array:
        """By how much the sign of 1 + d k along each direction is preferred to the other one, shape (2,), >= 0.

        The least difference of deviance, and of distance, of the hypotheses of the other sign from the best one. The
        deviance alone bounds the probability to err; but it rejects what predicts little, such as a saddle of unknown
        directions, where both explain the pictures equally well.
        """
        other = np.sign(self.hypotheses) != np.sign(self.hypotheses[0])
        return np.array([self._preferred[of].min(initial=np.inf) for of in other.T])

    def told_bends(self) -> tuple[int, int]:
        """Sign of the curvature k along each direction, 0 where it is not told.

        An abs(1 + d k) below 1 is that of a concave surface, whatever its sign; where it is 1 within the noise, the
        surface may be flat.
        """
        told = []
        for i, sign in enumerate(self.told_signs):
            gains = self.hypotheses[:, i]
            gains = gains[np.sign(gains) == sign] if sign else gains
            bends = np.sign(gains - 1) * (np.abs(gains - 1) > 2 * self.gain_sd * np.abs(gains))
            told.append(int(bends[0]) if (bends == bends[0]).all() else 0)
        return told[0], told[1]

    @cached_property
    def _preferred(self) -> Array:
        """By how much the best one is preferred to each, shape (H,)."""
        more = np.minimum(self.distance2 - self.distance2[0], self.deviance - self.deviance[0])
        return np.asarray(np.maximum(more, 0.0))

    @property
    def told_signs(self) -> tuple[int, int]:
        """Sign of 1 + d k along each direction, 0 where the pictures do not tell it."""
        told = (self.sign_margins > CLEAR) & self.fits
        first, second = (np.sign(self.hypotheses[0]) * told).astype(int).tolist()
        return first, second


def rank_by_motions(
    first: Estimate, views: Sequence[MovedView], priors: Priors, gain_sd: float = GAIN_SD
) -> RankedHypotheses | Failure:
    """Rank the first picture's curvature hypotheses by the highlight's positions in further pictures.

    Each hypothesis is a quadric patch, on which the point is solved whose normal points at each further camera. What
    all predictions share, the first picture's normal, distance, gains and principal directions, moves all of them at
    once: the pictures' distances are not added, but taken together with their joint covariance. A motion along one
    principal direction determines that direction's sign alone: two hypotheses then remain equally good.

    Parameters
    ----------
    first : Estimate
        Of `curved` or `inverse_rendering` with the lobe known, so that it has hypotheses.
    views : sequence of MovedView
        Those without an estimate that states its uncertainty, and those too far off for the patch, are passed over.
        Where none is left a Failure ``no_estimate`` or ``undecided``.
    priors : Priors
        For the distance in the first picture; without it, or hypotheses, a Failure ``not_known``.
    gain_sd : float
        Relative standard deviation of the first picture's abs(1 + d k), > 0.
    """
    if first.curvature is None or first.curvature.hypotheses is None or priors.distance_mm is None:
        return Failure(Reason.NOT_KNOWN, "needs curvature hypotheses of the first picture, and its distance")
    if first.covariance is None:
        return Failure(Reason.NOT_KNOWN, "needs the uncertainty of the first picture's normal, which states none")
    views = [replace(view, estimates=[e for e in view.estimates if e.covariance is not None]) for view in views]
    used = [(view, rigid(view.view_from_first, "view_from_first")) for view in views if view.estimates]
    if not used:
        return Failure(Reason.NO_ESTIMATE, "no further picture shows the highlight, with an uncertainty")
    # The sizes of all gains go with 1 / sqrt(c) of the lobe.
    lobe_sd = priors.lobe_curvature.sd / priors.lobe_curvature.mean / 2 if priors.lobe_curvature else 0.0
    distance_sd = priors.distance_mm.sd / priors.distance_mm.mean
    hypotheses = first.curvature.hypotheses
    pictures = [FirstPicture(first, priors.distance_mm.mean, gains) for gains in hypotheses]
    # A view for which a patch has no highlight nearby lies too far off: what is missing there is no evidence.
    explained = [[_explain(picture, view, T) for picture in pictures] for view, T in used]
    near = [[each for each in of_view if each is not None] for of_view in explained]
    near = [of_view for of_view in near if len(of_view) == len(pictures)]
    if not near:
        return Failure(Reason.UNDECIDED, "the camera moved farther than the curvatures at one point predict")
    judged = []
    for i, picture in enumerate(pictures):
        sources = picture.sources(first.covariance, distance_sd, gain_sd, lobe_sd)
        judged.append(_judge([of_view[i] for of_view in near], sources))
    distance2, deviance = (np.array([each[i] for each in judged]) for i in range(2))
    predicted = np.array([each[2] for each in judged])
    order = np.argsort(distance2, kind="stable")
    return RankedHypotheses(
        hypotheses[order], distance2[order], predicted[order], deviance[order], 2 * len(near),
        float(np.hypot(gain_sd, lobe_sd)),
    )  # fmt: skip


@dataclass(frozen=True)
class _Explained:
    """A further picture under a hypothesis: what it predicts, and how far off the estimate is that fits best."""

    predicted: Array  # normal in the view's own frame, shape (3,)
    miss: Array  # of the estimate, in the tangent basis of the predicted normal, rad, shape (2,)
    jacobian: Array  # of the prediction by `SOURCES`, shape (2, 6)
    own: Array  # covariance of what this picture alone adds, shape (2, 2)


def _explain(picture: FirstPicture, view: MovedView, view_from_first: Array) -> _Explained | None:
    """Explain a further picture by a hypothesis; None where the patch has no highlight nearby for its position."""
    R, t = view_from_first[:3, :3], view_from_first[:3, 3]
    position = -R.T @ t
    prediction = picture.predict(position)
    if prediction is None or (J := picture.jacobian(prediction)) is None:
        return None
    moved = _moved_by_pose(picture, prediction, view.error)
    shape = prediction.shape_sd(CHANGE_SD) ** 2 + LEAST_SD**2
    found = []
    for estimate in view.estimates:
        own = _turned(estimate, R, prediction.normal) + moved + shape * np.eye(2)
        miss = tangent_coordinates(prediction.normal, R.T @ estimate.normal)
        found.append(_Explained(R @ prediction.normal, miss, J, own))
    return min(found, key=lambda each: float(each.miss @ np.linalg.solve(each.own, each.miss)))


def _judge(explained: Sequence[_Explained], sources: Array) -> tuple[float, float, Array]:
    """Return squared distance and deviance of a hypothesis over all pictures, and the first predicted normal."""
    # joint covariance: what each picture adds stands on the diagonal, what they share everywhere
    J = np.concatenate([each.jacobian for each in explained])
    covariance = J @ sources @ J.T
    for i, each in enumerate(explained):
        covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += each.own
    miss = np.concatenate([each.miss for each in explained])
    distance2 = float(miss @ np.linalg.solve(covariance, miss))
    return distance2, distance2 + float(np.linalg.slogdet(covariance)[1]), explained[0].predicted


def _moved_by_pose(picture: FirstPicture, prediction: Prediction, error: PoseError) -> Array:
    """Return the covariance that the motion's error gives the difference of seen and predicted normal, (2, 2)."""
    made = error.rotation**2 * np.eye(2)
    if error.translation > 0:
        by_position = picture.by_position(prediction)
        sd = error.translation * float(np.linalg.norm(prediction.position))
        made = made + sd**2 * by_position @ by_position.T
    return made


def _turned(estimate: Estimate, R: Array, predicted: Array) -> Array:
    """Return a further normal's covariance in the predicted one's tangent basis, first camera's frame."""
    assert estimate.covariance is not None
    turn = basis_across(predicted) @ (basis_across(estimate.normal) @ R).T
    return np.asarray(turn @ estimate.covariance @ turn.T)


def rigid(motion: npt.ArrayLike, name: str) -> Array:
    """Return a rigid motion, shape (4, 4), checked; `name` stands in the `InputError` of one that is not."""
    T = np.asarray(motion, dtype=float)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{name}: shape {T.shape}; must be a finite 4 x 4 matrix")
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0 or np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputError(f"{name}: must be a rotation and a translation")
    return T
