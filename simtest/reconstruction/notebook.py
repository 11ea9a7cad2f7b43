"""What a notebook shows of a reconstruction: the best normals on the frame, and a row each."""

from dataclasses import replace

import cv2
import numpy as np

from simtest.errors import Failure
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import tilt_deg
from simtest.pages.notebook import note_html, picture_html, table_html
from simtest.pages.pixels import displayed
from simtest.reconstruction.description import Drawing, SpecularityRecord, describe
from simtest.reconstruction.explanations import kind_name
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.pipeline import Reconstruction, Specularities, Specularity
from simtest.reconstruction.ranking import best_of
from simtest.runtime.arrays import Array, Image

MOST_ROWS = 10
PATCH_PX = 300

HEADS = ("normal (x, y, z)", "tilt (deg)", "± (deg)", "flags")


def specularities_html(found: Specularities) -> str:
    """Return the frame with its best normals, and the rows of the brightest specularities."""
    frame = found.detection.frame
    records = describe(Reconstruction(list(found), found.detection), frame.camera)
    drawn = cv2.cvtColor(draw_overlay(_picture(frame.encoded, found.choices.encoding), records), cv2.COLOR_BGR2RGB)
    what = "specularity" if len(found) == 1 else "specularities"
    more = f"{len(found)} {what}; the best normal of each is drawn"
    more += f", the brightest {MOST_ROWS} are listed." if len(found) > MOST_ROWS else "."
    rows = [_best_row(each) for each in records[:MOST_ROWS]]
    return picture_html(drawn, more) + note_html(more) + table_html(("No.", "kind", "best estimator", *HEADS), rows)


def specularity_html(found: Specularity) -> str:
    """Return the patch of a specularity, with the isophotes of its best estimate, and a row for each estimator."""
    best, because = best_of(found.estimates)
    rows = [_row(name + " *" * (name == best), each) for name, each in found.estimates.items()]
    table = table_html(("estimator", *HEADS), rows) + note_html(f"* best: {because}" if best else because)
    if isinstance(found.patch, Failure):
        return found.patch._repr_html_() + table
    record = SpecularityRecord(0, found.region.box, found.patch.peak_px, None, None, None, best, found.estimates)
    values = np.asarray(found.patch.values, dtype=np.float32)
    # The patch alone is drawn, so what stands in px of the frame is moved to it.
    moved = _moved(record, found, np.array(found.patch.origin_px, dtype=float))
    drawn = cv2.cvtColor(draw_overlay(_picture(values, "linear"), [moved]), cv2.COLOR_BGR2RGB)
    return picture_html(drawn, "the highlight with its best normal", PATCH_PX) + table


def _picture(values: Image, encoding: str) -> Image:
    """Return values in [0, 1] for the eye: linear light gets the display's gamma."""
    scaled = np.asarray(values, dtype=np.float32)
    if encoding != "linear":
        return np.clip(scaled, 0, 1)
    return displayed(scaled / max(float(scaled.max()), 1e-12))


def _moved(record: SpecularityRecord, found: Specularity, origin: Array) -> SpecularityRecord:
    """Return the record in px of the patch, whose upper left corner lies at `origin` in the frame."""
    estimates = {
        name: each if isinstance(each, Failure) else replace(each, look_px=each.look_px - origin, cloud=None)
        for name, each in record.estimates.items()
    }
    drawings = {
        name: Drawing([(t, (points - origin).tolist()) for t, points in each.contours(found.patch)], [])
        for name, each in record.normals.items()
    }
    x, y = found.region.box[:2]
    box = (x - int(origin[0]), y - int(origin[1]), *found.region.box[2:])
    return replace(record, box_px=box, estimates=estimates, drawings=drawings)


def _best_row(record: SpecularityRecord) -> tuple[object, ...]:
    best = record.best_estimate
    kind = kind_name(record.kind) or ("cloud" if best is not None and best.cloud is not None else "")
    if best is None:
        return (record.id, kind, "no normal", "", "", "", record.best_because)
    return (record.id, kind, record.best, *_row("", best)[1:])


def _row(name: str, result: Estimate | Failure) -> tuple[object, ...]:
    """Return the cells under an estimator's name and `HEADS`."""
    if isinstance(result, Failure):
        return (name, "no normal", "", "", str(result.reason))
    x, y, z = result.normal
    deviation = "–" if result.deviation_deg is None else f"{result.deviation_deg:.3g}"
    return (name, f"{x:.3f}, {y:.3f}, {z:.3f}", f"{tilt_deg(result.normal):.1f}", deviation, ", ".join(result.flags))
