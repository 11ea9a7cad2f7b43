"""Writes the page of a judged run: one HTML file that needs nothing else."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import polars as pl

from simtest.nightly import phrases
from simtest.nightly.page import run_tables as tables
from simtest.nightly.page.error_figures import error_figures
from simtest.nightly.page.ladder_figures import ladder
from simtest.nightly.page.trends import LEFT_OUT, MEDIAN, NEWEST, Trends, trends
from simtest.nightly.page.worst_cases import read_cases
from simtest.nightly.records import JudgedRun, Verdict
from simtest.pages import chart_web, style
from simtest.pages.html import environment
from simtest.report.gallery import draw_gallery, isophote_keys
from simtest.report.run_folder import GalleryItem
from simtest.runtime.files import write_atomically


def write_nightly_page(folder: Path, judged: JudgedRun, files: Sequence[str] = ()) -> Path:
    """Write the page of a run into a folder, which is made if need be.

    Parameters
    ----------
    folder : pathlib.Path
        Gets index.html, and the worst cases as ``figures/*.png``; those of an earlier page go.
    judged : JudgedRun
        The run. Its history may hold runs of any profile, and lack the run's own.
    files : sequence of str
        Names of the files that lie beside the page, to link.

    Returns
    -------
    pathlib.Path
        The page.
    """
    folder = Path(folder)
    figures = folder / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for old in figures.glob("*.png"):
        old.unlink()
    html = _render(judged, files, figures)
    page = folder / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _render(judged: JudgedRun, files: Sequence[str], figures: Path) -> str:

    run, verdict, record = judged.run, judged.verdict, judged.run.record
    # Read and draw
    items, unread = read_cases(judged)
    past = trends(judged.history, run)
    colours = style.colours(_estimators(judged, items, past))
    groups, steps = error_figures(run, colours), ladder(run, colours)
    charts = [figure.chart for group in groups for figure in group.figures] + ([steps.chart] if steps else [])
    # Fill in
    return environment().get_template("nightly.html.j2").render(
        title=f"Nightly accuracy, {record.profile} profile",
        started=phrases.when(record.started),
        commit=phrases.short_commit(record.commit),
        duration_s=record.duration_s,
        state=verdict.state,
        mark=phrases.MARKS[verdict.state],
        headline=phrases.headline_sentence(judged),
        lines=phrases.verdict_lines(judged),
        causes=verdict.causes,
        notes=[*verdict.notes, *unread],
        counts=phrases.counts(verdict),
        compared=tables.comparisons(verdict),
        canaries=tables.canaries(run),
        trends=past,
        trend_data=None if past is None else _trend_data(past, verdict, colours),
        trend_gap=LEFT_OUT,
        newest=NEWEST,
        groups=groups,
        ladder=steps,
        gallery=draw_gallery(items, colours, figures),
        isophotes=isophote_keys(items),
        truth_colour=style.TRUTH,
        results=tables.results(run),
        results_apart=tables.results(run, apart=True),
        failures=tables.failures(run),
        costs=tables.costs(judged),
        provenance=tables.provenance(judged),
        files=files,
        colours={name: colours[name] for name in style.estimator_order(_names(run.rows))},
        figures=chart_web.packed({chart.key: chart_web.figure(chart) for chart in charts}),
        plotly=chart_web.packed_plotly() if charts or past else None,
    )  # fmt: skip


def _names(table: pl.DataFrame) -> list[str]:
    return [name for name in table["estimator"].drop_nulls().unique(maintain_order=True) if name]


def _estimators(judged: JudgedRun, items: Iterable[GalleryItem], past: Trends | None) -> list[str]:
    """Return all names that need a colour."""
    names = [*_names(judged.run.rows), *_names(judged.run.figures), *_names(judged.verdict.comparisons)]
    names += [estimate.estimator for item in items for estimate in item.meta.estimates]
    return list(dict.fromkeys(names + ([] if past is None else past.data["names"]["estimator"])))


def _trend_data(past: Trends, verdict: Verdict, colours: dict[str, str]) -> str:
    """Return what the page's script needs of the trends, packed; they open with the first finding, if any."""
    names = ("experiment", "quantity", "setting")
    findings = pl.concat([verdict.regressions, verdict.unexplained])
    data = past.data | {
        "colours": [colours[name] for name in past.data["names"]["estimator"]],
        "start": next(findings.select(names).iter_rows(named=True), dict.fromkeys(names)),
        "baseline": None if verdict.baseline is None else verdict.baseline.started,
        "median": MEDIAN,
    }
    return chart_web.packed(data)
