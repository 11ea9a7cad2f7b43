"""Maps of normals and depths: encodings, axes, alignment, zones, figures and files; and the baseline `shading`."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import polars as pl
import pytest
from dense_frames import LENSES, hit, sphere_truth, turned, write_png

from simtest.calibration import Calibration
from simtest.dataset.scoring.dense.depth import align, normals_of_distance
from simtest.dataset.scoring.dense.maps import (
    MapFolder,
    MapOptions,
    RawMap,
    Shading,
    channel_vectors,
    open_method,
    parse_axes,
)
from simtest.dataset.scoring.dense.score import frame_figures, joined_figures, score_frames, write_score
from simtest.dataset.scoring.dense.shading import shading_maps
from simtest.dataset.scoring.dense.truth import BINS, CELLS, ZONES, _bin_names, cell_pixels, frame_truth, zones
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.axes import ALL, matrix
from simtest.geometry.vectors import angle_deg
from tests.marked import marked


def angles(score, figure, source="normal"):
    return np.array([cell[figure] for key, cell in score.cells if key[0] == source and key[1] == "angle_deg"])


def scored(folder, *truths, **options):
    return score_frames(truths, MapFolder(folder), MapOptions(**options))


@pytest.mark.parametrize("lens", LENSES)
def test_normals_turned_by_one_degree_score_one_degree_in_every_cell(lens, tmp_path):
    truths = [
        sphere_truth(name, LENSES[lens], centre=(x, -2.0, 30.0))
        for name, x in zip("abcde", (3.0, -6.0, 4.0, 5.0, -5.0), strict=True)
    ]
    for seed, truth in enumerate(truths):
        np.save(tmp_path / f"{truth.name}.npy", turned(truth.normal["fine"], 1.0, seed))
    score = scored(tmp_path, *truths)
    assert len(angles(score, "mean")) > 30
    for figure in ("mean", "median", "rms", "p95", "mean_penalised"):
        np.testing.assert_allclose(angles(score, figure), 1.0, atol=1e-9)
    assert not any(line.startswith("warning") for line in score.lines)
    low, high = score.cell("normal")["ci95"]["median"]
    assert low == pytest.approx(1.0, abs=1e-9)
    assert high == pytest.approx(1.0, abs=1e-9)


def test_each_cell_holds_its_pixels_in_order():
    truth = sphere_truth()
    held = dict(cell_pixels(truth, "fine"))
    distance, zone = truth.distance[truth.scored], truth.zone[truth.scored]
    for number, cell in enumerate(CELLS):
        if cell.group == "zone" and cell.label != "all":
            inside = zone == ZONES.index(cell.label)
        elif cell.group == "distance_mm" and cell.scope == "everywhere":
            names = _bin_names(BINS[cell.group])
            low, high = BINS[cell.group][names.index(cell.label) :][:2]
            inside = (distance >= low) & (distance < high)
        else:
            continue
        assert np.array_equal(held.get(number, np.empty(0, int)), np.flatnonzero(inside))
    assert np.array_equal(held[0], np.arange(len(zone)))


@pytest.mark.parametrize(("bits", "tolerance"), [(16, 1e-3), (8, 0.1)])
def test_png_costs_no_more_than_its_steps(bits, tolerance, tmp_path):
    truth = sphere_truth()
    write_png(tmp_path / "a.png", turned(truth.normal["fine"], 1.0), bits)
    np.testing.assert_allclose(angles(scored(tmp_path, truth), "mean"), 1.0, atol=tolerance)
    write_png(tmp_path / "a.png", truth.normal["fine"], bits)
    # The truth itself scores the quantisation alone.
    assert angles(scored(tmp_path, truth), "mean").max() < {16: 0.002, 8: 0.4}[bits]


@pytest.mark.parametrize(
    ("axes", "told"),
    [("x,-y,-z", "opengl"), ("x,y,-z", "directx"), ("-z,-y,x", "-z,-y,x")],
)
def test_other_axes_are_read_and_warned_of(axes, told, tmp_path):
    truth = sphere_truth()
    # The transpose brings the camera frame to the channels.
    write_png(tmp_path / "a.png", turned(truth.normal["fine"], 1.0) @ matrix(axes))
    score = scored(tmp_path, truth, frame=axes)
    assert any(told in line and "as stated" in line for line in score.lines)
    assert not any(line.startswith("warning") for line in score.lines)
    np.testing.assert_allclose(angles(score, "mean"), 1.0, atol=1e-3)
    wrong = scored(tmp_path, truth)
    assert any("channels hold x,y,z (opencv), by default" in line for line in wrong.lines)
    assert any(
        f"warning: normals fit the truth better with --frame {axes}: mean cosine 0.9998" in line for line in wrong.lines
    )
    held = wrong.to_json()["conventions"]["normals"]
    assert (held["axes"], held["axes_stated"], held["best_axes"]) == ("x,y,z", False, axes)
    assert held["mean_cosine"] < 0.9 < held["best_mean_cosine"]


def test_all_48_axes_differ_and_are_parsed():
    assert len({matrix(axes).tobytes() for axes in ALL}) == 48
    assert parse_axes("+X, -y, z") == "x,-y,z"
    assert parse_axes("OpenGL") == "x,-y,-z"
    for wrong in ("x,y", "x,x,z", "world", ""):
        with pytest.raises(InputError, match="--frame"):
            parse_axes(wrong)


def test_stated_axes_are_taken_as_they_are(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", truth.normal["fine"])
    score = scored(tmp_path, truth, frame="x,-y,z")
    assert score.cell("normal")["mean"] > 10
    assert any("as stated" in line for line in score.lines)


@pytest.mark.parametrize("what", ["flat", "noise"])
def test_normals_that_tell_no_axes_are_not_warned_of(what, tmp_path):
    truth = sphere_truth()
    shape = truth.normal["fine"].shape
    flat, noise = np.broadcast_to([0.0, 0.0, -1.0], shape), np.random.default_rng(1).normal(size=shape)
    np.save(tmp_path / "a.npy", flat if what == "flat" else noise / np.linalg.norm(noise, axis=-1, keepdims=True))
    score = scored(tmp_path, truth)
    assert not any(line.startswith("warning") for line in score.lines)
    assert score.cell("normal")["n"] == truth.scored.sum()


@pytest.mark.parametrize("encoding", ["positive_z", "unit", "centred"])
def test_encodings_of_integers(encoding, tmp_path):
    truth = sphere_truth()
    # Seen by the camera, z towards the viewer is positive but at steep rims.
    vectors = turned(truth.normal["fine"], 1.0) * [1, -1, -1]
    vectors[vectors[..., 2] < 0] = np.nan
    write_png(tmp_path / "a.png", vectors, 16, encoding)
    score = scored(tmp_path, truth, encoding=None if encoding == "unit" else encoding, frame="opengl")
    np.testing.assert_allclose(angles(score, "mean"), 1.0, atol=1e-3)


def test_values_of_an_encoding_stand_for_exact_components():
    bytes_of = RawMap(Path("a.png"), "normal", np.uint8([[[128, 128, 1], [255, 1, 128]]]))
    assert channel_vectors(bytes_of, "centred").tolist() == [[[0, 0, -1], [1, -1, 0]]]
    shares = RawMap(Path("a.npy"), "normal", np.array([[[0.5, 0.5, 0.0], [1.0, 0.5, 0.5]]]))
    assert channel_vectors(shares, "unit").tolist() == [[[0, 0, -1], [1, 0, 0]]]


def test_floats_between_0_and_1_must_be_stated(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", ((truth.normal["fine"] + 1) / 2).astype(np.float32))
    assert any("off from length 1" in line and "--encoding says" in line for line in scored(tmp_path, truth).lines)
    score = scored(tmp_path, truth, encoding="unit")
    assert not any(line.startswith("warning") for line in score.lines)
    assert score.cell("normal")["p95"] < 1e-3


def test_channels_first_are_read(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", np.moveaxis(truth.normal["fine"], -1, 0))
    assert scored(tmp_path, truth).cell("normal")["p95"] < 1e-4


def test_a_first_frame_without_an_answer_does_not_decide_how_others_are_read(tmp_path):
    first, second = sphere_truth("a"), sphere_truth("b")
    np.save(tmp_path / "a.npy", np.full(first.normal["fine"].shape, np.nan))
    np.save(tmp_path / "b.npy", second.normal["fine"])
    cell = scored(tmp_path, first, second).cell("normal")
    assert cell["share_unanswered"] == 0.5
    assert cell["p95"] < 1e-4


def test_pixels_without_an_answer_are_counted(tmp_path):
    truth = sphere_truth()
    vectors = turned(truth.normal["fine"], 1.0)
    vectors[:, :24] = np.nan
    vectors[:, 24:48] = 0.0
    np.save(tmp_path / "a.npy", vectors)
    cell = scored(tmp_path, truth).cell("normal")
    assert cell["n"] == truth.scored.sum()
    assert cell["share_unanswered"] == pytest.approx(0.5)
    assert cell["mean"] == pytest.approx(1.0)
    # An unanswered pixel lies below no threshold, and counts as 90 deg in the penalised mean.
    assert cell["below_30"] == pytest.approx(0.5)
    assert cell["mean_penalised"] == pytest.approx(45.5)


def test_alpha_and_grey_are_no_answer(tmp_path):
    truth = sphere_truth()
    counts = np.rint(255 * (truth.normal["fine"] + 1) / 2).astype(np.uint8)
    alpha = np.full((*counts.shape[:2], 1), 255, np.uint8)
    alpha[:, :24] = 0
    counts[:, 24:48] = 128
    cv2.imwrite(str(tmp_path / "a.png"), np.concatenate([counts[:, :, ::-1], alpha], axis=2))
    assert scored(tmp_path, truth).cell("normal")["share_unanswered"] == pytest.approx(0.5)


def test_a_frame_without_a_map_is_unanswered_as_a_whole(tmp_path):
    truths = [sphere_truth("a"), sphere_truth("b")]
    np.save(tmp_path / "a.npy", truths[0].normal["fine"])
    score = scored(tmp_path, *truths)
    assert score.counts["frames_without_map"] == 1
    assert score.cell("normal")["share_unanswered"] == pytest.approx(0.5)
    assert any("1 of them without a map" in line for line in score.lines)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder, n: np.save(folder / "a.npy", n[:-1]), "is 96 x 71 px; must be 96 x 72"),
        (lambda folder, n: np.save(folder / "a.npy", n[..., :2]), "has shape"),
        (lambda folder, n: np.save(folder / "other.npy", n), "no map is called as a frame"),
        (lambda folder, n: (folder / "a.txt").write_text("1"), "holds no maps"),
        (lambda folder, n: np.save(folder / "a.npy", (100 * n).astype(np.int64)), "normals are int64"),
        (lambda folder, n: np.save(folder / "a_normal.npy", n[..., 0]), "has one channel"),
        (lambda folder, n: np.save(folder / "a.npy", np.float64(1.0)), r"has shape \(\)"),
        (lambda folder, n: _npz(folder / "a.npy", n), "holds several arrays"),
        (
            lambda folder, n: (np.save(folder / "a.npy", n), write_png(folder / "a.png", n)),
            "a second map of frame a",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(make, message, tmp_path):
    truth = sphere_truth()
    make(tmp_path, truth.normal["fine"])
    with pytest.raises(InputError, match=message) as refused:
        scored(tmp_path, truth)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda folder, n: np.save(folder / "a.npy", 1e300 * n),
        lambda folder, n: np.save(folder / "a.npy", 1e-300 * n),
        lambda folder, n: cv2.imwrite(str(folder / "a.png"), np.zeros((*n.shape[:2], 3), np.uint8)),
        lambda folder, n: cv2.imwrite(str(folder / "a.png"), np.full((*n.shape[:2], 4), [9, 8, 7, 0], np.uint8)),
    ],
)
def test_maps_without_any_answer_count_as_unanswered_and_are_told(make, tmp_path):
    truth = sphere_truth()
    make(tmp_path, truth.normal["fine"])
    score = scored(tmp_path, truth)
    assert score.cell("normal")["share_unanswered"] == 1
    assert "warning: normals: no pixel holds a direction; all count as unanswered" in score.lines


def _npz(path, values):
    with path.open("wb") as file:
        np.savez(file, values)


def test_maps_of_no_frame_are_told(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", truth.normal["fine"])
    np.save(tmp_path / "z.npy", truth.normal["fine"])
    with pytest.warns(UserWarning, match="no such frame"):
        scored(tmp_path, truth)


def test_zones_are_rings_in_radii_of_the_highlight():
    regions = np.zeros((101, 101), dtype=np.int64)
    y, x = np.mgrid[:101, :101] - 50
    regions[np.hypot(x, y) <= 8] = 1
    found = zones(regions)[50, 50:]
    assert (found[:9] == 0).all()
    # The radius is that of the circle of the same area, 7.92 px. The edge lies at 8.5; rings end at 16.4, 24.3, 40.2.
    np.testing.assert_array_equal([found[k] for k in (9, 16, 17, 24, 25, 40, 41, 50)], [1, 1, 2, 2, 3, 3, 4, 4])
    assert (zones(np.zeros((5, 5), dtype=np.int64)) == 4).all()


def test_pixels_off_the_view_the_surface_and_on_metal_are_excluded_and_counted():
    truth = sphere_truth()
    height, width = truth.size
    mask, instrument = np.ones((height, width), dtype=bool), np.zeros((height, width), dtype=np.uint8)
    mask[:10], instrument[20:40, 40:60] = False, 1
    regions = np.zeros((height, width), dtype=np.int64)
    regions[25:30, 45:50], regions[60:64, 10:14] = 1, 2
    curvature = truth.curvature["fine"]
    maps = SimpleNamespace(
        normal=truth.normal["fine"], normal_base=truth.normal["fine"], mask=mask, instrument=instrument,
        depth=truth.distance, larger_curvature=curvature, k_min_base=curvature, k_max_base=curvature,
    )  # fmt: skip
    made = frame_truth("a", maps, truth.camera, 1.0, regions)
    assert made.excluded == {"outside_view": 0, "no_surface": 10 * width, "instrument": 400}
    assert made.scored.sum() == height * width - 10 * width - 400
    # The reflection on metal makes no zone.
    assert (made.zone[60:64, 10:14] == 0).all()
    assert made.zone[35, 70] != 0
    assert not (made.zone[25:30, 45:50] == 0).any()


def joined(frames, scenes):
    rows = [frame_figures(np.asarray(values), (5.0, 20.0)) for values in frames]
    return joined_figures(rows, np.asarray(scenes), np.zeros(len(rows), dtype=int))


def test_figures_of_frames_are_joined():
    rng = np.random.default_rng(3)
    frames = [rng.gamma(2.0, 5.0, count) for count in (400, 100, 250, 400, 30, 400)]
    frames[2][:50] = np.nan
    found, values = joined(frames, range(6)), np.concatenate(frames)
    answers = values[np.isfinite(values)]
    assert (found["frames"], found["n"], found["n_unanswered"]) == (6, 1580, 50)
    assert found["median"] == np.median([np.nanmedian(own) for own in frames])
    assert found["p95"] == np.median([np.nanpercentile(own, 95) for own in frames])
    assert found["mean"] == pytest.approx(answers.mean())
    assert found["rms"] == pytest.approx(np.sqrt(np.mean(answers**2)))
    assert found["mean_penalised"] == pytest.approx(np.nan_to_num(values, nan=90.0).mean())
    assert found["below_5"] == pytest.approx((answers < 5).sum() / 1580)
    assert all(low < found[name] < high for name, (low, high) in found["ci95"].items())
    nothing = joined([np.full(4, np.nan)], [0])
    assert (nothing["mean"], nothing["median"], nothing["share_unanswered"], nothing["ci95"]) == (None, None, 1.0, {})


def test_intervals_are_over_scenes_not_pixels():
    rng = np.random.default_rng(4)
    truth = 10 + 2 * rng.standard_normal(60)
    whole = joined([centre + 0.01 * rng.standard_normal(5000) for centre in truth], range(60))
    # A scene in several frames is one scene.
    noisy = joined([c + 0.01 * rng.standard_normal(500) for c in truth for _ in range(4)], np.repeat(range(60), 4))
    assert noisy["frames"] == 240
    for name in ("mean", "median"):
        np.testing.assert_allclose(noisy["ci95"][name], whole["ci95"][name], atol=0.05)
    low, high = whole["ci95"]["mean"]
    # Two standard errors over 60 frames on each side, and its median's interval is wider.
    assert (high - low) / 2 == pytest.approx(2.0 * np.std(truth) / np.sqrt(60), rel=0.1)
    low, high = whole["ci95"]["median"]
    assert low < whole["median"] < high
    assert joined([np.ones(10), np.ones(10)], [0, 0])["ci95"] == {}


def depth_of(truth, kind):
    """Return the true depth along the ray, or its part along the optical axis."""
    rays = truth.camera.unproject(truth.camera.pixel_centres())
    points = truth.distance[..., None] * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return points[..., 2] if kind == "z" else truth.distance


@pytest.mark.parametrize("lens", LENSES)
def test_normals_of_a_plane_are_exact_through_any_lens(lens):
    camera = LENSES[lens]
    rays = camera.unproject(camera.pixel_centres())
    plane = np.array([0.3, -0.2, -0.9])
    plane /= np.linalg.norm(plane)
    distance = -20.0 / (rays @ plane)
    distance[distance < 0] = np.nan
    normal = normals_of_distance(distance, rays)
    known = np.isfinite(normal).all(axis=-1)
    assert known[1:-1, 1:-1].mean() > 0.9
    assert angle_deg(normal[known], plane).max() < 1e-6


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("kind", ["z", "ray"])
def test_both_kinds_of_depth_are_read(lens, kind, tmp_path):
    truth = sphere_truth(camera=LENSES[lens])
    np.save(tmp_path / "a.npy", depth_of(truth, kind))
    score = scored(tmp_path, truth, depth=None if kind == "z" else kind)
    percent = score.cell("depth_none", quantity="depth_percent")
    assert percent["p95"] < 1e-4
    # 90 deg stand for an unanswered normal; a depth has no such figure.
    assert "mean_penalised" not in percent
    assert "mean_penalised" in score.cell("depth_none")
    # At 96 px the central differences of the sphere's rim are coarse; the truth's own rim is not.
    assert score.cell("depth_none")["median"] < 0.2
    along, how = {"z": ("the axis (z)", "by default"), "ray": ("the ray", "as stated")}[kind]
    assert f"depths: along {along}, {how}" in score.lines
    assert not any(line.startswith("warning") for line in score.lines)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("kind", "shift"), [("z", -4.0), ("ray", 4.0)])
def test_the_other_kind_of_relative_depths_is_warned_of(lens, kind, shift, tmp_path):
    truth = sphere_truth(camera=LENSES[lens])
    np.save(tmp_path / "a.npy", 0.5 * depth_of(truth, kind) + shift)
    other = "ray" if kind == "z" else "z"
    (warning,) = (line for line in scored(tmp_path, truth, depth=other).lines if "better" in line)
    assert warning.startswith("warning: depths fit the truth better along")
    assert f"--depth {kind}: " in warning
    score = scored(tmp_path, truth, depth=kind)
    assert not any("better" in line for line in score.lines)
    assert score.cell("depth_affine")["median"] < 0.2


def test_a_wrong_scale_is_told_and_mended_by_alignment(tmp_path):
    truths = [sphere_truth("a"), sphere_truth("b", centre=(-5.0, 0.0, 28.0))]
    for truth in truths:
        np.save(tmp_path / f"{truth.name}_depth.npy", truth.distance / 1000)
    score = scored(tmp_path, *truths, depth="ray")
    assert score.cell("depth_none", quantity="depth_percent")["median"] == pytest.approx(99.9)
    for how in ("scale", "affine"):
        assert score.cell(f"depth_{how}", quantity="depth_percent")["p95"] < 1e-4
    found = score.to_json()["alignments"]["scale"]["factor"]
    assert found["median"] == pytest.approx(1000)
    assert any("factor 1000" in line for line in score.lines)


@pytest.mark.parametrize(("unit_mm", "given", "name"), [(1000, None, "m"), (10, None, "cm"), (1, 1000, "mm")])
def test_a_wrong_unit_of_depths_is_warned_of(unit_mm, given, name, tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a_depth.npy", 1.1 * truth.distance / unit_mm)
    (warning,) = (line for line in scored(tmp_path, truth, depth="ray", unit_mm=given).lines if "--unit-mm" in line)
    assert warning == (
        f"warning: depths: read in units of {given or 1} mm, the truth is about {unit_mm / (given or 1):g} times them, "
        f"as if they were in {name}; --unit-mm {unit_mm} says so"
    )
    # The right unit, and a scale that is none of a unit, are no reason.
    assert not any("--unit-mm" in line for line in scored(tmp_path, truth, depth="ray", unit_mm=unit_mm).lines)
    np.save(tmp_path / "a_depth.npy", truth.distance / 300)
    assert not any("--unit-mm" in line for line in scored(tmp_path, truth, depth="ray").lines)


def test_a_shift_is_mended_by_the_affine_alignment_alone(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", 0.5 * truth.distance - 4.0)
    score = scored(tmp_path, truth, depth="ray")
    assert score.cell("depth_scale", quantity="depth_percent")["median"] > 1
    assert score.cell("depth_affine", quantity="depth_percent")["p95"] < 1e-4
    assert score.cell("depth_affine")["median"] < score.cell("depth_none")["median"]
    assert score.to_json()["alignments"]["affine"]["shift_mm"]["median"] == pytest.approx(8.0)


@pytest.mark.parametrize("how", ["scale", "affine"])
def test_alignment_is_robust(how):
    rng = np.random.default_rng(2)
    truth = rng.uniform(10, 60, 4000)
    depth = (truth - (3.0 if how == "affine" else 0.0)) / 2.0 * (1 + 0.01 * rng.standard_normal(4000))
    depth[:200] *= 5
    depth[200:400] *= 1.5
    factor, shift = align(depth, truth, how)
    assert factor == pytest.approx(2.0, rel=0.01)
    assert shift == pytest.approx(3.0 if how == "affine" else 0.0, abs=0.4)
    assert align(depth, truth, "none") == (1.0, 0.0)
    assert np.isnan(align(depth[:2], truth[:2], how)).all()


def test_integers_need_a_unit(tmp_path):
    truth = sphere_truth()
    cv2.imwrite(str(tmp_path / "a.png"), np.rint(truth.distance / 0.005).astype(np.uint16))
    with pytest.raises(InputError, match="--unit-mm must say"):
        scored(tmp_path, truth)
    score = scored(tmp_path, truth, unit_mm=0.005, depth="ray")
    assert score.cell("depth_none", quantity="depth_percent")["p95"] < 0.02


def test_kinds_of_depth_that_fit_alike_are_not_warned_of(tmp_path):
    # Through a narrow lens both are nearly the same.
    truth = sphere_truth(camera=Camera(96, 72, 9000.0, 9000.0, 48.0, 36.0))
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", truth.distance * (1 + 0.01 * rng.standard_normal(truth.distance.shape)))
    assert not any(line.startswith("warning") for line in scored(tmp_path, truth).lines)


def test_depths_and_normals_are_scored_side_by_side(tmp_path):
    truth = sphere_truth()
    (tmp_path / "normal").mkdir()
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "normal" / "a.npy", truth.normal["fine"])
    depth = truth.distance.copy()
    depth[:36] = np.nan
    np.save(tmp_path / "depth" / "a.npy", depth)
    score = scored(tmp_path, truth)
    assert score.sources == ("normal", "depth_none", "depth_scale", "depth_affine")
    assert score.cell("normal")["share_unanswered"] == 0
    # A normal next to a hole has no differences, so a row more is unanswered than depths are missing.
    assert score.cell("depth_none")["share_unanswered"] > 0.5
    assert score.cell("depth_none", quantity="depth_percent")["share_unanswered"] == pytest.approx(0.5)


def test_a_second_kind_among_unnamed_maps_is_refused(tmp_path):
    truths = [sphere_truth("a"), sphere_truth("b")]
    np.save(tmp_path / "a.npy", truths[0].normal["fine"])
    np.save(tmp_path / "b.npy", truths[1].distance)
    with pytest.raises(InputError, match="NAME_normal and NAME_depth"):
        scored(tmp_path, *truths)


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(InputError, match="no folder of maps; must be one, or a method: shading"):
        open_method(tmp_path / "missing")


def test_page_table_and_json(tmp_path):
    image = np.random.default_rng(0).random((72, 96, 3)).astype(np.float32)
    truths = [sphere_truth("a", image=image), sphere_truth("b<script>")]
    (tmp_path / "maps").mkdir()
    np.save(tmp_path / "maps" / "a_normal.npy", truths[0].normal["fine"])
    np.save(tmp_path / "maps" / "a_depth.npy", truths[0].distance)
    score = scored(tmp_path / "maps", *truths, name="R & D", depth="ray")
    page = write_score(score, tmp_path / "out", "simtest score maps")
    text = page.read_text()
    assert "R &amp; D" in text
    assert "b&lt;script&gt;" in text
    for address in ("http://", "https://", 'src="/', "<script src"):
        assert address not in text
    for line in score.lines:
        assert line[1:20] in text
    record = json.loads((tmp_path / "out" / "dense.json").read_text())
    assert record["schema"] == 3
    assert record["counts"]["frames_without_map"] == 1
    zone = {cell["label"]: cell for cell in record["sources"]["normal"]["angle_deg"]["fine"] if cell["group"] == "zone"}
    assert set(zone) == {"all", "highlight", "ring_1", "ring_2", "ring_4", "elsewhere"}
    assert sum(cell["n"] for label, cell in zone.items() if label != "all") == zone["all"]["n"]
    rows = pl.read_parquet(tmp_path / "out" / "dense.parquet")
    all_fine = (pl.col("label") == "all") & (pl.col("source") == "normal") & (pl.col("surface") == "fine")
    assert rows.filter(all_fine)["n"].to_list() == [truth.scored.sum() for truth in truths]
    # The rows of the frames add up to the figures of all.
    assert rows.filter(all_fine)["n_unanswered"].sum() == zone["all"]["n_unanswered"]


def test_disparities_are_told_and_not_answered(tmp_path):
    truths = [sphere_truth("a"), sphere_truth("b", centre=(-5.0, 0.0, 28.0))]
    np.save(tmp_path / "a.npy", 1 / truths[0].distance)
    np.save(tmp_path / "b.npy", truths[1].distance)
    score = scored(tmp_path, *truths, depth="ray")
    assert score.to_json()["alignments"]["affine"]["frames_turned_round"] == 1
    assert any(line.startswith("warning: depths, affine: the factor is negative in 1 frames") for line in score.lines)
    # The frame of depths alone is answered.
    answers = truths[1].scored.sum() / sum(truth.scored.sum() for truth in truths)
    cell = score.cell("depth_affine", quantity="depth_percent")
    assert cell["share_unanswered"] == pytest.approx(1 - answers)
    assert cell["p95"] < 1e-4
    (tmp_path / "b.npy").unlink()
    only = scored(tmp_path, truths[0], depth="ray")
    assert only.cell("depth_affine")["share_unanswered"] == 1


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_alignment_does_not_depend_on_the_unit(scale):
    truth = np.random.default_rng(0).uniform(10, 60, 1000)
    factor, shift = align((truth - 3.0) * scale, truth, "affine")
    assert factor * scale == pytest.approx(1.0)
    assert shift == pytest.approx(3.0)


def test_depths_beyond_all_measure_are_no_answer(tmp_path):
    truth = sphere_truth()
    np.save(tmp_path / "a.npy", truth.distance * 1e306)
    assert scored(tmp_path, truth, depth="ray").cell("depth_affine")["share_unanswered"] == 1


SEEN_BY = Camera(160, 120, 110.0, 110.0, 80.0, 60.0)


def matt(normal, distance, rays, albedo=0.7):
    """Return Lambert's cosine over the squared distance, a light at the camera."""
    cosine = -np.einsum("hwi,hwi->hw", normal, rays)
    return (albedo * np.maximum(cosine, 0) * (20.0 / distance) ** 2).astype(np.float32)


def matt_plane(camera, normal, at_mm=25.0):
    rays = camera.unproject(camera.pixel_centres())
    normal = np.asarray(normal) / np.linalg.norm(normal)
    distance = at_mm * normal[2] / (rays @ normal)
    return np.broadcast_to(normal, rays.shape), distance, rays


@pytest.mark.parametrize("tilt", [[0.0, 0.0, -1.0], [0.4, 0.0, -1.0], [-0.3, 0.5, -1.0]])
def test_a_matt_plane_is_recovered_but_for_its_scale(tilt):
    normal, distance, rays = matt_plane(SEEN_BY, tilt)
    found, relative = shading_maps(matt(normal, distance, rays), Calibration(SEEN_BY))
    assert np.median(angle_deg(found, normal)) < 1.5
    ratio = distance / relative
    assert np.std(ratio) / np.mean(ratio) < 0.02


@pytest.mark.parametrize("lens", marked(LENSES, ci=["pinhole", "brown_conrady"]))
def test_a_matt_hollow_is_recovered_through_any_lens(lens):
    camera = LENSES[lens]
    rays = camera.unproject(camera.pixel_centres())
    distance, normal, _ = hit(rays, np.array([10.0, 5.0, 12.0]), -30.0)
    found, _ = shading_maps(matt(normal, distance, rays), Calibration(camera))
    facing = np.median(angle_deg(-rays, normal))
    assert facing > 10
    assert np.median(angle_deg(found, normal)) < 0.15 * facing


def test_the_albedo_does_not_matter():
    normal, distance, rays = matt_plane(SEEN_BY, [0.4, 0.2, -1.0])
    found = [shading_maps(matt(normal, distance, rays, albedo), Calibration(SEEN_BY))[0] for albedo in (0.05, 1.0)]
    assert angle_deg(*found).max() < 0.01


def test_a_highlight_is_left_out():
    normal, distance, rays = matt_plane(SEEN_BY, [0.4, 0.0, -1.0])
    frame = matt(normal, distance, rays)
    y, x = np.mgrid[:120, :160]
    frame += (5 * np.exp(-((x - 60) ** 2 + (y - 70) ** 2) / 18)).astype(np.float32)
    found, _ = shading_maps(frame, Calibration(SEEN_BY))
    assert np.median(angle_deg(found, normal)) < 2


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_a_frame_without_light_has_no_answer(value):
    found, distance = shading_maps(np.full((120, 160), value, np.float32), Calibration(SEEN_BY))
    assert np.isnan(found).all()
    assert np.isnan(distance).all()


@pytest.mark.ci  # meanwhile: test_dense_command scores maps; test_a_matt_hollow_is_recovered holds the method
def test_it_is_scored_as_maps_are():
    truth = sphere_truth()
    rays = truth.camera.unproject(truth.camera.pixel_centres())
    image = matt(truth.normal["fine"], truth.distance, rays)
    shown = replace(truth, image=image, calibration=Calibration(truth.camera))
    score = score_frames([shown], Shading(), MapOptions())
    found, _ = shading_maps(image, Calibration(truth.camera))
    error = angle_deg(found, truth.normal["fine"])[truth.scored]
    assert score.cell("normal")["mean"] == pytest.approx(error.mean())
    assert score.cell("depth_scale", quantity="depth_percent")["median"] < 10
    assert score.name == "shading"
