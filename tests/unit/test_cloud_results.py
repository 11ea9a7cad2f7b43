"""Rows of estimator `cloud` in results: against the base's highlight point, found, missed and refused."""

from types import SimpleNamespace

import numpy as np
import pytest

from simtest.estimators.cloud import CloudCentre, cloud
from simtest.estimators.cone_axis import cone_axis
from simtest.geometry.vectors import angle_deg
from simtest.pages.style import degrees
from simtest.report.gallery import result_of
from simtest.report.run_folder import read_item
from simtest.simulation.highlights import CloudRegions
from simtest.spec import Experiment
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand
from simtest.validation.realisation import Realiser, keep_frame
from simtest.validation.scoring import match_cloud

PLANE = {
    "surface.tilt_deg": 25.0, "surface.distance_mm": 25.0, "reflectance.exponent": 400.0, "camera.width": 512,
    "camera.height": 512, "camera.fx": 300.0, "camera.fy": 300.0, "sensor.noise_sigma": 0.01,
    "sensor.point_spread_px": 0.7, "surface.relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]},
}  # fmt: skip


def small_experiment():
    data = {"name": "clouds", "seed": 3, "realisations": 1, "groups": [{"scene": "plane", "set": PLANE}]}
    return validate(Experiment, data, "experiment")


def made_of(estimators):
    experiment, realiser = small_experiment(), Realiser(None)
    return realiser.make(experiment, expand(experiment)[0], 0, estimators), realiser.session


@pytest.mark.render
def test_a_cloud_is_measured_against_the_base():
    made, session = made_of({"cloud": cloud})
    (row,) = [row for row in made.rows if row["estimator"] == "cloud"]
    (centre,) = [point for point in made.view.clouds if point.lit]
    assert (row["status"], row["target"]) == ("ok", "base")
    assert row["cloud"] == row["true_id"] == made.view.clouds.index(centre)
    # The normal of a plane 25 deg off the optical axis.
    normal = np.array([row["normal_x"], row["normal_y"], row["normal_z"]])
    assert row["error_deg"] == row["error_base_deg"] == pytest.approx(float(angle_deg(normal, centre.normal_base)))
    assert row["error_deg"] < 3.0
    assert row["error_look_deg"] == pytest.approx(row["error_deg"], abs=1e-6)
    assert row.get("error_fine_deg") is None
    assert row["cloud_visible"] is not None
    assert row["budget_relief_deg"] > 0
    # Where no estimate is of it, the vote is empty.
    estimate = made.specularities[-1].estimates["cloud"]
    assert match_cloud(CloudRegions.of(session, made.view.clouds), made.view, estimate) == [row["cloud"]]


@pytest.mark.render
def test_the_card_of_a_frame_says_what_the_results_say(tmp_path):
    """A cloud is no false detection there, nor is a spot of several glints."""
    made, session = made_of({"cone_axis": cone_axis, "cloud": cloud})
    experiment = small_experiment()
    keep_frame(tmp_path / "item.npz", session, experiment, expand(experiment)[0], made)
    shown = {(each.specularity, each.estimator): each for each in read_item(tmp_path / "item.npz").meta.estimates}
    told = {(row.get("specularity"), row["estimator"]): row for row in made.rows if row.get("specularity") is not None}
    assert {key: (each.error_deg, each.status) for key, each in shown.items()} == {
        key: (row.get("error_deg"), row["status"]) for key, row in told.items()
    }
    (of_cloud,) = [each for (_, name), each in shown.items() if name == "cloud"]
    assert result_of(of_cloud) == degrees(of_cloud.error_deg) != "–"
    in_spots = {key for key, each in shown.items() if "in a spot of several glints or of none" in result_of(each)}
    assert in_spots
    assert {key for key in in_spots if key[1] == "cone_axis"} == {
        key for key, row in told.items()
        if key[1] == "cone_axis" and row["true_id"] is None and row["visible_id"] is not None
    }  # fmt: skip


@pytest.mark.render
def test_a_cloud_that_is_not_answered_is_a_row_with_its_reason():
    made, _ = made_of({"cloud": CloudCentre(least_spots=500)})
    (row,) = [row for row in made.rows if row["estimator"] == "cloud"]
    assert row["status"] == "no_estimate"
    assert row.get("error_deg") is None
    assert "a cloud takes 500" in row["flags"]


def test_a_cloud_belongs_to_the_point_of_most_of_its_spots_also_where_an_instrument_covers_that():
    """One stray spot at a lit point far away does not make that point the truth."""
    centres = [SimpleNamespace(light=0, lit=lit, bp_px=np.array(at)) for lit, at in ((False, (50, 50)), (True, (9, 9)))]
    points = np.zeros((26, 2))
    estimate = SimpleNamespace(cloud=SimpleNamespace(points_px=points), look_px=np.array([50.0, 50.0]))
    view = SimpleNamespace(clouds=centres)
    for owners, expected in (([0] * 25 + [1], [0]), ([0] * 12 + [1] * 14, [1]), ([None] * 26, [])):
        regions = SimpleNamespace(assign=lambda *_, owners=owners: owners)
        assert match_cloud(regions, view, estimate) == expected
