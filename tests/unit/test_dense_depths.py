"""Depth maps: what their values count, their alignment, the normals that they imply; files, page, table."""

import json

import numpy as np
import polars as pl
import pytest
from dense_frames import LENSES, sphere_truth

from simtest.dataset.scoring.dense.depth import align, normals_of_distance
from simtest.dataset.scoring.dense.maps import MapFolder, MapOptions, open_method
from simtest.dataset.scoring.dense.score import score_frames, write_score
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg


def depth_of(truth, kind):
    """Return the true depth along the ray, or its part along the optical axis."""
    rays = truth.camera.unproject(truth.camera.pixel_centres())
    points = truth.distance[..., None] * rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return points[..., 2] if kind == "z" else truth.distance


def scored(folder, *truths, **options):
    return score_frames(truths, MapFolder(folder), MapOptions(**options))


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
@pytest.mark.parametrize("kind", ["z", "ray"])
@pytest.mark.parametrize("shift", [-4.0, 4.0])
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
    depth[:400] *= 5
    factor, shift = align(depth, truth, how)
    assert factor == pytest.approx(2.0, rel=0.01)
    assert shift == pytest.approx(3.0 if how == "affine" else 0.0, abs=0.4)
    assert align(depth, truth, "none") == (1.0, 0.0)
    assert np.isnan(align(depth[:2], truth[:2], how)).all()


def test_integers_need_a_unit(tmp_path):
    import cv2

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
