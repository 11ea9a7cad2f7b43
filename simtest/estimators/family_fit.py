"""Fitting of highlights' isophote families, all ellipses and poses of several highlights at once."""

from collections.abc import Sequence

import numpy as np

from simtest.errors import Failure, Reason
from simtest.estimators.isophote_family import HOLDS_OTHERS, IsophoteFamily
from simtest.estimators.isophote_fit import FittedIsophote, fit_cut_isophote, fit_isophotes_of_each
from simtest.geometry import Camera, CirclePose, Patch, circle_poses

MIN_ISOPHOTES = 2
"""One isophote alone may be an accident of the background."""

OTHERS_RESIDUAL, OTHERS_RATIO = 0.1, 2.5
"""A lower isophote that differs from its ellipse by more than this share of its radius, and so many times more than the
innermost one does, holds other highlights too."""


def fit_isophote_family(patch: Patch, camera: Camera, isovalues: Sequence[float]) -> IsophoteFamily | Failure:
    """Fit the isophotes of one highlight (see `fit_isophote_families`)."""
    return fit_isophote_families([patch], camera, isovalues)[0]


def fit_isophote_families(
    patches: Sequence[Patch], camera: Camera, isovalues: Sequence[float]
) -> list[IsophoteFamily | Failure]:
    """Fit the isophotes of several highlights, all ellipses and poses at once, isovalues in any order.

    Where fewer than 2 isophotes (1, if only one isovalue is given) are whole, the seen parts of those that are cut are
    fitted too; with fewer than 2 of either kind the result is the first one's Failure.
    """
    if not patches:
        return []
    # A family begins with the lowest isophote, from which neighbours are left out, and ends with the innermost.
    isovalues = sorted(set(isovalues))
    # whole isophotes
    posed = _with_poses(fit_isophotes_of_each(patches, camera, isovalues))
    least = min(MIN_ISOPHOTES, len(isovalues))
    made: list[IsophoteFamily | Failure] = []
    for patch, (kept, poses, failures) in zip(patches, posed, strict=True):
        if len(poses) < least:
            made.append(_with_arcs(patch, camera, isovalues, kept, failures))
        else:
            family = _of_ellipses(IsophoteFamily(patch, camera, tuple(kept), tuple(poses), tuple(failures)), least)
            made.append(family if isinstance(family, Failure) else _of_one(family, least))
    return made


def _of_ellipses(family: IsophoteFamily, least: int) -> IsophoteFamily | Failure:
    """Leave out isophotes that are no ellipses across the mean axis; a Failure where too few are left."""
    while not (whole := family.are_ellipses).all():
        # Without them the mean axis is another one.
        failed = [Failure(Reason.NOT_AN_ELLIPSE, f"t = {i.isovalue:g} reaches too far off the mean axis")
                  for i, good in zip(family.isophotes, whole, strict=True) if not good]  # fmt: skip
        if whole.sum() < least:
            return failed[0]
        kept = np.flatnonzero(whole)
        isophotes, poses = tuple(family.isophotes[i] for i in kept), tuple(family.poses[i] for i in kept)
        family = IsophoteFamily(family.patch, family.camera, isophotes, poses, (*family.failures, *failed))
    return family


def _of_one(family: IsophoteFamily, least: int) -> IsophoteFamily:
    """Leave out the lower isophotes of a highlight that hold others too, as long as enough are left."""
    residuals = family.residuals
    allowed = max(OTHERS_RESIDUAL, OTHERS_RATIO * float(residuals[-1]))
    first = int(np.max(np.flatnonzero(residuals > allowed), initial=-1)) + 1
    if first == 0 or len(residuals) - first < least:
        return family
    held = [Failure(Reason.NOT_AN_ELLIPSE, f"t = {i.isovalue:g} {HOLDS_OTHERS}") for i in family.isophotes[:first]]
    kept, poses = family.isophotes[first:], family.poses[first:]
    return IsophoteFamily(family.patch, family.camera, kept, poses, (*family.failures, *held))


def _with_arcs(
    patch: Patch, camera: Camera, isovalues: Sequence[float], whole: list[FittedIsophote], failures: list[Failure]
) -> IsophoteFamily | Failure:
    """Fit the arcs of isophotes that the border or the view cuts, where too few are whole."""
    least = min(MIN_ISOPHOTES, len(isovalues))
    closed = {isophote.isovalue for isophote in whole}
    arcs = [fit_cut_isophote(patch, camera, t) for t in isovalues if t not in closed]
    cut = [arc for arc in arcs if isinstance(arc, FittedIsophote)]
    if len(whole) + len(cut) < least:
        return failures[0]
    failed = [arc for arc in arcs if isinstance(arc, Failure)]
    ((kept, poses, failed),) = _with_poses([(sorted([*whole, *cut], key=lambda i: i.isovalue), failed)])
    if len(poses) < least:
        return failures[0]
    return _of_ellipses(IsophoteFamily(patch, camera, tuple(kept), tuple(poses), tuple(failed)), least)


Posed = tuple[list[FittedIsophote], list[CirclePose], list[Failure]]


def _with_poses(fitted: Sequence[tuple[list[FittedIsophote], list[Failure]]]) -> list[Posed]:
    """Return each highlight's isophotes whose cones have a pose, their poses, and all failures."""
    every = [isophote for isophotes, _ in fitted for isophote in isophotes]
    if not every:
        return [([], [], failures) for _, failures in fitted]
    found = circle_poses(
        np.array([isophote.cone for isophote in every]), np.array([isophote.sightline for isophote in every])
    )
    poses = (found[i] for i in range(len(every)))
    made: list[Posed] = []
    for isophotes, failures in fitted:
        kept, own, failed = [], [], [*failures]
        for isophote in isophotes:
            if isinstance(pose := next(poses), Failure):
                failed.append(pose)
            else:
                kept.append(isophote)
                own.append(pose)
        made.append((kept, own, failed))
    return made
