"""Figures of the errors on a relief, over made-up rows whose means and distribution are known."""

import json

import numpy as np
import polars as pl
import pytest
from scipy import stats

from simtest.report import write_report
from simtest.report.relief_figures import KD, relief_figures
from simtest.report.run_folder import Run, completed
from simtest.spec import load_experiment
from simtest.validation.cases import expand

COLOURS = {"cone_axis": "#0072B2", "curved": "#56B4E9"}
SLOPE = "surface.relief.bands.0.slope_deg"
FACTOR = np.sqrt(np.pi / 2)


def made(estimator, label, setting, slope, count=40, fine=0.1, kd=(0.0, 0.0), seed=0, law=True, **swept):
    """Rows of one setting: errors against the base are Rayleigh's, those against the fine surface constant."""
    base = slope * np.sqrt(-2 * np.log(1 - (np.arange(count) + 0.5) / count))
    return [
        {
            "experiment": "relief", "label": label, "surface": label, "setting": setting, "realisation": i,
            "true_id": 0, "estimator": estimator, "status": "ok", "error_deg": fine, "error_oracle_deg": fine,
            "error_fine_deg": fine, "error_base_deg": float(base[i]), "kd_min": 1.0 + 0.3 * i, "kd_max": 3.0,
            "error_base_law_deg": FACTOR * slope if law else None, "kd_min_base": kd[0], "kd_max_base": kd[1], **swept,
        }
        for i in range(count)
    ]  # fmt: skip


def run_of(rows, tmp_path):
    return Run(tmp_path, completed(pl.DataFrame(rows, infer_schema_length=None)))


@pytest.fixture
def swept(tmp_path):
    """Slope swept on a plane, the radius on a cylinder, by two estimators; nothing answered at the slope of 1 deg."""
    rows = []
    for name in COLOURS:
        for slope in (2.0, 4.0, 8.0):
            rows += made(name, "plane", f"plane, slope {slope}", slope, **{SLOPE: slope})
        for radius, kd in ((20.0, 1.0), (10.0, 2.0)):
            rows += made(name, "cylinder", f"cylinder {radius}", 4.0, kd=(0.0, kd), **{"surface.radius_mm": radius})
        (answered,) = made(name, "plane", "plane, slope 1.0", 1.0, 1, **{SLOPE: 1.0})
        rows.append(answered | {"status": "missed", "error_base_deg": None})
    return run_of(rows, tmp_path)


def marks(figure):
    """By name and symbol: the marks of a figure's only panel."""
    return {(m.name, m.symbol) for m in figure.chart.panels[0].marks}, {
        (m.name, m.symbol): m for m in figure.chart.panels[0].marks
    }


def test_each_quantity_has_a_figure_and_a_radius_shows_as_curvature(swept):
    figures = relief_figures(swept, COLOURS)
    keys = [figure.chart.key for figure in figures]
    assert keys == ["relief_surface_relief_bands_0_slope_deg_plane", f"relief_{KD}_cylinder", "relief_distribution"]
    over_kd = marks(figures[1])[1]["cone_axis", "●"]
    np.testing.assert_allclose(over_kd.x, [1.0, 2.0])


def test_means_against_both_truths_stand_beside_the_dashed_law(swept):
    names, by_name = marks(relief_figures(swept, COLOURS)[0])
    assert names == {("law: 1.25 slopes", ""), *((name, s) for name in COLOURS for s in "●▲")}
    law = by_name["law: 1.25 slopes", ""]
    assert law.line == "dash"
    # A straight line through the settings, in many steps.
    np.testing.assert_allclose(np.interp([2.0, 3.0, 8.0], law.x, law.y), FACTOR * np.array([2.0, 3.0, 8.0]), rtol=1e-9)
    base, fine = by_name["cone_axis", "●"], by_name["cone_axis", "▲"]
    np.testing.assert_allclose(base.x, [2.0, 4.0, 8.0])
    np.testing.assert_allclose(base.y, FACTOR * np.array([2.0, 4.0, 8.0]), rtol=0.02)
    np.testing.assert_allclose(fine.y, 0.1)
    assert np.all(base.bars.low < base.y)
    assert np.all(base.bars.high > base.y)


def test_settings_at_one_value_are_one_point_whatever_their_numbers_of_rows(tmp_path):
    rows = []
    # 0.1 three times adds up to a little more than 0.3.
    for wave, count in ((1.0, 3), (2.0, 4)):
        for slope in (0.1, 0.2):
            swept = {SLOPE: slope, "surface.relief.bands.0.wavelength_mm": wave}
            rows += made("cone_axis", "plane", f"{slope}, {wave}", slope, count, **swept)
    mark = marks(relief_figures(run_of(rows, tmp_path), COLOURS)[0])[1]["cone_axis", "●"]
    np.testing.assert_allclose(mark.x, [0.1, 0.2])
    assert all(text.endswith(" of 7") for text in mark.hover)


def test_what_was_measured_is_told_with_what_gave_no_answer(swept):
    told = " ".join(relief_figures(swept, COLOURS)[0].measured)
    assert "cone_axis: 0.1° against the fine surface, 5.84° against the base, 0.998 of the law" in told
    assert "Nothing was answered at: plane, slope 1.0." in told
    assert "120 highlights" in told


def test_the_distribution_is_held_against_rayleigh(tmp_path):
    rng = np.random.default_rng(1)
    rows = made("cone_axis", "plane", "a", 3.0, 200) + made("cone_axis", "plane", "b", 6.0, 200)
    for row in rows:
        row["error_base_deg"] *= float(rng.uniform(0.5, 1.2))
    (figure,) = relief_figures(run_of(rows, tmp_path), COLOURS)
    values = np.array([row["error_base_deg"] / (row["error_base_law_deg"] / FACTOR) for row in rows])
    expected = stats.kstest(values, stats.rayleigh.cdf).statistic
    assert f"distance from Rayleigh {expected:.3g}" in figure.measured[0]
    assert f"mean {values.mean():.3g} slopes over 400 highlights" in figure.measured[0]
    law = next(m for m in figure.chart.panels[0].marks if m.name == "law: Rayleigh")
    np.testing.assert_allclose(law.y, stats.rayleigh.cdf(law.x), atol=1e-12)


def test_smooth_runs_and_those_of_older_versions_have_none(swept, tmp_path):
    smooth = swept.results.with_columns(error_base_deg=pl.col("error_fine_deg"), error_base_law_deg=pl.lit(None))
    assert relief_figures(Run(tmp_path, smooth), COLOURS) == []
    assert relief_figures(Run(tmp_path, swept.results.drop("error_base_deg")), COLOURS) == []
    assert relief_figures(Run(tmp_path, swept.results.clear()), COLOURS) == []


def test_a_relief_without_a_law_is_drawn_without_dashes(tmp_path):
    rows = [row for s in (2.0, 4.0) for row in made("cone_axis", "plane", f"{s}", s, law=False, **{SLOPE: s})]
    (figure,) = relief_figures(run_of(rows, tmp_path), COLOURS)
    assert marks(figure)[0] == {("cone_axis", "●"), ("cone_axis", "▲")}
    assert "of the law" not in " ".join(figure.measured)


def test_one_highlight_is_not_highlights(tmp_path):
    first, *rest = (row for s in (2.0, 4.0) for row in made("cone_axis", "plane", f"{s}", s, **{SLOPE: s}))
    run = run_of([first, *(row | {"status": "missed"} for row in rest)], tmp_path)
    texts = [text for figure in relief_figures(run, COLOURS) for text in figure.measured]
    assert any("1 highlight" in text for text in texts)
    assert all("1 highlights" not in text for text in texts)


def test_a_method_of_clouds_is_drawn_against_the_base_alone(tmp_path):
    """A method that reports the base's normal alone has no error against the fine surface."""
    rows = [row for s in (2.0, 4.0) for row in made("curved", "plane", f"{s}", s, **{SLOPE: s})]
    clouds = [row for s in (2.0, 4.0) for row in made("cone_axis", "plane", f"{s}", s, **{SLOPE: s})]
    rows += [row | {"error_fine_deg": None} for row in clouds]
    figure, *_ = relief_figures(run_of(rows, tmp_path), COLOURS)
    _, by_name = marks(figure)
    assert len(by_name["cone_axis", "▲"].x) + len(by_name["cone_axis", "●"].x) == 2
    assert any(text.startswith("cone_axis: – against the fine surface") for text in figure.measured)


def test_the_page_shows_the_figures(swept, tmp_path):
    swept.results.write_parquet(tmp_path / "results.parquet")
    (tmp_path / "summary.json").write_text(json.dumps({"run": {}, "experiments": {}}))
    page = write_report(tmp_path, charts=True).read_text()
    for figure in relief_figures(swept, COLOURS):
        assert f' id="{figure.chart.key}"' in page
        assert (tmp_path / "figures" / f"{figure.chart.key}.png").stat().st_size > 5000
        for line in figure.measured:
            assert line in page


def test_the_shipped_experiment_sweeps_what_the_law_knows_nothing_of():
    experiment = load_experiment("relief")
    cases = expand(experiment)
    swept = {key for case in cases for key in case.swept}
    assert {SLOPE, "surface.relief.bands.0.wavelength_mm", "surface.distance_mm", "surface.radius_mm"} <= swept
    assert "reflectance.film.level" in swept
    assert len(cases) <= 24
    first, second = (cases[0].scene(experiment, number)[0].surface.relief for number in (0, 1))
    assert first.seed != second.seed
