"""Writes the page of a night: one HTML file that needs nothing else."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import polars as pl

from simtest.nightly.gate.records import Night, Verdict
from simtest.nightly.page import night_tables as tables
from simtest.nightly.page import phrases as words
from simtest.nightly.page.comparisons import comparisons
from simtest.nightly.page.error_figures import error_figures
from simtest.nightly.page.extras import Extras
from simtest.nightly.page.ladder_figures import ladder
from simtest.nightly.page.trends import LEFT_OUT, MEDIAN, NEWEST, Trends, trends
from simtest.nightly.page.worst_cases import read_cases
from simtest.pages import chart_web, style
from simtest.pages.html import environment
from simtest.report.gallery import draw_gallery, isophote_keys
from simtest.report.run_folder import GalleryItem
from simtest.runtime.files import write_atomically

NO_EXTRAS = Extras()


def write_nightly_page(
    folder: Path, night: Night, verdict: Verdict, history: pl.DataFrame, extras: Extras = NO_EXTRAS
) -> Path:
    """Write the page of a night.

    Parameters
    ----------
    folder : pathlib.Path
        Where it goes; made if need be.
    night : Night
        What was measured tonight.
    verdict : Verdict
        What the gate says of it.
    history : polars.DataFrame
        Rows of the history's files (`simtest.nightly.page.trends.HISTORY_COLUMNS` at least), of any profile; empty
        where there is none. Tonight's own may be among them.
    extras : Extras
        Further parts.

    Returns
    -------
    pathlib.Path
        ``folder/index.html``. Beside it, ``folder/figures/*.png`` hold the worst cases, those of an earlier page go.
    """
    folder = Path(folder)
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for old in figures.glob("*.png"):
        old.unlink()
    html = _render(night, verdict, history, extras, figures)
    page = folder / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _render(night: Night, verdict: Verdict, history: pl.DataFrame, extras: Extras, figures: Path) -> str:
    items, unread = read_cases(extras)
    past = trends(history, night)
    colours = style.colours(_estimators(night, verdict, items, past))
    groups, steps = error_figures(night, colours), ladder(night, colours)
    charts = [figure.chart for group in groups for figure in group.figures] + ([steps.chart] if steps else [])
    table = comparisons(verdict)
    template = environment().get_template("nightly.html.j2")
    return template.render(
        title=f"Nightly accuracy, {night.run['profile']} profile",
        run=night.run,
        started=words.when(night.run["started"]),
        commit=words.short_commit(night.run.get("commit")),
        state=verdict.state,
        mark=words.MARKS.get(verdict.state, "•"),
        headline=words.headline(night, verdict),
        lines=words.lines(night, verdict),
        notes=[*verdict.notes, *(f"history, skipped: {line}" for line in extras.damaged), *unread],
        counts=words.counts(verdict),
        compared=table,
        canaries=tables.canaries(night),
        trends=None if past is None else _trends_section(past, verdict, colours),
        groups=groups,
        ladder=steps,
        gallery=draw_gallery(items, colours, figures),
        isophotes=isophote_keys(items),
        truth_colour=style.TRUTH,
        answers=tables.answers(night),
        answers_apart=tables.answers(night, ("experiment",)),
        reasons=tables.reasons(night),
        costs=tables.costs(night, verdict),
        provenance=tables.provenance(night, verdict),
        files=extras.files,
        colours={name: colours[name] for name in style.estimator_order(_names(night.rows["estimator"]))},
        figures=chart_web.packed({chart.key: chart_web.figure(chart) for chart in charts}),
        plotly=chart_web.packed_plotly() if charts or past else None,
    )


def _names(column: pl.Series) -> list[str]:
    return [str(name) for name in column.drop_nulls().unique(maintain_order=True) if name]


def _estimators(night: Night, verdict: Verdict, items: Iterable[GalleryItem], past: Trends | None) -> list[str]:
    """Name all that needs a colour."""
    names = [*_names(night.rows["estimator"]), *_names(night.figures["estimator"])]
    names += _names(verdict.comparisons["estimator"])
    names += [estimate.estimator for item in items for estimate in item.meta.estimates]
    return list(dict.fromkeys(names + ([] if past is None else past.data["names"]["estimator"])))


def _trends_section(past: Trends, verdict: Verdict, colours: dict[str, str]) -> dict[str, Any]:
    """Return what the template and the page's script need of the trends."""
    names = past.data["names"]
    first = verdict.regressions.head(1).to_dicts()
    wanted = first[0] if first else {}
    start = {
        "experiment": wanted.get("experiment"), "quantity": wanted.get("quantity"), "setting": wanted.get("setting"),
    }  # fmt: skip
    data = past.data | {
        "colours": [colours[name] for name in names["estimator"]],
        "start": start,
        "baseline": None if verdict.baseline is None else verdict.baseline.get("started"),
        "median": MEDIAN,
    }
    return {
        "nights": past.nights, "points": past.points, "thinned": past.nights > past.points, "newest": NEWEST,
        "left_out": past.left_out, "gap": LEFT_OUT, "data": chart_web.packed(data),
    }  # fmt: skip
