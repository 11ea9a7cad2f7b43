"""Sentences made from a run's numbers."""

import polars as pl

from simtest.pages.style import degrees, estimator_order, labelled, number
from simtest.report.heat_maps import HeatMap
from simtest.report.run_folder import Run
from simtest.report.series import LineFigure, law_misses


def headline(run: Run, figures: list[LineFigure]) -> list[str]:
    """Sum up what a run measured in a few sentences; laws are compared with the measurements of the figures."""
    rows = run.results
    if rows.is_empty():
        return ["The run has no rows: nothing was measured."]
    sentences = [*_errors(rows), _counts(rows)]
    for figure in figures:
        misses = law_misses(figure).values()
        met, total = sum(miss.met for miss in misses), sum(miss.total for miss in misses)
        if total and figure.key in ("error_vs_curvature", "axis_ratio", "error_vs_offset"):
            # Points where the law is 0 measure the noise alone; they are not counted.
            predicted = f"predicts {met} of {total} measured points to within {figure.rule}"
            sentences.append(f"{figure.title}: the closed-form law, which knows no noise, {predicted}.")
    return [s for s in sentences if s]


def _errors(rows: pl.DataFrame) -> list[str]:
    """State how far the estimators are off, apart for a light at the camera and beside it."""
    hits = rows.filter((pl.col("status") == "ok") & pl.col("true_id").is_not_null())
    hits = hits.filter(pl.col("error_oracle_deg").is_not_null())
    if hits.is_empty():
        return ["No row has a normal that could be compared with the truth."]
    beside = (pl.col("eps_over_d") > 1e-6).fill_null(False)
    parts = [
        (hits.filter(~beside), "with the light at the camera"),
        (hits.filter(beside), "with the light beside the camera"),
    ]
    both = all(part.height for part, _ in parts)
    return [_means(part, f", {where}" if both else "") for part, where in parts if part.height]


def _means(hits: pl.DataFrame, where: str) -> str:
    table = hits.group_by("estimator").agg(
        mean=pl.col("error_oracle_deg").mean(),
        p95=pl.col("error_oracle_deg").quantile(0.95, "linear"),
    )
    texts = {
        row["estimator"]: f"{row['estimator']} by {degrees(row['mean'])} on average (95 % of its rows within "
        f"{degrees(row['p95'])})"
        for row in table.iter_rows(named=True)
    }
    answers = labelled([texts[name] for name in estimator_order(texts)])
    settings = hits["setting"].n_unique()
    over = f"Over {settings} {_plural('setting', settings)}{where}"
    return f"{over}, the better candidate misses the true normal: {answers}."


def _plural(word: str, count: int) -> str:
    return word if count == 1 else word + "s"


def _counts(rows: pl.DataFrame) -> str:
    unmatched = rows["true_id"].is_null() & (rows["status"] != "missed").fill_null(True)
    # On a relief a spot may melt several glints, or hold none: it is no single highlight, but it is there.
    melted = unmatched & rows["visible_id"].is_not_null() if "visible_id" in rows.columns else unmatched & False
    false = unmatched & ~melted
    missed = (rows["status"] == "missed").fill_null(False)
    failed = rows.filter((pl.col("status") != "ok") & (pl.col("status") != "missed") & ~unmatched)
    total = rows.height
    reasons = failed["status"].value_counts(sort=True).iter_rows()
    detail = f" ({', '.join(f'{name} {count}' for name, count in reasons)})" if failed.height else ""
    parts = [f"{failed.height} gave no normal{detail}", f"{int(missed.sum())} missed a true highlight"]
    if melted.any():
        parts.append(f"{int(melted.sum())} belong to spots of several glints or of none")
    parts.append(f"{int(false.sum())} belong to false detections")
    return f"Of {total} {_plural('row', total)}, {', '.join(parts[:-1])} and {parts[-1]}."


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
