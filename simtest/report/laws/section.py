"""Puts the laws' table, figures and sentence together for the page."""

from pathlib import Path
from typing import Any

from simtest.report import static
from simtest.report.laws import drawing
from simtest.report.laws.judge import law_results, sentence
from simtest.report.run_folder import Run


def laws_section(run: Run, folder: Path) -> tuple[dict[str, Any], dict[str, str]] | None:
    """Draw the section of the error laws: a PNG file as a side effect, the page's parts as the value.

    Parameters
    ----------
    run : Run
        A run directory.
    folder : pathlib.Path
        Where the PNG file goes.

    Returns
    -------
    (dict, dict of str to str) or None
        What the template shows, and the plotly figures by key; None where the experiment names no law.
    """
    from simtest.report.interactive import to_json

    results = law_results(run)
    if not any(result.settings for result in results):
        return None
    static.save(drawing.draw(results), folder / "laws.png")
    drawn = {key: drawing.chart(results, key) for key in drawing.TITLES}
    charts = {key: to_json(figure) for key, figure in drawn.items() if figure is not None}
    colours = drawing.colour_of(results)
    table = [
        {"title": r.law.title, "formula": r.law.formula, "estimator": r.law.estimator, "verdict": r.verdict,
         "colour": colours[r.name], **r.cells}
        for r in results
    ]  # fmt: skip
    panels = [(key, drawing.TITLES[key]) for key in charts if key != drawing.DEPARTURES]
    whole = (drawing.DEPARTURES, drawing.TITLES[drawing.DEPARTURES])
    return {"table": table, "panels": panels, "whole": whole, "headline": sentence(results)}, charts
