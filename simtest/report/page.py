"""Writes the page of a run: figures as PNG, and one HTML file that needs nothing else."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from simtest.pages import chart_png, chart_web, pixels, style
from simtest.pages.chart import Chart
from simtest.pages.html import environment
from simtest.report import sentences
from simtest.report.coverage import Coverage, coverage, is_anatomical
from simtest.report.error_laws import LawResult, law_results, sentence
from simtest.report.figure_files import FigureFiles
from simtest.report.gallery import draw_gallery, isophote_keys
from simtest.report.heat_maps import heat_charts, heat_maps
from simtest.report.law_charts import law_charts, law_colours
from simtest.report.pairs import Pair, pairs
from simtest.report.paper.paper_section import PaperSection, paper_section
from simtest.report.run_folder import Run, read_run
from simtest.report.series import LineFigure, line_chart, line_figures
from simtest.report.summary_table import COLUMNS, TableRow, table_rows
from simtest.report.surface_errors import SurfaceErrors, surface_chart, surface_errors
from simtest.report.triangle_cost import Fineness, fineness_charts, read_study
from simtest.report.view3d import View3D, view_3d, view_json, view_picture
from simtest.runtime.files import write_atomically

_FIRST_CARDS, _MAX_HEAT_MAPS = 9, 18


@dataclass(frozen=True)
class LineSection:
    """A figure of curves with its chart and its numbers in words."""

    figure: LineFigure
    chart: Chart
    measured: list[str]


@dataclass(frozen=True)
class LawsSection:
    """The laws with their colours by name, and their charts."""

    results: list[LawResult]
    colours: dict[str, str]
    charts: list[Chart]

    @property
    def headline(self) -> str:
        """How many laws are met."""
        return sentence(self.results)


@dataclass(frozen=True)
class FinenessSection:
    """The study of what triangles cost, and its charts."""

    study: Fineness
    charts: list[Chart]


@dataclass(frozen=True)
class Content:
    """What the page's template shows of a run, section by section; a section without data is empty or None."""

    headline: list[str]
    paper: PaperSection | None
    laws: LawsSection | None
    lines: list[LineSection]
    heat: list[tuple[Chart, str]]
    surfaces: SurfaceErrors | None
    boxes: Chart | None
    coverage: Coverage | None
    fineness: FinenessSection | None
    pairs: list[Pair]
    view: View3D | None
    view_picture: str
    summary: list[TableRow]


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
    colours = style.colours(run.estimators)
    with ThreadPoolExecutor(2) as pool, chart_png.settings():
        # Frames are drawn beside the figures: most of their time is spent outside Python.
        cards = pool.submit(draw_gallery, run.gallery, colours, folder)
        figures = FigureFiles(folder, pool)
        content = _content(run, colours, figures)
        gallery, packed = cards.result(), figures.packed()
    experiment = run.experiments.get(run.experiment)
    return environment().get_template("run.html.j2").render(
        experiment=run.experiment,
        title=experiment.title if experiment and experiment.title else run.experiment,
        description=experiment.description if experiment else "",
        gallery=gallery,
        gallery_total=run.gallery_total,
        first=_FIRST_CARDS,
        length_units=" or ".join(dict.fromkeys(item.meta.length_unit for item in run.gallery)) or "mm",
        provenance=run.provenance,
        columns=[heading for _, heading in COLUMNS],
        colours={name: colours[name] for name in style.estimator_order(colours)},
        truth_colour=style.TRUTH,
        isophotes=isophote_keys(run.gallery),
        figures=packed,
        plotly=chart_web.packed_plotly() if figures.json else None,
        **vars(content),
    )  # fmt: skip


def _content(run: Run, colours: Mapping[str, str], figures: FigureFiles) -> Content:
    """Compute and draw the sections of the page."""
    curves = line_figures(run)
    lines = [LineSection(curve, line_chart(curve, colours), sentences.measured(curve)) for curve in curves]
    for section in lines:
        figures.add(section.figure.key, [section.chart])
    paper, laws = paper_section(run, colours, figures), _laws(run, figures)
    maps = heat_maps(run)[:_MAX_HEAT_MAPS]
    heat = heat_charts(maps) if maps else []
    if heat:
        figures.add("heatmap", heat)
    surfaces = surface_errors(run, has_figures=bool(lines or maps or paper))
    boxes = surface_chart(surfaces, colours) if surfaces and surfaces.boxes else None
    if boxes:
        figures.add("anatomy", [boxes])
    view = view_3d(run, colours)
    more = [section.headline for section in (paper, laws) if section]
    return Content(
        headline=[*sentences.headline(run, curves), *more],
        paper=paper,
        laws=laws,
        lines=lines,
        heat=[(chart, sentences.heat_line(item)) for chart, item in zip(heat, maps, strict=True)],
        surfaces=surfaces,
        boxes=boxes,
        coverage=coverage(run),
        fineness=_fineness(figures) if is_anatomical(run) else None,
        pairs=pairs(run),
        view=view,
        view_picture=_still(view, figures) if view else "",
        summary=table_rows(run),
    )


def _laws(run: Run, figures: FigureFiles) -> LawsSection | None:
    results = law_results(run)
    if not any(result.settings for result in results):
        return None
    section = LawsSection(results, law_colours(results), law_charts(results))
    figures.add("laws", section.charts)
    return section


def _fineness(figures: FigureFiles) -> FinenessSection:
    study = read_study()
    section = FinenessSection(study, fineness_charts(study))
    figures.add("fineness", section.charts)
    return section


def _still(view: View3D, figures: FigureFiles) -> str:
    """Draw the 3D view, and return the picture that stands in where a browser draws no 3D."""
    picture = view_picture(view)
    figures.write(view.key, picture)
    figures.json[view.key] = view_json(view)
    return pixels.data_address(picture)
