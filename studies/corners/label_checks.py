"""Checks of labels against the image: which highlights count, their pixels, size and noise, and the stored maps."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import ndimage

from simtest.rendering import HighlightPoint, Session
from simtest.rendering.backend import colour_variant
from simtest.rendering.rays import Sightlines
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.spec.scene import scene_from_dict
from studies.corners import formulas
from studies.corners.case import Case, Faults, mean

MOST_CUT = 0.1
"""Share of an isolated highlight's border that an instrument may make."""

DIVISION = 100
"""Rays along a pixel's side."""


def peak_of(session: Session, point_px: Array) -> float:
    """Render a pixel's area around a point with many rays, and return the lobe's brightest."""
    camera, corner, size = session.camera, point_px - 0.5, DIVISION
    x, y = (camera.cx - corner[0]) * DIVISION, (camera.cy - corner[1]) * DIVISION
    close = replace(
        camera, fx=camera.fx * DIVISION, fy=camera.fy * DIVISION, cx=x, cy=y, width=size, height=size, view_mask=None
    )
    sightlines = Sightlines(close, session.surface.model_from_camera)
    parts, _ = session._tracer(sightlines).centres(None, True, None)
    # Of an instrument in front, too.
    channels = len(parts) // (2 if session.scene.instruments else 1) // 2
    return float(np.mean(parts[:channels], axis=0).max())


def isolated(case: Case) -> Faults:
    """Check that what is isolated is lit and no streak, and that what stands alone is isolated."""
    faults, metal = [], case.frame.labels.instrument > 0
    for number, each in enumerate(case.seen.highlights):
        gain = min(abs(1 + each.kd_min), abs(1 + each.kd_max))
        if each.isolated and not (each.lit and gain > 0.25 and each.peak_snr >= 10):
            faults.append(f"highlight {number}: isolated, but lit {each.lit}, gain {gain:.2g}, SNR {each.peak_snr:.3g}")
        row, column = (min(int(v), n - 1) for v, n in zip(each.bp_px[::-1], metal.shape, strict=True))
        around = metal[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        if (around.all() and not each.hidden) or (each.hidden and not around.any()):
            faults.append(
                f"highlight {number}: hidden {each.hidden}, the pixels around show metal {bool(around.all())}"
            )
        if each.isolated and (cut := _cut(case.specular, metal, (row, column))) > MOST_CUT:
            faults.append(f"highlight {number}: isolated, but {cut:.0%} of its region's border is an instrument's")
        # On a smooth surface the brightest of several that melt stands for them (docs/reference/limits.md).
        rough = case.row["relief"] != "none"
        if rough and each.isolated and (held := _others_in_region(case, each)):
            faults.append(f"highlight {number}: isolated, but its region at half height holds {held} other highlights")
        if each.hidden and each.lit:
            faults.append(f"highlight {number}: hidden and lit")
        if case.row["relief"] == "none" and gain > 0.35 and not each.isolated and case.stands_alone(each):
            faults.append(f"highlight {number} stands alone, but: {each.why_not}")
    return faults


def _others_in_region(case: Case, point: HighlightPoint) -> int:
    """Return how many other lit highlights lie at half height or above in a highlight's region."""
    height, width = case.specular.shape
    start = formulas.climbed(case.specular, (min(int(point.bp_px[1]), height - 1), min(int(point.bp_px[0]), width - 1)))
    region = formulas.at_half_height(case.specular, start)
    others = [o.bp_px for o in case.seen.highlights if o.lit and np.linalg.norm(o.bp_px - point.bp_px) > 1e-6]
    return sum(bool(region[min(int(y), height - 1), min(int(x), width - 1)]) for x, y in others)


def _cut(specular: Array, metal: Mask, start: tuple[int, int]) -> float:
    """Return the share of the pixels around a highlight's region at half height that show metal."""
    region = formulas.at_half_height(np.where(metal, 0, specular), formulas.climbed(specular, start), ~metal)
    around = ndimage.binary_dilation(region) & ~region
    return int(np.count_nonzero(around & metal)) / max(int(np.count_nonzero(around)), 1)


def labels(case: Case) -> Faults:
    """Check a sample's `instance` and `visible`: pixels above half of the lobe's peak, nothing smoothed.

    Of `instance` before the lens, whose peak may lie between pixels; of `visible` behind it.
    """
    sample = case.sample
    meta, faults = sample["meta"], []
    session = Session(scene_from_dict(meta["scene"]), colour_variant(), labelled=True)
    specular = mean(session.frame().radiance.specular).astype(float)
    instance, metal = sample["instance"].astype(int), sample["instrument"] > 0
    expected = _instances(session, meta["highlights"], specular)
    for number, each in enumerate(meta["highlights"]):
        own, region = instance == number + 1, expected == number + 1
        size, kept = int(region.sum()), int(own.sum())
        if not each["isolated"]:
            faults += [f"instance {number + 1}: of a highlight that is not isolated"] if kept else []
        elif (each["region"]["instance_px"] or 0) != kept or bool(kept) == bool(each["region"]["no_instance"]):
            faults.append(f"instance {number + 1}: {kept} px, described as {each['region']}")
        elif size >= 20:
            overlap = np.count_nonzero(own & region) / np.count_nonzero(own | region)
            faults += [f"instance {number + 1}: IoU {overlap:.2f} of {kept} with {size} px"] if overlap < 0.9 else []
        elif abs(kept - size) > 1:
            faults.append(f"instance {number + 1}: {kept} px where {size} are above half height")
    if (instance[metal] > 0).any():
        faults.append("instance: on an instrument")
    return faults + _visible(sample, specular * case.falloff)


def _instances(session: Session, highlights: Sequence[Mapping[str, Any]], specular: Array) -> IntArray:
    """Return the number, from 1, of the isolated highlight at half of whose peak or above each pixel lies, 0 for none.

    Uphill from its point leads to a pixel; the peak is what that shows, or the brightest of many rays through a
    pixel's area around the point, and what two claim is the brighter one's. The mean over a relief that is smaller
    than a pixel has no peak between pixels.
    """
    found = []
    for number, each in enumerate(highlights, 1):
        if each["isolated"]:
            column, row = (min(int(v), n - 1) for v, n in zip(each["bp_px"], specular.shape[::-1], strict=True))
            start = formulas.climbed(specular, (row, column))
            between = 0.0 if session.scene.render.samples_per_pixel > 1 else peak_of(session, np.array(each["bp_px"]))
            found.append((max(between, float(specular[start])), number, start))
    numbers = np.zeros(specular.shape, dtype=np.int64)
    for peak, number, start in sorted(found):
        if specular[start] >= peak / 2 > 0:
            numbers[formulas.at_half_height(specular, start, level=peak / 2)] = number
    return numbers


def _visible(sample: Mapping[str, Any], specular: Array) -> Faults:
    """Check that each visible spot holds its peak and pixels above half of it, and is described as its pixels are."""
    faults = []
    regions = sample["visible"]
    for number, spot in enumerate(sample["meta"]["visible_highlights"]):
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
            stated = np.round(spot["centroid_px"], 2)
            faults.append(f"visible {number + 1}: centroid_px {stated} for {centroid.round(2)}")
    return faults
