"""The page of a dense score: how the maps were read, figures by zone and bin, and some frames as pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from simtest.dataset.scoring.dense.truth import (
    ANGLE,
    BELOW,
    BINS,
    DEPTH,
    SCOPES,
    SOURCE_MEANINGS,
    SURFACES,
    ZONE_MEANINGS,
    FrameTruth,
    Key,
)
from simtest.geometry.vectors import angle_deg
from simtest.pages.html import environment
from simtest.pages.pixels import data_address, normal_colours
from simtest.pages.style import number
from simtest.runtime import provenance
from simtest.runtime.arrays import Array, Image, Picture

if TYPE_CHECKING:
    from simtest.dataset.scoring.dense.score import DenseScore

GROUP_TITLES = {
    "d_k": "d k, the distance times the principal curvature of the larger size",
    "eps_over_d": "ε/d, the offset of the farthest light over the distance",
    "distance_mm": "distance, mm",
}
SCOPE_TITLES = {"everywhere": "all scored pixels", "highlights": "pixels of highlights alone"}

Figures = Mapping[str, object]


@dataclass(frozen=True)
class Block:
    """A table of the page: its title and its rows of figures."""

    title: str
    rows: Sequence[Figures]


def write_dense_page(path: Path, score: "DenseScore", command: str) -> None:
    """Write the page of a score into one file that needs nothing else."""
    held: dict[Key, list[Figures]] = {}
    for key, found in score.cells:
        held.setdefault(key, []).append(found)
    made_by = provenance.environment()
    html = environment().get_template("dense.html.j2").render(
        score=score, command=command, headline=headlines(held), zones=ZONE_MEANINGS,
        surfaces=SURFACES, sources=[(name, SOURCE_MEANINGS[name]) for name in score.sources],
        zone_rows=_zone_rows(held, ANGLE), depth_rows=_zone_rows(held, DEPTH), bin_blocks=_bin_blocks(held),
        heads={ANGLE: _heads(ANGLE, "deg"), DEPTH: _heads(DEPTH, "%")}, below=BELOW,
        interval=interval_text, percent=percent_text,
        error_end=ERROR_END_DEG,
        frames=[(shown, [(title, data_address(picture)) for title, picture in shown.pictures])
                for shown in score.shown],
        provenance={"simtest": made_by["version"], "commit": made_by["commit"] or "–", "python": made_by["python"]},
    )  # fmt: skip
    path.write_text(html, encoding="utf-8")


def _heads(quantity: str, unit: str) -> list[str]:
    """Return the headings of a table of figures but for the first; those that begin with "=" stand over text."""
    thresholds = [f"below {most:g} {unit}" for most in BELOW[quantity]]
    figures = [f"median, {unit}", "95 % interval of the median", f"mean, {unit}", "95 % interval of the mean"]
    return [
        "=source",
        "=surface",
        *figures,
        f"RMS, {unit}",
        f"p95, {unit}",
        *thresholds,
        "unanswered",
        "pixels",
        "frames",
    ]


def headlines(held: Mapping[Key, Sequence[Figures]]) -> list[str]:
    """Return a sentence for each source: its median error at highlights and everywhere."""
    told = []
    for (source, quantity, surface), cells in held.items():
        if quantity != ANGLE or surface != "fine":
            continue
        zones = {str(cell["label"]): cell for cell in cells if cell["group"] == "zone"}
        parts = [
            f"{number(zones[label]['median'])}° {where} ({percent_text(zones[label]['share_unanswered'])} unanswered)"
            for label, where in (("highlight", "at highlights"), ("all", "everywhere")) if label in zones
        ]  # fmt: skip
        told.append(f"{SOURCE_MEANINGS[source].capitalize()}: median error {', '.join(parts)}.")
    return told


def _zone_rows(held: Mapping[Key, Sequence[Figures]], quantity: str) -> list[Figures]:
    return [
        {**cell, "source": source, "surface": surface}
        for (source, own, surface), cells in held.items() if own == quantity
        for cell in cells if cell["group"] == "zone"
    ]  # fmt: skip


def _bin_blocks(held: Mapping[Key, Sequence[Figures]]) -> list[Block]:
    """Return a table for each quantity and scope, of the angles alone."""
    blocks = []
    for group in BINS:
        for scope in SCOPES:
            rows = [
                {**cell, "source": source, "surface": surface}
                for (source, quantity, surface), cells in held.items() if quantity == ANGLE
                for cell in cells if (cell["group"], cell["scope"]) == (group, scope)
            ]  # fmt: skip
            if rows:
                blocks.append(Block(f"By {GROUP_TITLES[group]}: {SCOPE_TITLES[scope]}", rows))
    return blocks


def interval_text(found: Figures, name: str) -> str:
    """Return the 95 % interval of a figure; a dash where there is none."""
    intervals = found["ci95"]
    if not isinstance(intervals, Mapping) or name not in intervals:
        return "–"
    low, high = intervals[name]
    return f"{number(low)} to {number(high)}"


def percent_text(share: object) -> str:
    """Return a share as per cent; a dash where there is none."""
    return f"{100 * share:.3g} %" if isinstance(share, int | float) else "–"


# Pictures -----------------------------------------------------------------------------------------------------------

WIDTH = 320
"""Width of a picture, px."""

ERROR_END_DEG = 30.0
"""Error at which the colours end."""

_UNANSWERED, _EXCLUDED = (190, 60, 160), (60, 64, 70)
"""Colours of pixels without an answer, and of those that are not scored."""


@dataclass(frozen=True)
class Shown:
    """The pictures of one frame, with their captions."""

    frame: str
    setting: str
    source: str | None
    pictures: list[tuple[str, Picture]]
    median_deg: float | None


def picture_row(truth: FrameTruth, estimate: Array | None, source: str | None) -> Shown:
    """Return the pictures of a frame; `estimate` are the normals of a source, shape (H, W, 3), None for no answer."""
    normal = truth.normal["fine"]
    pictures = [] if truth.image is None else [("frame", _small(_grey(truth.image)))]
    pictures.append(("true normal (fine surface)", _scored(normal_colours(normal, _UNANSWERED), truth)))
    error = np.full(truth.size, np.nan)
    if estimate is not None:
        error = angle_deg(estimate, normal)
        pictures.append(("estimated normal", _scored(normal_colours(estimate, _UNANSWERED), truth)))
    error[~truth.scored] = np.nan
    known = error[np.isfinite(error)]
    pictures.append(("error", _scored(error_colours(error), truth)))
    return Shown(truth.name, truth.setting, source, pictures, float(np.median(known)) if known.size else None)


def error_colours(error: Array) -> Picture:
    """Return errors, deg, as colours from dark (0) to bright (`ERROR_END_DEG` and beyond)."""
    share = np.clip(np.nan_to_num(error) / ERROR_END_DEG, 0, 1)
    colours = cv2.applyColorMap(np.rint(255 * share).astype(np.uint8), cv2.COLORMAP_CIVIDIS)[:, :, ::-1].copy()
    colours[~np.isfinite(error)] = _UNANSWERED
    return np.asarray(colours, np.uint8)


def _scored(colours: Picture, truth: FrameTruth) -> Picture:
    colours[~truth.scored] = _EXCLUDED
    return _small(colours)


def _grey(image: Image) -> Picture:
    """Return a frame for the eye, as it is encoded."""
    values = np.rint(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)
    return values if values.ndim == 3 else np.repeat(values[:, :, None], 3, axis=2)


def _small(picture: Picture) -> Picture:
    height, width = picture.shape[:2]
    if width <= WIDTH:
        return picture
    size = (WIDTH, max(1, round(height * WIDTH / width)))
    # Colours of single pixels, since a mean of two directions is none.
    return np.asarray(cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_NEAREST), np.uint8)
