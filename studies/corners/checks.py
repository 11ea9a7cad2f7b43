"""The checks: each takes a case and returns its faults, none where the case is right."""

import csv
import json
import math
from collections.abc import Callable, Sequence

import numpy as np
import polars as pl

from simtest.api import reconstruct_picture
from simtest.calibration import Response
from simtest.dataset import calibration_of
from simtest.dataset.maker import colour_variant
from simtest.errors import Failure
from simtest.reconstruction import reconstruct
from simtest.reconstruction.picture import Options
from simtest.rendering import HighlightPoint, Session
from simtest.runtime.arrays import Array
from simtest.simulation.flow import HIDDEN, INSTRUMENT, NONE, OUT, SEEN, SeenSurface, flow_between
from simtest.simulation.true_highlights import TrueHighlight
from simtest.spec.scene import scene_from_dict
from studies.corners import formulas
from studies.corners.case import STORED, Case, NotAskedError, View
from studies.corners.scenes import EMISSION_POWER, SMOOTH, VIGNETTING_POWER

Faults = list[str]

DRAWS = 96
"""Pictures by which the noise is measured: its deviation is then known to 7 %."""

BORDER_PX = 0.5
"""What lies so near to the frame's border may be in view on one side of a symmetry alone."""


def law(case: Case) -> Faults:
    """At each highlight the normal bisects the directions to light and camera; also at the base's."""
    faults, lights = [], formulas.lights_mm(case.tables["rig"])
    for name, points in (("highlight", case.seen.highlights), ("cloud", case.seen.clouds)):
        for number, each in enumerate(points):
            normal = each.normal if name == "highlight" else each.normal_base
            off = formulas.angle_deg(normal, formulas.bisectors(each.position, lights[each.light]))
            if not off < 1e-5:
                faults.append(f"{name} {number}: normal {off:.2g} deg off the bisector")
            if not abs(np.linalg.norm(normal) - 1) < 1e-9 or not abs(np.linalg.norm(each.position) - each.distance) < 1e-9:
                faults.append(f"{name} {number}: normal not unit, or distance not that of its position")
    return faults


def projection(case: Case) -> Faults:
    """Each highlight's position, and each pixel's, is imaged where it is listed."""
    faults = []
    for number, each in enumerate([*case.seen.highlights, *case.seen.clouds]):
        gap = np.linalg.norm(formulas.project(case.camera, each.position) - each.bp_px)
        if not gap < 1e-5:
            faults.append(f"highlight {number}: imaged {gap:.2g} px beside its bp_px")
        if not ((each.bp_px >= 0) & (each.bp_px <= [case.camera["width"], case.camera["height"]])).all():
            faults.append(f"highlight {number}: bp_px {each.bp_px} outside the frame")
    truth = case.truth
    gaps = truth.position - case.rays * truth.depth[..., None]
    if not np.nanmax(np.abs(gaps)) < 1e-7:
        faults.append(f"truth.position: up to {np.nanmax(np.abs(gaps)):.2g} mm off the pixels' sightlines")
    if (np.isfinite(truth.depth) != truth.mask).any():
        faults.append("truth.mask: not where depth is finite")
    labels = case.frame.labels
    gap = np.nanmax(np.abs(labels.position - case.rays * labels.depth[..., None]) / labels.depth[..., None])
    if not gap < 1e-5:
        faults.append(f"labels.position: up to {gap:.2g} of the distance off the pixels' sightlines")
    return faults


def surface(case: Case) -> Faults:
    """Depth, normals and curvatures are those of the surface: by its closed form, or by differences of positions."""
    truth, labels = case.truth, case.frame.labels
    off_metal = truth.instrument == 0
    faults = []
    if case.row["surface"] in SMOOTH:
        depth, normal = formulas.cast(case.tables, case.rays)
        known = np.isfinite(depth) & off_metal
        if (np.isfinite(truth.depth)[off_metal] != np.isfinite(depth)[off_metal]).any():
            wrong = (np.isfinite(truth.depth) != np.isfinite(depth)) & off_metal
            faults.append(f"depth: there is a surface or none, wrongly, at {np.count_nonzero(wrong)} pixels")
        for name, found, limit in (("truth", truth, 1e-6), ("labels", labels, 2e-3)):
            gap = np.nanmax(np.abs(found.depth - depth)[known] / depth[known])
            angle = np.nanmax(formulas.angle_deg(found.normal_base, normal)[known])
            if not gap < limit:
                faults.append(f"{name}.depth: up to {gap:.2g} of the distance off")
            if not angle < (1e-5 if name == "truth" else 0.3):
                faults.append(f"{name}.normal_base: up to {angle:.2g} deg off")
        expected = formulas.curvatures(case.tables, truth.position)
        for k, name in enumerate(("k_min_base", "k_max_base")):
            gap = np.nanmax(np.abs(getattr(truth, name) - expected[..., k])[known])
            if not gap < 1e-6:
                faults.append(f"truth.{name}: up to {gap:.2g} per mm off")
    else:
        # A mesh's facets are flat, its normals and curvatures interpolated.
        angle, share = (4.0, 0.5) if case.row["surface"] == "mesh" else (0.3, 0.1)
        curvature = truth.k_min_base + truth.k_max_base
        faults += _by_differences(truth.position, truth.normal_base, curvature, off_metal, angle, share)
        gap = np.nanmedian(formulas.angle_deg(labels.normal_base, truth.normal_base)[off_metal])
        if not gap < 0.5:
            faults.append(f"labels.normal_base: {gap:.2g} deg from the truth in the median")
    if case.row["relief"] == "none" and not np.array_equal(truth.normal, truth.normal_base, equal_nan=True):
        faults.append("normal: not that of the base on a surface without relief")
    if case.row["relief"] == "resolved":
        faults += _relief_slopes(case)
    return faults


def _by_differences(
    position: Array, normal: Array, curvature: Array, allowed: Array, angle: float, share: float
) -> Faults:
    """Compare normals and twice the mean curvature with differences of positions and normals over two pixels."""
    along_x = (position[1:-1, 2:] - position[1:-1, :-2]) / 2
    along_y = (position[2:, 1:-1] - position[:-2, 1:-1]) / 2
    crossed = np.cross(along_x, along_y)
    inner = normal[1:-1, 1:-1]
    crossed = crossed * np.sign(np.sum(crossed * inner, -1, keepdims=True))
    with np.errstate(invalid="ignore"):
        off = formulas.angle_deg(formulas.unit(crossed), inner)
    used = np.isfinite(off) & allowed[1:-1, 1:-1]
    faults = []
    if used.any() and not np.median(off[used]) < angle:
        faults.append(f"normal_base: {np.median(off[used]):.2g} deg from differences of positions in the median")
    # dN = S dP, whose trace is the sum of the curvatures: convex towards the camera positive.
    turn_x = (normal[1:-1, 2:] - normal[1:-1, :-2]) / 2
    turn_y = (normal[2:, 1:-1] - normal[:-2, 1:-1]) / 2
    E, F, G = (np.sum(a * b, -1) for a, b in ((along_x, along_x), (along_x, along_y), (along_y, along_y)))
    e, f, g = np.sum(turn_x * along_x, -1), np.sum(turn_x * along_y, -1), np.sum(turn_y * along_y, -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = (e * G - 2 * f * F + g * E) / (E * G - F * F)
        gap = np.abs(total - curvature[1:-1, 1:-1]) / (np.abs(curvature[1:-1, 1:-1]) + 0.01)
    used &= np.isfinite(gap)
    if used.any() and not np.median(gap[used]) < share:
        faults.append(f"curvature: {np.median(gap[used]):.2g} of itself from differences of normals in the median")
    return faults


def _relief_slopes(case: Case) -> Faults:
    """Compare the fine normals' slopes against the base with the relief's stated deviation."""
    truth = case.truth
    used = (truth.instrument == 0) & np.isfinite(truth.depth)
    base, fine = truth.normal_base[used], truth.normal[used]
    cosine = np.sum(base * fine, -1, keepdims=True)
    slopes = fine / cosine - base
    deviation = np.degrees(np.sqrt(np.mean(np.sum(slopes**2, -1)) / 2))
    stated = case.tables["surface"]["relief"]["bands"][0]["slope_deg"]
    return [] if 0.7 < deviation / stated < 1.3 else [f"relief: slopes of {deviation:.2g} deg, {stated:g} given"]


def search(case: Case) -> Faults:
    """Each zero of the misfit on a smooth surface's own rays is a listed highlight."""
    if case.row["surface"] not in SMOOTH or case.row["relief"] != "none":
        raise NotAskedError("rays of closed form on smooth surfaces alone")
    width, height = case.camera["width"], case.camera["height"]
    corners = np.stack(np.meshgrid(np.arange(0, width + 0.01, 0.5), np.arange(0, height + 0.01, 0.5)), -1)
    rays = formulas.sightlines(case.camera, corners)
    depth, normal = formulas.cast(case.tables, rays)
    faults = []
    for light, place in enumerate(formulas.lights_mm(case.tables["rig"])):
        bisector = formulas.bisectors(rays * depth[..., None], place)
        misfit = normal - bisector
        # Two components across the middle sightline: misfits are small where they count.
        w = misfit[..., :2]
        low = np.minimum.reduce([w[:-1, :-1], w[1:, :-1], w[:-1, 1:], w[1:, 1:]])
        high = np.maximum.reduce([w[:-1, :-1], w[1:, :-1], w[:-1, 1:], w[1:, 1:]])
        with np.errstate(invalid="ignore"):
            rows, columns = np.nonzero(((low <= 0) & (high >= 0)).all(-1))
        listed = np.array([each.bp_px for each in case.seen.highlights if each.light == light]).reshape(-1, 2)
        for row, column in zip(rows, columns, strict=True):
            zero = _zero_in(w[row : row + 2, column : column + 2], corners[row, column])
            if zero is not None and not (np.linalg.norm(listed - zero, axis=1) < 0.3).any():
                faults.append(f"light {light}: no highlight listed at {zero.round(2).tolist()} px")
        for point in listed:
            cells = np.stack([columns, rows], -1) / 2 + 0.25
            if not (np.abs(cells - point).max(-1) < 1.0).any():
                faults.append(f"light {light}: highlight at {point.round(2).tolist()} px is no zero of the misfit")
    return faults


def _zero_in(w: Array, corner: Array) -> Array | None:
    """Return the zero of a misfit, linear over half a pixel with values at four corners; None where it lies outside."""
    across, down = ((w[:, 1] - w[:, 0]).mean(0), (w[1] - w[0]).mean(0))
    step = np.linalg.solve(np.stack([across, down], -1), -w.mean((0, 1)))
    return corner + 0.25 + 0.5 * step if (np.abs(step) <= 0.55).all() else None


def mirror(case: Case) -> Faults:
    """A mirrored scene has mirrored labels."""
    other = case.mirrored

    def pixels(p: Array) -> Array:
        return np.stack([case.camera["width"] - p[..., 0], p[..., 1]], -1)

    return _same(case, other, pixels, np.diag([-1.0, 1.0, 1.0]), lambda image: image[:, ::-1])


def turn(case: Case) -> Faults:
    """A camera turned by 90 deg about its axis sees the same scene with turned labels and normals."""
    other = case.turned

    def pixels(p: Array) -> Array:
        return np.stack([case.camera["height"] - p[..., 1], p[..., 0]], -1)

    turning = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return _same(case, other, pixels, turning, lambda image: np.rot90(image, -1))


def double(case: Case) -> Faults:
    """Twice as many pixels along each side show the same highlights."""
    return _same(case, case.finer, lambda p: 2 * p, np.eye(3), None)


def _same(
    case: Case, other: View, pixels: Callable[[Array], Array], turning: Array, image: Callable[[Array], Array] | None
) -> Faults:
    """Compare labels with those of the same scene seen otherwise; `image` turns an image, None where sizes differ."""
    faults = []
    size = np.array([case.camera["width"], case.camera["height"]])
    if image is not None:
        sampled = case.tables["render"]["samples_per_pixel"] > 1
        faults += _same_maps(case, other, turning, image, sampled)
    scale = 1.0 if image is not None else 2.0
    points, left = case.seen.highlights, list(other.seen.highlights)
    if image is None and case.row["relief"] != "none":
        # Finer pixels resolve more of a relief: the base's highlights stay.
        points, left = list(case.seen.clouds), list(other.seen.clouds)
    for number, each in enumerate(points):
        if (each.bp_px < BORDER_PX).any() or (each.bp_px > size - BORDER_PX).any():
            left = [o for o in left if np.linalg.norm(o.bp_px - pixels(each.bp_px)) > 1e-3 * scale]
            continue
        near = [o for o in left if o.light == each.light and np.linalg.norm(o.bp_px - pixels(each.bp_px)) < 1e-3]
        if not near:
            faults.append(f"highlight {number} at {each.bp_px.round(2).tolist()} px is not listed there")
            continue
        left = [o for o in left if o is not near[0]]
        faults += [f"highlight {number}: {text}" for text in _differences(each, near[0], turning, scale)]
    there = np.array([other.camera["width"], other.camera["height"]])
    for each in left:
        if (each.bp_px > BORDER_PX * scale).all() and (each.bp_px < there - BORDER_PX * scale).all():
            faults.append(f"a highlight at {each.bp_px.round(2).tolist()} px is listed there alone")
    return faults


def _differences(one: HighlightPoint, other: HighlightPoint, turning: Array, scale: float) -> Faults:
    """Return how two labels of a highlight differ, of which one is seen turned and in finer pixels."""
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
    if not isinstance(one, TrueHighlight):
        return faults
    if one.why_not != other.why_not:
        faults.append(f"why_not {one.why_not!r} and {other.why_not!r} there")
    if one.isolated and other.isolated:
        if not abs(other.radius_px / one.radius_px / scale - 1) < 1e-3:
            faults.append(f"radius_px {one.radius_px:.4g} and {other.radius_px:.4g}")
        if math.isfinite(one.peak_snr) and not abs(other.peak_snr / one.peak_snr - 1) < (0.02 if scale == 1 else 0.15):
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
        a, b = image(getattr(case.frame.radiance, name)), getattr(other.frame.radiance, name)
        # Samples, and the points of a source of finite size, do not turn with the picture.
        if sampled:
            a, b = (_blocks(each) for each in (a, b))
        limit = 0.1 if sampled else 0.02 if case.row["light"] == "disc" else 1e-3
        gap = np.quantile(np.abs(a - b), 0.999) / max(float(a.max()), 1e-12)
        if not gap < limit:
            faults.append(f"radiance.{name}: {gap:.2g} of its maximum off")
    if not sampled:
        spots, others = case.seen.visible_highlights, other.seen.visible_highlights
        if len(spots) != len(others):
            faults.append(f"{len(spots)} visible highlights, {len(others)} there")
        areas = [sorted(spot.area_px for spot in each) for each in (spots, others)]
        if len(spots) == len(others) and sum(abs(a - b) for a, b in zip(*areas, strict=True)) > 1 + 0.01 * sum(areas[0]):
            faults.append("visible highlights have other areas there")
    return faults


def _blocks(image: Array) -> Array:
    """Return the means of blocks of 8 x 8 pixels; the frame's sides are multiples of it."""
    height, width = image.shape
    return image.reshape(height // 8, 8, width // 8, 8).mean(axis=(1, 3))


def isolated(case: Case) -> Faults:
    """What is isolated is lit and no streak; a clear highlight of a smooth surface that stands alone is isolated."""
    faults, specular = [], case.specular
    size = np.array([case.camera["width"], case.camera["height"]])
    metal = case.frame.labels.instrument > 0
    for number, each in enumerate(case.seen.highlights):
        column, row = np.minimum(each.bp_px.astype(int), size - 1)
        gain = min(abs(1 + each.kd_min), abs(1 + each.kd_max))
        if each.isolated and not (each.lit and gain > 0.25 and each.peak_snr >= 10):
            faults.append(f"highlight {number}: isolated, but lit {each.lit}, gain {gain:.2g}, SNR {each.peak_snr:.3g}")
        if case.row["relief"] != "none" or not each.lit or gain < 0.35:
            continue
        start = formulas.climbed(specular, (int(row), int(column)))
        region = formulas.at_half_height(specular, start)
        rows, columns = np.nonzero(region)
        # Room for the smoothing of detectors on all sides.
        room = 5
        closed = rows.min() >= room and columns.min() >= room
        closed &= rows.max() < size[1] - room and columns.max() < size[0] - room
        radius = math.sqrt(len(rows) / math.pi)
        reach = 3 * radius + 8
        alone = all(
            np.linalg.norm(o.bp_px - each.bp_px) > reach for o in case.seen.highlights if o is not each
        ) and not _within(metal, each.bp_px, reach)
        share = specular[start] / max(float(case.light[start]), 1e-30)
        bright = specular[start] > 0.3 * specular.max()
        if closed and alone and bright and share > 0.5 and radius > 2 and not each.isolated:
            faults.append(f"highlight {number} of {radius:.2g} px radius stands alone, but: {each.why_not}")
    return faults


def _within(mask: Array, point: Array, reach: float) -> bool:
    """Return whether any pixel of a mask lies so near to a point, px."""
    rows, columns = np.nonzero(mask)
    return bool((np.hypot(columns + 0.5 - point[0], rows + 0.5 - point[1]) < reach).any())


def radius(case: Case) -> Faults:
    """The radius of an isolated highlight is that of the rendered lobe at half height."""
    specular = case.frame.radiance.specular.astype(float)
    points = [h for h in case.seen.highlights if h.isolated]
    if case.row["relief"] == "not_resolved":
        raise NotAskedError("the lobe of a relief below a pixel has no closed form")
    ratios = []
    for each in points:
        column, row = (int(v) for v in each.bp_px)
        start = formulas.climbed(specular, (min(row, specular.shape[0] - 1), min(column, specular.shape[1] - 1)))
        region = formulas.at_half_height(specular, start)
        rows, columns = np.nonzero(region)
        edge = min(rows.min(), columns.min(), specular.shape[0] - 1 - rows.max(), specular.shape[1] - 1 - columns.max())
        if edge > 0 and len(rows) > 30:
            ratios.append(each.radius_px / math.sqrt(len(rows) / math.pi))
    # Single glints are no circles.
    least = 1 if case.row["relief"] == "none" else 5
    if len(ratios) < least:
        raise NotAskedError(f"fewer than {least} isolated highlights of more than 30 px in the frame's interior")
    ratio, room = float(np.median(ratios)), 1.12 if case.row["relief"] == "none" else 1.35
    return [] if 1 / room < ratio < room else [f"radius_px: {ratio:.3g} of the rendered one in the median of {len(ratios)}"]


def snr(case: Case) -> Faults:
    """The noise behind `peak_snr` is that of pictures drawn again."""
    if case.row["sensor"] == "ideal":
        raise NotAskedError("no noise")
    spots = [s for s in case.seen.visible_highlights if s.instrument is None][:8]
    response = Response("srgb") if case.row["sensor"] == "processed" else Response()
    drawn = []
    places = [(int(s.peak_px[1]), int(s.peak_px[0])) for s in spots]
    if not places:
        raise NotAskedError("no visible highlight")
    for seed in range(DRAWS):
        linear = response.decode(case.seen.frame(seed))
        linear = linear if linear.ndim == 2 else linear.mean(axis=2)
        drawn.append([linear[place] for place in places])
    values = np.array(drawn)
    ratios = []
    for spot, of_spot in zip(spots, values.T, strict=True):
        if np.quantile(of_spot, 0.95) < 0.97 and math.isfinite(spot.peak_snr):
            sigma = spot.specular / spot.peak_snr / case.seen.full_scale
            ratios.append(float(of_spot.std(ddof=1)) / sigma)
    if not ratios:
        raise NotAskedError("all visible highlights are clipped")
    ratio = float(np.median(ratios))
    return [] if 0.75 < ratio < 1.33 else [f"peak_snr: the noise is {ratio:.3g} times that behind it"]


def flow(case: Case) -> Faults:
    """Flow and states follow from depths and poses of the two frames."""
    other, faults = case.further, []
    session, step = case.session, np.linalg.inv(formulas.moved_pose(case.camera)) @ formulas.moved_pose(other.camera)
    here = case.truth
    session.update(case.scene)
    first = SeenSurface.of(session)
    session.update(other.scene)
    try:
        second, there = SeenSurface.of(session), session.truth()
        found = flow_between(session, first, second)
    finally:
        session.update(case.scene)
    gap = np.abs(first.world_from_camera @ step - second.world_from_camera).max()
    if not gap < 1e-7:
        faults.append(f"world_from_camera: {gap:.2g} off the stated motion")
    points = (here.position - step[:3, 3]) @ step[:3, :3]
    target = formulas.project(other.camera, points)
    expected = target - formulas.pixel_centres(case.camera)
    metal = here.instrument > 0
    known = np.isfinite(here.depth) & ~metal
    gaps = np.linalg.norm(found.flow_px - expected, axis=-1)[known & (found.state != NONE)]
    if len(gaps) and not np.nanquantile(gaps, 0.999) < 0.02:
        faults.append(f"flow: {np.nanquantile(gaps, 0.999):.2g} px off for 0.1 % of the pixels")
    # States.
    height, width = there.depth.shape
    if (found.state[metal] != INSTRUMENT).any():
        faults.append("state: pixels of an instrument are not marked")
    behind = points[..., 2] <= 0 if "kannala" not in str(case.camera.get("distortion")) else np.zeros_like(known)
    inside = known & ~behind & (target > 0.05).all(-1) & (target < [width - 0.05, height - 0.05]).all(-1)
    outside = known & (behind | (target < -0.05).any(-1) | (target > [width + 0.05, height + 0.05]).any(-1))
    if (found.state[outside] != OUT).any():
        faults.append(f"state: {np.count_nonzero(found.state[outside] != OUT)} points out of view are not marked so")
    column, row = (np.clip(np.nan_to_num(target[..., k]).astype(int), 0, n - 1) for k, n in ((0, width), (1, height)))
    covered = inside & (there.instrument[row, column] > 0)
    if (found.state[covered] == SEEN).any():
        faults.append(f"state: {np.count_nonzero(found.state[covered] == SEEN)} points behind an instrument count as seen")
    near, far = _around(there.depth)
    distance = np.linalg.norm(points, axis=-1)
    with np.errstate(invalid="ignore"):
        clear = inside & ~covered & (distance < near[row, column] * 1.001 + 1e-6) & (there.instrument[row, column] == 0)
        shadowed = inside & ~covered & (distance > far[row, column] * 1.02)
    for mask, state, text in ((clear, SEEN, "in plain view"), (shadowed, HIDDEN, "behind the surface")):
        wrong = np.count_nonzero(mask & (found.state != state))
        if wrong > 2 + 0.002 * np.count_nonzero(mask):
            faults.append(f"state: {wrong} of {np.count_nonzero(mask)} points {text} are not marked so")
    return faults


def _around(depth: Array) -> tuple[Array, Array]:
    """Return the least and the largest distance of each pixel and those around it; NaN where any has none."""
    padded = np.pad(depth, 1, constant_values=np.nan)
    height, width = depth.shape
    shifted = np.stack([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])
    return shifted.min(axis=0), shifted.max(axis=0)


def stored(case: Case) -> Faults:
    """Answers in a dataset are those of the stored picture with `calibration_of`."""
    sample = case.sample
    meta = sample["meta"]
    kept = [e for e in meta["estimates"] if e.get("status") == "ok" and "normal_x" in e]
    again = reconstruct(sample["image"], calibration_of(meta), list(STORED), detector="peaks", smoothing_px=2.0)
    made = [
        (name, result)
        for spot in again
        for name, result in spot.estimates.items()
        if not isinstance(result, Failure)
    ]
    faults = []
    if len(meta["detections"]) != len(again):
        faults.append(f"{len(meta['detections'])} detections stored, {len(again)} in the stored picture")
    if len(kept) != len(made):
        faults.append(f"{len(kept)} answers stored, {len(made)} from the stored picture")
    worst, spread = 0.0, 0.0
    for entry in kept:
        normal = np.array([entry[f"normal_{axis}"] for axis in "xyz"])
        look = np.array([entry["look_x_px"], entry["look_y_px"]])
        near = [r for name, r in made if name == entry["estimator"] and np.linalg.norm(r.look_px - look) < 2]
        if near:
            worst = max(worst, float(min(formulas.angle_deg(normal, r.normal) for r in near)))
            if near[0].covariance is not None and "cov_11" in entry:
                ratio = (entry["cov_11"] + entry["cov_22"]) / float(np.trace(near[0].covariance))
                spread = max(spread, abs(math.log(ratio)) / 2)
    if worst > 0.01:
        faults.append(f"a stored normal is {worst:.2g} deg from that of the stored picture")
    if spread > 0.02:
        faults.append(f"a stored +- is {math.exp(spread):.3g} times that of the stored picture, or its inverse")
    return faults


def labels(case: Case) -> Faults:
    """A sample's `instance` and `visible` are the pixels above half of the lobe's peak, unsmoothed and behind the lens."""
    sample = case.sample
    meta, faults = sample["meta"], []
    specular = _lobe_of_sample(case)
    instance, metal = sample["instance"].astype(int), sample["instrument"] > 0
    nulls, poor = 0, []
    for number, each in enumerate(meta["highlights"]):
        own = instance == number + 1
        if not each["isolated"]:
            if own.any():
                faults.append(f"instance {number + 1}: of a highlight that is not isolated")
            continue
        column, row = (min(int(v), n - 1) for v, n in zip(each["bp_px"], specular.shape[::-1], strict=True))
        region = formulas.at_half_height(specular, formulas.climbed(specular, (row, column)))
        size, kept = int(region.sum()), int(own.sum())
        nulls += not kept
        if kept and size >= 20:
            overlap = np.count_nonzero(own & region) / np.count_nonzero(own | region)
            poor += [f"instance {number + 1}: IoU {overlap:.2f} of {kept} with {size} px"] if overlap < 0.9 else []
        elif kept and abs(kept - size) > 1:
            poor.append(f"instance {number + 1}: {kept} px where {size} are above half height")
    if nulls:
        faults.append(f"instance: {nulls} isolated highlights have no pixel")
    faults += poor
    if (instance[metal] > 0).any():
        faults.append("instance: on an instrument")
    # Each visible spot is connected, holds its peak, and no pixel below half of it.
    regions = sample["visible"]
    for number, spot in enumerate(meta["visible_highlights"]):
        own = regions == number + 1
        column, row = (int(v) for v in spot["peak_px"])
        if spot["area_px"] != np.count_nonzero(own) or not own[row, column]:
            faults.append(f"visible {number + 1}: area_px {spot['area_px']} for {np.count_nonzero(own)} px")
            continue
        around = formulas.at_half_height(specular, (row, column))
        if np.count_nonzero(own & ~around) > 1 + 0.01 * spot["area_px"]:
            faults.append(f"visible {number + 1}: {np.count_nonzero(own & ~around)} px are not above half of its peak")
        rows, columns = np.nonzero(own)
        weight = specular[rows, columns]
        centroid = np.array([weight @ (columns + 0.5), weight @ (rows + 0.5)]) / weight.sum()
        if not np.linalg.norm(centroid - spot["centroid_px"]) < 0.02:
            faults.append(f"visible {number + 1}: centroid_px {np.round(spot['centroid_px'], 2)} for {centroid.round(2)}")
    return faults


def _lobe_of_sample(case: Case) -> Array:
    """Return the lobe's light behind the lens, rendered again as the sample was: in colour, with its seeds."""
    session = Session(scene_from_dict(case.sample["meta"]["scene"]), colour_variant(), labelled=True)
    radiance = session.frame().radiance.specular
    return np.asarray((radiance if radiance.ndim == 2 else radiance.mean(axis=2)).astype(float) * case.falloff)


def depth(case: Case) -> Faults:
    """A sample's depth, normals and masks are those of the surface, within what their encoding loses."""
    sample, truth = case.sample, case.truth
    faults = []
    step = sample["meta"]["depth_scale_mm"]
    off = truth.instrument == 0
    with np.errstate(invalid="ignore"):
        gap = np.abs(sample["depth"] - truth.depth) - step
        angle = formulas.angle_deg(formulas.unit(sample["normal_base"].astype(float)), truth.normal_base)
    smooth = case.row["surface"] in SMOOTH
    if not np.nanmedian((gap / truth.depth)[off]) < 1e-3 or (smooth and not np.nanmax((gap / truth.depth)[off]) < 5e-3):
        faults.append(f"depth: {np.nanmedian(gap[off]):.2g} mm off in the median, {np.nanmax(gap[off]):.2g} at most")
    if not np.nanmedian(angle[off]) < (0.03 if smooth else 0.5):
        faults.append(f"normal_base: {np.nanmedian(angle[off]):.2g} deg off in the median")
    if np.count_nonzero((sample["instrument"] > 0) != (truth.instrument > 0)) > 0:
        faults.append("instrument: not where the truth has it")
    if smooth:
        # Normals by differences of the stored depth, on rays of the checks' formulas.
        points = case.rays * sample["depth"][..., None].astype(float)
        crossed = formulas.unit(np.cross(points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]))
        inner, allowed = truth.normal_base[1:-1, 1:-1], _shrunk(off)[1:-1, 1:-1]
        with np.errstate(invalid="ignore"):
            off_deg = formulas.angle_deg(crossed * np.sign(np.sum(crossed * inner, -1, keepdims=True)), inner)[allowed]
        if not np.nanmedian(off_deg) < 0.3:
            faults.append(f"depth: normals by differences of it are {np.nanmedian(off_deg):.2g} deg off in the median")
    return faults


def _shrunk(mask: Array) -> Array:
    """Return where a mask holds for a pixel and all around it."""
    padded = np.pad(mask, 1, constant_values=True)
    height, width = mask.shape
    return np.logical_and.reduce([padded[i : i + height, j : j + width] for i in range(3) for j in range(3)])


def calibration(case: Case) -> Faults:
    """The calibration file beside a rendered picture, read back, says what the scene says."""
    from simtest.simulation.frame_files import write_frame
    from simtest.simulation.labelled_frame import make_frame
    from simtest.spec import load_calibration

    write_frame(make_frame(case.scene), case.folder / "frame")
    read, given = load_calibration(case.folder / "frame" / "calibration.toml"), case.seen.calibration
    faults, sensor, row = [], case.tables["sensor"], case.row
    camera, tables = read.camera, case.camera
    pixels = formulas.pixel_centres(tables)[::7, ::7].reshape(-1, 2)
    rays = formulas.sightlines(tables, pixels)
    if not np.abs(camera.unproject(pixels) - rays).max() < 1e-9 or not np.abs(camera.project(rays) - pixels).max() < 1e-6:
        faults.append("camera: its sightlines are not those of the scene")
    if (camera.width, camera.height) != (tables["width"], tables["height"]):
        faults.append("camera: another size")
    # Response and bits are those of the picture that is written.
    encodes = "bits" in sensor or "response" in sensor
    kind = "srgb" if "response" in sensor or not encodes else "linear"
    if (read.response is None or read.response.kind) != kind:
        faults.append(f"response: {read.response}, written as {kind}")
    if read.noise.bits != (sensor.get("bits") if encodes else 8):
        faults.append(f"sensor.bits: {read.noise.bits}")
    if (read.noise.full_well, read.noise.read_noise) != (sensor.get("full_well"), sensor.get("read_noise", 0.0)):
        faults.append(f"sensor: {read.noise}")
    clips = sensor["saturation"] or encodes or "mosaic" in sensor
    if read.saturation_level != 1.0 and (clips or not encodes):
        faults.append(f"sensor.saturation_level: {read.saturation_level}")
    # Falloff, of lens and light.
    angles = np.radians(np.linspace(0, 60, 13))
    for name, power in (
        ("vignetting", VIGNETTING_POWER if row["vignetting"] == "known" else 0.0),
        ("emission", EMISSION_POWER if row["emission"] == "known" and row["light"] in ("at_camera", "disc") else 0.0),
    ):
        profile = getattr(read, name).at(np.cos(angles), np.sin(angles))
        if not np.abs(profile - np.cos(angles) ** power).max() < 1e-9:
            faults.append(f"{name}: not cos^{power:g} of the angle")
    lights = np.array(read.priors.lights_mm).reshape(-1, 3)
    expected = formulas.lights_mm(case.tables["rig"]) if row["light"] != "beside_not_given" else np.zeros((0, 3))
    if lights.shape != expected.shape or (lights.size and not np.abs(lights - expected).max() < 1e-9):
        faults.append(f"rig.lights_mm: {lights.tolist()}, rendered {expected.tolist()}")
    lobe = read.priors.lobe_curvature
    if (None if lobe is None else lobe.mean) != (600.0 if row["reflectance"] == "phong" else None):
        faults.append(f"surface: lobe curvature {lobe}")
    # A falloff that is in the frame and not given stays a prior.
    left = row["vignetting"] == "not_known" or row["emission"] == "not_known"
    left |= row["emission"] == "known" and row["light"] not in ("at_camera", "disc")
    for name, priors in (("given", given.priors), ("read back", read.priors)):
        if left and priors.falloff_power is None:
            faults.append(f"falloff: one that is in the frame is not given, and {name} it has no prior")
    if read.priors != given.priors:
        faults.append(f"priors: {read.priors} read back, {given.priors} given")
    return faults


def counts(case: Case) -> Faults:
    """Highlights, detections and answers are as many in JSON, CSV, NPZ and the page, and in a dataset's tables."""
    faults, folder = [], case.folder / "frame"
    if not (folder / "frame.png").is_file():
        calibration(case)
    record, _ = reconstruct_picture(folder / "frame.png", case.folder / "normals", Options(folder / "calibration.toml"))
    found = json.loads((case.folder / "normals" / "normals.json").read_text())["specularities"]
    with (case.folder / "normals" / "normals.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    page = (case.folder / "normals" / "index.html").read_text()
    shown = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])["spots"]
    arrays = np.load(case.folder / "normals" / "constraints.npz")
    answers = {(s["id"], name) for s in found for name, e in s["estimates"].items() if e["status"] == "ok"}
    others = {
        "Python": {(s.id, name) for s in record.specularities for name in s.normals},
        "normals.csv": {(int(r["specularity"]), r["estimator"]) for r in lines if r["status"] == "ok"},
        "the page": {(s["id"], r["name"]) for s in shown for r in s["rows"] if r["status"] == "ok"},
    }
    faults += [f"answers: {len(answers)} in normals.json, {len(o)} in {n}" for n, o in others.items() if o != answers]
    for entry in lines:
        if entry["status"] == "ok" and entry["candidate"] == "0":
            kept = found[int(entry["specularity"])]["estimates"][entry["estimator"]]["normal"]
            if [float(entry[f"normal_{axis}"]) for axis in "xyz"] != kept:
                faults.append(f"normals.csv: another normal of {entry['specularity']} {entry['estimator']}")
    best = [s for s in found if s["best"] is not None and s["sightline"] is not None]
    if arrays["id"].tolist() != [s["id"] for s in best]:
        faults.append(f"constraints.npz: {len(arrays['id'])} for {len(best)} best normals")
    # The dataset's tables.
    meta = case.sample["meta"]
    index, highlights, estimates = (
        pl.read_parquet(case.dataset / f"{name}.parquet") for name in ("index", "highlights", "estimates")
    )
    isolated = [h["isolated"] for h in meta["highlights"]]
    stated = (len(isolated), sum(isolated), len(meta["detections"]))
    tabled = tuple(index.row(0, named=True)[f"n_{name}"] for name in ("highlights", "isolated", "detections"))
    if tabled != stated:
        faults.append(f"index.parquet: {tabled} for {stated} highlights, isolated ones, detections")
    if highlights["isolated"].to_list() != isolated:
        faults.append("highlights.parquet: not the sample's highlights")
    if len(estimates) != len(meta["estimates"]) or estimates["status"].to_list() != [
        e["status"] for e in meta["estimates"]
    ]:
        faults.append("estimates.parquet: not the sample's estimates")
    # Each detection is answered, false or on metal; each isolated highlight is found or missed.
    one = estimates.filter(pl.col("estimator") == STORED[0]) if len(estimates) else estimates
    missed = sum(e["status"] == "missed" and e["estimator"] == STORED[0] for e in meta["estimates"])
    matched = one.filter(pl.col("true_id").is_not_null() & pl.col("specularity").is_not_null())["true_id"].n_unique()
    detected = one["specularity"].drop_nulls().n_unique() if len(one) else 0
    if detected != len(meta["detections"]):
        faults.append(f"estimates: of {detected} specularities, {len(meta['detections'])} detected")
    if matched + missed != sum(isolated):
        faults.append(f"estimates: {matched} found and {missed} missed of {sum(isolated)} isolated highlights")
    # A rendered frame's JSON.
    described = json.loads((folder / "frame.json").read_text())
    if len(described["highlights"]) != len(case.seen.highlights):
        faults.append(f"frame.json: {len(described['highlights'])} of {len(case.seen.highlights)} highlights")
    if len(described["visible_highlights"]) != len(case.seen.visible_highlights):
        faults.append("frame.json: another number of visible highlights")
    return faults


CHECKS: dict[str, Callable[[Case], Faults]] = {
    each.__name__: each
    for each in (
        law, projection, surface, search, mirror, turn, double, isolated, labels, depth, radius, snr, flow,
        calibration, stored, counts,
    )
}


def first_line(text: str) -> str:
    """Return the first line of a text."""
    return next(iter(text.splitlines()), "")


def run(check: str, case: Case) -> tuple[str, Sequence[str]]:
    """Run a check on a case; return its verdict (green, refused, not asked, red) and the reasons."""
    from simtest.errors import SimtestError

    try:
        faults = CHECKS[check](case)
    except NotAskedError as reason:
        return "not asked", [str(reason)]
    except SimtestError as error:
        return "refused", [first_line(str(error))]
    except Exception as error:  # noqa: BLE001 - a check that fails is one red line, and the run goes on
        return "red", [f"{type(error).__name__}: {first_line(str(error))}"]
    return ("red" if faults else "green"), faults
