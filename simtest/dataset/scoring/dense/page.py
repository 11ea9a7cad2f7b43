"""The page of a dense score: how the maps were read, figures by zone and bin, and some frames as pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from simtest.dataset.scoring.dense.cells import BINS, SCOPES, ZONE_MEANINGS
from simtest.dataset.scoring.dense.frame_truth import SURFACES
from simtest.dataset.scoring.dense.pictures import ERROR_END_DEG
from simtest.dataset.scoring.dense.scorer import ANGLE, BELOW, DEPTH, NORMAL, Key
from simtest.pages.html import environment
from simtest.pages.pixels import data_address
from simtest.pages.style import number
from simtest.runtime import provenance

if TYPE_CHECKING:
    from simtest.dataset.scoring.dense.score import DenseScore

SOURCE_MEANINGS = {
    NORMAL: "normal maps",
    "depth_none": "normals of the depth maps, as stated",
    "depth_scale": "normals of the depth maps, aligned by a factor a frame",
    "depth_affine": "normals of the depth maps, aligned by a factor and a shift a frame",
}
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
    for key, found in score.scorer.cells():
        held.setdefault(key, []).append(found)
    made_by = provenance.environment()
    html = environment().get_template("dense.html.j2").render(
        score=score, command=command, headline=headlines(held), zones=ZONE_MEANINGS,
        surfaces=SURFACES, sources=[(name, SOURCE_MEANINGS[name]) for name in score.scorer.sources],
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
