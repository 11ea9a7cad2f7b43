"""What a notebook shows of a reconstruction: the best normals on the frame, and a row each."""

from dataclasses import replace

import cv2
import numpy as np

from simtest.errors import Failure
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import tilt_deg
from simtest.pages.notebook import note_html, picture_html, table_html
from simtest.pages.pixels import displayed
from simtest.reconstruction.explanations import kind_name
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.records import Specularities, Specularity
from simtest.runtime.arrays import Image

MOST_ROWS = 10
PATCH_PX = 300

HEADS = ("normal (x, y, z)", "tilt (deg)", "± (deg)", "flags")


def specularities_html(spots: Specularities) -> str:
    """Return the frame with its best normals, and the rows of the brightest specularities."""
    picture = _picture(spots.detection.frame.encoded, spots.choices.encoding)
    drawn = cv2.cvtColor(draw_overlay(picture, spots), cv2.COLOR_BGR2RGB)
    what = "specularity" if len(spots) == 1 else "specularities"
    more = f"{len(spots)} {what}; the best normal of each is drawn"
    more += f", the brightest {MOST_ROWS} are listed." if len(spots) > MOST_ROWS else "."
    rows = [_best_row(spot) for spot in spots[:MOST_ROWS]]
    return picture_html(drawn, more) + note_html(more) + table_html(("No.", "kind", "best estimator", *HEADS), rows)


def specularity_html(spot: Specularity) -> str:
    """Return the patch of a specularity, with the isophotes of its best estimate, and a row for each estimator."""
    rows = [_row(name + " *" * (name == spot.best), each) for name, each in spot.estimates.items()]
    because = f"* best: {spot.best_because}" if spot.best else spot.best_because
    table = table_html(("estimator", *HEADS), rows) + note_html(because)
    if isinstance(spot.patch, Failure):
        return spot.patch._repr_html_() + table
    picture = _picture(np.asarray(spot.patch.values, dtype=np.float32), "linear")
    # Without the camera the isophote is drawn alone, without its ellipse.
    drawn = cv2.cvtColor(draw_overlay(picture, [replace(spot, camera=None)], spot.patch.origin_px), cv2.COLOR_BGR2RGB)
    return picture_html(drawn, "the highlight with its best normal", PATCH_PX) + table


def _picture(values: Image, encoding: str) -> Image:
    """Return values in [0, 1] for the eye: linear light gets the display's gamma."""
    scaled = np.asarray(values, dtype=np.float32)
    if encoding != "linear":
        return np.clip(scaled, 0, 1)
    return displayed(scaled / max(float(scaled.max()), 1e-12))


def _best_row(spot: Specularity) -> tuple[object, ...]:
    best = spot.best_estimate
    kind = kind_name(spot.kind) or ("cloud" if best is not None and best.cloud is not None else "")
    if best is None:
        return (spot.id, kind, "no normal", "", "", "", spot.best_because)
    return (spot.id, kind, spot.best, *_row("", best)[1:])


def _row(name: str, result: Estimate | Failure) -> tuple[object, ...]:
    """Return the cells under an estimator's name and `HEADS`."""
    if isinstance(result, Failure):
        return (name, "no normal", "", "", str(result.reason))
    x, y, z = result.normal
    deviation = "–" if result.deviation_deg is None else f"{result.deviation_deg:.3g}"
    return (name, f"{x:.3f}, {y:.3f}, {z:.3f}", f"{tilt_deg(result.normal):.1f}", deviation, ", ".join(result.flags))
