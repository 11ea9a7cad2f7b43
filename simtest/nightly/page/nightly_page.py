"""Writes the page of a judged run: one HTML file that needs nothing else."""

from collections.abc import Sequence
from pathlib import Path

from simtest.nightly import phrases
from simtest.nightly.page import run_tables as tables
from simtest.nightly.page.trends import trends
from simtest.nightly.records import JudgedRun
from simtest.pages import style
from simtest.pages.charts import embedded
from simtest.pages.html import environment
from simtest.runtime.files import write_atomically

REPORTS = "reports"
"""Folder beside the page with the run folders of experiments that have findings."""


def write_nightly_page(folder: Path, judged: JudgedRun, files: Sequence[str] = ()) -> Path:
    """Write the page of a run into a folder, which is made if need be.

    Parameters
    ----------
    folder : pathlib.Path
        Gets index.html.
    judged : JudgedRun
        The run.
    files : sequence of str
        Names of the files that lie beside the page, to link.

    Returns
    -------
    pathlib.Path
        The page.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    html = _render(judged, files)
    page = folder / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _render(judged: JudgedRun, files: Sequence[str]) -> str:
    run, verdict, record = judged.run, judged.verdict, judged.run.record
    names = [name for name in run.rows["estimator"].drop_nulls().unique(maintain_order=True) if name]
    past = [] if judged.history.is_empty() else judged.history["estimator"].drop_nulls().unique().sort().to_list()
    colours = style.colours(dict.fromkeys([*names, *past]))
    charts = trends(judged.history, verdict.baseline, colours)
    return environment().get_template("nightly.html.j2").render(
        title=f"Nightly accuracy, {record.profile} profile",
        started=phrases.when(record.started),
        commit=phrases.short_commit(record.commit),
        duration_s=record.duration_s,
        state=verdict.state,
        mark=phrases.MARKS[verdict.state],
        headline=phrases.headline_sentence(verdict),
        lines=phrases.verdict_lines(verdict),
        causes=verdict.causes,
        notes=verdict.notes,
        reports={name: f"{REPORTS}/{name}/index.html" for name in judged.reports},
        counts=phrases.counts(verdict),
        compared=tables.comparisons(verdict),
        trends=charts,
        results=tables.results(run),
        results_apart=tables.results(run, apart=True),
        provenance=tables.provenance(judged),
        files=files,
        colours={name: colours[name] for name in style.estimator_order(names)},
        **embedded(charts),
    )  # fmt: skip
