"""Writes the page of a run: figures as PNG, and one HTML file that needs nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from simtest.pages import style
from simtest.pages.html import environment, packed_plotly, picture
from simtest.report import labels as words
from simtest.report import static
from simtest.report import triangle_cost as fineness
from simtest.report.coverage import coverage, is_anatomical
from simtest.report.gallery import isophote_colour, isovalues
from simtest.report.laws.section import laws_section
from simtest.report.pairs import pairs
from simtest.report.paper.section import paper_section
from simtest.report.run_folder import Run, read_run
from simtest.report.series import LineFigure, line_figures
from simtest.report.surface3d import surface_3d
from simtest.report.tables import SUMMARY_COLUMNS, heat_maps, summary_rows, surface_figure
from simtest.runtime.files import write_atomically

_IMAGE_BUDGET = 1_350_000
_FIRST = 9
_MAX_HEAT_MAPS = 18


def write_report(run: Path) -> Path:
    """Write the figures and the page of a run.

    Parameters
    ----------
    run : pathlib.Path
        Run directory with results.parquet, summary.json and, if there is one, gallery/*.npz.

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
    colours = style.colours(data.estimators)
    if folder.is_dir():
        for old in folder.glob("*.png"):
            old.unlink()
    with static.settings():
        sections, charts = _sections(data, colours, folder)
    html = _render(data, colours, sections, charts)
    page = data.path / "index.html"
    write_atomically(page, lambda part: part.write_text(html, encoding="utf-8"))
    return page


def _sections(run: Run, colours: Mapping[str, str], folder: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Draw everything once: PNG files as a side effect, the page's parts and its plotly figures as the value."""
    from simtest.report import interactive

    charts: dict[str, str] = {}
    lines = line_figures(run)
    for figure in lines:
        static.save(static.draw_lines(figure, colours), folder / f"{figure.key}.png")
        charts[figure.key] = interactive.to_json(interactive.lines(figure, colours))
    sections: dict[str, Any] = {"headline": words.headline(run, lines), "lines": [_line_section(f) for f in lines]}
    published = paper_section(run, colours, folder, picture)
    if published:
        sections["paper"] = published[0]
        sections["headline"].append(published[0]["headline"])
        charts |= published[1]
    laws = laws_section(run, folder)
    if laws:
        sections["laws"] = laws[0]
        sections["headline"].append(laws[0]["headline"])
        charts |= laws[1]
    maps = heat_maps(run)[:_MAX_HEAT_MAPS]
    if maps:
        static.save(static.draw_heat_maps(maps, colours), folder / "heatmap.png")
        for i, item in enumerate(maps):
            charts[f"heatmap_{i}"] = interactive.to_json(interactive.heat_map(item, maps))
        sections["heat"] = [
            {"key": f"heatmap_{i}", "title": f"{m.estimator}, {m.label}", "line": words.heat_line(m)}
            for i, m in enumerate(maps)
        ]
    surfaces = surface_figure(run, has_figures=bool(lines or maps or published))
    if surfaces:
        sections["surfaces"] = surfaces
        if surfaces.boxes:
            static.save(static.draw_surfaces(surfaces, colours), folder / "anatomy.png")
            charts["anatomy"] = interactive.to_json(interactive.surfaces(surfaces, colours))
    sections["coverage"] = coverage(run)
    if is_anatomical(run):
        sections["fineness"] = _fineness_section(folder, charts)
    sections["pairs"] = pairs(run)
    paths = static.draw_gallery(run.gallery, colours, folder)
    sections["gallery"] = _gallery_section(run, paths)
    view = surface_3d(run)
    if view:
        path = static.save(static.draw_surface_3d(view, colours), folder / "surface3d.png", 110)
        charts["surface3d"] = interactive.to_json(interactive.surface_3d(view, colours))
        curved = view.curvature is not None
        sections["view"] = {"title": view.title, "unit": view.unit, "curved": curved, "picture": picture(path, 120_000)}
    return sections, charts


def _line_section(figure: LineFigure) -> dict[str, Any]:
    marks = style.symbols(figure.labels)
    return {
        "key": figure.key,
        "title": figure.title,
        "about": figure.about,
        "measured": words.measured(figure),
        "marks": [(marks[label].text, label) for label in figure.labels] if len(figure.labels) > 1 else [],
        "binned": any(not curve.joined for curve in figure.curves),
    }


def _fineness_section(folder: Path, charts: dict[str, str]) -> dict[str, Any]:
    from simtest.report import interactive

    study = fineness.read_study()
    static.save(fineness.draw(study), folder / "fineness.png")
    charts["fineness"] = interactive.to_json(fineness.interactive(study))
    marks = style.symbols(study.surfaces)
    return {
        "distance": study.distance_mm, "exponent": study.exponent, "sentence": study.sentence(),
        "marks": [(marks[name].text, name) for name in study.surfaces],
    }  # fmt: skip


def _gallery_section(run: Run, paths: Sequence[Path]) -> list[dict[str, Any]]:
    share = _IMAGE_BUDGET // max(len(paths), 1)
    return [
        {**words.gallery_caption(item), "picture": picture(path, min(share, 130_000)), "file": path.name}
        for item, path in zip(run.gallery, paths, strict=True)
    ]


def _render(run: Run, colours: Mapping[str, str], sections: Mapping[str, Any], charts: Mapping[str, str]) -> str:
    from markupsafe import Markup

    content = run.experiments.get(run.experiment) or {}
    template = environment().get_template("template.html.j2")
    return template.render(
        experiment=run.experiment,
        title=content.get("title") or run.experiment,
        description=content.get("description") or "",
        headline=sections["headline"],
        lines=sections["lines"],
        paper=sections.get("paper"),
        heat=sections.get("heat", []),
        surfaces=sections.get("surfaces"),
        coverage=sections["coverage"],
        fineness=sections.get("fineness"),
        laws=sections.get("laws"),
        pairs=sections["pairs"],
        gallery=sections["gallery"],
        gallery_total=run.gallery_total,
        first=_FIRST,
        view=sections.get("view"),
        summary=summary_rows(run),
        columns=[heading for _, heading in SUMMARY_COLUMNS],
        length_units=" or ".join(dict.fromkeys(item.length_unit for item in run.gallery)) or "mm",
        provenance=words.provenance_rows(run),
        colours={name: colours[name] for name in style.estimator_order(colours)},
        truth_colour=style.TRUTH,
        isophotes=[(t, style.hexadecimal(isophote_colour(t))) for t in isovalues(run.gallery)],
        charts={key: Markup(text) for key, text in charts.items()},
        plotly=packed_plotly() if charts else None,
    )
