"""The report of a run, on small synthetic run folders."""

import base64
import itertools
import json
import re
import zlib
from html.parser import HTMLParser

import numpy as np
import polars as pl
import pytest
from PIL import Image
from scipy.special import stdtrit

from simtest.errors import InputError
from simtest.geometry.camera import Camera
from simtest.pages.charts import Axis
from simtest.pages.html import code_spans
from simtest.pages.style import colours, number
from simtest.report import write_report
from simtest.report.error_figures import Curve, _join_mark, heat_maps, heat_range, law_misses, line_chart, line_figures
from simtest.report.run_folder import read_run
from simtest.report.scene3d import curvature_limit, framed, kept_scene
from simtest.report.tables import _apart
from simtest.validation import laws

ESTIMATORS = ("circle_pose", "brightest_point", "cone_axis")


REASONS = ("no_peak", "no_closed_isophote", "not_an_ellipse")


DISTANCE = 10.0


EVIL = '<script>alert("x")</script>&<img src=https://evil.example/x>'


def rows_of_setting(rng, label, setting, kd, eps, realisations, estimators=ESTIMATORS, n_true=1, **more):
    """Rows as the runner writes them: curvature k d = kd in one direction, light offset over distance eps."""
    rows = []
    for realisation, true_id in itertools.product(range(realisations), range(n_true)):
        k = kd if n_true == 1 else float(rng.uniform(-0.6, 4))
        low, high = min(k, 0.0), max(k, 0.0)
        pose = float(np.degrees(laws.circle_pose_error(*laws.isophote_half_axes(0.5, 200, low, high))))
        half = float(np.degrees(laws.offset_error(eps)))
        law = {"circle_pose": pose if eps == 0 else None, "brightest_point": half, "cone_axis": half}
        noise = {"circle_pose": 5.0 / (1 + pose), "brightest_point": 0.3, "cone_axis": 0.009}
        for name in estimators:
            is_pose = name == "circle_pose"
            error = float(np.hypot(max(pose * is_pose, half), noise.get(name, 0.1) * abs(rng.normal(1, 0.4))))
            status = "ok" if rng.random() > 0.04 else str(rng.choice([*REASONS, "missed"]))
            ratio = float(laws.axis_ratio(low, high)) * rng.normal(1, 0.01)
            rows.append(
                {
                    "experiment": "", "surface": label.split()[0], "label": label, "setting": setting,
                    "realisation": realisation, "specularity": true_id, "true_id": true_id, "estimator": name,
                    "status": status, "error_deg": error if status == "ok" else None,
                    "error_oracle_deg": error if status == "ok" else None, "error_law_deg": law.get(name),
                    "kd_min": low, "kd_max": high, "eps_over_d": eps, "isovalue": 0.5,
                    "axis_ratio": ratio if is_pose and status == "ok" else None,
                    "axis_ratio_law": float(laws.axis_ratio(low, high)) if is_pose else None, **more,
                }
            )  # fmt: skip
        if n_true > 1 and rng.random() < 0.2:
            blank = dict.fromkeys(("true_id", "error_deg", "error_oracle_deg", "kd_min", "kd_max", "error_law_deg"))
            rows.append(rows[-1] | blank | {"status": "ok"})
    return rows


def sweeps_of(kind):
    """(label, setting, k d, eps/d, swept parameters) of an experiment."""
    curved = [("cylinder outside", radius, DISTANCE / radius) for radius in (1000, 100, 10, 5)]
    curved += [("cylinder inside", radius, -DISTANCE / radius) for radius in (100, 30, 15)]
    curvature = [
        (label, f"{label} R = {radius} mm", kd, 0.0, {"surface.radius_mm": float(radius)})
        for label, radius, kd in curved
    ]
    offset = [
        ("plane offset", f"offset {eps}", 0.0, eps, {"rig.lights.0.offset_mm": eps * DISTANCE})
        for eps in (0.0, 0.01, 0.05, 0.1, 0.2)
    ]
    pairs = [(radius, eps) for radius in (100, 20, 10) for eps in (0.0, 0.05, 0.2)]
    grid = [("sphere", f"R = {radius}, offset {eps}", DISTANCE / radius, eps, {}) for radius, eps in pairs]
    noise = [("plane", f"noise {sigma}", 0.0, 0.0, {"sensor.noise_sigma": sigma}) for sigma in (0.0, 0.02, 0.05)]
    anatomy = [
        (surface, f"view {view}", 0.0, 0.0, {"surface.viewpoint": view})
        for surface in ("colon", "liver")
        for view in range(2)
    ]
    return {"curvature": curvature, "light_offset": offset, "overview": curvature + offset, "grid": grid,
            "noise": noise, "anatomy": anatomy}[kind]  # fmt: skip


def make_rows(kind, realisations=4, estimators=ESTIMATORS, seed=0):
    rng = np.random.default_rng(seed)
    rows = []
    for label, setting, kd, eps, swept in sweeps_of(kind):
        n_true = 5 if kind == "anatomy" else 1
        rows += rows_of_setting(rng, label, setting, kd, eps, realisations, estimators, n_true, **swept)
    return [row | {"experiment": kind} for row in rows]


def summarise(rows):
    settings = {}
    for row in rows:
        entry = settings.setdefault(row["setting"], {}).setdefault(row["estimator"], {"rows": []})
        entry["rows"].append(row)
    for by_estimator in settings.values():
        for name, entry in by_estimator.items():
            errors = [r["error_deg"] for r in entry["rows"] if r["error_deg"] is not None]
            failed = [r["status"] for r in entry["rows"] if r["status"] in REASONS]
            mean = float(np.mean(errors)) if errors else None
            by_estimator[name] = {
                "n": len(entry["rows"]), "n_ok": len(errors),
                "n_failed_by_reason": {s: failed.count(s) for s in set(failed)},
                "n_missed": sum(r["status"] == "missed" for r in entry["rows"]),
                "n_false": sum(r["true_id"] is None for r in entry["rows"]), "n_in_spot": 0,
                "mean_deg": mean, "mean_oracle_deg": mean,
                "rms_deg": mean, "std_deg": None, "median_deg": mean, "p95_deg": mean, "max_deg": mean,
                "mean_penalised_deg": mean, "ci95_deg": [mean, mean], "coverage95": None,
            }  # fmt: skip
    return settings


def make_item(path, radius=10.0, size=(64, 48), tilt=0.3, estimator="circle_pose", detail=8, curved=False):
    """One cylinder seen from outside, with a true highlight and two estimates."""
    width, height = size
    camera = Camera.from_fov(60, width, height)
    rays = camera.unproject(camera.pixel_centres())
    normal0 = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    centre = np.array([0, 0, DISTANCE]) - radius * normal0
    centre[0] += 2.0
    a = rays[..., 0] ** 2 + rays[..., 2] ** 2
    b = rays[..., 0] * centre[0] + rays[..., 2] * centre[2]
    with np.errstate(invalid="ignore"):
        distance = (b - np.sqrt(b**2 - a * (centre[0] ** 2 + centre[2] ** 2 - radius**2))) / a
    position = rays * distance[..., None]
    normal = (position - centre * [1, 0, 1]) * [1, 0, 1] / radius
    frame = np.clip(-np.sum(normal * rays, axis=-1), 0, 1) ** 200
    frame = np.nan_to_num(frame) + np.random.default_rng(0).normal(0, 0.02, frame.shape)
    s = np.array([centre[0], 0, centre[2]]) / np.hypot(centre[0], centre[2])
    spot, point = camera.project(s), s * (np.hypot(centre[0], centre[2]) - radius)
    axes = np.array([0.03, 0.06]) * camera.fx
    angle = np.linspace(0, 2 * np.pi, 40)
    ring = np.stack([np.cos(angle), np.sin(angle)], 1) * axes
    contours = [{"t": t, "points": (spot + ring * np.sqrt(-np.log(t) / 0.7)).tolist()} for t in (0.3, 0.5, 0.7)]
    curve = (spot + ring).tolist()
    turned = [[-s[0] * np.cos(u) - s[2] * np.sin(u), 0.0, s[0] * np.sin(u) - s[2] * np.cos(u)] for u in (-1, 1)]
    common = {"specularity": 0, "true_id": 0, "status": "ok", "look_px": spot.tolist(), "bp_px": (spot + 0.7).tolist()}
    estimates = [
        common | {"estimator": estimator, "error_deg": 57.3, "normal": turned[0], "candidates": turned,
                  "isophotes": contours[1:2], "curves": [curve]},
        common | {"estimator": "cone_axis", "error_deg": 0.01, "normal": (-s).tolist(), "candidates": [(-s).tolist()],
                  "isophotes": contours, "curves": []},
        common | {"estimator": "brightest_point", "specularity": 1, "true_id": None, "status": "no_peak",
                  "kind": "false", "error_deg": None, "normal": None, "candidates": [], "look_px": None,
                  "isophotes": [], "curves": []},
    ]  # fmt: skip
    meta = {
        "surface": "cylinder", "setting": f"R = {radius:g} mm", "label": "cylinder outside", "sigma": 0.02,
        "command": "simtest render cylinder --set surface.radius_mm=10 --out DIR",
        "camera": {"width": width, "height": height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
                   "cy": camera.cy, "skew": 0.0},
        "truth": [{"id": 0, "bp_px": spot.tolist(), "normal": (-s).tolist(), "position": point.tolist(),
                   "kd_min": 0.0, "kd_max": float(np.linalg.norm(point) / radius),
                   "isolated": True}],
        "estimates": estimates,
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    step = max(1, width // detail)
    more = {}
    if curved:
        meta["lights"] = [[1.0, 2.0, 0.0]]
        more["curvature"] = np.where(np.isfinite(distance), 1 / radius, np.nan)[::step, ::step].astype(np.float16)
    np.savez(path, frame=frame.astype(np.float32), position=position[::step, ::step].astype(np.float32),
             normal=normal[::step, ::step].astype(np.float32), meta=json.dumps(meta), **more)  # fmt: skip


PROVENANCE = {
    "commit": "0123abc", "version": "0.1.0", "versions": {"numpy": "2.4.6"}, "variant": None, "llvm": "23.1",
    "processor": "test", "python": "3.11", "seed": 0, "started": "2026-01-01T00:00:00Z", "duration_s": 12.5,
    "command": ["simtest", "validate", "overview"], "inputs": {"scenes/overview.toml": "ab" * 32},
}  # fmt: skip


def make_run(path, kind="overview", rows=None, items=1, **more):
    rows = make_rows(kind, **more) if rows is None else rows
    path.mkdir(parents=True, exist_ok=True)
    pl.DataFrame(rows, infer_schema_length=None).write_parquet(path / "results.parquet")
    content = {"title": f"Title of {kind}", "description": "What it does.", "settings": summarise(rows)}
    (path / "summary.json").write_text(json.dumps({"run": PROVENANCE, "experiments": {kind: content}}))
    for i in range(items):
        make_item(path / "gallery" / f"item_{i:02d}.npz", radius=(10.0, 4.0, 30.0)[i % 3])
    return path


class Page(HTMLParser):
    """The page's elements, with scripts and data apart."""

    def __init__(self, html):
        super().__init__()
        self.tags, self.text, self._stack = [], [], []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self._stack.append(tag)

    def handle_endtag(self, tag):
        self._stack.append(f"/{tag}")

    def handle_data(self, data):
        if self._stack[-1:] not in (["script"], ["style"]):
            self.text.append(data)

    def ids(self):
        return {attrs["id"] for _, attrs in self.tags if "id" in attrs}


def read_page(path):
    html = path.read_text(encoding="utf-8")
    page = Page(html)
    assert len(html) < 8_000_000
    for _, attrs in page.tags:
        for key in ("src", "href"):
            value = attrs.get(key) or "#"
            assert value.startswith(("#", "data:", "figures/")), value
    assert html.count('id="vega-packed"') <= 1
    assert all(attrs.get("alt") for tag, attrs in page.tags if tag == "img")
    assert not re.search(r"@import|url\(", html[: html.index("</style>")])
    return page


def charts_of(page):
    """The page's figures as its script finds them: specifications by key."""
    html = page.read_text(encoding="utf-8")
    (packed,) = re.findall(r'<script type="application/octet-stream" id="figures-packed">(.*?)</script>', html)
    return json.loads(zlib.decompress(base64.b64decode(packed)))


@pytest.fixture(scope="module")
def overview(tmp_path_factory):
    path = make_run(tmp_path_factory.mktemp("overview"), items=2)
    return path, write_report(path, charts=True)


def test_overview_page_has_its_sections_and_files(overview):
    path, index = overview
    assert index == path / "index.html"
    page = read_page(index)
    wanted = {"error_vs_curvature", "axis_ratio", "error_vs_offset", "gallery", "surface3d", "summary", "provenance"}
    assert wanted <= page.ids()
    assert not {"heatmap", "surfaces"} & page.ids()
    text = " ".join(page.text)
    for part in ("Title of overview", "outside of a tube", "0123abc", "ab" * 32, "simtest render cylinder"):
        assert part in text, part
    assert {"viewport"} <= {attrs.get("name") for tag, attrs in page.tags if tag == "meta"}
    shapes = {}
    for file in (path / "figures").iterdir():
        with Image.open(file) as picture:
            shapes[file.stem] = picture.size
    assert shapes.keys() == {"error_vs_curvature", "axis_ratio", "error_vs_offset", "gallery_000", "gallery_001"}
    assert all(500 <= width <= 2500 and 400 <= height <= 2500 for width, height in shapes.values())


def test_a_run_s_page_shows_the_answer_and_one_chart_and_folds_the_rest(overview):
    page = read_page(overview[1])
    folds = {attrs["id"]: "open" in attrs for tag, attrs in page.tags if tag == "details" and "id" in attrs}
    assert {"guide", "axis_ratio", "error_vs_offset", "gallery", "summary", "provenance"} <= folds.keys()
    assert not any(folds.values())
    sections = [attrs["id"] for tag, attrs in page.tags if tag == "section" and "id" in attrs]
    assert sections == ["answer", "error_vs_curvature"]


def test_the_3d_view_is_coloured_by_curvature_where_the_run_kept_it(tmp_path):
    path = make_run(tmp_path, items=0)
    make_item(path / "gallery" / "item_00.npz", radius=4.0, curved=True)
    content = kept_scene(read_run(path)).content
    np.testing.assert_allclose(content.curvature, 0.25, rtol=1e-3)
    assert content.lit.shape == content.vertices.shape
    # The one curvature of a sphere is not the end of the colours.
    assert curvature_limit(content.curvature) == pytest.approx(0.25 * 1.4, rel=1e-3)
    np.testing.assert_array_equal(content.lights, [[1.0, 2.0, 0.0]])
    _, parts = framed(content, "curvature")
    assert [(part.name, part.shown) for part in parts if not part.colour] == [
        ("surface: lit", False), ("surface: curvature from −0.35 (blue) to 0.35 (red)", True)
    ]  # fmt: skip
    assert {"true normal", "cone_axis", "light"} <= {part.name for part in parts}
    page = write_report(path)
    assert "coloured by its curvature" in page.read_text(encoding="utf-8")


def test_a_point_of_the_page_s_charts_tells_its_setting(overview):
    charts = charts_of(overview[1])
    assert set(charts) == {"error_vs_curvature", "axis_ratio", "error_vs_offset"}
    run = read_run(overview[0])
    for key, chart in charts.items():
        told = [row["told"] for layer in chart["layer"] for row in layer["data"]["values"] if row["told"]]
        figure = next(each for each in line_figures(run) if each.key == key)
        for curve in figure.curves:
            for setting in curve.names:
                assert any(setting in text for text in told), (key, setting)


def test_series_follow_the_rows_and_the_laws(tmp_path):
    run = read_run(make_run(tmp_path, "overview", items=0, realisations=6))
    figures = {figure.key: figure for figure in line_figures(run)}
    curves = {(c.estimator, c.label): c for c in figures["error_vs_curvature"].curves}
    assert {label for _, label in curves} == {"cylinder outside", "cylinder inside"}
    pose = curves["circle_pose", "cylinder outside"]
    np.testing.assert_allclose(pose.x, [0.01, 0.1, 1, 2])
    rows = run.results.filter(
        (pl.col("estimator") == "circle_pose") & (pl.col("status") == "ok")
        & (pl.col("setting") == "cylinder outside R = 10 mm")
    )  # fmt: skip
    assert pose.y[2] == pytest.approx(rows["error_oracle_deg"].mean())
    assert (pose.low[2] < pose.y[2]) & (pose.y[2] < pose.high[2])
    at_one = np.interp(1.0, pose.law_x, pose.law_y)
    law = np.degrees(laws.circle_pose_error(*laws.isophote_half_axes(0.5, 200, 0, 1)))
    assert at_one == pytest.approx(law, abs=1e-6)
    assert pose.law_x.size > 100
    offset = {c.estimator: c for c in figures["error_vs_offset"].curves}
    np.testing.assert_allclose(offset["cone_axis"].x, [0, 0.01, 0.05, 0.1, 0.2])
    assert offset["circle_pose"].label == "plane offset"
    met, total, gap, _ = law_misses(figures["error_vs_offset"])["cone_axis"]
    # The law is 0 at the first of the five: that point is not counted.
    assert (met, total) == (4, 4)
    assert gap < 0.3
    ratio = figures["axis_ratio"]
    assert ratio.shared_law
    assert {c.estimator for c in ratio.curves} == {"circle_pose"}


def test_a_law_of_another_reflectance_is_drawn_from_the_rows(tmp_path):
    rows = [r | {"error_law_deg": 33.0} for r in make_rows("curvature")]
    figure = line_figures(read_run(make_run(tmp_path, "curvature", rows, items=0)))[0]
    for curve in figure.curves:
        np.testing.assert_allclose(curve.law_y, 33.0)
        np.testing.assert_allclose(curve.law_x, curve.x)


@pytest.mark.parametrize("values", [np.linspace(0.5, 0.74, 7), np.linspace(-0.74, -0.5, 7), [0.5, 0.51, 2.0]])
def test_neighbouring_settings_have_cells_of_their_own(tmp_path, values):
    rng, rows = np.random.default_rng(0), []
    for kd in values:
        for eps in (0.05, 0.1):
            # The offset moves the highlight, and so its curvature, a little.
            own = rows_of_setting(rng, "sphere", f"{kd:.3f}, {eps}", float(kd) + 0.001 * eps, eps, 4)
            rows += [row | {"experiment": "grid"} for row in own]
    maps = heat_maps(read_run(make_run(tmp_path, "grid", rows, items=0)))
    assert len(maps) == len(ESTIMATORS)
    for item in maps:
        assert item.mean_deg.shape == (2, len(values))
        np.testing.assert_allclose(item.kd, values, atol=1e-3)


def test_grid_gives_heat_maps_and_slices(tmp_path):
    path = make_run(tmp_path, "grid", items=0)
    run = read_run(path)
    maps = heat_maps(run)
    assert [m.estimator for m in maps] == ["cone_axis", "circle_pose", "brightest_point"]
    assert maps[0].mean_deg.shape == (3, 3)
    assert maps[0].mean_deg[2] == pytest.approx(np.degrees(laws.offset_error(0.2)), abs=0.1)
    assert heat_range(maps)[0] > 0
    curvature, _, offset = line_figures(run)
    np.testing.assert_allclose(curvature.curves[0].x, [0.1, 0.5, 1])
    np.testing.assert_allclose(offset.curves[0].x, [0, 0.05, 0.2])
    assert "heatmap" in read_page(write_report(path, charts=True)).ids()
    assert (path / "figures" / "heatmap.png").stat().st_size > 5000


def test_anatomy_gives_surfaces_and_bins(tmp_path):
    path = make_run(tmp_path, "anatomy", realisations=3)
    page = read_page(write_report(path, charts=True))
    assert {"surfaces", "coverage", "error_vs_curvature"} <= page.ids()
    assert (path / "figures" / "anatomy.png").stat().st_size > 5000
    figure = line_figures(read_run(path))[0]
    assert not any(curve.joined for curve in figure.curves)
    assert all(curve.x.size <= 12 for curve in figure.curves)


def test_a_point_of_several_settings_has_the_interval_of_their_frames(tmp_path):
    """A grid of noise and something else: a point of the noise pools the settings, whose differences are no chance."""
    rng = np.random.default_rng(0)
    base = make_rows("noise")[0] | {"label": "grid", "kd_min": 0.0, "kd_max": 0.0, "status": "ok", "true_id": 0}
    rows = [
        base | {"setting": f"noise {noise}, focus {focus}", "realisation": i, "sensor.noise_sigma": noise,
                "camera.focus": focus, "error_oracle_deg": 5 + 10 * focus + float(rng.normal())}
        for noise in (0.01, 0.02) for focus in (0.0, 1.0, 2.0) for i in range(5)
    ]  # fmt: skip
    run = read_run(make_run(tmp_path, "noise", rows, items=0))
    figure = next(each for each in line_figures(run) if each.key == "error_vs_sensor_noise_sigma")
    (curve,) = figure.curves
    assert curve.names == ("sensor.noise_sigma = 0.01", "sensor.noise_sigma = 0.02")
    errors = np.reshape([row["error_oracle_deg"] for row in rows], (2, 3, 5))
    deviation = np.sqrt(errors.var(axis=2, ddof=1).sum(axis=1) / 5) / 3
    # Student's with 15 frames less 3 settings; 4 degrees of freedom, as of 5 frames, would reach 2.78.
    np.testing.assert_allclose((curve.high - curve.low) / (2 * deviation), stdtrit(12, 0.975), rtol=0.1)


BLANK = dict.fromkeys(("error_deg", "error_oracle_deg", "axis_ratio"))
KEPT = ("experiment", "setting", "estimator", "status")
POOR = {
    "no answer": (
        [row | BLANK | {"status": "no_peak"} for row in make_rows("overview")], {"surfaces", "summary"}, {"gallery"}),
    "one setting": (
        [row for row in make_rows("curvature") if row["setting"] == "cylinder outside R = 10 mm"], {"surfaces"},
        {"error_vs_curvature"}),
    **{
        f"{blank} everywhere": (
            [{key: value if key in KEPT else blank for key, value in row.items()}
             for row in make_rows("curvature", realisations=1)], {"summary"}, set())
        for blank in (None, float("nan"))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", POOR)
def test_poor_results_have_a_page(tmp_path, name):
    rows, held, lacking = POOR[name]
    ids = read_page(write_report(make_run(tmp_path, "curvature", rows, items=0))).ids()
    assert held <= ids
    assert not lacking & ids


def test_empty_summary_and_results(tmp_path):
    make_run(tmp_path, "curvature", make_rows("curvature", realisations=1), items=0)
    pl.read_parquet(tmp_path / "results.parquet").head(0).write_parquet(tmp_path / "results.parquet")
    summary = {"run": {}, "experiments": {"curvature": {"settings": {}}}}
    (tmp_path / "summary.json").write_text(json.dumps(summary))
    page = read_page(write_report(tmp_path))
    assert "nothing was measured" in " ".join(page.text)
    assert "provenance" not in page.ids()


def test_names_are_escaped(tmp_path):
    rows = make_rows("overview", realisations=2, estimators=("cone_axis", EVIL))
    rows = [r | {"experiment": EVIL, "setting": r["setting"] + EVIL, "label": r["label"] + EVIL} for r in rows]
    path = make_run(tmp_path, EVIL, rows, items=0)
    make_item(path / "gallery" / "a.npz", estimator=EVIL)
    page = read_page(write_report(path))
    assert EVIL in " ".join(page.text)
    html = (path / "index.html").read_text(encoding="utf-8")
    assert "<script>alert" not in html
    assert "<img src=https" not in html


def test_missing_and_malformed_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"results\.parquet"):
        write_report(tmp_path)
    for name, content in (("summary.json", b"{"), ("gallery/bad.npz", b"no")):
        make_run(tmp_path, "curvature", items=0)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name.rpartition("/")[2]):
            write_report(tmp_path)


def test_long_gallery_is_thinned(tmp_path):
    make_run(tmp_path, "noise", items=26)
    run = read_run(tmp_path)
    assert (len(run.gallery), run.gallery_total) == (24, 26)
    assert {"item_00", "item_25"} <= {item.name for item in run.gallery}


def test_surface_without_truth_or_pixels(tmp_path):
    make_item(tmp_path / "gallery" / "a.npz")
    with np.load(tmp_path / "gallery" / "a.npz") as data:
        content = dict(data)
    meta = json.loads(str(content["meta"]))
    meta["truth"], meta["estimates"] = [], [{"estimator": "x", "status": "ok", "bp_px": None}]
    content |= {"meta": json.dumps(meta), "position": content["position"] * np.nan}
    # A frame in colour, and a name that mathematics would set, are drawn all the same.
    content |= {"frame": np.repeat(content["frame"][..., None], 3, axis=-1)}
    np.savez(tmp_path / "gallery" / "a.npz", **content)
    make_run(tmp_path, "noise", items=0, realisations=2, estimators=("_$x_1$",))
    assert kept_scene(read_run(tmp_path)) is None
    page = read_page(write_report(tmp_path))
    assert "surface3d" not in page.ids()
    assert "_$x_1$" in " ".join(page.text)


def test_style():
    shades = colours(["new", "cone_axis", "circle_pose", "also new"])
    assert len(set(shades.values())) == 4
    assert shades["cone_axis"] == "#166B90"
    texts = [number(v) for v in (None, float("nan"), 3, 0.01234, 123456.0, 1e-5)]
    assert texts == ["–", "–", "3", "0.0123", "1.23e+05", "1.00e-05"]
    axis = Axis("x", "stretched")
    np.testing.assert_allclose(axis.from_axis(axis.to_axis([-0.5, 0, 3])), [-0.5, 0, 3], atol=1e-12)
    ends = axis.ends([[-0.5, 2]])
    assert ends[0] < -0.5
    assert ends[1] > 2
    ticks = axis.channel("x", ends)["axis"]["values"]
    assert {-0.3, 0, 1} <= set(ticks)
    assert all(ends[0] <= at <= ends[1] for at in ticks)


def test_no_chord_joins_unlike_settings(tmp_path):
    """Lines end where curvature or offset changes sign or becomes 0, and none runs beside a law."""
    for figure in line_figures(read_run(make_run(tmp_path, "overview", items=0))):
        shades = colours(figure.estimators)
        lines = [mark for mark in line_chart(figure, shades).panels[0].marks if mark.line == "solid"]
        for line in lines:
            x = np.asarray(line.x)
            assert all(np.sign(a) == np.sign(b) for a, b in itertools.pairwise(x) if np.isfinite([a, b]).all())
        # As many joins as joined curves without a visible law.
        free = [c for c in figure.curves if c.joined and not np.isfinite(figure.y.visible(c.law_y)).any()]
        assert len(lines) == len(free)


def test_gaps_stand_between_kinds():
    x = np.array([-0.5, -0.1, 0.0, 0.1, 0.5])
    blank = np.empty(0)
    curve = Curve("cone_axis", "a", x, x + 2, x, x, x * np.nan, blank, blank, ("",) * 5, ("",) * 5, True)
    mark = _join_mark(curve, colours(["cone_axis"]))
    np.testing.assert_array_equal(mark.x, [-0.5, -0.1, np.nan, 0.0, np.nan, 0.1, 0.5])
    np.testing.assert_array_equal(mark.y, [1.5, 1.9, np.nan, 2.0, np.nan, 2.1, 2.5])


def test_a_surface_lit_from_both_sides_is_two():
    rows = pl.DataFrame(
        {"surface": ["plane", "plane", "tube"], "setting": ["a", "b", "c"], "eps_over_d": [0.0, 0.1, 0.1]}
    )
    assert _apart(rows)["surface"].to_list() == ["plane", "plane, offset", "tube"]


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("`--set a=B` names <it>", "<code>--set a=B</code> names &lt;it&gt;"),
        ("a `b` and `<c>`", "a <code>b</code> and <code>&lt;c&gt;</code>"),
        ("no code, one ` mark", "no code, one ` mark"),
        ("", ""),
    ],
)
def test_what_stands_between_backticks_is_code(text, html):
    assert str(code_spans(text)) == html


def test_rounding_is_no_figure():
    assert (number(-6.45e-17), number(0.0), number(2e-9)) == ("0", "0", "2.00e-09")
