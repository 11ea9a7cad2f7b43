"""Figures of errors, clouds and glints on a relief, over made-up rows whose means and distributions are known."""

import json
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from scipy import stats

from simtest.conventions import ON_INSTRUMENT
from simtest.report import write_report
from simtest.report.glint_figures import LEVEL, glint_figures, pooled_ratio
from simtest.report.relief_figures import KD, relief_figures, visible_figures
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
    """Return the marks of a figure's only panel by name and symbol."""
    return {(mark.name, mark.symbol): mark for mark in figure.chart.panels[0].marks}


def test_each_quantity_has_a_figure_and_a_radius_shows_as_curvature(swept):
    figures = relief_figures(swept, COLOURS)
    keys = [figure.chart.key for figure in figures]
    assert keys == ["relief_surface_relief_bands_0_slope_deg_plane", f"relief_{KD}_cylinder", "relief_distribution"]
    np.testing.assert_allclose(marks(figures[1])["cone_axis", "●"].x, [1.0, 2.0])


def test_means_against_both_truths_stand_beside_the_dashed_law(swept):
    figure = relief_figures(swept, COLOURS)[0]
    found = marks(figure)
    assert found.keys() == {("law: 1.25 slopes", ""), *((name, s) for name in COLOURS for s in "●▲")}
    law = found["law: 1.25 slopes", ""]
    assert law.line == "dash"
    # A straight line through the settings, in many steps.
    np.testing.assert_allclose(np.interp([2.0, 3.0, 8.0], law.x, law.y), FACTOR * np.array([2.0, 3.0, 8.0]), rtol=1e-9)
    base, fine = found["cone_axis", "●"], found["cone_axis", "▲"]
    np.testing.assert_allclose(base.x, [2.0, 4.0, 8.0])
    np.testing.assert_allclose(base.y, FACTOR * np.array([2.0, 4.0, 8.0]), rtol=0.02)
    np.testing.assert_allclose(fine.y, 0.1)
    assert np.all(base.bars.low < base.y)
    assert np.all(base.bars.high > base.y)
    told = " ".join(figure.measured)
    assert "cone_axis: 0.1° against the fine surface, 5.84° against the base, 0.998 of the law" in told
    assert "Nothing was answered at: plane, slope 1.0." in told
    assert "120 highlights" in told


def test_settings_at_one_value_are_one_point_whatever_their_numbers_of_rows(tmp_path):
    rows = []
    # 0.1 three times adds up to a little more than 0.3.
    for wave, count in ((1.0, 3), (2.0, 4)):
        for slope in (0.1, 0.2):
            swept = {SLOPE: slope, "surface.relief.bands.0.wavelength_mm": wave}
            rows += made("cone_axis", "plane", f"{slope}, {wave}", slope, count, **swept)
    mark = marks(relief_figures(run_of(rows, tmp_path), COLOURS)[0])["cone_axis", "●"]
    np.testing.assert_allclose(mark.x, [0.1, 0.2])
    assert all(text.endswith(" of 7") for text in mark.hover)


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


def test_smooth_runs_and_those_of_older_versions_have_none(swept, glints, tmp_path):
    smooth = swept.results.with_columns(error_base_deg=pl.col("error_fine_deg"), error_base_law_deg=pl.lit(None))
    for results in (smooth, swept.results.drop("error_base_deg"), swept.results.clear()):
        assert relief_figures(Run(tmp_path, results), COLOURS) == []
    rough = [name for name in glints.results.columns if name.startswith("cloud_")]
    smooth = glints.results.with_columns(pl.lit(None, glints.results[n].dtype).alias(n) for n in [*rough, "pool"])
    for results in (smooth, glints.results.drop(rough), glints.results.clear()):
        assert glint_figures(Run(tmp_path, results)) == []


def test_a_relief_without_a_law_is_drawn_without_dashes(tmp_path):
    rows = [row for s in (2.0, 4.0) for row in made("cone_axis", "plane", f"{s}", s, law=False, **{SLOPE: s})]
    (figure,) = relief_figures(run_of(rows, tmp_path), COLOURS)
    assert marks(figure).keys() == {("cone_axis", "●"), ("cone_axis", "▲")}
    assert "of the law" not in " ".join(figure.measured)


def test_a_method_of_clouds_is_drawn_against_the_base_alone(tmp_path):
    """A method that reports the base's normal alone has no error against the fine surface."""
    rows = [row for s in (2.0, 4.0) for name in COLOURS for row in made(name, "plane", f"{s}", s, **{SLOPE: s})]
    rows = [row | {"error_fine_deg": None} if row["estimator"] == "cone_axis" else row for row in rows]
    figure, *_ = relief_figures(run_of(rows, tmp_path), COLOURS)
    found = marks(figure)
    assert len(found["cone_axis", "▲"].x) + len(found["cone_axis", "●"].x) == 2
    assert any(text.startswith("cone_axis: – against the fine surface") for text in figure.measured)


def page_of(run, folder):
    run.results.write_parquet(folder / "results.parquet")
    (folder / "summary.json").write_text(json.dumps({"run": {}, "experiments": {}}))
    return write_report(folder, charts=True).read_text()


@pytest.mark.parametrize("kind", ["errors", pytest.param("glints", marks=pytest.mark.slow)])
def test_the_page_shows_the_figures(swept, glints, tmp_path, kind):
    page = page_of(swept if kind == "errors" else glints, tmp_path)
    figures = relief_figures(swept, COLOURS) if kind == "errors" else glint_figures(glints)
    for figure in figures:
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


def clouds(label, setting, frames=10, glints=8, kd=0.0, slope=4.0, ratio=1.0, off=1.5, law=True, seed=0, **swept):
    """Rows of one setting: two estimators and two highlights a frame, one cloud; `off` in s/sqrt(N)."""
    rng = np.random.default_rng(seed)
    rows = []
    for frame in range(frames):
        # The direction of k_max has the larger abs(1 + d k), whichever the sign: the cloud is narrower along it.
        at = rng.normal(0, 1, (glints, 2)) * [1.0, ratio]
        c11, c12, c22 = (float(at[:, i] @ at[:, j]) / glints for i, j in ((0, 0), (0, 1), (1, 1)))
        unit = slope / np.sqrt(glints)
        for true_id, estimator in ((t, e) for t in (0, 1) for e in ("cone_axis", "curved")):
            radius = 2.0 + 0.5 * true_id + 0.1 * frame
            rows.append(
                {
                    "experiment": "relief", "label": label, "surface": label, "setting": setting, "realisation": frame,
                    "true_id": true_id, "estimator": estimator, "status": "ok", "error_deg": 0.1,
                    "error_oracle_deg": 0.1, "error_fine_deg": 0.1, "error_base_deg": 4.0, "kd_min": 3.0,
                    "kd_max": 5.0, "error_base_law_deg": FACTOR * slope, "kd_min_base": min(kd, 0.0),
                    "kd_max_base": max(kd, 0.0), "cloud": 0, "pool": False, "radius_px": radius * 1.1,
                    "radius_law_px": radius, "cloud_glints": glints, "cloud_glints_law": 0.8 * glints if law else None,
                    "cloud_visible": 2 * glints, "cloud_error_deg": off * unit,
                    "cloud_error_law_deg": FACTOR * unit if law else None, "cloud_kd_min": min(kd, 0.0),
                    "cloud_kd_max": max(kd, 0.0), "cloud_cov_11": c11, "cloud_cov_12": c12, "cloud_cov_22": c22,
                    **swept,
                }
            )  # fmt: skip
    return rows


@pytest.fixture
def glints(tmp_path):
    """Slope swept on a plane, curvature on a cylinder, the level of a film without laws."""
    rows = []
    for slope, glints in ((2.0, 4), (4.0, 16), (8.0, 64)):
        rows += clouds("plane", f"slope {slope}", glints=glints, slope=slope, off=1.4, **{SLOPE: slope})
    for radius, kd, ratio in ((20.0, 1.0, 0.5), (40.0, -0.5, 0.5)):
        swept = {"surface.radius_mm": radius}
        rows += clouds("cylinder", f"radius {radius}", 60, 30, kd, ratio=ratio, off=1.6, seed=round(radius), **swept)
    for level in (-1.0, 1.0):
        film = clouds("film", f"level {level}", law=False, **{LEVEL: level})
        for row in film:
            # One of the two highlights lies in a pool at the higher level.
            if level > 0 and row["true_id"] == 0:
                row |= {"pool": True, "radius_px": 20.0, "radius_law_px": 20.0}
        rows += film
    return run_of(rows, tmp_path)


def by_key(glints):
    return {figure.chart.key: figure for figure in glint_figures(glints)}


def test_there_is_a_figure_for_each_law(glints):
    swept = ("surface_relief_bands_0_slope_deg_plane", f"{KD}_cylinder", "reflectance_film_level_film")
    whole = ("centroid", "axis_ratio", "radius", "pools")
    assert list(by_key(glints)) == [*(f"relief_glints_{name}" for name in swept), *(f"relief_{name}" for name in whole)]


def mark(figure, name, panel=0):
    (found,) = [mark for mark in figure.chart.panels[panel].marks if mark.name == name]
    return found


def test_numbers_stand_beside_the_dashed_law(glints):
    figure = by_key(glints)["relief_glints_surface_relief_bands_0_slope_deg_plane"]
    law = mark(figure, "law of glints")
    assert law.line == "dash"
    np.testing.assert_allclose(law.x, [2.0, 4.0, 8.0])
    np.testing.assert_allclose(law.y, 0.8 * np.array([4, 16, 64]))
    np.testing.assert_allclose(mark(figure, "glints").y, [4, 16, 64])
    np.testing.assert_allclose(mark(figure, "visible highlights").y, [8, 32, 128])
    # A frame counts once, whatever its rows: 30 frames.
    assert figure.measured[0].startswith("Glints over the law: 1.25 ± ")
    assert figure.measured[1] == "2 visible highlights a glint (30 clouds, 840 glints)."
    film = by_key(glints)["relief_glints_reflectance_film_level_film"]
    assert {m.name for m in film.chart.panels[0].marks} == {"glints", "visible highlights"}
    assert "knows no pools" in film.caption


def test_the_error_of_numbers_is_that_of_independent_clouds(glints):
    rng = np.random.default_rng(2)
    rows = []
    for slope, mean in ((2.0, 20), (4.0, 40)):
        part = clouds("plane", f"slope {slope}", 50, **{SLOPE: slope})
        counts = rng.poisson(mean, 50)
        rows += [row | {"cloud_glints": int(counts[row["realisation"]]), "cloud_glints_law": mean} for row in part]
    told = by_key(run_of(rows, glints.path))["relief_glints_surface_relief_bands_0_slope_deg_plane"].measured[0]
    ratio, error = (float(text) for text in told.removeprefix("Glints over the law: ").split(" (")[0].split(" ± "))
    # Poisson: 3000 glints are expected.
    assert ratio == pytest.approx(1, abs=4 / np.sqrt(3000))
    assert error == pytest.approx(1 / np.sqrt(3000), rel=0.25)


def test_centroids_stand_over_slope_and_root_of_the_number(glints):
    figure = by_key(glints)["relief_centroid"]
    plane = mark(figure, "plane")
    np.testing.assert_allclose(plane.x, [1.0, 1.0, 1.0])
    np.testing.assert_allclose(plane.y, 1.4)
    cylinder = mark(figure, "cylinder")
    np.testing.assert_allclose(cylinder.y, 1.6 * np.asarray(cylinder.x))
    lines = [m for m in figure.chart.panels[0].marks if m.line]
    factors = [np.asarray(m.y) / np.asarray(m.x) for m in lines]
    np.testing.assert_allclose([f.mean() for f in factors], [FACTOR, 1.3, 1.8])
    assert "plane: 1.4 s/√N in the mean of 30 clouds" in " ".join(figure.measured)
    # Pools have no law.
    assert "film" not in " ".join(figure.measured)


def test_axis_ratios_are_pooled_along_the_principal_directions(glints):
    figure = by_key(glints)["relief_axis_ratio"]
    cylinder = mark(figure, "cylinder")
    np.testing.assert_allclose(cylinder.x, [-0.5, 1.0])
    # 1800 glints each: a ratio of deviations is off by a share of 1/sqrt(n).
    np.testing.assert_allclose(cylinder.y, 0.5, rtol=4 / np.sqrt(1800))
    law = mark(figure, "law: |1 + d k|, minor over major")
    np.testing.assert_allclose(np.interp([-0.5, 0.0, 1.0], law.x, law.y), [0.5, 1.0, 0.5], atol=0.01)
    assert "(law 0.5; 1800 glints in 60 clouds)" in " ".join(figure.measured)


def test_a_pooled_ratio_weighs_glints_and_knows_its_error():
    rng = np.random.default_rng(4)

    def cloud(setting, scale, glints, frame=0):
        at = rng.normal(0, scale, (glints, 2)) * [3.0, 1.0]
        return {
            "experiment": "e", "setting": setting, "realisation": frame,
            "cloud_kd_min": -0.2, "cloud_kd_max": 2.0, "cloud_glints": glints,
            "cloud_cov_11": float(at[:, 0] @ at[:, 0]) / glints, "cloud_cov_22": float(at[:, 1] @ at[:, 1]) / glints,
        }  # fmt: skip

    found = []
    for _ in range(200):
        rows = [cloud("near", 1.0, n, n) for n in (5, 40)] + [cloud("far", 10.0, n, n) for n in (20, 30, 25)]
        found.append(pooled_ratio(pl.DataFrame(rows)))
    ratios, errors = np.array([each[:2] for each in found]).T
    assert np.median(ratios) == pytest.approx(1 / 3, rel=0.03)
    # Its spread is that of 120 glints, and the jackknife knows it.
    assert ratios.std() == pytest.approx(1 / 3 / np.sqrt(120), rel=0.25)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(ratios.std(), rel=0.3)
    assert np.isnan(pooled_ratio(pl.DataFrame([cloud("near", 1.0, 9)]))[1])


def test_radii_are_compared_highlight_by_highlight(glints):
    figure = by_key(glints)["relief_radius"]
    plane = mark(figure, "plane")
    assert len(plane.x) == 60
    np.testing.assert_allclose(plane.y, 1.1 * np.asarray(plane.x))
    assert "plane: 1.1 of the law, median of 60 highlights" in " ".join(figure.measured)
    assert "unresolved_relief" in figure.about


def test_pools_are_fewer_and_larger(glints):
    figure = by_key(glints)["relief_pools"]
    np.testing.assert_allclose(mark(figure, "in pools").y, [0.0, 0.5])
    np.testing.assert_allclose(mark(figure, "on crests").y, [1.0, 0.5])
    below = mark(figure, "in pools", 1)
    np.testing.assert_allclose((below.x, below.y), [[1.0], [20.0]])
    told = "in pools: 10 of 40 isolated highlights, 20 px radius in the mean (10 alone in their spots)."
    assert figure.measured[0] == told


def seen_results(*rows, names=("cone_axis",)):
    """Rows of detections: (frame, detection, visible spot, its peak over the noise, spots of the frame, others)."""
    return pl.DataFrame(
        [
            {"setting": "s", "realisation": frame, "specularity": spot, "visible_id": seen, "visible_snr": snr,
             "frame_visible": visible, "estimator": name, "true_id": None, "status": "ok", **more}
            for frame, spot, seen, snr, visible, more in rows for name in names
        ],
        schema_overrides={
            **dict.fromkeys(("specularity", "visible_id", "true_id"), pl.Int64()), "visible_snr": pl.Float64(),
        },
    )  # fmt: skip


def test_detection_is_scored_on_visible_highlights():
    # Two frames: 3 and 2 visible highlights, of which 2 and 0 are found; one detection shows nothing, one a faint spot.
    results = seen_results(
        (0, 0, 0, 20.0, 3, {}), (0, 1, 2, 12.0, 3, {}), (0, 2, None, None, 3, {}), (1, 0, 4, 6.0, 2, {}),
        (1, None, None, None, 2, {}), names=("cone_axis", "curved"),
    )  # fmt: skip
    (figure,) = visible_figures(SimpleNamespace(results=results))
    assert figure.measured[0].startswith("40 % of 5 visible highlights are found (40 % where a frame holds 1 to 9;")
    assert figure.measured[0].endswith("1 of 4 detections show nothing visible.")
    assert visible_figures(SimpleNamespace(results=results.drop("visible_snr"))) == []


def test_of_visible_highlights_instruments_are_none_and_no_noise_hides_none():
    # Without noise there is no ratio to it. Two detections lie on an instrument, one of them in a spot that is seen.
    metal = {ON_INSTRUMENT: True}
    results = seen_results(
        (0, 0, 0, None, 1, {ON_INSTRUMENT: False}), (0, 1, None, None, 1, metal), (0, 2, 1, 30.0, 1, metal)
    )
    (figure,) = visible_figures(SimpleNamespace(results=results))
    assert figure.measured[0].startswith("100 % of 1 visible highlights are found")
    assert figure.measured[0].endswith("0 of 1 detections show nothing visible.")
