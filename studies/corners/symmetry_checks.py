"""Checks by symmetry: a scene that is mirrored or turned has the same labels."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry import BrownConrady, Camera
from simtest.reconstruction import reconstruct
from simtest.rendering import HighlightPoint
from simtest.runtime.arrays import Array
from simtest.simulation.highlights import TrueHighlight
from studies.corners import formulas
from studies.corners.case import ESTIMATORS, TURN, Case, Faults, View, mean

BORDER_PX = 0.5
"""What lies so near to the frame's border may be in view on one side of a symmetry alone."""


def mirror(case: Case) -> Faults:
    """Check that a mirrored scene has mirrored labels."""
    other = case.mirrored

    def pixels(p: Array) -> Array:
        return np.stack([case.camera["width"] - p[..., 0], p[..., 1]], -1)

    return _same(case, other, pixels, np.diag([-1.0, 1.0, 1.0]), lambda image: image[:, ::-1])


def turn(case: Case) -> Faults:
    """Check that a camera turned by 90 deg about its axis sees turned labels and normals."""
    other = case.turned

    def pixels(p: Array) -> Array:
        return np.stack([case.camera["height"] - p[..., 1], p[..., 0]], -1)

    return _same(case, other, pixels, TURN, lambda image: np.rot90(image, -1))


def _same(
    case: Case, other: View, pixels: Callable[[Array], Array], turning: Array, image: Callable[[Array], Array]
) -> Faults:
    """Compare labels with those of the same scene seen otherwise; `image` turns an image."""
    size = np.array([case.camera["width"], case.camera["height"]])
    sampled = case.tables["render"]["samples_per_pixel"] > 1
    faults = _same_maps(case, other, turning, image, sampled)
    points: list[HighlightPoint] = list(case.seen.highlights)
    left: list[HighlightPoint] = list(other.seen.highlights)
    for number, each in enumerate(points):
        if (each.bp_px < BORDER_PX).any() or (each.bp_px > size - BORDER_PX).any():
            left = [o for o in left if np.linalg.norm(o.bp_px - pixels(each.bp_px)) > 1e-3]
            continue
        near = [o for o in left if o.light == each.light and np.linalg.norm(o.bp_px - pixels(each.bp_px)) < 1e-3]
        if not near:
            faults.append(f"highlight {number} at {each.bp_px.round(2).tolist()} px is not listed there")
            continue
        left = [o for o in left if o is not near[0]]
        faults += [f"highlight {number}: {text}" for text in _differences(each, near[0], turning, not sampled)]
    there = np.array([other.camera["width"], other.camera["height"]])
    for each in left:
        if (each.bp_px > BORDER_PX).all() and (each.bp_px < there - BORDER_PX).all():
            faults.append(f"a highlight at {each.bp_px.round(2).tolist()} px is listed there alone")
    return faults


def _differences(one: HighlightPoint, other: HighlightPoint, turning: Array, judged: bool) -> Faults:
    """Return how two labels of a highlight differ, of which one is seen turned.

    Verdicts are compared where `judged`.
    """
    faults = []
    if not np.linalg.norm(turning @ one.position - other.position) < 1e-5 * one.distance:
        faults.append("another position")
    for name in ("normal", "normal_base"):
        off = formulas.angle_deg(turning @ getattr(one, name), getattr(other, name))
        if not off < 1e-4:
            faults.append(f"{name} {off:.2g} deg off")
    for name in ("kd_min", "kd_max", "kd_min_base", "kd_max_base"):
        a, b = getattr(one, name), getattr(other, name)
        if not abs(a - b) < 1e-4 * (1 + abs(a)):
            faults.append(f"{name} {a:.6g} and {b:.6g}")
    for name in ("lit", "hidden", "pool"):
        if getattr(one, name) != getattr(other, name):
            faults.append(f"{name} {getattr(one, name)} and {getattr(other, name)}")
    if isinstance(one, TrueHighlight) and isinstance(other, TrueHighlight) and judged:
        faults += _other_verdicts(one, other)
    return faults


def _other_verdicts(one: TrueHighlight, other: TrueHighlight) -> Faults:
    """Return how the verdicts on a highlight differ, of which one is seen turned."""
    faults = []
    if one.why_not != other.why_not:
        faults.append(f"why_not {one.why_not!r} and {other.why_not!r} there")
    if one.isolated and other.isolated:
        if not abs(other.radius_px / one.radius_px - 1) < 1e-3:
            faults.append(f"radius_px {one.radius_px:.4g} and {other.radius_px:.4g}")
        # The noise behind a chain of stages is that of few draws, known to 13 %.
        if math.isfinite(one.peak_snr) and not abs(math.log(other.peak_snr / one.peak_snr)) < 0.4:
            faults.append(f"peak_snr {one.peak_snr:.4g} and {other.peak_snr:.4g}")
    return faults


def _same_maps(case: Case, other: View, turning: Array, image: Callable[[Array], Array], sampled: bool) -> Faults:
    """Compare radiance, depth, normals, curvatures and visible spots of a turned or mirrored picture."""
    faults, here, there = [], case.truth, other.truth
    for name in ("depth", "k_min", "k_max", "k_min_base", "k_max_base"):
        a, b = image(getattr(here, name)), getattr(there, name)
        with np.errstate(invalid="ignore"):
            wrong = ~((np.abs(a - b) <= 1e-5 * (1 + np.abs(a))) | (np.isnan(a) & np.isnan(b)))
        # Rays along a silhouette may meet it or not.
        if np.count_nonzero(wrong) > 1e-3 * wrong.size:
            faults.append(f"truth.{name}: differs at {np.count_nonzero(wrong)} pixels")
    for name in ("normal", "normal_base"):
        a, b = image(getattr(here, name)) @ turning.T, getattr(there, name)
        with np.errstate(invalid="ignore"):
            wrong = ~((formulas.angle_deg(a, b) < 1e-4) | (np.isnan(a).any(-1) & np.isnan(b).any(-1)))
        if np.count_nonzero(wrong) > 1e-3 * wrong.size:
            faults.append(f"truth.{name}: differs at {np.count_nonzero(wrong)} pixels")
    for name in ("specular", "diffuse"):
        a, b = (mean(getattr(each.frame.radiance, name)).astype(float) for each in (case, other))
        a = image(a)
        # Samples, and the points of a source of finite size, do not turn with the picture.
        if sampled:
            a, b = (_blocks(each) for each in (a, b))
        share, limit = (0.95, 0.1) if sampled else (0.999, 0.02 if case.row["light"] == "disc" else 1e-3)
        gap = np.quantile(np.abs(a - b), share) / max(float(a.max()), 1e-12)
        if not gap < limit:
            faults.append(f"radiance.{name}: {gap:.2g} of its maximum off")
    if not sampled:
        spots, others = case.seen.visible_highlights, other.seen.visible_highlights
        if len(spots) != len(others):
            faults.append(f"{len(spots)} visible highlights, {len(others)} there")
            return faults
        areas, theirs = (np.array(sorted(spot.area_px for spot in each)) for each in (spots, others))
        if np.abs(areas - theirs).sum() > 1 + 0.01 * areas.sum():
            faults.append("visible highlights have other areas there")
    return faults


def _blocks(image: Array) -> Array:
    """Return the means of blocks of 8 x 8 pixels; the frame's sides are multiples of it."""
    height, width = image.shape
    return image.reshape(height // 8, 8, width // 8, 8).mean(axis=(1, 3))


def answers(case: Case) -> Faults:
    """Check that the answers from a mirrored picture, and from one turned by 90 deg, are mirrored and turned."""
    known, size = case.calibration, (case.camera["width"], case.camera["height"])
    found = reconstruct(case.picture, known, ESTIMATORS)
    faults = []
    mirroring = np.diag([-1.0, 1.0, 1.0])
    for name, turning, picture, pixel in (
        ("mirrored", mirroring, case.picture[:, ::-1], lambda p: np.array([size[0] - p[0], p[1]])),
        ("turned", TURN, np.rot90(case.picture, -1), lambda p: np.array([size[1] - p[1], p[0]])),
    ):
        lights = tuple(tuple((turning @ light).tolist()) for light in known.priors.lights_mm)
        given = replace(known, camera=_seen(known.camera, turning), priors=replace(known.priors, lights_mm=lights))
        others = reconstruct(np.ascontiguousarray(picture), given, ESTIMATORS)
        if len(others) != len(found):
            faults.append(f"{name}: {len(others)} specularities, {len(found)} as it is")
        peaks = [(o, o.patch.peak_px) for o in others if not isinstance(o.patch, Failure)]
        for spot in found:
            if isinstance(spot.patch, Failure):
                continue
            near = [o for o, peak in peaks if np.linalg.norm(peak - pixel(spot.patch.peak_px)) < 0.3]
            if not near:
                faults.append(f"{name}: none at the peak {spot.patch.peak_px.round(2).tolist()} px")
                continue
            for estimator, one in spot.estimates.items():
                if text := _other_answer(one, near[0].estimates[estimator], turning):
                    faults.append(f"{name}: {estimator} at {spot.patch.peak_px.round(1).tolist()} px: {text}")
    return faults


def _other_answer(one: Estimate | Failure, other: Estimate | Failure, turning: Array) -> str:
    """Return how an answer differs from that of the same picture seen turned; empty where it does not."""
    if isinstance(one, Failure) or isinstance(other, Failure):
        status = [str(each.reason) if isinstance(each, Failure) else "ok" for each in (one, other)]
        return "" if status[0] == status[1] else f"{status[0]} and {status[1]}"
    off = float(formulas.angle_deg(turning @ one.normal, other.normal))
    reported = [
        0.0 if each.covariance is None else math.sqrt(float(np.trace(each.covariance))) for each in (one, other)
    ]
    # A pose without a deviation is near its branch point, where rounding is the root of itself.
    if off > (0.01 if reported[0] else 0.1) + 0.05 * math.degrees(reported[0]):
        return f"{off:.2g} deg off, reported {math.degrees(reported[0]):.2g}"
    if reported[0] and not 0.95 < reported[1] / reported[0] < 1.05:
        return f"reported {math.degrees(reported[0]):.3g} and {math.degrees(reported[1]):.3g} deg"
    return "" if one.flags == other.flags else f"flags {one.flags} and {other.flags}"


def _seen(camera: Camera, turning: Array) -> Camera:
    """Return the camera of a picture that is mirrored or turned by 90 deg."""
    lens = camera.distortion
    if turning[0, 0] < 0:
        lens = replace(lens, p2=-lens.p2) if isinstance(lens, BrownConrady) else lens
        return replace(camera, cx=camera.width - camera.cx, distortion=lens)
    lens = replace(lens, p1=lens.p2, p2=-lens.p1) if isinstance(lens, BrownConrady) else lens
    return Camera(camera.height, camera.width, camera.fy, camera.fx, camera.height - camera.cy, camera.cx, 0.0, lens)
