"""The section of the published protocol: the article's statements, figures and the pipeline in pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from simtest.pages import style
from simtest.pages.charts import Chart
from simtest.pages.style import labelled
from simtest.report.figure_files import FigureFiles
from simtest.report.paper.pictures import Stages, isocurve_charts, isocurve_figure, stage_charts, stages
from simtest.report.paper.statements import AGREES, ARTICLE, DIFFERS, Statement, statements
from simtest.report.paper.sweeps import SweepFigure, sweep_chart, sweep_figures
from simtest.report.run_folder import Run


@dataclass(frozen=True)
class PaperSection:
    """All of the published protocol that the page shows."""

    headline: str
    statements: list[Statement]
    because: list[tuple[str, str]]  # statements, and the reason why they differ
    isocurves: list[Chart]
    stages: Stages | None
    pipeline: list[Chart]
    sweeps: list[tuple[SweepFigure, Chart]]


def paper_section(run: Run, colours: Mapping[str, str], files: FigureFiles) -> PaperSection | None:
    """Draw the section of the published protocol; None where the run has no such sweep."""
    figures = sweep_figures(run)
    if not figures:
        return None
    sweeps = [(figure, files.draw(figure.key, [sweep_chart(figure, colours)])[0]) for figure in figures]
    curves = files.draw("isocurves", isocurve_charts(isocurve_figure()))
    rows, kept = statements(figures), stages(run)
    pipeline = stage_charts(kept, colours.get("circle_pose", style.NEUTRAL)) if kept else []
    if pipeline:
        files.draw("pipeline", pipeline)
    return PaperSection(_headline(rows), rows, _because(rows), curves, kept, pipeline, sweeps)


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
