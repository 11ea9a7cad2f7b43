"""Estimates kept in a dataset: scored as an experiment's are, and of the very picture that is stored."""

import json

import pytest

import simtest
from simtest.dataset import calibration_of
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.dataset.shard import decode
from simtest.errors import Failure
from simtest.estimators import load_estimators
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import Experiment, load_dataset
from simtest.spec.recipes import Dataset, Family
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand
from simtest.validation.realisation import realise

pytestmark = pytest.mark.render

CLOUDY = {
    "surface.distance_mm": 25.0, "reflectance.exponent": 400.0, "camera.width": 160, "camera.height": 120,
    "camera.fx": 110.0, "camera.fy": 110.0, "sensor.point_spread_px": 0.3, "sensor.noise_sigma": 0.0, "sensor.bits": 8,
    "sensor.response": {"type": "srgb"}, "surface.relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]},
}  # fmt: skip


def planes(values, **recipe):
    """A recipe of one family of planes with these values."""
    told = {"samples": 1, "highlights": 0, "splits": {"train": 1.0, "validation": 0.0, "test": 0.0}, "per_sample": {}}
    data = load_dataset("tiny").model_dump(mode="json", exclude_unset=True) | {"name": "planes", **told, **recipe}
    return validate(Dataset, data | {"families": [Family(scene="plane", set=values)]}, "planes")


def test_a_cloud_in_a_dataset_is_scored_as_in_an_experiment():
    plan = Plan(planes(CLOUDY | {"surface.tilt_deg": 20.0}, estimators=["cone_axis", "cloud"]))
    stored = Maker(plan).make(0).meta["estimates"]
    group = {"scene": "plane", "set": CLOUDY}
    experiment = validate(Experiment, {"name": "same", "realisations": 1, "groups": [group]}, "experiment")
    scene = plan.draw(0).scene
    session = Session(scene, "llvm_ad_rgb", labelled=True)
    view = render_view(session, scene)
    estimators = load_estimators(plan.dataset.estimators)
    made = realise(session, experiment, expand(experiment)[0], 0, view, {}, estimators)
    told = {
        (row["estimator"], row["specularity"], row["true_id"], row.get("error_deg"))
        for row in made.rows
        if row["estimator"] == "cloud"
    }
    own = [row for row in stored if row["estimator"] == "cloud"]
    assert any(row["status"] == "ok" and row.get("error_deg") < 5 for row in own)
    assert {(row["estimator"], row.get("specularity"), row["true_id"], row.get("error_deg")) for row in own} == told
    # What is of single highlights is the same too, but for their numbers in the list of all.
    count = {"ok": 0, "missed": 0}
    for row in stored:
        if row["estimator"] == "cone_axis" and "true_id" in row:
            count[row["status"]] = count.get(row["status"], 0) + 1
            assert view.highlights[row["true_id"]].isolated
    assert count["ok"] == sum(row["estimator"] == "cone_axis" and row.get("error_deg") is not None for row in made.rows)


SMALL = {"camera.width": 96, "camera.height": 72, "camera.fx": 80.0, "camera.fy": 80.0, "reflectance.exponent": 120.0}
NOISY = {"sensor.full_well": 20_000.0, "sensor.read_noise": 5.0}
SENSORS = {
    "linear, overexposed, a given distance": {"sensor.exposure.gain": 4.0, "known.distance_error": 0.1},
    "of 12 bits, a given distance": NOISY | {"sensor.bits": 12, "known.distance_error": -0.2},
    "of a response that is not known": NOISY | {"sensor.bits": 10, "sensor.response.type": "gamma",
                                               "sensor.response_known": False},
    "linear, a response that is not known": {"sensor.response_known": False, "sensor.noise_sigma": 0.01},
}  # fmt: skip


@pytest.mark.parametrize("sensor", SENSORS.values(), ids=SENSORS)
def test_stored_estimates_are_those_of_the_stored_picture(sensor):
    names = ["bisector", "cone_axis", "curved"]
    plan = Plan(planes(SMALL | {"surface.tilt_deg": 10.0} | sensor, estimators=names))
    members = Maker(plan).make(0).encode()
    meta = json.loads(members["json"])
    picture = decode(members, meta).images["image"]
    found = simtest.reconstruct(picture, calibration_of(meta), names, detector="peaks")
    assert [list(each.region.box) for each in found] == [each["box_px"] for each in meta["detections"]]
    stored = {(row["specularity"], row["estimator"]): row for row in meta["estimates"] if "specularity" in row}
    assert stored.keys() == {(i, name) for i in range(len(found)) for name in names} != set()
    for (i, name), row in stored.items():
        result = found[i].estimates[name]
        if isinstance(result, Failure):
            assert row["status"] == str(result.reason)
            continue
        assert [row[f"normal_{axis}"] for axis in "xyz"] == result.normal.tolist()
        assert [row["look_x_px"], row["look_y_px"]] == result.look_px.tolist()
        assert [row[f"cov_{place}"] for place in ("11", "12", "22")] == result.covariance[[0, 0, 1], [0, 1, 1]].tolist()
        assert row.get("flags", "") == ",".join(result.flags)
