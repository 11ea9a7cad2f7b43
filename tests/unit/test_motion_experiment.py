"""The experiment `motion`: its views, rows, counts and page."""

from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from simtest.api import validate
from simtest.rendering import Session
from simtest.runtime.seeds import from_integer
from simtest.spec import load_experiment, scene_from_dict
from simtest.spec.camera import Moved, Views
from simtest.validation.cases import expand
from simtest.validation.motion import told_pose, true_gains
from simtest.validation.statistics import motion_counts, motion_rows

SADDLE = {"type": "quadric", "k1_per_mm": 0.05, "k2_per_mm": -0.05, "spin_deg": 30.0}


def keep_label(experiment, label, **changes):
    group = next(group for group in experiment.groups if group.label == label)
    return experiment.model_copy(update={"groups": (group.model_copy(update=changes),)})


def test_the_shipped_experiment_expands():
    cases = expand(load_experiment("motion"))
    assert len({case.setting for case in cases}) > 50
    assert all(case.data["views"] for case in cases)


def test_views_stand_where_they_are_told():
    views = Views(count=4, length_mm=2.0, direction_deg=30.0, turn_deg=90.0)
    places = np.array([moved.translation_mm for moved in views.moved()])
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 2.0)
    np.testing.assert_allclose(np.degrees(np.arctan2(places[:, 1], places[:, 0])), [30, 120, -150], atol=1e-9)


def test_told_poses_have_the_stated_errors():
    views = Views(length_mm=2.0, translation_error=0.05, rotation_error_deg=0.5)
    (true,) = views.moved()
    rng = from_integer(1)
    off = np.array([np.linalg.inv(true.pose()) @ np.linalg.inv(told_pose(views, true, rng)) for _ in range(400)])
    assert np.std(off[:, :3, 3]) == pytest.approx(0.05 * 2.0, rel=0.1)
    turned = np.degrees(np.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]]))
    assert np.std(turned) == pytest.approx(0.5, rel=0.1)
    exact = Views(length_mm=2.0)
    np.testing.assert_allclose(told_pose(exact, true, rng) @ true.pose(), np.eye(4), atol=1e-15)


@pytest.mark.render
def test_a_moved_camera_sees_the_same_surface_from_elsewhere():
    camera = {"width": 64, "height": 64, "fx": 64.0, "fy": 64.0}
    still = scene_from_dict({"surface": SADDLE, "camera": camera})
    moved = {"translation_mm": [0.4, -0.2, 0.1], "rotation_deg": [2.0, -3.0, 5.0]}
    elsewhere = scene_from_dict({"surface": SADDLE, "camera": {**camera, "moved": moved}})
    session = Session(still)
    first = session.exact_points(np.array([[32.0, 32.0], [40.0, 20.0]])).position
    session.update(elsewhere)
    # The same points, seen by the moved camera: where its rays through their pixels hit the surface.
    T = np.linalg.inv(Moved(**moved).pose())
    expected = first @ T[:3, :3].T + T[:3, 3]
    found = session.exact_points(session.camera.project(expected)).position
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # The light moves with the camera: its highlight is where the normal points at the new place.
    (truth,) = [h for h in session.highlights(session.radiance()) if h.lit][:1]
    np.testing.assert_allclose(truth.normal, -truth.position / truth.distance, atol=1e-9)
    session.update(still)
    np.testing.assert_array_equal(session.exact_points(np.array([[32.0, 32.0], [40.0, 20.0]])).position, first)


def test_scenes_without_views_are_written_as_before():
    dumped = scene_from_dict({"surface": SADDLE}).model_dump()
    assert "views" not in dumped
    assert "moved" not in dumped["camera"]


@pytest.mark.ci  # meanwhile: test_motion_evidence and test_motion_sequence
@pytest.mark.render
def test_a_small_run_tells_right_signs(tmp_path):
    whole = keep_label(load_experiment("motion", {"realisations": 2}), "saddle", sweep=({"views.length_mm": (0.5,)},))
    validate(whole, tmp_path / "run")
    rows = motion_rows(pl.read_parquet(tmp_path / "run" / "results.parquet"))
    counts = motion_counts(rows)
    assert (counts.signs, counts.wrong) == (4, 0)
    assert counts.told >= 2
    assert set(rows["motion_over_d"].round(2)) == {0.05}
    # Answers keep the normal of the first view; undecided ones have none.
    assert (rows.filter(status="ok")["error_deg"] < 1).all()
    assert f"{counts.told} of 4 signs told, 0 wrong" in (tmp_path / "run" / "index.html").read_text()
    # The guide compares methods for normals; motion has those of the first view.
    assert "motion" not in (tmp_path / "run" / "guide.json").read_text().replace("views.", "")


def test_gains_follow_eulers_formula():
    along = np.array([1.0, 0, 0])
    truth = SimpleNamespace(normal=np.array([0.0, 0, -1]), direction_min=along, kd_min=-0.5, kd_max=1.5)
    np.testing.assert_allclose(true_gains(np.array([along, [0.5**0.5, 0.5**0.5, 0]]), truth), [0.5, 1.5])


def test_counts_of_rows_that_were_not_judged():
    rows = pl.DataFrame({
        "experiment": ["e"] * 4, "setting": ["s"] * 4, "realisation": [0, 0, 1, 1],
        "estimator": ["motion"] * 4, "true_id": [0, 1, 2, None], "motion_over_d": [0.1] * 4,
        "motion_sign_1": [1.0, -1.0, None, 1.0], "motion_sign_2": [0.0, 1.0, None, 1.0],
        "motion_gain_1": [1.2, 0.8, None, None], "motion_gain_2": [0.5, 1.5, None, None],
        "motion_margin_1": [20.0, 20.0, None, None], "motion_margin_2": [1.0, 20.0, None, None],
        "motion_distance2": [1.0, 2.0, None, None], "motion_fits": [1.0, 1.0, None, 1.0],
    })  # fmt: skip
    counts = motion_counts(motion_rows(rows))
    assert (counts.signs, counts.told, counts.wrong, counts.judged, counts.misfits) == (6, 3, 1, 2, 0)
    share, low, high = counts.wrong_share
    assert share == 0.25
    assert low < 0.25 < high
    assert motion_rows(rows.drop("motion_fits")).is_empty()
