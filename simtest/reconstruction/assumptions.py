"""What is not known exactly of a picture: priors in place of what nobody told, and texts about them for people."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, CameraPrior, Priors
from simtest.calibration.priors import (
    OF_PICTURES,
    UNTOLD_DISTANCE_MM,
    UNTOLD_FALLOFF_POWER,
    UNTOLD_OFFSET_MM,
    UNTOLD_SLOPE_RAD,
    Floors,
)
from simtest.detection.view import DARK, View
from simtest.errors import InputError
from simtest.estimators.prior_parts import relief_part
from simtest.geometry import Camera, KannalaBrandt, ViewMask

FOCAL_SD = 0.1
"""Standard deviation of a focal length that follows from a stated field of view, as a share of it: makers state it
along the diagonal, and the picture is often cropped."""

CENTRE_SD_SHARE = 0.02
"""Standard deviation of the principal point about the picture's centre along each axis, over the picture's width."""

DISTORTION_SD = 0.1
"""Standard deviation of a radial distortion k1, where a lens of which nobody told is taken for a pinhole."""

WIDEST_PINHOLE_DEG = 100.0
"""Field of view up to which it is; wider ones, and round views, are those of an equidistant lens."""

LENS_SD = 0.17
"""Standard deviation of k1 about such a lens whose edge is given: of a stereographic one k1 is 1/12, equisolid -1/24,
orthographic -1/6, a pinhole 1/3. tests/statistical/test_wide_fov.py draws them; of pinholes from 90 deg on
few are held."""


@dataclass(frozen=True)
class Assumption:
    """One thing that is not known exactly: what it is, how it is taken, and how to narrow it.

    `given` is whether the calibration states it; else nobody did, and a prior stands in its place.
    """

    what: str
    distribution: str
    how_to_narrow: str
    given: bool = False

    def __str__(self) -> str:
        told = "given by the calibration" if self.given else f"to narrow: {self.how_to_narrow}"
        return f"{self.what}: {self.distribution} ({told})"


Extent = Literal["width", "height", "diagonal", "view"]
"""Extents of a picture that a stated field of view may span; the last is the round view in it."""

LIGHT = "light"

LIGHT_AT_CAMERA = (
    "The position of the light is not given, so each normal is the reversed line of sight to its highlight, as if the "
    "light were at the camera. A light beside it turns the true normal away by half the angle between light and camera."
)
"""What a picture's normals are where nobody told the light; in pages and in the terminal."""

NEAR_MISSES = Assumption(
    "highlights",
    "each holds a point whose normal bisects light and camera; where an organ folds about one in five only comes near: "
    "its normal is then off by 2 to 3 deg, which the budget holds where a frame shows more than three for each light",
    "compare the normals of neighbouring highlights; in Python Priors(plane=True), if the surface is a plane",
)
"""Shares and errors: python -m studies.human_meshes (docs/concepts/uncertainty.md)."""


USUAL_FOV = (10.0, 170.0)
"""Of an endoscope, deg."""


def fov_question(fov_deg: float) -> list[str]:
    """Return a question about a field of view, deg, that no endoscope has; empty for a usual one."""
    low, high = USUAL_FOV
    if low <= fov_deg <= high:
        return []
    return [f"field of view of {fov_deg:g} deg: is it in degrees? Endoscopes see {low:g} to {high:g} deg"]


def calibration_of_view(fov_deg: float, width: int, height: int, across: Extent = "width") -> Calibration:
    """Return the calibration of a camera of which the field of view alone is known, deg, across the whole picture.

    `across` names the extent that the angle spans: the picture's width, height or diagonal; for its round view see
    `calibration_of_round_view`. Raises `InputError` if the angle or the extent is none of those allowed.
    """
    extents = {"width": width, "height": height, "diagonal": math.hypot(width, height)}
    if across not in extents:
        raise InputError(f"--fov-of {across}: must be one of {', '.join(extents)}")
    return _guessed(fov_deg, width, height, extents[across], (width / 2, height / 2))


def calibration_of_round_view(fov_deg: float, width: int, height: int, view: ViewMask) -> Calibration:
    """Return the same where the angle, deg, spans the round view in the picture; the lens is centred on that view."""
    return _guessed(fov_deg, width, height, 2 * view.radius, (view.cx, view.cy), view)


def _guessed(
    fov_deg: float, width: int, height: int, extent_px: float, centre: tuple[float, float], view: ViewMask | None = None
) -> Calibration:
    """Return a calibration whose angle spans `extent_px`, with the priors of a guess."""
    centre_sd = CENTRE_SD_SHARE * width
    focal = Camera.from_fov(fov_deg, width, height).fx * extent_px / width
    if view is None and fov_deg <= WIDEST_PINHOLE_DEG:
        prior = CameraPrior(FOCAL_SD, centre_sd, DISTORTION_SD, guessed=True)
        return Calibration(Camera(width, height, focal, focal, *centre), priors=Priors(camera=prior))
    edge = math.radians(fov_deg) / 2
    focal = extent_px / 2 / edge
    prior = CameraPrior(FOCAL_SD, centre_sd, LENS_SD, edge, guessed=True)
    # No lens images what is straight behind it, which the black corners of a picture may need.
    far = max(math.hypot(x - centre[0], y - centre[1]) for x in (0, width) for y in (0, height))
    if far >= math.pi * focal and view is None:
        raise InputError(
            f"--fov {fov_deg:g}: the corners of the picture would see more than 180 deg off the axis; must be less, or "
            "--fov-of view"
        )
    mask = view if far >= math.pi * focal else None
    camera = Camera(width, height, focal, focal, *centre, distortion=KannalaBrandt(), view_mask=mask)
    return Calibration(camera, priors=Priors(camera=prior))


def assumptions(calibration: Calibration, encoding: str | None) -> list[Assumption]:
    """List what is not known exactly of a picture: what its calibration gives with a spread, and what nobody told.

    `encoding` is the one that was told beside the calibration, if any. A default of `Priors` counts as told by nobody.
    """
    priors, key = calibration.priors, "in a calibration file"
    floors, given = priors.open, priors.floors != OF_PICTURES
    made: list[Assumption] = []

    def add(what: str, distribution: str, how_to_narrow: str, given: bool = False) -> None:
        made.append(Assumption(what, distribution, how_to_narrow, given))

    if not priors.lights_mm:
        beside = f"{priors.light_offset_mm} mm beside the camera, in any direction across the optical axis"
        add(LIGHT, beside, f"[rig] lights_mm or light_offset_mm {key}", priors.light_offset_mm != UNTOLD_OFFSET_MM)
    if priors.lights_covariance is not None:
        worst = float(np.sqrt(np.linalg.eigvalsh(priors.lights_covariance)[:, -1].max()))
        spread = f"as given, normal, ± {worst:.2g} mm along the least certain axis"
        stated = bool(priors.lights_covariance_mm2)
        how = "[rig] lights_covariance_mm2" + " or [uncertainty] light_floor_mm and light_floor_deg" * (not stated)
        add("light positions", spread, f"{how} {key}", stated or given)
    if priors.distance.sd > 0:
        told, raised = priors.distance_mm is not None, priors.distance not in (priors.distance_mm, UNTOLD_DISTANCE_MM)
        how = "[rig] distance_mm or distance_range_mm" + ", or [uncertainty] distance_floor," * raised
        as_given = told and (given or not raised)
        add("distance of the tissue", f"{priors.distance} mm along the sightline", f"{how} {key}", as_given)
    camera, prior = calibration.camera, priors.camera
    told = not prior.guessed
    if prior.focal_sd > 0:
        spread = f"{camera.fx:.0f} px, normal, ± {100 * prior.focal_sd:g} %"
        add("focal length", spread, f"[camera] fx, fy and [uncertainty] focal_sd {key}", told)
    if prior.centre_sd_px > 0:
        spread = f"({camera.cx:.0f}, {camera.cy:.0f}) px, normal, ± {prior.centre_sd_px:.0f} px an axis"
        add("principal point", spread, f"[camera] cx, cy and [uncertainty] centre_sd_px {key}", told)
    if prior.distortion_sd > 0:
        lens = "none" if camera.distortion is None else "as given" if told else "equidistant"
        edge = f", unchanged {prior.edge_reach:.2f} focal lengths from the principal point" if prior.edge_reach else ""
        spread = f"{lens}, its k1 normal, ± {prior.distortion_sd:g}{edge}"
        add("distortion", spread, f"[camera.distortion] and [uncertainty] distortion_sd {key}", told)
    if calibration.response is None and encoding is None:
        add("response", "sRGB, sharpened or not", f"[response] {key}, or --encoding")
    made += _of_normals(floors, given)
    if priors.falloff_power is not None:
        falloff = f"cos^k over the angle from the optical axis, k {priors.falloff_power}"
        how = f"[vignetting] and [emission] {key}, or [uncertainty] falloff_power"
        add("falloff towards the border", falloff, how, priors.falloff_power != UNTOLD_FALLOFF_POWER)
    if relief_part(priors).any():
        slope = priors.relief_slope
        in_degrees = type(slope)(*map(math.degrees, vars(slope).values()))
        how = f"[surface] relief_slope_deg {key}"
        add("slope of the relief", f"{in_degrees} deg an axis, for the organ's normal", how, slope != UNTOLD_SLOPE_RAD)
    if not priors.plane:
        made.append(NEAR_MISSES)
    return made


def _of_normals(floors: Floors, given: bool) -> list[Assumption]:
    """List the floors of each normal."""
    moved, turned = f"± {floors.response_sd:.2g} of its size", f"± {math.degrees(floors.feature_sd):.2g} deg an axis"
    missed = f"± {math.degrees(floors.near_miss_sd):.2g} deg an axis over the root of each one's contrast"
    each = (
        ("response at a highlight's centre", floors.response_sd, moved, "response_floor"),
        ("features finer than a pixel", floors.feature_sd, turned, "feature_floor_deg"),
        ("near misses among few highlights", floors.near_miss_sd, missed, "near_miss_floor_deg"),
    )
    how = "[uncertainty] {} in a calibration file"
    return [Assumption(what, spread, how.format(key), given) for what, sd, spread, key in each if sd > 0]


def light_note(assumed: Iterable[Assumption]) -> str:
    """Return what the normals are if the light is among what is assumed; else an empty text."""
    return LIGHT_AT_CAMERA if any(each.what == LIGHT for each in assumed) else ""


BORDERED = "the picture has dark borders"
"""How the note about borders begins."""

LEAST_SHARE = 0.02
"""Borders of less than this share of the picture's side say nothing about a field of view: focal lengths that follow
from one are known to 10 %."""

Span = tuple[int, int]


def border_note(picture: npt.NDArray[np.floating], view: View) -> str:
    """Return a note of the dark borders' columns and rows, and what to do; empty where there are none to speak of.

    The picture has shape (H, W) or (H, W, 3), values as encoded in [0, 1]. A round view spans its circle, so that text
    beside it does not count; else a border is a run of rows or columns that are dark along their whole length.
    """
    height, width = picture.shape[:2]
    if (circle := view.circle) is not None:
        columns, rows = _within(circle.cx, circle.radius, width), _within(circle.cy, circle.radius, height)
    else:
        lit = (picture >= DARK).reshape(height, width, -1)
        columns, rows = (_lit_span(np.asarray(lit.any(axis=axes))) for axes in ((0, 2), (1, 2)))
    named = [
        f"{name} {first} to {end - 1} of {size}"
        for name, (first, end), size in (("columns", columns, width), ("rows", rows, height))
        if size - (end - first) >= LEAST_SHARE * size
    ]
    if not named:
        return ""
    round_view = ", or give --fov-of view" if view.circle is not None else ""
    return (
        f"{BORDERED}: its visible part is {' and '.join(named)}. The field of view is taken across the whole picture; "
        f"if it is that of the visible part, crop the picture to these{round_view}"
    )


def _within(centre: float, radius: float, size: int) -> Span:
    return max(int(np.floor(centre - radius)), 0), min(int(np.ceil(centre + radius)), size)


def _lit_span(lit: npt.NDArray[np.bool_]) -> Span:
    """Return the first lit line and the end of the last; all lines where none is lit."""
    found = np.flatnonzero(lit)
    return (int(found[0]), int(found[-1]) + 1) if len(found) else (0, len(lit))
