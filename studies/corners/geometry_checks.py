"""Checks of highlights, surfaces and flow by closed forms."""

import numpy as np

from simtest.runtime.arrays import Array
from studies.corners import formulas
from studies.corners.case import Case, Faults, NotAskedError
from studies.corners.scenes import SMOOTH

AT_SILHOUETTE = 3
"""Pixels at which rounding may decide whether there is a surface."""


def law(case: Case) -> Faults:
    """Check that at each highlight, and at each of the base, the normal bisects the directions to light and camera."""
    faults, lights = [], formulas.lights_mm(case.tables["rig"])
    for name, points in (("highlight", case.seen.highlights), ("cloud", case.seen.clouds)):
        for number, each in enumerate(points):
            normal = each.normal if name == "highlight" else each.normal_base
            off = formulas.angle_deg(normal, formulas.bisectors(each.position, lights[each.light]))
            if not off < 1e-5:
                faults.append(f"{name} {number}: normal {off:.2g} deg off the bisector")
            gaps = abs(np.linalg.norm(normal) - 1), abs(np.linalg.norm(each.position) - each.distance)
            if not max(gaps) < 1e-9:
                faults.append(f"{name} {number}: normal not unit, or distance not that of its position")
    return faults


def projection(case: Case) -> Faults:
    """Check that each highlight's position, and each pixel's, is imaged where it is listed."""
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
    """Check depth, normals and curvatures by the surface's closed form, or by differences of positions."""
    truth, labels = case.truth, case.frame.labels
    off_metal = truth.instrument == 0
    faults = []
    if case.row["surface"] in SMOOTH:
        depth, normal = formulas.cast(case.tables, case.rays)
        known = np.isfinite(depth) & off_metal
        # Rays along a silhouette may meet it or not.
        wrong = np.count_nonzero((np.isfinite(truth.depth) != np.isfinite(depth)) & off_metal)
        if wrong > AT_SILHOUETTE:
            faults.append(f"depth: there is a surface or none, wrongly, at {wrong} pixels")
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
        faults += _highlights_on_surface(case)
    else:
        curvature = truth.k_min_base + truth.k_max_base
        # A mesh's facets are flat, its normals and curvatures interpolated: means over facets are compared.
        means, angle, share = (8 * int(case.row["size"]), 4.0, 0.5) if case.row["surface"] == "mesh" else (1, 0.3, 0.1)
        faults += _by_differences(truth.position, truth.normal_base, curvature, off_metal, means, angle, share)
        gap = np.nanmedian(formulas.angle_deg(labels.normal_base, truth.normal_base)[off_metal])
        if not gap < 0.5:
            faults.append(f"labels.normal_base: {gap:.2g} deg from the truth in the median")
    if case.row["relief"] == "none" and not np.array_equal(truth.normal, truth.normal_base, equal_nan=True):
        faults.append("normal: not that of the base on a surface without relief")
    if case.row["relief"] == "resolved":
        faults += _relief_slopes(case)
    return faults


def _highlights_on_surface(case: Case) -> Faults:
    """Compare each highlight's place, base normal and curvatures with the closed form on its own sightline."""
    points = [*case.seen.highlights, *case.seen.clouds]
    if not points:
        return []
    rays = formulas.sightlines(case.camera, np.array([each.bp_px for each in points]))
    depth, normal = formulas.cast(case.tables, rays)
    curvatures = formulas.curvatures(case.tables, rays * depth[:, None])
    faults = []
    for number, each in enumerate(points):
        if not abs(each.distance / depth[number] - 1) < 1e-7:
            faults.append(f"highlight {number}: at {each.distance:.6g} mm, the surface at {depth[number]:.6g} mm")
        off = formulas.angle_deg(each.normal_base, normal[number])
        kd = np.array([each.kd_min_base, each.kd_max_base])
        if not off < 1e-5 or not np.abs(kd - depth[number] * curvatures[number]).max() < 1e-6:
            faults.append(f"highlight {number}: base normal {off:.2g} deg off, kd {kd.round(5).tolist()}")
    return faults


def _by_differences(
    position: Array, normal: Array, curvature: Array, allowed: Array, means: int, angle: float, share: float
) -> Faults:
    """Compare normals and twice the mean curvature with differences of positions and normals over two pixels."""
    along_x = (position[1:-1, 2:] - position[1:-1, :-2]) / 2
    along_y = (position[2:, 1:-1] - position[:-2, 1:-1]) / 2
    crossed = np.cross(along_x, along_y)
    inner = normal[1:-1, 1:-1]
    crossed = formulas.unit(crossed * np.sign(np.sum(crossed * inner, -1, keepdims=True)))
    with np.errstate(invalid="ignore"):
        off = formulas.angle_deg(*(formulas.unit(_means(each, means)) for each in (crossed, inner)))
    used = np.isfinite(off) & (_means(allowed[1:-1, 1:-1, None].astype(float), means)[..., 0] == 1)
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
    used = np.isfinite(gap) & allowed[1:-1, 1:-1]
    if used.any() and not np.median(gap[used]) < share:
        faults.append(f"curvature: {np.median(gap[used]):.2g} of itself from differences of normals in the median")
    return faults


def _means(image: Array, size: int) -> Array:
    """Return the means of blocks of pixels of an image, shape (H, W, C); what fills no block is left out."""
    height, width = (n // size for n in image.shape[:2])
    return image[: height * size, : width * size].reshape(height, size, width, size, -1).mean(axis=(1, 3))


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
    """Check that the zeros of the misfit on a smooth surface's own rays are the listed highlights."""
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
