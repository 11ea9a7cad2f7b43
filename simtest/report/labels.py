"""Sentences and captions made from the run's numbers."""

from collections.abc import Mapping
from typing import Any

import polars as pl

from simtest.pages.style import degrees, estimator_order, labelled, number
from simtest.report.run_folder import GalleryItem, Run
from simtest.report.series import LineFigure, law_misses
from simtest.report.tables import HeatMap


def headline(run: Run, figures: list[LineFigure]) -> list[str]:
    """Say what the run measured, in a few sentences.

    Parameters
    ----------
    run : Run
        A run directory.
    figures : list of LineFigure
        Figures whose laws are compared with the measurements.

    Returns
    -------
    list of str
        Plain text.
    """
    rows = run.results
    if rows.is_empty():
        return ["The run has no rows: nothing was measured."]
    sentences = [*_errors(rows), _counts(rows)]
    for figure in figures:
        met = sum(v[0] for v in law_misses(figure).values())
        total = sum(v[1] for v in law_misses(figure).values())
        if total and figure.key in ("error_vs_curvature", "axis_ratio", "error_vs_offset"):
            rule = "3 %" if figure.shared_law else "0.3° or 3 %"
            met_text = f"is met within {rule} at {met} of {total} points"
            sentences.append(f"{figure.title}: the law, without noise, {met_text} of the sweeps where it is not 0.")
    return [s for s in sentences if s]


def _errors(rows: pl.DataFrame) -> list[str]:
    """Say how far the estimators are off, apart for a light at the camera and beside it."""
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
    false = rows["true_id"].is_null() & (rows["status"] != "missed").fill_null(True)
    missed = (rows["status"] == "missed").fill_null(False)
    failed = rows.filter((pl.col("status") != "ok") & (pl.col("status") != "missed") & ~false)
    total = rows.height
    reasons = failed["status"].value_counts(sort=True).iter_rows()
    detail = f" ({', '.join(f'{name} {count}' for name, count in reasons)})" if failed.height else ""
    return (
        f"Of {total} {_plural('row', total)}, {failed.height} gave no normal{detail}, {int(missed.sum())} missed "
        f"a true highlight and {int(false.sum())} belong to false detections."
    )


def measured(figure: LineFigure) -> list[str]:
    """Give the measured numbers of a figure of curves, a line an estimator."""
    misses = law_misses(figure)
    unit = "" if figure.shared_law else "°"
    rule = "3 %" if figure.shared_law else "0.3° or 3 %"
    lines = []
    for name in figure.estimators:
        means = [float(y) for curve in figure.curves if curve.estimator == name for y in curve.y]
        text = f"{name}: means from {number(min(means))}{unit} to {number(max(means))}{unit}"
        if name in misses:
            met, total, gap, where = misses[name]
            text += f"; law met within {rule} at {met} of {total} points, "
            text += f"largest departure {number(gap)}{unit} ({where})"
        lines.append(text + ".")
    if figure.empty:
        places = "one place" if len(figure.empty) == 1 else f"{len(figure.empty)} places"
        shown = "; ".join(figure.empty[:6]) + ("; …" if len(figure.empty) > 6 else ".")
        lines.append(f"No value, so no point, at {places}: {shown}")
    return lines


def heat_line(item: HeatMap) -> str:
    """Give the range of a heat map."""
    values = item.mean_deg[item.mean_deg == item.mean_deg]
    return f"{item.estimator}, {item.label}: {degrees(float(values.min()))} to {degrees(float(values.max()))}."


def gallery_caption(item: GalleryItem) -> dict[str, Any]:
    """Give the texts of a gallery item: title, setting, errors and the command that makes it again."""
    errors = []
    for estimate in item.estimates:
        status = str(estimate.get("status"))
        value = degrees(estimate.get("error_deg"))
        if estimate.get("true_id") is None:
            result = "false detection" if status == "ok" else f"{status} (false detection)"
        else:
            result = value if status == "ok" else status
            if status == "ok" and len(estimate.get("candidates") or ()) > 1:
                better = degrees(estimate.get("error_oracle_deg"))
                result += f" (better candidate {better})" if better not in ("–", value) else ""
        name = str(estimate.get("estimator"))
        errors.append({"spot": estimate.get("specularity"), "estimator": name, "text": result})
    found = {e.get("true_id") for e in item.estimates}
    return {
        "title": item.meta.get("label") or item.meta.get("surface") or item.name,
        "setting": item.meta.get("setting") or "",
        "noise": number(item.meta.get("sigma")),
        "command": item.meta.get("command") or "",
        "errors": errors,
        "missed": sum(bool(t.get("isolated", True)) and t.get("id") not in found for t in item.truth),
    }


def flattened(values: Mapping[str, Any]) -> dict[str, str]:
    """Give the entries of a table, and of tables within it, as text by name."""
    made: dict[str, str] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            made |= {f"{key}: {name}": str(entry) for name, entry in value.items()}
        elif isinstance(value, list | tuple):
            made[str(key)] = " ".join(str(entry) for entry in value)
        else:
            made[str(key)] = "–" if value is None else str(value)
    return made


def provenance_rows(run: Run) -> list[tuple[str, str]]:
    """Flatten the provenance of summary.json to (name, text)."""
    return list(flattened(run.summary.get("run") or {}).items())
