"""Puts the published protocol's figures and sentences together for the page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from simtest.pages import style
from simtest.pages.style import degrees, labelled, number
from simtest.report import static as base
from simtest.report.paper import static
from simtest.report.paper.isocurves import isocurve_figure
from simtest.report.paper.stages import Stages, stages
from simtest.report.paper.stages_static import draw_panels, draw_stages
from simtest.report.paper.statements import AGREES, ARTICLE, DIFFERS, Statement, statements
from simtest.report.paper.sweeps import Sweep, SweepFigure, departures, sweep_figures
from simtest.report.run_folder import Run

_PANEL_BYTES = 60_000

Embed = Callable[[Path, int], str]
"""Gives a PNG as a data address of at most so many bytes."""


def paper_section(
    run: Run, colours: Mapping[str, str], folder: Path, embed: Embed
) -> tuple[dict[str, Any], dict[str, str]] | None:
    """Draw the section of the published protocol: PNG files as a side effect, the page's parts as the value.

    Parameters
    ----------
    run : Run
        A run directory.
    colours : mapping of str to str
        Colour by estimator.
    folder : pathlib.Path
        Where the PNG files go.
    embed : callable
        See `Embed`.

    Returns
    -------
    (dict, dict of str to str) or None
        What the template shows, and the plotly figures by key; None where the run has no such sweep.
    """
    from simtest.report.interactive import to_json
    from simtest.report.paper import interactive

    figures = sweep_figures(run)
    if not figures:
        return None
    charts = {}
    for figure in figures:
        base.save(static.draw_sweep(figure, colours), folder / f"{figure.key}.png")
        charts[figure.key] = to_json(interactive.sweep(figure, colours))
    curves = isocurve_figure()
    base.save(static.draw_isocurves(curves), folder / "isocurves.png")
    charts |= {key: to_json(part) for key, part in interactive.isocurves(curves).items()}
    rows = statements(figures)
    section = {
        "headline": _headline(rows),
        "statements": rows,
        "because": _because(rows),
        "sweeps": [_sweep_part(figure) for figure in figures],
        "stages": _stages_part(stages(run), colours, folder, embed),
    }
    return section, charts


def _stages_part(data: Stages | None, colours: Mapping[str, str], folder: Path, embed: Embed) -> dict[str, Any] | None:
    if data is None:
        return None
    colour = colours.get("circle_pose", style.NEUTRAL)
    base.save(draw_stages(data, colour), folder / "pipeline.png")
    panels = []
    for i, panel in enumerate(draw_panels(data, colour), 1):
        panels.append(embed(base.save(panel, folder / f"pipeline_{i}.png"), _PANEL_BYTES))
    errors = [degrees(error) for error in data.errors_deg]
    result = f"candidates off by {labelled(errors)}" if errors else f"no normal ({data.status})"
    return {"setting": data.setting, "panels": panels, "result": result, "is_default": data.is_default}


def _headline(rows: Sequence[Statement]) -> str:
    own = [row for row in rows if row.source == ARTICLE and row.verdict in (AGREES, DIFFERS)]
    if not own:
        return "The run holds none of the article's own sweeps by circle_pose; its statements are not compared."
    differing = list(dict.fromkeys(row.sweep for row in own if row.verdict == DIFFERS))
    agreeing = sum(row.verdict == AGREES for row in own)
    text = f"Of the article's {len(own)} statements that the run can test, {agreeing} agree with it"
    return f"{text}; it differs in {labelled(differing)}." if differing else f"{text}."


def _because(rows: Sequence[Statement]) -> list[tuple[str, str]]:
    """Give each reason once, with the statements it explains."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if row.because:
            reasons.setdefault(row.because, []).append(f"{row.sweep}: {row.claim}")
    return [("; ".join(claims), reason) for reason, claims in reasons.items()]


def _sweep_part(figure: SweepFigure) -> dict[str, Any]:
    marks = style.symbols(figure.labels)
    drawn = {
        "bound": bool(static.bounds(figure)),
        "law": bool(static.laws(figure)),
        "log": figure.y.scale == "log",
        "several": len(figure.sweeps) > 1,
    }
    return {
        "key": figure.key,
        "title": figure.title,
        "about": figure.parameter.about,
        "measured": [_measured(sweep) for sweep in figure.sweeps],
        "marks": [(marks[label].text, label) for label in figure.labels] if len(figure.labels) > 1 else [],
        **drawn,
    }


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
