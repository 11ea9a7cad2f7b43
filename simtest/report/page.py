"""Writes the page of a run: figures as PNG, and one HTML file that needs nothing else."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from simtest.pages import chart_web, pixels, style
from simtest.pages.html import environment
from simtest.report import sentences
from simtest.report.coverage import coverage, is_anatomical
from simtest.report.error_laws import is_tested, law_results, sentence
from simtest.report.figure_files import FigureFiles
from simtest.report.gallery import draw_gallery, isophote_keys
from simtest.report.glint_figures import glint_figures
from simtest.report.heat_maps import heat_charts, heat_maps
from simtest.report.law_charts import law_charts, law_colours
from simtest.report.pairs import pairs
from simtest.report.paper.paper_section import paper_section
from simtest.report.relief_figures import relief_figures
from simtest.report.run_folder import ExperimentSummary, Run, read_run
from simtest.report.series import line_chart, line_figures
from simtest.report.summary_table import HEADINGS, table_rows
from simtest.report.surface_errors import surface_chart, surface_errors
from simtest.report.triangle_cost import fineness_charts, read_study
from simtest.report.view3d import view_3d, view_json, view_picture
from simtest.report.visible_figures import visible_figures
from simtest.runtime.files import write_atomically

_FIRST_CARDS, _MAX_HEAT_MAPS = 9, 18


def write_report(run: Path) -> Path:
    """Write the figures and the page of a run.

    Parameters
    ----------
    run : pathlib.Path
        Run folder with results.parquet, summary.json and, if there is one, gallery/*.npz.

    Returns
    -------
    pathlib.Path
        ``run/index.html``. Beside it, ``run/figures/*.png`` are written anew; pictures of an earlier report go.

    Raises
    ------
    InputError
        If a file of the run is missing or malformed.
    """
    data = read_run(Path(run))
    folder = data.path / "figures"
    folder.mkdir(exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    html = _render(data, folder)
    page = data.path / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _render(run: Run, folder: Path) -> str:
    """Compute and draw the sections of the page; one without data is empty or None."""
    colours = style.colours(run.estimators)
    with ThreadPoolExecutor(2) as pool:
        # Frames are drawn beside the figures: most of their time is spent outside Python.
        cards = pool.submit(draw_gallery, run.gallery, colours, folder)
        figures = FigureFiles(folder, pool)

        # Errors over one quantity and over two, and against their laws.
        curves = line_figures(run)
        lines = [(curve, figures.draw(curve.key, [line_chart(curve, colours)])[0]) for curve in curves]
        relief = [*relief_figures(run, colours), *glint_figures(run), *visible_figures(run)]
        for each in relief:
            figures.draw(each.chart.key, [each.chart])
        paper, results = paper_section(run, colours, figures), law_results(run)
        laws = figures.draw("laws", law_charts(results)) if is_tested(results) else []
        maps = heat_maps(run)[:_MAX_HEAT_MAPS]
        heat = figures.draw("heatmap", heat_charts(maps)) if maps else []

        # What runs over anatomies show beside, and those without any curve.
        surfaces = surface_errors(run, has_figures=bool(curves or maps or paper or relief))
        boxes = figures.draw("anatomy", [surface_chart(surfaces, colours)]) if surfaces and surfaces.boxes else []
        study = read_study() if is_anatomical(run) else None
        fineness = figures.draw("fineness", fineness_charts(study)) if study else []
        view, still = view_3d(run, colours), ""
        if view is not None:
            picture = view_picture(view)
            figures.write(view.key, picture)
            figures.json[view.key] = view_json(view)
            still = pixels.data_address(picture)

        headline = sentences.headline(run, curves)
        headline += ([paper.headline] if paper else []) + ([sentence(results)] if laws else [])
        summary = run.experiments.get(run.experiment) or ExperimentSummary()
        template = environment().get_template("run.html.j2")
        return template.render(
            run=run, title=summary.title or run.experiment, description=summary.description, headline=headline,
            paper=paper, laws=laws, law_results=results, law_colours=law_colours(results),
            lines=[(curve, chart, sentences.measured(curve)) for curve, chart in lines],
            relief=relief,
            heat=[(chart, sentences.heat_line(item)) for chart, item in zip(heat, maps, strict=True)],
            surfaces=surfaces, boxes=boxes, coverage=coverage(run), study=study, fineness=fineness, pairs=pairs(run),
            gallery=cards.result(), first=_FIRST_CARDS, isophotes=isophote_keys(run.gallery), truth_colour=style.TRUTH,
            view=view, still=still, summary=table_rows(run), columns=HEADINGS,
            length_units=" or ".join(dict.fromkeys(item.meta.length_unit for item in run.gallery)) or "mm",
            colours={name: colours[name] for name in style.estimator_order(colours)},
            figures=figures.packed(), plotly=chart_web.packed_plotly() if figures.json else None,
        )  # fmt: skip
