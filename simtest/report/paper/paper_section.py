"""The section of the published protocol: the article's statements, figures and the pipeline in pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from simtest.pages import chart_png, pixels, style
from simtest.pages.chart import Chart
from simtest.pages.style import degrees, labelled, number
from simtest.report.figure_files import FigureFiles
from simtest.report.paper.isocurve_figure import isocurve_charts, isocurve_figure
from simtest.report.paper.stages import Stages, stage_charts, stages
from simtest.report.paper.statements import AGREES, ARTICLE, DIFFERS, Statement, statements
from simtest.report.paper.sweep_chart import bounds, laws, sweep_chart
from simtest.report.paper.sweeps import Sweep, SweepFigure, departures, sweep_figures
from simtest.report.run_folder import Run

_STAGE_ALTS = (
    "Texture of the specular term on the plane.", "The texture seen slanted, without noise.", "The same with noise.",
    "Smoothed and normalised, with the isophote and the fitted ellipse.",
    "The true normal and both candidates, seen from the side.",
    "The better candidate about the true normal, in degrees.",
)  # fmt: skip


@dataclass(frozen=True)
class StagesPart:
    """The pipeline in pictures: the setting, how it came out, and (data address, description) of each picture."""

    setting: str
    result: str
    is_default: bool
    pictures: list[tuple[str, str]]


@dataclass(frozen=True)
class SweepPart:
    """A sweep's figure, its chart and its numbers in words; what the caption has to explain."""

    figure: SweepFigure
    chart: Chart
    measured: list[str]
    has_bound: bool
    has_law: bool


@dataclass(frozen=True)
class PaperSection:
    """All of the published protocol that the page shows; `because` are (statements, reason why they differ)."""

    headline: str
    statements: list[Statement]
    because: list[tuple[str, str]]
    isocurves: list[Chart]
    stages: StagesPart | None
    sweeps: list[SweepPart]


def paper_section(run: Run, colours: Mapping[str, str], files: FigureFiles) -> PaperSection | None:
    """Draw the section of the published protocol; None where the run has no such sweep."""
    figures = sweep_figures(run)
    if not figures:
        return None
    sweeps = [
        SweepPart(figure, sweep_chart(figure, colours), [_measured(sweep) for sweep in figure.sweeps],
                  bool(bounds(figure)), bool(laws(figure)))
        for figure in figures
    ]  # fmt: skip
    for part in sweeps:
        files.add(part.chart.key, [part.chart])
    curves = isocurve_charts(isocurve_figure())
    files.add("isocurves", curves)
    rows = statements(figures)
    pictures = _stages_part(stages(run), colours, files)
    return PaperSection(_headline(rows), rows, _because(rows), curves, pictures, sweeps)


def _stages_part(data: Stages | None, colours: Mapping[str, str], files: FigureFiles) -> StagesPart | None:
    if data is None:
        return None
    whole, parts = chart_png.draw(stage_charts(data, colours.get("circle_pose", style.NEUTRAL)))
    files.write("pipeline", whole)
    for i, part in enumerate(parts, 1):
        files.write(f"pipeline_{i}", part)
    errors = [degrees(error) for error in data.errors_deg]
    result = f"candidates off by {labelled(errors)}" if errors else f"no normal ({data.status})"
    pictures = [(pixels.data_address(part), alt) for part, alt in zip(parts, _STAGE_ALTS, strict=True)]
    return StagesPart(data.setting, result, data.is_default, pictures)


def _headline(rows: Sequence[Statement]) -> str:
    own = [row for row in rows if row.source == ARTICLE and row.verdict in (AGREES, DIFFERS)]
    if not own:
        return "The run holds none of the article's own sweeps by circle_pose; its statements are not compared."
    differing = list(dict.fromkeys(row.sweep for row in own if row.verdict == DIFFERS))
    agreeing = sum(row.verdict == AGREES for row in own)
    text = f"Of the article's {len(own)} statements that the run can test, {agreeing} agree with it"
    return f"{text}; it differs in {labelled(differing)}." if differing else f"{text}."


def _because(rows: Sequence[Statement]) -> list[tuple[str, str]]:
    """Return each reason once, with the statements it explains."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row.because:
            reasons.setdefault(row.because, []).append(f"{row.sweep}: {row.claim}")
    return [("; ".join(claims), reason) for reason, claims in reasons.items()]


def _measured(sweep: Sweep) -> str:
    known = np.isfinite(sweep.mean)
    name = f"{sweep.estimator}, {sweep.label}"
    other = departures(sweep.fixed)
    text = f"{name} ({other}): " if other else f"{name}: "
    if known.any():
        low, high = (float(value) for value in (np.nanmin(sweep.mean), np.nanmax(sweep.mean)))
        largest = degrees(float(np.nanmax(sweep.largest)))
        text += f"means from {degrees(low)} to {degrees(high)}, single errors up to {largest}"
    else:
        text += "no answer"
    failing = [
        f"{sweep.parameter.text(float(x))}: {failed:.0f} of {failed + answered:.0f} ({reasons})"
        for x, failed, answered, reasons in zip(sweep.x, sweep.failed, sweep.answered, sweep.reasons, strict=True)
        if failed
    ]
    text += f"; failures at {', '.join(failing)}" if failing else "; no failures"
    wide = known & np.isfinite(sweep.law) & (sweep.law > 1e-3)
    if sweep.fixed.get("sigma") == 0 and wide.any():
        ratio = sweep.mean[wide] / sweep.law[wide]
        text += f"; measured over predicted bias {number(float(ratio.min()))} to {number(float(ratio.max()))}"
    return text + "."
