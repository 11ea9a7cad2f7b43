"""The page of a picture's twins: one HTML file that needs nothing else."""

from dataclasses import dataclass

import cv2
import numpy as np

from simtest.advice.twin.run import SpotTwins, TwinResult
from simtest.pages.html import environment
from simtest.pages.pixels import jpeg_address
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, Image, Picture

SHOWN_SPOTS, SHOWN_TWINS = 6, 6
"""Highlights whose twins are shown, evenly over their sizes, and the likest twins of each."""

PATCH_PX, LEAST_HALF_PX, RADII = 112, 9, 3.5
"""Side of a shown patch; half the side that it shows of the frame, at least and in radii of the real highlight, px."""


@dataclass(frozen=True)
class ShownTwin:
    """A twin's patch, as an address, its error in deg and whether it is a near miss."""

    address: str
    error_deg: float
    is_near_miss: bool


@dataclass(frozen=True)
class ShownSpot:
    """A real highlight's patch, as an address, and its likest twins."""

    each: SpotTwins
    address: str
    twins: list[ShownTwin]


def render_page(result: TwinResult, command: str = "") -> str:
    """Return the page."""
    made_by = provenance.environment()
    told = [each for each in result.spots if each.stated_deg is not None]
    stated = (
        float(np.sqrt(np.mean([each.stated_deg**2 for each in told if each.stated_deg is not None]))) if told else None
    )
    return environment().get_template("twin.html.j2").render(
        result=result, command=command, stated=stated, rms=result.rms_deg(), base=result.rms_deg("base_rms_deg"),
        uncovered=sum(not each.twins.is_covered for each in result.spots), strips=_strips(result),
        provenance={"commit": made_by["commit"] or "–", "simtest": made_by["version"], "python": made_by["python"]},
    )  # fmt: skip


def _strips(result: TwinResult) -> list[ShownSpot]:
    """Return some highlights with their likest twins, the smallest first."""
    ordered = sorted(result.spots, key=lambda each: each.spot.radius_px)
    picked = np.unique(np.linspace(0, len(ordered) - 1, SHOWN_SPOTS).round().astype(int)).tolist()
    picture = np.asarray(np.rint(255 * np.clip(result.picture, 0, 1)), dtype=np.uint8)
    return [_strip(result, picture, ordered[i]) for i in picked]


def _strip(result: TwinResult, picture: Picture, each: SpotTwins) -> ShownSpot:
    half = max(LEAST_HALF_PX, round(RADII * each.spot.radius_px))
    twins = []
    for number in each.twins.best[:SHOWN_TWINS].tolist():
        frame, scored = result.bank_spots[number]
        patch = _patch(result.bank[frame].picture, scored.spot.peak_px, half)
        twins.append(ShownTwin(jpeg_address(patch, 90), scored.error_deg, scored.is_near_miss))
    return ShownSpot(each, jpeg_address(_patch(picture, each.spot.peak_px, half), 90), twins)


def _patch(picture: Picture | Image, centre: Array, half: int) -> Picture:
    """Return the surroundings of a point, px, enlarged; beyond the border the frame is repeated."""
    padded = cv2.copyMakeBorder(picture, half, half, half, half, cv2.BORDER_REPLICATE)
    x, y = (int(v) for v in centre)
    cut = padded[y : y + 2 * half + 1, x : x + 2 * half + 1]
    return np.asarray(cv2.resize(cut, (PATCH_PX, PATCH_PX), interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
