"""The page of the published protocol: figures hold the rows' numbers, verdicts are computed from them."""

import io
import json
import re

import numpy as np
import polars as pl
import pytest
from PIL import Image

from simtest.pages import style
from simtest.pages.charts import png
from simtest.report import write_report
from simtest.report.error_figures import line_figures
from simtest.report.paper.pictures import KAPPA, OFFSET_LIGHT, isocurve_figure, stages
from simtest.report.paper.statements import (
    ABSENT,
    AGREES,
    DIFFERS,
    FEW,
    PART,
    fit_line,
    offset_inside_window,
    statements,
)
from simtest.report.paper.sweeps import BOUND_NAME, DEFAULTS, LAW_NAME, PARAMETERS, sweep_chart, sweep_figures
from simtest.report.run_folder import read_run
from simtest.spec import Experiment
from simtest.validation.runner import run_experiment
from tests.isocurve_formulas import cosine_beta

COLOURS = {"circle_pose": "#B15912", "cone_axis": "#166B90"}


MEANS = {
    "sigma": {0.0: 0.2, 0.05: 0.4, 0.1: 0.8},
    "theta_deg": {10.0: 0.5, 58.0: 1.0, 80.0: 3.0},
    "exponent": {30.0: 0.4, 75.0: 0.85, 120.0: 1.3},
    "isovalue": {0.05: 0.8, 0.5: 0.3, 0.8: 0.7},
    "eps": {0.0: 1.0, 200.0: 1.02, 800.0: 3.0},
}
"""Means of a run that agrees with the article in everything, deg."""


GROWS = "the mean error grows with the noise"
BELOW = "the mean stays below 1.25° throughout to 10\u00a0%"
SLOPE = "about linear, slope about 10⁻² degrees per unit"


def rows_of(label, name, means, fixed=None, count=40, failures=0, estimator="circle_pose", law=None, spread=0.1):
    rng = np.random.default_rng(len(label) + len(name))
    rows = []
    for x, mean in means.items():
        errors = rng.uniform(1 - spread, 1 + spread, count) if spread else np.ones(count)
        for i, error in enumerate(errors / errors.mean() * mean):
            ok = i >= failures
            setting = {**DEFAULTS, **(fixed or {}), name: x}
            rows.append(
                {
                    "experiment": "planted", "label": label, "surface": "published plane", "realisation": i,
                    "setting": f"{label}, {name}={x}", "specularity": 0, "true_id": 0, "estimator": estimator,
                    "status": "ok" if ok else "no_closed_isophote", "error_deg": 100 - error if ok else None,
                    "error_oracle_deg": float(error) if ok else None, "bound_deg": mean / 5,
                    "error_law_deg": law(x) if law else None, "kd_min": None, "kd_max": None, "eps_over_d": None,
                    **{f"paper.{key}": value for key, value in setting.items()},
                }
            )  # fmt: skip
    return rows


def planted(means=MEANS, **more):
    fixed = {"eps": {"exponent": 100.0}}
    return [row for name, values in means.items() for row in rows_of(name, name, values, fixed.get(name), **more)]


def run_of(path, rows):
    path.mkdir(parents=True, exist_ok=True)
    pl.DataFrame(rows, infer_schema_length=None).write_parquet(path / "results.parquet")
    (path / "summary.json").write_text(json.dumps({"run": {}, "experiments": {"planted": {"settings": {}}}}))
    return read_run(path)


def judged(path, rows):
    return {row.claim: row for row in statements(sweep_figures(run_of(path, rows)))}


def test_figure_1_is_the_formulas():
    figure = isocurve_figure()
    assert figure.inner == pytest.approx(0.44387, abs=5e-6)
    assert figure.outer == pytest.approx(2.25293, abs=5e-6)
    ring = {branch.is_isophote: np.hypot(*branch.points.T) for branch in figure.together}
    np.testing.assert_allclose(ring[True], figure.inner)
    np.testing.assert_allclose(ring[False], figure.outer)
    np.testing.assert_allclose(figure.inner_of_kappa, np.tan(np.arccos(np.sqrt(1 - figure.kappa)) / 2))
    np.testing.assert_allclose(figure.inner_of_kappa * figure.outer_of_kappa, 1)
    assert [branch.is_isophote for branch in figure.apart] == [True, False]
    for branch in figure.apart:
        cosine = cosine_beta(branch.points, np.array(OFFSET_LIGHT), np.array([0.0, 0.0, 1.0]))
        sign = 1 if branch.is_isophote else -1
        np.testing.assert_allclose(cosine, sign * np.sqrt(1 - KAPPA), atol=1e-4)


def test_error_plots_hold_the_rows(tmp_path):
    rows = planted(failures=3) + rows_of("noise", "sigma", MEANS["sigma"], estimator="cone_axis")
    figures = sweep_figures(run_of(tmp_path, rows))
    assert [figure.parameter.name for figure in figures] == ["sigma", "theta_deg", "exponent", "isovalue", "eps"]
    table = pl.DataFrame(rows, infer_schema_length=None)
    for figure in figures:
        name = figure.parameter.name
        sweep = figure.sweeps[-1] if name == "sigma" else figure.sweeps[0]
        for i, x in enumerate(sweep.x):
            own = table.filter((pl.col("estimator") == sweep.estimator) & (pl.col("label") == sweep.label))
            errors = own.filter(pl.col(f"paper.{name}") == x)["error_oracle_deg"].drop_nulls().to_numpy()
            wanted = [errors.mean(), errors.std(ddof=1), errors.min(), errors.max(), len(errors)]
            got = [getattr(sweep, k)[i] for k in ("mean", "std", "least", "largest", "answered")]
            np.testing.assert_allclose(got, wanted)
            assert sweep.bound[i] == pytest.approx(MEANS[name][x] / 5)
            assert sweep.failed[i] == 40 - len(errors)
    assert [sweep.estimator for sweep in figures[0].sweeps] == ["circle_pose", "cone_axis"]
    assert "no_closed_isophote 3" in figures[1].sweeps[0].reasons


def test_a_chart_holds_bars_bound_law_and_failures(tmp_path):
    rows = rows_of("slant", "theta_deg", MEANS["theta_deg"], failures=5, law=lambda x: 0.01 * x)
    (figure,) = sweep_figures(run_of(tmp_path, rows))
    (sweep,) = figure.sweeps
    chart = sweep_chart(figure, COLOURS)
    upper, lower = chart.panels
    thin, thick, means = (mark for mark in upper.marks if mark.name == "circle_pose: slant")
    np.testing.assert_allclose(thin.bars[:2], [sweep.least, sweep.largest])
    np.testing.assert_allclose(thick.bars.high - sweep.mean, sweep.std)
    assert thick.bars.width > 3 * thin.bars.width
    np.testing.assert_allclose(means.y, sweep.mean)
    named = {mark.name: mark for mark in upper.marks}
    np.testing.assert_allclose(named[BOUND_NAME].y, sweep.bound)
    np.testing.assert_allclose(named[LAW_NAME].y, 0.01 * sweep.x)
    (failures, *_) = (mark for mark in lower.marks if len(mark.words))
    assert list(failures.words) == ["5"] * 3
    assert failures.bold
    assert "5 of 40 failed: no_closed_isophote 5" in failures.hover[0]
    with Image.open(io.BytesIO(png([chart]))) as file:
        picture = np.asarray(file.convert("RGB"))
    # Ink of the curve, of the bound and of the failures.
    for colour in (COLOURS["circle_pose"], "#8A6D00", "#D03030"):
        assert (np.abs(picture.astype(int) - style.rgb(colour)).max(axis=-1) < 8).sum() > 20, colour


def test_a_run_that_agrees_gets_agrees(tmp_path):
    found = judged(tmp_path, planted())
    assert [row.verdict for row in found.values()] == [AGREES] * 8, found
    assert "(10.00 ± " in found[SLOPE].measured


COUNTER_EXAMPLES = [
    ("sigma", {0.0: 0.9, 0.05: 0.4, 0.1: 0.8}, GROWS),
    ("sigma", {0.0: 0.2, 0.05: 0.4, 0.1: 1.3}, BELOW),
    ("theta_deg", {0.0: 6.6, 58.0: 0.4, 80.0: 0.8}, "strong growth of the error with the slant"),
    ("theta_deg", {10.0: 0.5, 58.0: 1.0, 80.0: 7.0}, "the maximum stays below 7°"),
    ("exponent", {30.0: 0.4, 75.0: 0.55, 120.0: 0.7}, SLOPE),
    ("exponent", {30.0: 0.4, 75.0: 0.85, 120.0: 1.74}, "never above 1.75°"),
    ("isovalue", {0.05: 0.8, 0.3: 0.2, 0.5: 0.3, 0.8: 0.7}, "U-shaped, minimum at 0.5 to 0.6"),
    ("isovalue", {0.05: 0.1, 0.5: 0.3, 0.8: 0.7}, "U-shaped, minimum at 0.5 to 0.6"),
    ("eps", {0.0: 1.0, 200.0: 1.5, 800.0: 3.0}, "stable up to ε = 200"),
]


@pytest.mark.parametrize(("name", "means", "claim"), COUNTER_EXAMPLES)
def test_a_planted_counter_example_differs_and_is_explained(tmp_path, name, means, claim):
    found = judged(tmp_path, planted({**MEANS, name: means}))
    assert found[claim].verdict == DIFFERS, found[claim]
    assert found[claim].because.count(".") >= 2
    assert {row.verdict for key, row in found.items() if key != claim and row.sweep != found[claim].sweep} == {AGREES}


def test_statements_need_the_articles_settings_and_method(tmp_path):
    rows = rows_of("noise", "sigma", MEANS["sigma"], {"exponent": 70.0})
    rows += rows_of("slant", "theta_deg", MEANS["theta_deg"], estimator="cone_axis")
    assert {row.verdict for row in judged(tmp_path / "other", rows).values()} == {ABSENT}
    wider = rows_of("noise", "sigma", MEANS["sigma"], {"smoothing_px": 5.0})
    assert judged(tmp_path / "wider", wider)[GROWS].verdict == AGREES


def test_equal_errors_whose_mean_is_rounded_are_drawn(tmp_path):
    """The mean of 100 times 0.51286693750636 is not quite that: a bar of negative length would be refused."""
    errors = {2.0: 0.2357, 3.0: 0.51286693750636}
    rows = rows_of("quiet", "smoothing_px", errors, {"sigma": 0.0}, count=100, spread=0)
    rows = [row | {"error_oracle_deg": errors[row["paper.smoothing_px"]]} for row in rows]
    (figure,) = (f for f in sweep_figures(run_of(tmp_path, rows)) if f.parameter.name == "smoothing_px")
    (sweep,) = figure.sweeps
    assert (sweep.least <= sweep.mean).all()
    assert (sweep.mean <= sweep.largest).all()


def test_one_realisation_is_too_few_to_judge_by(tmp_path):
    rows = judged(tmp_path, planted(count=1, spread=0))
    assert [(rows[claim].verdict, rows[claim].because) for claim in (GROWS, SLOPE)] == [(FEW, "")] * 2
    assert rows[BELOW].verdict == AGREES


def test_part_of_the_range_is_not_the_claim(tmp_path):
    """What holds in part may fail in the rest; what fails in part fails."""
    part = {"sigma": {0.0: 0.2, 0.01: 0.3}, "theta_deg": {40.0: 0.5, 58.0: 0.9}, "exponent": {30.0: 0.4, 40.0: 0.5}}
    rows = judged(tmp_path / "part", planted(part))
    assert {row.verdict for row in rows.values()} == {PART, ABSENT}
    high = rows_of("sigma", "sigma", {0.0: 1.1, 0.01: 1.4})
    assert judged(tmp_path / "high", high)[BELOW].verdict == DIFFERS


def test_the_slopes_explanation_is_computed(tmp_path):
    rows = rows_of("n", "exponent", {30.0: 0.4, 75.0: 0.55, 120.0: 0.7}, law=lambda n: 0.0025 * n)
    reason = judged(tmp_path, rows)[SLOPE].because
    assert "0.0025° per unit is predicted at this run's s = 3 px" in reason
    assert "about 6 px" in reason


def test_limits_are_judged(tmp_path):
    root = {s: 30 * s**0.5 for s in (0.002, 0.01, 0.05)}
    failing = rows_of("foot", "eps", {0.0: 1.0, 160.0: 1.0}, {"exponent": 100.0, "recentre": False})
    failing += rows_of("foot", "eps", {400.0: 20.0}, {"exponent": 100.0, "recentre": False}, failures=30)
    quiet = {"sigma": 0.0, "isovalue": 0.5}
    rows = rows_of("slant 0", "sigma", root, {"theta_deg": 0.0}) + failing
    rows += rows_of("smooth", "smoothing_px", {1.0: 0.06, 4.0: 0.9}, quiet, spread=0, law=lambda s: 0.055 * s**2)
    found = [row for row in judged(tmp_path / "met", rows).values() if row.verdict != ABSENT]
    assert [row.verdict for row in found] == [AGREES] * 3
    assert found[0].measured.startswith("slope 0.500 ± ")
    assert "30 of 40 at 400" in found[1].measured
    assert "0.06/0.055" in found[2].measured
    linear = {s: 30 * s for s in root}
    early = rows_of("foot", "eps", {0.0: 1.0, 160.0: 1.0}, {"exponent": 100.0, "recentre": False}, failures=1)
    rows = rows_of("slant 0", "sigma", linear, {"theta_deg": 0.0}) + early
    rows += rows_of("smooth", "smoothing_px", {1.0: 0.06, 4.0: 0.9}, quiet, spread=0, law=lambda s: 0.04 * s**2)
    found = [row for row in judged(tmp_path / "missed", rows).values() if row.verdict != ABSENT]
    assert [row.verdict for row in found] == [DIFFERS] * 3


def test_line_and_window():
    fitted = fit_line(np.array([0.0, 1.0, 2.0, 3.0]), np.array([1.0, 3.0, 5.0, np.nan]), np.full(4, 0.1))
    assert fitted.slope == pytest.approx(2)
    assert fitted.error == pytest.approx(0.1 / np.sqrt(2))
    assert fitted.worst == pytest.approx(0, abs=1e-12)
    setting = {"isovalue": 0.1, "exponent": 100.0, "height": 1000.0, "size": 406}
    assert offset_inside_window(setting) == pytest.approx(183, abs=1)
    assert offset_inside_window({**setting, "size": 100}) == 0


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    settings = {"paper.size": 128, "paper.height": 315.0, "paper.isovalue": 0.3}
    groups = [
        {"scene": "published", "label": "noise", "set": settings, "sweep": [{"paper.sigma": [0.0, 0.05]}]},
        {"scene": "published", "label": "steep", "set": {**settings, "paper.theta_deg": 89.0}},
        {"scene": "published", "label": "offset", "set": {**settings, "paper.eps": 60.0}},
        {"scene": "published", "label": "defaults"},
    ]
    experiment = Experiment(name="small", realisations=4, groups=groups, estimators=("circle_pose", "cone_axis"))
    return run_experiment(experiment, tmp_path_factory.mktemp("paper_page"))


def test_the_pages_sections_and_files(small):
    html = write_report(small.folder, charts=True).read_text(encoding="utf-8")
    sections = set(re.findall(r'<(?:section|details)[^>]* id="(\w+)"', html))
    assert {"statements", "isocurves", "pipeline", "error_vs_paper_sigma", "gallery"} <= sections
    assert not {"error_vs_curvature", "surfaces"} & sections
    files = {file.name for file in (small.folder / "figures").iterdir()}
    assert {"isocurves.png", "pipeline.png", "error_vs_paper_sigma.png", "gallery_000.png"} <= files
    assert line_figures(read_run(small.folder)) == []
    assert set(PARAMETERS) == set(DEFAULTS)


def test_the_kept_realisation_is_that_of_its_row(small):
    run = read_run(small.folder)
    assert {item.meta.label for item in run.gallery} == {"noise", "steep", "offset", "defaults"}
    shown = stages(run)
    assert shown.is_default
    row = small.results.filter((pl.col("label") == "defaults") & (pl.col("estimator") == "circle_pose")).row(
        0, named=True
    )
    assert min(shown.errors_deg) == pytest.approx(row["error_oracle_deg"], abs=1e-9)
    assert shown.smoothed.max() == pytest.approx(1, abs=2e-3)
    assert shown.clean.shape == shown.noisy.shape == shown.smoothed.shape
    assert np.std(shown.noisy - shown.clean) == pytest.approx(0.05, rel=0.05)
    centre = np.mean(shown.ellipse[:-1], axis=0)
    assert shown.extent[0] < centre[0] < shown.extent[1]
    for item in run.gallery:
        (true,) = item.meta.truth
        np.testing.assert_allclose(item.camera.project(np.array(true.position)), true.bp_px)
        on_plane = item.position[np.isfinite(item.position).all(axis=-1)]
        np.testing.assert_allclose((on_plane - true.position) @ true.normal, 0, atol=1e-2)
        failed = item.meta.estimates[0].status != "ok"
        assert failed == (item.meta.label == "steep")


def test_the_printed_command_makes_the_realisation_again(small, capsys):
    run = read_run(small.folder)
    item = next(item for item in run.gallery if item.meta.label == "offset")
    code = re.fullmatch(r'python -c "(.*)"', item.meta.command).group(1)
    exec(code.replace("print(", "made = (", 1), space := {})
    np.testing.assert_allclose(space["made"]["circle_pose"][0].normal, item.meta.estimates[0].normals[0], atol=1e-12)


def test_another_setting_is_shown_where_no_default_was_run(small, tmp_path):
    rows = small.results.filter(pl.col("label") != "defaults")
    run = run_of(tmp_path, rows.to_dicts())
    assert stages(run) is None
    (tmp_path / "gallery").mkdir()
    for file in sorted((small.folder / "gallery").glob("*.npz"))[:-1]:
        (tmp_path / "gallery" / file.name).write_bytes(file.read_bytes())
    shown = stages(read_run(tmp_path))
    assert not shown.is_default
    assert shown.status == "ok"


def test_a_run_without_an_answer_has_a_page(tmp_path):
    rows = planted({"sigma": MEANS["sigma"]}, failures=40)
    run_of(tmp_path, rows)
    html = write_report(tmp_path).read_text(encoding="utf-8")
    assert "not in this run" in html
    assert "40 of 40" in html
