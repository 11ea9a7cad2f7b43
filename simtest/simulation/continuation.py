"""Follows highlight points over the surface while camera and lights move: Newton's method with a predictor.

At a highlight point X the fine normal N is the bisector b of the unit directions r' to the camera V (r' = -r) and t to
the light L. Let the camera move by dV and the light by dL. With d and l the distances of X to both and s = |t - r|, the
point moves over the base by u, where

    dN(u) + B u = c,    B = (I - b b^T) [(I - r r^T)/d + (I - t t^T)/l] / s,
                        c = (I - b b^T) [(I - r r^T) dV/d + (I - t t^T) dL/l] / s.

With the light at the camera this is (I + d S) u = dV across the sightline (theory.md 3; docs/concepts/theory.md 3.3).
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from simtest.geometry.vectors import tangent_basis
from simtest.rendering import Session
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.surfaces import RayHits, SurfaceModel
from simtest.surfaces.relief_field import normal_derivative

NEWTON_STEPS = 8
ZERO = 1e-10
"""A point is a highlight point where normal and bisector differ by less than this, rad."""

CORRECTION = 0.5
"""A step is refused where the correction is longer than this share of the predicted motion."""

LEAST_MM = 1e-6
"""Corrections shorter than this, as a share of the distance, are always allowed."""

BEND = 3.0
"""A step is refused where the determinant changes by more than this factor: a fold may lie between."""

LEAST_STEP = 1.0 / 256
"""Shortest step, as a share of the motion between two frames."""

ANOTHER = 0.02
"""A ray that ends off the expected point by more than this share of the distance meets another part of the surface."""

REACHED, MERGED, HIDDEN, OFF, LOST = "", "merged", "hidden", "off the surface", "not followed"
"""How a continuation ends: at the end of the motion, at a fold, behind another part of the surface, beyond it, or where
steps of `LEAST_STEP` are still too long and none of these explains it."""

FOLD_STEPS, PROBE = 8.0, 1e-3
"""A fold explains the end where the squared determinant, linear in time there, reaches 0 within so many shortest steps;
its change is measured over this share of one."""


@dataclass(frozen=True)
class Contact:
    """Where rays meet the surface; NaN where they miss.

    Parameters
    ----------
    position : ndarray, shape (N, 3)
        World frame, mm.
    normal : ndarray, shape (N, 3)
        Unit normal of the fine surface or of its base.
    plane : ndarray, shape (N, 3)
        Normals of the planes in which the positions move.
    derivative : ndarray, shape (N, 3, 3)
        Change of `normal` along these planes, 1/mm.
    """

    position: Array
    normal: Array
    plane: Array
    derivative: Array


class SurfaceInTime(Protocol):
    """The surface between two frames."""

    @property
    def deforms(self) -> bool:
        """Whether it changes its form in time."""

    @property
    def reversed(self) -> "SurfaceInTime":
        """The surface with time running backwards."""

    def meet(self, shares: Array, origins: Array, directions: Array) -> Contact:
        """Return where rays, shape (N, 3), world frame, meet the surface, each at its own moment.

        `shares`, shape (N,), are 0 at the first frame and 1 at the second.
        """


@dataclass(frozen=True)
class StillSurface:
    """A surface that does not deform, at a session's scene.

    Parameters
    ----------
    session : Session
        At any of the frames.
    fine : bool
        Whether normals are those of the relief, where there is one.
    """

    session: Session
    fine: bool = True
    deforms = False

    @property
    def reversed(self) -> "StillSurface":
        """Itself: it is the same at all moments."""
        return self

    def meet(self, shares: Array, origins: Array, directions: Array) -> Contact:
        """Return where rays meet the surface (see `SurfaceInTime.meet`)."""
        hits = self.session.exact_hits(origins, directions)
        return contact(self.session.surface, origins, directions, hits, self.fine)


def contact(surface: SurfaceModel, origins: Array, directions: Array, hits: RayHits, fine: bool) -> Contact:
    """Return where rays, shape (N, 3), meet a surface, from their hits; normals of the relief if `fine`."""
    base = surface.points(origins, directions, hits)
    plane, derivative = surface.motion(base, hits)
    normal = base.normal
    if fine and surface.relief is not None:
        jets = surface.relief.jets(np.where(base.valid[:, None], base.position, 0.0))
        normal, derivative = normal_derivative(normal, derivative, jets)
    return Contact(base.position, normal, plane, derivative)


@dataclass(frozen=True)
class Motion:
    """How camera centre and lights move between two frames, along straight lines, world frame, mm.

    Parameters
    ----------
    camera : tuple of ndarray, shape (3,)
        The camera's centre at the first and at the second frame.
    lights : tuple of ndarray, shape (L, 3)
        The lights.
    """

    camera: tuple[Array, Array]
    lights: tuple[Array, Array]

    def at(self, shares: Array, light: IntArray) -> tuple[Array, Array]:
        """Return camera centre and light, two arrays of shape (N, 3), at moments between the frames."""
        share = shares[:, None]
        first, second = self.lights
        return (
            (1 - share) * self.camera[0] + share * self.camera[1],
            (1 - share) * first[light] + share * second[light],
        )

    def speed(self, light: IntArray) -> tuple[Array, Array]:
        """Return the whole motion of the camera's centre and of each point's light, two arrays of shape (N, 3)."""
        moved = self.lights[1] - self.lights[0]
        return np.broadcast_to(self.camera[1] - self.camera[0], (len(light), 3)), moved[light]

    @property
    def reversed(self) -> "Motion":
        """The motion from the second frame to the first."""
        return Motion(self.camera[::-1], self.lights[::-1])


@dataclass(frozen=True)
class Continued:
    """Where highlight points have moved.

    Parameters
    ----------
    position : ndarray, shape (N, 3)
        World frame, mm: at the end of the motion, or where the continuation ended before.
    share : ndarray, shape (N,)
        How far along the motion: 1 where it was reached.
    end : list of str
        `REACHED`, or why not.
    """

    position: Array
    share: Array
    end: list[str]


@dataclass
class _State:
    """Points at their moments: position, gap of normal and bisector, and the linear map of motions to its change."""

    position: Array
    gap: Array
    matrix: Array
    basis: Array
    determinant: Array
    driven: Array
    offset: Array


def follow(surface: SurfaceInTime, motion: Motion, positions: Array, lights: IntArray) -> Continued:
    """Follow highlight points from the first frame to the second.

    Parameters
    ----------
    surface : SurfaceInTime
        The surface.
    motion : Motion
        Of camera and lights.
    positions : ndarray, shape (N, 3)
        Highlight points at the first frame, world frame, mm.
    lights : ndarray of int, shape (N,)
        Index of the light of each.

    Returns
    -------
    Continued
        Where each point is at the second frame, or where and why its continuation ended before.
    """
    count = len(positions)
    position, share, step = np.array(positions, dtype=float), np.zeros(count), np.ones(count)
    end = [REACHED] * count
    going = np.arange(count)
    if not count:
        return Continued(position, share, end)
    state = _state(surface, motion, share, lights, position)
    while len(going):
        own = _part(state, going)
        # Predict, then correct at the next moment.
        size = np.minimum(step[going], 1 - share[going])
        later = share[going] + size
        predicted = _predicted(surface, motion, later, lights[going], own, size)
        found, moved, why = _corrected(surface, motion, later, lights[going], own, predicted)
        # Accept, or halve the step.
        accepted = going[moved]
        position[accepted], share[accepted] = found.position[moved], later[moved]
        _write(state, accepted, _part(found, moved))
        step[accepted] *= 2
        refused = going[~moved]
        step[refused] /= 2
        ended = step[refused] < LEAST_STEP
        reasons = np.where(_at_fold(surface, motion, share, lights, state, refused[ended]), MERGED, LOST)
        for i, reason, other in zip(refused[ended], np.asarray(why)[~moved][ended], reasons, strict=True):
            end[i] = str(other if reason == LOST else reason)
        going = np.array([i for i in going if share[i] < 1 and step[i] >= LEAST_STEP], dtype=np.int64)
    return Continued(position, share, end)


def _at_fold(
    surface: SurfaceInTime, motion: Motion, shares: Array, lights: IntArray, state: _State, chosen: IntArray
) -> Mask:
    """Return which of the chosen points are about to meet another one at a fold, shape (K,).

    There the determinant falls as the root of the time that is left.
    """
    if not len(chosen):
        return np.zeros(0, dtype=bool)
    own, size = _part(state, chosen), np.full(len(chosen), PROBE * LEAST_STEP)
    later, light = shares[chosen] + size, lights[chosen]
    with np.errstate(invalid="ignore", divide="ignore"):
        ahead = own.position + _predicted(surface, motion, later, light, own, size)
        sound = np.asarray(np.isfinite(ahead).all(axis=1))
        moved = _state(surface, motion, later, light, np.where(sound[:, None], ahead, own.position))
        rate = (moved.determinant - own.determinant) / size
        left = -own.determinant / (2 * rate)
        return np.asarray(sound & (left > 0) & (left < FOLD_STEPS * LEAST_STEP))


def _predicted(
    surface: SurfaceInTime, motion: Motion, shares: Array, lights: IntArray, start: _State, size: Array
) -> Array:
    """Return the expected motions of points, shape (N, 3), mm, until their next moments, a share `size` later."""
    if not surface.deforms:
        return _solve(start, start.driven) * size[:, None]
    # The surface moves too: one step of Newton's method at the next moment holds all motions to first order.
    ahead = _state(surface, motion, shares, lights, start.position)
    return ahead.position - _solve(ahead, ahead.gap) - start.position


def _corrected(
    surface: SurfaceInTime, motion: Motion, shares: Array, lights: IntArray, start: _State, predicted: Array
) -> tuple[_State, Mask, list[str]]:
    """Correct predicted points at their moments; return them, which are sound, and why others are not."""
    target = start.position + predicted
    state = _state(surface, motion, shares, lights, target)
    reach = _length(target - motion.at(shares, lights)[0])[:, 0]
    allowed = CORRECTION * _length(predicted)[:, 0] + LEAST_MM * reach
    for _ in range(NEWTON_STEPS):
        with np.errstate(invalid="ignore"):
            strayed = ~(_length(state.position - target)[:, 0] <= allowed) | ~(state.offset < ANOTHER)
            done = _length(state.gap)[:, 0] < ZERO
        if (done | strayed).all():
            break
        aim = state.position - _solve(state, state.gap)
        # What strays is not needed any more, and may have no finite position.
        aim[strayed | done] = state.position[strayed | done]
        state = _state(surface, motion, shares, lights, aim)
    with np.errstate(invalid="ignore", divide="ignore"):
        done = _length(state.gap)[:, 0] < ZERO
        near = _length(state.position - target)[:, 0] <= allowed
        ratio = state.determinant / start.determinant
        same = (ratio > 1 / BEND) & (ratio < BEND)
        jumped = state.offset >= ANOTHER
    missed = ~np.isfinite(state.position).all(axis=1)
    why = np.select([missed, jumped], [OFF, HIDDEN], LOST).tolist()
    return state, done & near & same & ~jumped & ~missed, why


def _state(surface: SurfaceInTime, motion: Motion, shares: Array, lights: IntArray, targets: Array) -> _State:
    """Cast rays from the camera to points, and return what they meet."""
    centre, light = motion.at(shares, lights)
    towards = targets - centre
    reach = _length(towards)
    r = towards / reach
    met = surface.meet(shares, centre, r)
    distance = _length(met.position - centre)
    # Bisector of the directions to camera and light.
    t = light - met.position
    far = _length(t)
    t = t / far
    size = _length(t - r)
    b = (t - r) / size
    eye = np.eye(3)
    from_camera = (eye - _outer(r, r)) / distance[:, :, None]
    from_light = (eye - _outer(t, t)) / far[:, :, None]
    across = (eye - _outer(b, b)) / size[:, :, None]
    turned = across @ (from_camera + from_light)
    # In a basis of the plane in which the point moves, and one across the bisector.
    with np.errstate(invalid="ignore"):
        # On the camera's side, so that the determinant keeps its sign.
        side = -np.sign(np.sum(met.plane * r, axis=1, keepdims=True))
        unit = met.plane * side / _length(met.plane)
        basis = np.stack(tangent_basis(np.where(np.isfinite(unit), unit, [0.0, 0.0, 1.0])), axis=1)
        rows = np.stack(tangent_basis(np.where(np.isfinite(b), b, [0.0, 0.0, 1.0])), axis=1)
    matrix = np.einsum("nai,nij,nbj->nab", rows, met.derivative + turned, basis)
    dV, dL = motion.speed(lights)
    drive = across @ (np.einsum("nij,nj->ni", from_camera, dV) + np.einsum("nij,nj->ni", from_light, dL))[:, :, None]
    return _State(
        position=met.position,
        gap=np.einsum("nai,ni->na", rows, met.normal - b),
        matrix=matrix,
        basis=basis,
        # Times the squared distance: the product of both 1 + d k where light and camera are one.
        determinant=np.linalg.det(matrix) * distance[:, 0] ** 2,
        driven=np.einsum("nai,nij->na", rows, drive),
        offset=np.abs(distance - reach)[:, 0] / reach[:, 0],
    )


def _solve(state: _State, right: Array) -> Array:
    """Return the motions over the surface, shape (N, 3), mm, that change the gap by given amounts, shape (N, 2)."""
    (a, b), (c, d) = state.matrix[:, 0].T, state.matrix[:, 1].T
    first, second = right.T
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1 / (a * d - b * c)
        along = np.stack([(d * first - b * second) * inverse, (a * second - c * first) * inverse], axis=1)
    return np.einsum("na,nai->ni", along, state.basis)


def _part(state: _State, chosen: IntArray | Mask) -> _State:
    return _State(**{name: values[chosen] for name, values in vars(state).items()})


def _write(state: _State, chosen: IntArray, part: _State) -> None:
    for name, values in vars(part).items():
        getattr(state, name)[chosen] = values


def _outer(a: Array, b: Array) -> Array:
    return np.asarray(a[:, :, None] * b[:, None, :])


def _length(vectors: Array) -> Array:
    return np.sqrt(np.sum(vectors * vectors, axis=-1, keepdims=True))
