"""Which highlights belong to which light, and how many lights there are.

candidates: every pair of highlights of two pictures, whose reflected rays meet near a point. growth: each candidate
takes, picture by picture, the highlight that lies where it predicts one, and is corrected by it. choice: the candidate
that explains most highlights becomes a light, its highlights are taken away, and so on.
"""

import math
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from simtest.calibration.lights.bundle import (
    REACH_MM,
    Bundle,
    Highlights,
    derivatives,
    prediction,
    solve,
    with_error,
)
from simtest.calibration.lights.mirrors import Mirrors
from simtest.geometry.camera import Camera
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, Index, Mask

MOST_LIGHTS = 4
PAIRS = 24
"""Pairs of pictures whose highlights are combined: those whose mirrors lie farthest apart in the view."""

MOST_CANDIDATES = 4000
SLACK_PX = 0.3
"""Error of a highlight's centre that the search allows beyond the stated one; the fit does not use it."""

GATE = chi_squared.quantile(0.999, 2)
"""Squared distance of a highlight from its expected pixel, in standard deviations, up to which it is taken."""

LEAST_SHARE = 0.6
"""A light must explain a highlight in this share of the pictures that show any."""

LEAST_PICTURES = 3
"""And in so many pictures, if there are as many."""

SEEN_TOO_SELDOM = 3
"""A position that explains so many of the highlights left may be a light that most pictures do not show."""

MERGED_PX = 3.0
"""Two lights that are expected so near to each other, with one highlight, have merged: it is neither's."""

PARALLEL = 0.02
"""Rays at a smaller angle, rad, count as parallel."""

MOST_GHOSTS = 12
"""Candidates that may belong to another explanation, the likeliest first, are tried up to this number."""

FIRST_STEPS = 5
ROUNDS = 6
DISTINCT = chi_squared.quantile(0.9999, 3)


@dataclass(frozen=True)
class Found:
    """Lights, and which one made each highlight."""

    bundle: Bundle  # the fit
    source: Index  # (N,): number of the light of each highlight; -1: none
    # (A, 3): positions, mm, of another set of lights that explains the highlights about as well: the result is
    # ambiguous.
    others: Array
    further: Array  # (B, 3): positions, mm, that explain three or more of the highlights left, but too few for a light


class _Views(NamedTuple):
    """Pictures of mirrors, and the highlights measured in them."""

    camera: Camera
    mirrors: Mirrors
    highlights: Highlights


@dataclass
class _Candidates:
    """Positions (N, 3), covariances (N, 3, 3), the highlight taken in each picture (N, V), and chi-squared (N,)."""

    lights: Array
    covariances: Array
    taken: Index
    chi2: Array

    def only(self, kept: Mask) -> "_Candidates":
        return _Candidates(self.lights[kept], self.covariances[kept], self.taken[kept], self.chi2[kept])


def find_lights(camera: Camera, mirrors: Mirrors, highlights: Highlights, most: int = MOST_LIGHTS) -> Found | None:
    """Find up to `most` lights that explain the highlights; None where there is none.

    Highlights that no light explains are left out: a second reflection, a window, a lamp that does not move with the
    camera.
    """
    loose = _Views(camera, mirrors, with_error(highlights, SLACK_PX))
    candidates = _grow(loose, _candidates(loose))
    shown = len(np.unique(highlights.view))
    least = max(min(LEAST_PICTURES, max(len(mirrors), 2)), math.ceil(LEAST_SHARE * shown))
    everything = np.ones(len(highlights), dtype=bool)
    starts = _chosen(loose, candidates, [], everything, (least, most))
    if not starts:
        return None
    together = _refined(loose, np.array(starts), everything, ROUNDS)
    if together is None:
        return None
    source = _without_merged(loose, *together)
    bundle = solve(camera, mirrors, highlights, source, together[0].lights)
    if bundle is None:
        return None
    left = together[1] < 0
    known = list(bundle.lights)
    more = _chosen(loose, candidates, known, left, (SEEN_TOO_SELDOM, most))[len(known) :]
    found = Found(bundle, source, np.empty((0, 3)), np.array(more).reshape(-1, 3))
    others = _ambiguities(_Views(camera, mirrors, highlights), candidates, replace(found, source=together[1]), least)
    return replace(found, others=others)


def _chosen(
    views: _Views, candidates: _Candidates, starts: list[Array], free: Mask, counts_allowed: tuple[int, int]
) -> list[Array]:
    """Return positions of lights: those given, and the candidates that explain most of the highlights left, in turn.

    `counts_allowed` is the least number of highlights of a light and the largest number of lights.
    """
    least, most = counts_allowed
    starts, free = list(starts), free.copy()
    while len(starts) < most and len(candidates.lights):
        counts = _counted(candidates, free)
        best = int(np.lexsort((candidates.chi2, -counts))[0])
        if counts[best] < least:
            break
        alone = _refined(views, candidates.lights[best][None], free, 1)
        if alone is None or (alone[1] >= 0).sum() < least:
            candidates = candidates.only(np.arange(len(candidates.lights)) != best)
            continue
        starts.append(alone[0].lights[0])
        free &= alone[1] < 0
    return starts


def _without_merged(views: _Views, bundle: Bundle, source: Index) -> Index:
    """Return the assignment without highlights that lie where a light without a highlight of its own is expected too.

    The lights' images have merged there, and the centre is that of both. A light that would keep fewer than two
    highlights keeps all.
    """
    kept, highlights = source.copy(), views.highlights
    lights = np.arange(len(bundle.lights))
    for view in np.unique(highlights.view):
        own = np.flatnonzero((highlights.view == view) & (source >= 0))
        unseen = np.setdiff1d(lights, source[own])
        predicted, _ = prediction(views.camera, views.mirrors, bundle, np.full(len(lights), view), lights)
        for row in own:
            gaps = np.linalg.norm(predicted[unseen] - highlights.pixels[row], axis=1)
            if (gaps < MERGED_PX).any():
                kept[row] = -1
    counts = np.bincount(kept[kept >= 0], minlength=len(lights))
    few = np.isin(source, np.flatnonzero(counts < 2))
    return np.where(few, source, kept)


def _candidates(views: _Views) -> _Candidates:
    """Return positions where the reflected rays of two highlights of different pictures meet."""
    camera, mirrors, highlights = views
    first, second = _pairs(highlights, camera)
    none = _Candidates(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, len(mirrors)), np.intp), np.empty(0))
    if not len(first):
        return none
    ends = [mirrors.reflect(camera, highlights.view[k], highlights.pixels[k]) for k in (first, second)]
    lights = _nearest_points(*ends[0], *ends[1])
    # refine: both highlights' pixels, and the prior
    covariances = np.empty((len(lights), 3, 3))
    chi2 = np.zeros(len(lights))
    for _ in range(FIRST_STEPS):
        normal = np.broadcast_to(np.eye(3) / REACH_MM**2, covariances.shape).copy()
        gradient = -lights / REACH_MM**2
        chi2 = np.zeros(len(lights))
        for k in (first, second):
            residual, J, weights = _weighted(views, lights, k)
            normal += np.swapaxes(J, 1, 2) @ weights @ J
            gradient += np.einsum("nki,nkl,nl->ni", J, weights, residual)
            chi2 += np.einsum("nk,nkl,nl->n", residual, weights, residual)
        fine = np.asarray(np.isfinite(normal).all(axis=(1, 2)) & np.isfinite(gradient).all(axis=1))
        covariances = np.linalg.inv(np.where(fine[:, None, None], normal, np.eye(3)))
        lights = np.where(fine[:, None], lights + np.einsum("nij,nj->ni", covariances, gradient), np.nan)
    taken = np.full((len(lights), len(mirrors)), -1, dtype=np.intp)
    rows = np.arange(len(lights))
    taken[rows, highlights.view[first]], taken[rows, highlights.view[second]] = first, second
    return _Candidates(lights, covariances, taken, chi2).only(np.isfinite(lights).all(axis=1) & (chi2 < GATE))


def _pairs(highlights: Highlights, camera: Camera) -> tuple[Index, Index]:
    """Return pairs of highlights of different pictures, of those pictures that differ most first."""
    views = np.unique(highlights.view)
    middles = {view: camera.unproject(highlights.pixels[highlights.view == view]).mean(axis=0) for view in views}
    apart = sorted(combinations(views, 2), key=lambda pair: -float(np.linalg.norm(middles[pair[0]] - middles[pair[1]])))
    # Every picture takes part, with the one that differs most from it.
    chosen = list(dict.fromkeys(next(pair for pair in apart if view in pair) for view in views)) if apart else []
    chosen += [pair for pair in apart[:PAIRS] if pair not in chosen]
    first, second = list[int](), list[int]()
    for a, b in chosen:
        ones, others = np.flatnonzero(highlights.view == a), np.flatnonzero(highlights.view == b)
        first += np.repeat(ones, len(others)).tolist()
        second += np.tile(others, len(ones)).tolist()
    return np.array(first[:MOST_CANDIDATES], np.intp), np.array(second[:MOST_CANDIDATES], np.intp)


def _nearest_points(p: Array, u: Array, q: Array, v: Array) -> Array:
    """Return the points midway between lines through p, q along u, v, shape (N, 3), at most twice the reach away."""
    w, cosine = p - q, np.sum(u * v, axis=1)
    square = np.maximum(1 - cosine**2, 1e-9)
    a, b = np.sum(u * w, axis=1), np.sum(v * w, axis=1)
    middle = (p + ((cosine * b - a) / square)[:, None] * u + q + ((b - cosine * a) / square)[:, None] * v) / 2
    # Rays that are all but parallel meet nowhere in particular: the point nearest to the camera, which the prior takes.
    nearest = p - np.sum(p * u, axis=1)[:, None] * u
    middle = np.where((square > PARALLEL**2)[:, None], middle, nearest)
    length = np.linalg.norm(middle, axis=1, keepdims=True)
    return np.asarray(middle * np.minimum(1.0, 2 * REACH_MM / np.maximum(length, 1e-9)))


def _weighted(views: _Views, lights: Array, measured: Index) -> tuple[Array, Array, Array]:
    """Return residuals (N, 2), derivatives by the light (N, 2, 3) and inverse covariances (N, 2, 2) of highlights."""
    camera, mirrors, highlights = views
    predicted, J, K = derivatives(camera, mirrors, highlights.view[measured], lights, np.zeros(3))
    spread = highlights.covariance[measured] + K @ np.swapaxes(K, 1, 2)
    fine = np.asarray(np.isfinite(spread).all(axis=(1, 2)))
    return highlights.pixels[measured] - predicted, J, np.where(fine[:, None, None], _inverse(spread, fine), np.nan)


def _inverse(covariances: Array, fine: Mask) -> Array:
    """Return the inverses of those covariances, shape (..., 2, 2), that are finite; of the others the unit matrix."""
    return np.linalg.inv(np.where(fine[..., None, None], covariances, np.eye(2)))


def _squares(gaps: Array, covariances: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances, inf where they are not known, and the covariances' inverses."""
    fine = np.asarray(np.isfinite(covariances).all(axis=(-2, -1)) & np.isfinite(gaps).all(axis=-1))
    inverse = _inverse(covariances, fine)
    return np.where(fine, np.einsum("nhi,nhij,nhj->nh", gaps, inverse, gaps), np.inf), inverse


def _grow(views: _Views, held: _Candidates) -> _Candidates:
    """Let every candidate take the highlight that it predicts in each further picture, and be corrected by it."""
    camera, mirrors, highlights = views
    for view in range(len(mirrors)):
        own = np.flatnonzero(highlights.view == view)
        asked = np.flatnonzero(held.taken[:, view] < 0)
        if not len(own) or not len(asked):
            continue
        at = np.full(len(asked), view)
        predicted, J, K = derivatives(camera, mirrors, at, held.lights[asked], np.zeros(3))
        spread = J @ held.covariances[asked] @ np.swapaxes(J, 1, 2) + K @ np.swapaxes(K, 1, 2)
        # the nearest highlight, in standard deviations
        gaps = highlights.pixels[own][None] - predicted[:, None]
        squares, inverse = _squares(gaps, spread[:, None] + highlights.covariance[own][None])
        nearest = squares.argmin(axis=1)
        rows = np.flatnonzero(squares[np.arange(len(asked)), nearest] < GATE)
        if not len(rows):
            continue
        n, h = asked[rows], nearest[rows]
        gain = held.covariances[n] @ np.swapaxes(J[rows], 1, 2) @ inverse[rows, h]
        held.lights[n] += np.einsum("nij,nj->ni", gain, gaps[rows, h])
        held.covariances[n] -= gain @ J[rows] @ held.covariances[n]
        held.chi2[n] += squares[rows, h]
        held.taken[n, view] = own[h]
    return held


def _counted(candidates: _Candidates, free: Mask) -> Index:
    """Return how many free highlights each candidate has taken."""
    return np.asarray(((candidates.taken >= 0) & free[candidates.taken]).sum(axis=1), np.intp)


def _refined(views: _Views, starts: Array, free: Mask, rounds: int) -> tuple[Bundle, Index] | None:
    """Assign highlights to lights and fit the lights, in turn, until the assignment stays."""
    bundle: Bundle | None = Bundle(starts, np.eye(starts.size), np.zeros(3), 0.0, 0)
    source = np.full(len(views.highlights), -1, dtype=np.intp)
    for _ in range(max(rounds, 2)):
        assert bundle is not None
        assigned = _assign(views, bundle, free)
        if np.array_equal(assigned, source):
            break
        source = assigned
        counts = np.bincount(source[source >= 0], minlength=len(starts))
        if counts.min() < 1:
            return None
        bundle = solve(*views, source, bundle.lights)
        if bundle is None:
            return None
    assert bundle is not None
    return bundle, source


def _assign(views: _Views, bundle: Bundle, free: Mask) -> Index:
    """Return which light made each highlight, one highlight a light and picture at most; -1 where none did.

    Of all assignments of a picture's highlights the one with the smallest sum of squared distances is taken, where a
    highlight without a light costs `GATE`.
    """
    from scipy.optimize import linear_sum_assignment

    camera, mirrors, highlights = views
    source = np.full(len(highlights), -1, dtype=np.intp)
    lights = np.arange(len(bundle.lights))
    for view in np.unique(highlights.view):
        own = np.flatnonzero((highlights.view == view) & free)
        if not len(own):
            continue
        predicted, spread = prediction(camera, mirrors, bundle, np.full(len(lights), view), lights)
        gaps = highlights.pixels[own][:, None] - predicted[None]
        squares, _ = _squares(gaps, spread[None] + highlights.covariance[own][:, None])
        rows, columns = linear_sum_assignment(np.minimum(squares, GATE))
        for row, column in zip(rows, columns, strict=True):
            if squares[row, column] < GATE:
                source[own[row]] = column
    return source


def _ambiguities(views: _Views, candidates: _Candidates, found: Found, least: int) -> Array:
    """Return positions of further lights that are part of an explanation about as good as the one found; (A, 3), mm.

    A candidate that explains as many highlights as a light is often a chance meeting of other lights' rays. It is a
    doubt only if the best set of lights that holds it explains as many highlights as the lights found, about as well.
    """
    highlights, bundle = views.highlights, found.bundle
    loose = views._replace(highlights=with_error(highlights, SLACK_PX))
    everything = np.ones(len(highlights), dtype=bool)
    explained, lights = int((found.source >= 0).sum()), len(bundle.lights)
    own = solve(*views, found.source, bundle.lights)
    if not len(candidates.lights) or own is None:
        return np.empty((0, 3))
    inflation = max(1.0, own.chi2 / own.freedom) if own.freedom > 0 else 1.0
    counts, tried = _counted(candidates, everything), list[tuple[Array, Array]]()
    for index in np.lexsort((candidates.chi2, -counts)):
        light, spread = candidates.lights[index], candidates.covariances[index]
        known = [(each, bundle.covariance_of(i)) for i, each in enumerate(bundle.lights)] + tried
        if counts[index] < least or len(tried) >= MOST_GHOSTS:
            break
        if min((light - each) @ np.linalg.solve(spread + about, light - each) for each, about in known) < DISTINCT:
            continue
        tried.append((light, spread))
        alone = _refined(loose, light[None], everything, 1)
        if alone is None or (alone[1] >= 0).sum() < least or not _is_apart(alone[0], 0, bundle):
            continue
        starts = _chosen(loose, candidates, [alone[0].lights[0]], alone[1] < 0, (least, lights))
        other = _refined(loose, np.array(starts), everything, ROUNDS)
        if other is None or (other[1] >= 0).sum() < explained:
            continue
        strict = solve(*views, other[1], other[0].lights)
        if strict is None or (strict.chi2 - own.chi2) / inflation > GATE:
            continue
        for number in range(len(strict.lights)):
            if _is_apart(strict, number, bundle):
                return strict.lights[number][None]
    return np.empty((0, 3))


def _is_apart(other: Bundle, number: int, bundle: Bundle) -> bool:
    """Return whether a light of another bundle is none of a bundle's lights."""
    gaps = other.lights[number] - bundle.lights
    spreads = [other.covariance_of(number) + bundle.covariance_of(i) for i in range(len(gaps))]
    return min(float(gap @ np.linalg.solve(spread, gap)) for gap, spread in zip(gaps, spreads, strict=True)) > DISTINCT
