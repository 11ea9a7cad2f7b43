"""Sentences made from a run's numbers."""

import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.pages.style import counted, degrees, number
from simtest.report.error_figures import HeatMap, LineFigure, law_misses
from simtest.report.run_folder import Run
from simtest.validation.statistics import counts, row_kind


def headline(run: Run, figures: list[LineFigure]) -> list[str]:
    """Return in a few sentences what a run counted, and how many points the closed-form laws predict."""
    rows = run.results
    if rows.is_empty():
        return ["The run has no rows: nothing was measured."]
    sentences = [_counts(rows)]
    for figure in figures:
        misses = law_misses(figure).values()
        met, total = sum(miss.met for miss in misses), sum(miss.total for miss in misses)
        if total and figure.key in ("error_vs_curvature", "axis_ratio", "error_vs_offset"):
            # Points where the law is 0 measure the noise alone; they are not counted.
            predicted = f"predicts {met} of {total} measured points to within {figure.rule}"
            sentences.append(f"{figure.title}: the closed-form law, which knows no noise, {predicted}.")
    return [s for s in sentences if s]


def _counts(rows: pl.DataFrame) -> str:
    count = rows.select(**counts(rows)).row(0, named=True)
    total = rows.height
    reasons = rows.filter(row_kind(rows) == "failed")["status"].value_counts(sort=True).iter_rows()
    detail = f" ({', '.join(f'{name} {number}' for name, number in reasons)})" if count["failed"] else ""
    parts = [f"{count['failed']} gave no normal{detail}", f"{count['missed']} missed a true highlight"]
    if count["in_spot"]:
        parts.append(f"{count['in_spot']} belong to spots of several glints or of none")
    if count[ON_INSTRUMENT]:
        parts.append(f"{count[ON_INSTRUMENT]} lie on instruments")
    parts.append(f"{count['false']} belong to false detections")
    return f"Of {counted(total, 'row')}, {', '.join(parts[:-1])} and {parts[-1]}."


def measured(figure: LineFigure) -> list[str]:
    """State the measured numbers of a figure of curves, a line for each estimator."""
    misses = law_misses(figure)
    unit, lines = figure.unit, []
    for name in figure.estimators:
        means = [float(y) for curve in figure.curves if curve.estimator == name for y in curve.y]
        text = f"{name}: means from {number(min(means))}{unit} to {number(max(means))}{unit}"
        if name in misses:
            miss = misses[name]
            text += f"; the law predicts {miss.met} of {miss.total} points to within {figure.rule}, "
            text += f"largest departure {number(miss.worst)}{unit} ({miss.where})"
        lines.append(text + ".")
    if figure.empty:
        count = "one setting" if len(figure.empty) == 1 else f"{len(figure.empty)} settings"
        shown = "; ".join(figure.empty[:6]) + ("; …" if len(figure.empty) > 6 else ".")
        lines.append(f"No value, and so no point, at {count}: {shown}")
    return lines


def heat_line(item: HeatMap) -> str:
    """State the range of a heat map."""
    values = item.mean_deg[item.mean_deg == item.mean_deg]
    return f"{item.title}: {degrees(float(values.min()))} to {degrees(float(values.max()))}."
