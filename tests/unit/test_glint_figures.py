"""Figures of clouds and glints, over made-up rows whose numbers, centroids, shapes and radii are known."""

import json
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from simtest.conventions import ON_INSTRUMENT
from simtest.report import write_report
from simtest.report.glint_figures import LEVEL, glint_figures, pooled_ratio
from simtest.report.relief_figures import KD, visible_figures
from simtest.report.run_folder import Run, completed

SLOPE = "surface.relief.bands.0.slope_deg"
FACTOR = np.sqrt(np.pi / 2)


def made(label, setting, frames=10, glints=8, kd=0.0, slope=4.0, ratio=1.0, off=1.5, law=True, seed=0, **swept):
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


def run_of(rows, tmp_path):
    return Run(tmp_path, completed(pl.DataFrame(rows, infer_schema_length=None)))


@pytest.fixture
def run(tmp_path):
    """Slope swept on a plane, curvature on a cylinder, the level of a film without laws."""
    rows = []
    for slope, glints in ((2.0, 4), (4.0, 16), (8.0, 64)):
        rows += made("plane", f"slope {slope}", glints=glints, slope=slope, off=1.4, **{SLOPE: slope})
    for radius, kd, ratio in ((20.0, 1.0, 0.5), (40.0, -0.5, 0.5)):
        swept = {"surface.radius_mm": radius}
        rows += made("cylinder", f"radius {radius}", 60, 30, kd, ratio=ratio, off=1.6, seed=round(radius), **swept)
    for level in (-1.0, 1.0):
        film = made("film", f"level {level}", law=False, **{LEVEL: level})
        for row in film:
            # One of the two highlights lies in a pool at the higher level.
            if level > 0 and row["true_id"] == 0:
                row |= {"pool": True, "radius_px": 20.0, "radius_law_px": 20.0}
        rows += film
    return run_of(rows, tmp_path)


def by_key(run):
    return {figure.chart.key: figure for figure in glint_figures(run)}


def mark(figure, name, panel=0):
    (found,) = [mark for mark in figure.chart.panels[panel].marks if mark.name == name]
    return found


def test_there_is_a_figure_for_each_law(run):
    assert list(by_key(run)) == [
        "relief_glints_surface_relief_bands_0_slope_deg_plane",
        f"relief_glints_{KD}_cylinder",
        "relief_glints_reflectance_film_level_film",
        "relief_centroid",
        "relief_axis_ratio",
        "relief_radius",
        "relief_pools",
    ]


def test_numbers_stand_beside_the_dashed_law(run):
    figure = by_key(run)["relief_glints_surface_relief_bands_0_slope_deg_plane"]
    law = mark(figure, "law of glints")
    assert law.line == "dash"
    np.testing.assert_allclose(law.x, [2.0, 4.0, 8.0])
    np.testing.assert_allclose(law.y, 0.8 * np.array([4, 16, 64]))
    np.testing.assert_allclose(mark(figure, "glints").y, [4, 16, 64])
    np.testing.assert_allclose(mark(figure, "visible highlights").y, [8, 32, 128])
    # A frame counts once, whatever its rows: 30 frames.
    assert figure.measured[0].startswith("Glints over the law: 1.25 ± ")
    assert figure.measured[1] == "2 visible highlights a glint (30 clouds, 840 glints)."
    film = by_key(run)["relief_glints_reflectance_film_level_film"]
    assert {m.name for m in film.chart.panels[0].marks} == {"glints", "visible highlights"}
    assert "knows no pools" in film.caption


def test_the_error_of_numbers_is_that_of_independent_clouds(run):
    rng = np.random.default_rng(2)
    rows = []
    for slope, mean in ((2.0, 20), (4.0, 40)):
        part = made("plane", f"slope {slope}", 50, **{SLOPE: slope})
        counts = rng.poisson(mean, 50)
        rows += [row | {"cloud_glints": int(counts[row["realisation"]]), "cloud_glints_law": mean} for row in part]
    told = by_key(run_of(rows, run.path))["relief_glints_surface_relief_bands_0_slope_deg_plane"].measured[0]
    ratio, error = (float(text) for text in told.removeprefix("Glints over the law: ").split(" (")[0].split(" ± "))
    # Poisson: 3000 glints are expected.
    assert ratio == pytest.approx(1, abs=4 / np.sqrt(3000))
    assert error == pytest.approx(1 / np.sqrt(3000), rel=0.25)


def test_centroids_stand_over_slope_and_root_of_the_number(run):
    figure = by_key(run)["relief_centroid"]
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


def test_axis_ratios_are_pooled_along_the_principal_directions(run):
    figure = by_key(run)["relief_axis_ratio"]
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


def test_radii_are_compared_highlight_by_highlight(run):
    figure = by_key(run)["relief_radius"]
    plane = mark(figure, "plane")
    assert len(plane.x) == 60
    np.testing.assert_allclose(plane.y, 1.1 * np.asarray(plane.x))
    assert "plane: 1.1 of the law, median of 60 highlights" in " ".join(figure.measured)
    assert "unresolved_relief" in figure.about


def test_pools_are_fewer_and_larger(run):
    figure = by_key(run)["relief_pools"]
    np.testing.assert_allclose(mark(figure, "in pools").y, [0.0, 0.5])
    np.testing.assert_allclose(mark(figure, "on crests").y, [1.0, 0.5])
    below = mark(figure, "in pools", 1)
    np.testing.assert_allclose((below.x, below.y), [[1.0], [20.0]])
    told = "in pools: 10 of 40 isolated highlights, 20 px radius in the mean (10 alone in their spots)."
    assert figure.measured[0] == told


def test_smooth_runs_and_those_of_older_versions_have_none(run, tmp_path):
    rough = [name for name in run.results.columns if name.startswith("cloud_")]
    assert glint_figures(Run(tmp_path, run.results.drop(rough))) == []
    smooth = run.results.with_columns(pl.lit(None, run.results[n].dtype).alias(n) for n in [*rough, "pool"])
    assert glint_figures(Run(tmp_path, smooth)) == []
    assert glint_figures(Run(tmp_path, run.results.clear())) == []


@pytest.mark.slow
def test_the_page_shows_the_figures(run, tmp_path):
    run.results.write_parquet(tmp_path / "results.parquet")
    (tmp_path / "summary.json").write_text(json.dumps({"run": {}, "experiments": {}}))
    page = write_report(tmp_path, charts=True).read_text()
    for figure in glint_figures(run):
        assert f' id="{figure.chart.key}"' in page
        assert (tmp_path / "figures" / f"{figure.chart.key}.png").stat().st_size > 5000
        for line in figure.measured:
            assert line in page


def test_detection_is_scored_on_visible_highlights(tmp_path):
    # Two frames: 3 and 2 visible highlights, of which 2 and 0 are found; one detection shows nothing, one a faint spot.
    rows = [
        (0, 0, 0, 20.0, 3), (0, 1, 2, 12.0, 3), (0, 2, None, None, 3), (1, 0, 4, 6.0, 2), (1, None, None, None, 2),
    ]  # fmt: skip
    results = pl.DataFrame(
        [
            {
                "setting": "s", "realisation": frame, "specularity": spot, "visible_id": seen, "visible_snr": snr,
                "frame_visible": visible, "estimator": name, "true_id": None, "status": "ok",
            }
            for frame, spot, seen, snr, visible in rows
            for name in ("cone_axis", "curved")
        ],
        schema_overrides={"specularity": pl.Int64(), "visible_id": pl.Int64(), "visible_snr": pl.Float64()},
    )  # fmt: skip
    (figure,) = visible_figures(SimpleNamespace(results=results))
    assert figure.measured[0].startswith("40 % of 5 visible highlights are found (40 % where a frame holds 1 to 9;")
    assert figure.measured[0].endswith("1 of 4 detections show nothing visible.")
    assert visible_figures(SimpleNamespace(results=results.drop("visible_snr"))) == []


def test_of_visible_highlights_instruments_are_none_and_no_noise_hides_none():
    schema = {name: pl.Int64() for name in ("specularity", "true_id", "visible_id")} | {"visible_snr": pl.Float64()}
    # Without noise there is no ratio to it. Two detections lie on an instrument, one of them in a spot that is seen.
    rows = [(0, 0, None, False), (1, None, None, True), (2, 1, 30.0, True)]
    results = pl.DataFrame(
        [
            {"setting": "s", "realisation": 0, "specularity": i, "true_id": None, "visible_id": seen,
             "visible_snr": snr, ON_INSTRUMENT: metal, "frame_visible": 1, "estimator": "cone_axis", "status": "ok"}
            for i, seen, snr, metal in rows
        ],
        schema_overrides=schema,
    )  # fmt: skip
    (figure,) = visible_figures(SimpleNamespace(results=results))
    assert figure.measured[0].startswith("100 % of 1 visible highlights are found")
    assert figure.measured[0].endswith("0 of 1 detections show nothing visible.")
