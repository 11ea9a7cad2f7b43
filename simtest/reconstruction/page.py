"""What is shown of a reconstruction: the page of a picture, that of a sequence, and what a notebook displays.

A page is one file that needs nothing else, but for a sequence's pictures.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.estimators.budget import deviations
from simtest.geometry.vectors import covariance_across, tilt_deg
from simtest.pages.html import write_page
from simtest.pages.notebook import note_html, picture_html, table_html
from simtest.pages.pixels import displayed, jpeg_address
from simtest.pages.style import colours
from simtest.reconstruction import explanations
from simtest.reconstruction.assumptions import light_note
from simtest.reconstruction.explanations import kind_name
from simtest.reconstruction.overlay import draw_overlay
from simtest.reconstruction.records import SIGHTLINE_RULE, Points, Specularities, Specularity, cloud_members
from simtest.reconstruction.tracking import DoneFrame, Track
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Image
from simtest.runtime.files import JsonObject

MAX_ADDRESS = 1_600_000
"""Characters of a picture in its page: 1.2 MB of JPEG."""

LEAST_FRAMES = 3
"""Shorter tracks are counted, not listed."""

OUTLINE = "#5cd0ff"
"""Colour of the outlines of highlights without a single normal: neither that of isophotes nor of any estimator."""

HALF = 0.5
"""Isovalue of the isophote that is drawn of every highlight."""


def write_picture_page(path: Path, spots: Specularities, picture: Image) -> None:
    """Write the page of a picture in [0, 1], RGB as encoded: its highlights one by one, to zoom and click."""
    belongs, rule = cloud_members(spots), spots.sightline_rule
    drawn = [_spot(spot, belongs.get(spot.id), rule) for spot in spots]
    palette = colours(row["name"] for spot in drawn for row in spot["rows"])
    data = {
        "spots": drawn,
        "others": [
            {"kind": explanations.kind_name(h.kind), "outline": _rounded(h.outline, 1),
             "peak": np.add(h.region.peak, 0.5).tolist(), "id": number}
            for number, h in [
                *((None, h) for h in spots.detection.others),
                *((s.id, s.highlight) for s in spots if s.highlight and s.peak_px is None),
            ]
        ],
        "colours": palette,
        "words": {name: getattr(explanations, name.upper()) for name in ("flags", "reasons", "parts")}
        | {"kinds": {explanations.kind_name(kind): text for kind, text in explanations.KINDS.items()}},
    }  # fmt: skip
    height, width = picture.shape[:2]
    best, stated = Counter(spot["best"] for spot in drawn if spot["best"]), spots.stated
    parts = {} if stated is None else stated.shown_parts_deg
    clouds = bool(spots.clouds)
    write_page(
        path, "picture.html.j2", data, record=spots, stated=stated, organ=spots.stated_of_organ,
        of_organ=spots.of_organ, rule_note=spots.rule_note, doubts=spots.doubts,
        told=list(parts.items()), picture=_address(picture),
        title=Path(spots.image).name, width=width, height=height, palette=palette, best=best,
        answered=sum(best.values()), clouds=clouds, terms=explanations.TERMS,
        others=len(data["others"]), left_out=len(spots.detection.others),
        left_out_kinds=explanations.kinds_counted(h.kind for h in spots.detection.others),
        light_note=light_note(spots.choices.assumed), parts=explanations.PARTS, outline=OUTLINE,
        chi95=chi_squared.quantile(0.95, 2),
    )  # fmt: skip


def write_sequence_page(path: Path, frames: Sequence[DoneFrame], tracks: Sequence[Track]) -> None:
    """Write the page of a sequence: its frames, whose pictures lie beside it in frames/, and its tracks."""
    data = {
        "frames": [
            {"file": f"frames/{frame.index:06d}.jpg", "name": frame.name, "time": frame.time_s,
             "count": frame.count}
            for frame in frames
        ],
        "position": {frame.index: i for i, frame in enumerate(frames)},
    }  # fmt: skip
    listed = [track for track in tracks if len(track.frames) >= LEAST_FRAMES]
    # the longest first: those are what a reader looks for
    listed.sort(key=lambda track: (-len(track.frames), track.track))
    write_page(
        path, "sequence.html.j2", data, count=len(frames), tracks=listed, short=len(tracks) - len(listed),
        terms=explanations.TERMS, judged=any(track.shapes for track in tracks),
    )  # fmt: skip


def _address(picture: Image) -> str:
    """Return the picture as a JPEG's data address, of lower quality where it would be large."""
    values = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    addresses = (jpeg_address(values, quality) for quality in (92, 80, 65))
    return next((each for each in addresses if len(each) <= MAX_ADDRESS), None) or jpeg_address(values, 45)


def _index(line: Points, kept: list[Points]) -> int:
    """Return the index of a line to draw, px; each is kept once, as estimators share isophotes and fitted curves."""
    # A tenth of a pixel cannot be seen, and the digits would double the page.
    rounded = _rounded(line, 1)
    if rounded not in kept:
        kept.append(rounded)
    return kept.index(rounded)


def _spot(spot: Specularity, cloud_id: int | None, rule: Sequence[str]) -> JsonObject:
    """Describe a specularity; the estimators that are one rule have one row, that of the best one which answered."""
    lines: list[Points] = []
    of_rule = [name for name in (spot.best, *spot.normals, *spot.estimates) if name in rule][:1]
    rows = [
        {"name": SIGHTLINE_RULE if name in rule else name, **_row(name, result, spot, lines)}
        for name, result in spot.estimates.items()
        if name not in rule or name in of_rule
    ]
    return {
        "id": spot.id,
        "peak": _rounded(spot.position_px, 2),
        "size": max(spot.region.box[2:]),
        "kind": explanations.kind_name(spot.kind),
        "score": spot.score,
        "best": SIGHTLINE_RULE if spot.best in rule else spot.best,
        "because": spot.best_because,
        "cloud": cloud_id,
        "lines": lines,
        "rows": rows,
    }


def _row(name: str, result: Estimate | Failure, spot: Specularity, lines: list[Points]) -> JsonObject:
    if isinstance(result, Failure):
        return {"status": str(result.reason), "detail": result.detail}
    error = spot.reference.errors.get(name) if spot.reference else None
    drawing, across = spot.drawings[name], None
    if result.covariance is not None:
        # Of the normal's part across the view: xx, xy and yy.
        seen = covariance_across(result.normal, result.covariance)
        across = [float(f"{v:.4g}") for v in seen[np.triu_indices(2)]]
    traced = sorted(drawing.isophotes, key=lambda each: abs(each[0] - HALF))
    # nearest to half height first, which is drawn of every highlight
    return {
        "status": "ok",
        "normals": _rounded(result.candidates, 4),
        "tilt": round(tilt_deg(result.normal), 2),
        "margin": result.choice_margin,
        "look": [v if np.isfinite(v) else None for v in _rounded(result.look_px, 2)],
        "isophotes": [_index(points, lines) for _, points in traced],
        "curves": [_index(curve, lines) for curve in drawing.curves],
        "deviation": result.deviation_deg,
        "silent": explanations.why_no_error(name, result),
        "across": across,
        "target": result.target,
        "parts": {name: round(float(np.degrees(v)), 4) for name, v in deviations(result.budget or {}).items()},
        "flags": result.flags,
        "error": error and error.error_deg,
        "cloud": _cloud(result),
        **({} if result.calibrated is None else {"calibrated": asdict(result.calibrated)}),
    }


def _cloud(result: Estimate) -> JsonObject | None:
    """Describe the cloud of glints that an estimate stands on."""
    if (cloud := result.cloud) is None:
        return None
    slope = [round(float(np.degrees(v)), 2) for v in (cloud.slope.value, cloud.slope.low, cloud.slope.high)]
    points = _rounded(cloud.points_px, 1)
    return {"points": points, "seen": cloud.seen, "ratio": round(cloud.axis_ratio, 3), "slope": slope}


def _rounded(points: npt.ArrayLike, digits: int) -> Points:
    return np.round(np.asarray(points, dtype=float), digits).tolist()


# What a notebook shows -----------------------------------------------------------------------------------------------

MOST_ROWS = 10
PATCH_PX = 300

HEADS = ("normal (x, y, z)", "tilt (deg)", "± (deg)", "flags")


def specularities_html(spots: Specularities) -> str:
    """Return the frame with its best normals, and the rows of the brightest specularities."""
    picture = _picture(spots.detection.frame.encoded, spots.choices.encoding)
    drawn = cv2.cvtColor(draw_overlay(picture, spots), cv2.COLOR_BGR2RGB)
    more = f"{spots.counted}; the best normal of each is drawn"
    more += f", the brightest {MOST_ROWS} are listed." if len(spots) > MOST_ROWS else "."
    rows = [_best_cells(spot, spots.sightline_rule) for spot in spots[:MOST_ROWS]]
    return picture_html(drawn, more) + note_html(more) + table_html(("No.", "kind", "best estimator", *HEADS), rows)


def specularity_html(spot: Specularity) -> str:
    """Return the patch of a specularity, with the isophotes of its best estimate, and a row for each estimator."""
    rows = [_cells(name + " *" * (name == spot.best), each) for name, each in spot.estimates.items()]
    because = f"* best: {spot.best_because}" if spot.best else spot.best_because
    table = table_html(("estimator", *HEADS), rows) + note_html(because)
    if isinstance(spot.patch, Failure):
        return spot.patch._repr_html_() + table
    picture = _picture(np.asarray(spot.patch.values, dtype=np.float32), "linear")
    drawn = cv2.cvtColor(draw_overlay(picture, [spot], spot.patch.origin_px, with_curves=False), cv2.COLOR_BGR2RGB)
    return picture_html(drawn, "the highlight with its best normal", PATCH_PX) + table


def _picture(values: Image, encoding: str) -> Image:
    """Return values in [0, 1] for the eye: linear light gets the display's gamma."""
    scaled = np.asarray(values, dtype=np.float32)
    if scaled.ndim == 3 and scaled.shape[2] not in (1, 3, 4):
        scaled = scaled.mean(axis=2)  # channels that are no colours of a display
    if encoding != "linear":
        return np.clip(scaled, 0, 1)
    return displayed(scaled / max(float(scaled.max()), 1e-12))


def _best_cells(spot: Specularity, rule: Sequence[str]) -> tuple[object, ...]:
    best = spot.best_estimate
    kind = kind_name(spot.kind) or ("cloud" if best is not None and best.cloud is not None else "")
    if best is None:
        return (spot.id, kind, "none", "", "", "", spot.best_because)
    return (spot.id, kind, SIGHTLINE_RULE if spot.best in rule else spot.best, *_cells("", best)[1:])


def _cells(name: str, result: Estimate | Failure) -> tuple[object, ...]:
    """Return the cells under an estimator's name and `HEADS`."""
    if isinstance(result, Failure):
        return (name, "no normal", "", "", str(result.reason))
    x, y, z = result.normal
    deviation = "–" if result.deviation_deg is None else f"{result.deviation_deg:.3g}"
    return (name, f"{x:.3f}, {y:.3f}, {z:.3f}", f"{tilt_deg(result.normal):.1f}", deviation, ", ".join(result.flags))
