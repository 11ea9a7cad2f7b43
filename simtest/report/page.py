"""Draws the page of a run: figures as PNG, and one HTML file that needs nothing else."""

import itertools
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from simtest.estimators.names import DESCRIPTIONS
from simtest.pages import style
from simtest.pages.charts import embedded, packed
from simtest.pages.html import environment
from simtest.report import sentences
from simtest.report.error_figures import LineFigure, heat_charts, heat_maps, line_chart, line_figures
from simtest.report.error_laws import is_tested, law_charts, law_colours, law_results, sentence
from simtest.report.figure_files import THREADS, FigureFiles
from simtest.report.gallery import Shown, draw_shown, file_name, isophote_keys
from simtest.report.glint_figures import glint_figures
from simtest.report.guide_text import MOST_ANSWERS, answers, guide_content
from simtest.report.paper.paper_section import paper_section
from simtest.report.relief_figures import ReliefFigure, motion_figures, relief_figures, visible_figures
from simtest.report.run_folder import Run
from simtest.report.scene3d import framed, kept_scene
from simtest.report.tables import HEADINGS, coverage, pairs, surface_chart, surface_errors, table_rows
from simtest.report.write import Progress
from simtest.validation.kept_frames import KeptItem

_FIRST_CARDS, _MAX_HEAT_MAPS = 9, 18


def draw_page(
    run: Run, folder: Path, progress: Progress | None = None, charts: bool = False
) -> tuple[str, dict[str, str], int]:
    """Draw the frames of a run, and its charts where asked for, into files of a folder, which must exist.

    Returns
    -------
    (str, dict of str to str, int)
        The page; the SHA-256 of each figure by file name, of which those of an earlier report go; and the steps that
        `progress` was told of, with the last one, writing the page, still to do.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        figures = FigureFiles(folder, pool, progress, charts)
        # Stages: describe the sections, draw them, fill in the page.
        sections = _sections(run, figures)
        figures.finish()
        figures.tell("writing the page")
        return _render(run, sections, figures), figures.hashes, len(figures.work) + 1


def _sections(run: Run, figures: FigureFiles) -> dict[str, Any]:
    """Compute the sections of the page by name, and start drawing them; one without data is empty or None."""
    colours = style.colours(run.estimators)
    # Frames are drawn beside the figures: most of their time is spent outside Python.
    cards = [
        figures.start(f"frame {index + 1}", _draw_frame, figures, index, item, colours)
        for index, item in enumerate(run.gallery)
    ]

    # Errors over one quantity and over two, and against their laws.
    figures.tell("comparing with the laws")
    curves = line_figures(run)
    relief = [*relief_figures(run, colours), *glint_figures(run), *visible_figures(run), *motion_figures(run)]
    shown = [*relief, *(_described(curve, colours) for curve in curves)]
    for each in shown:
        figures.draw(each.chart.key, [each.chart])
    paper, results = paper_section(run, colours, figures), law_results(run)
    laws = figures.draw("laws", law_charts(results)) if is_tested(results) else []
    maps = heat_maps(run)[:_MAX_HEAT_MAPS]
    heat = figures.draw("heatmap", heat_charts(maps)) if maps else []

    # What runs over anatomies show beside, and those without any curve.
    surfaces = surface_errors(run, has_figures=bool(curves or maps or paper or relief))
    boxes = figures.draw("anatomy", [surface_chart(surfaces, colours)]) if surfaces and surfaces.boxes else []
    view = kept_scene(run)
    frame, parts = framed(view.content, "curvature") if view else ("", [])

    headline = sentences.headline(run, curves)
    headline += ([paper.headline] if paper else []) + ([sentence(results)] if laws else [])
    return {
        "headline": headline, "paper": paper, "laws": laws, "law_results": results,
        "law_colours": law_colours(results),
        # The first one stands beside the answer, the others below it.
        "lead": shown[0] if shown else None, "shown": shown[1:],
        "heat": [(chart, sentences.heat_line(item)) for chart, item in zip(heat, maps, strict=True)],
        "surfaces": surfaces, "boxes": boxes,
        "coverage": coverage(run),
        "pairs": pairs(run), "cards": cards, "view": view, "frame": packed(frame), "parts": parts,
        "summary": table_rows(run),
        "colours": {name: colours[name] for name in style.estimator_order(colours)},
    }  # fmt: skip


def _described(curve: LineFigure, colours: Mapping[str, str]) -> ReliefFigure:
    """Return a figure of curves with its sentences."""
    caption = "Points are means over the realisations of a setting, bars their 95 % interval (over frames); dashes are "
    caption += "the law, which knows no noise."
    if curve.binned:
        caption += " Where one setting holds many highlights, points are bins of highlights."
    return ReliefFigure(line_chart(curve, colours), curve.about, tuple(sentences.measured(curve)), caption)


def guide_json(run: Run) -> dict[str, Any]:
    """Return the content of guide.json: which method to use, and where each breaks."""
    return guide_content(run.guide, DESCRIPTIONS | run.summary.estimators, run.summary.frames, run.experiment)


def _guide(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the guide's template needs of guide.json."""
    groups = itertools.groupby(content["rows"], lambda row: row["circumstances"])
    # Under a name of its own: a template's `methods` would be anyone's.
    guide = {**content, "groups": [(circumstances, list(rows)) for circumstances, rows in groups]}
    return {"guide": guide, "answers": answers(content), "most_answers": MOST_ANSWERS}


def _draw_frame(figures: FigureFiles, index: int, item: KeptItem, colours: Mapping[str, str]) -> Shown:
    shown, content = draw_shown(item, colours)
    figures.write(file_name(index), content)
    return shown


def _render(run: Run, sections: Mapping[str, Any], figures: FigureFiles) -> str:
    """Fill in the page's template."""
    summary = run.summary
    return environment().get_template("run.html.j2").render(
        {
            **sections,
            "run": run, "title": summary.title or run.experiment, "description": summary.description,
            "realism": summary.realism, "meshes": summary.meshes, "faults": summary.faults,
            "gallery": [card.result() for card in sections["cards"]],
            "first": _FIRST_CARDS, "isophotes": isophote_keys(run.gallery), "truth_colour": style.TRUTH,
            "columns": [*HEADINGS.values()], "chart_files": figures.chart_files, **_guide(guide_json(run)),
            "length_units": " or ".join(dict.fromkeys(item.meta.length_unit for item in run.gallery)) or "mm",
            **embedded(figures.charts),
        }
    )  # fmt: skip
