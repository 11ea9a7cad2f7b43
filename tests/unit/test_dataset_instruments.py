"""Datasets and experiments with instruments in a share of the frames: labels, tables, scoring, and none without."""

import numpy as np
import polars as pl
import pytest

from simtest.dataset import read
from simtest.dataset.card import make_card, write_preview
from simtest.dataset.index import ESTIMATES, SAMPLES
from simtest.dataset.manifest import read_manifest
from simtest.dataset.plan import Plan
from simtest.dataset.shard_writer import write_dataset
from simtest.dataset.verify import check_sample, verify
from simtest.errors import InputError
from simtest.runtime.processes import make_engine
from simtest.spec.recipes import Dataset, Experiment
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand, swept_example
from simtest.validation.columns import table
from simtest.validation.realisation import Realiser
from simtest.validation.statistics import figures

pytestmark = pytest.mark.render

CAMERA = {"camera.width": 96, "camera.height": 72, "camera.fx": 72.0, "camera.fy": 72.0}
INSTRUMENTS = {"instruments": [{"kind": "grasper", "diameter_mm": 2.0, "alpha": 0.1}]}
DRAWN = {
    "instruments.0.present": {"choose": [True, False]},
    "instruments.0.azimuth_deg": {"low": -30.0, "high": 30.0},
    "instruments.0.depth_share": {"low": 0.5, "high": 0.9},
}


def recipe(settings, drawn):
    family = {"scene": "sphere", "set": CAMERA | settings, "per_sample": drawn}
    described = {"name": "metal", "samples": 6, "samples_per_anatomy": 6, "highlights": 0, "families": [family]}
    described |= {"splits": {"train": 1, "validation": 0, "test": 0}, "estimators": ["cone_axis"]}
    return validate(Dataset, described, "metal")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("metal") / "metal"
    write_dataset(recipe(INSTRUMENTS, DRAWN), folder, make_engine())
    return folder


def test_samples_hold_the_map_and_say_how_much_is_metal(made):
    assert verify(made) == []
    records = list(read(made))
    shares = [record["meta"]["instrument_share"] for record in records]
    present = [record["meta"]["drawn"]["instruments.0.present"] for record in records]
    assert 0 < sum(present) < len(present)
    for record, share, there in zip(records, shares, present, strict=True):
        metal = record["instrument"]
        assert metal.dtype == np.uint8
        assert set(np.unique(metal)) <= {0, 1}
        assert (share > 0.02) == there
        assert np.mean(metal > 0) == share
        on = metal > 0
        # Depth and normals are the instrument's, before the sphere; its curvature has no value.
        assert np.isfinite(record["depth"][on]).all()
        assert np.isfinite(record["normal"][on]).all()
        assert np.isnan(record["curvature"][on]).all()
        assert np.isfinite(record["curvature"][~on & np.isfinite(record["depth"])]).all()
    index = pl.read_parquet(made / SAMPLES)
    assert index["instrument_share"].to_list() == shares
    assert "on_instrument" in pl.read_parquet(made / ESTIMATES).columns


def test_poses_lead_to_the_surface(made):
    for record in read(made):
        pose = np.array(record["meta"]["world_from_camera"])
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        # The world is the surface's own frame: all true highlights lie on one sphere about (0, 0, -R).
        radius = record["meta"]["scene"]["surface"]["radius_mm"]
        for highlight in record["meta"]["highlights"]:
            place = pose[:3, :3] @ highlight["position_mm"] + pose[:3, 3]
            assert np.linalg.norm(place + np.array([0, 0, radius])) == pytest.approx(radius, rel=1e-9)


def test_card_and_preview_show_instruments(made, tmp_path):
    plan = Plan(recipe(INSTRUMENTS, DRAWN))
    card = make_card(plan, read_manifest(made))
    assert "KEY.instrument.png" in card
    assert "on_instrument" in card
    page = write_preview(made, tmp_path / "page.html", 6).read_text(encoding="utf-8")
    # A picture's title stands twice.
    assert page.count("instruments, by number") == 2 * sum(r["meta"]["instrument_share"] > 0 for r in read(made))


def test_map_of_an_instrument_that_is_not_listed_is_a_fault(made):
    from simtest.dataset.shard import read_member, samples

    with next(made.glob("*.tar")).open("rb") as file:
        stored = next(iter(samples(file)))
        members = {suffix: read_member(file, stored, suffix) for suffix in stored.members if suffix != "json"}
    assert list(check_sample(members, stored.meta)) == []
    members["instrument.png"] = members["image.png"]
    assert any("instrument" in fault for fault in check_sample(members, stored.meta))
    del members["instrument.png"]
    assert list(check_sample(members, stored.meta)) == ["has no instrument"]


def test_without_instruments_nothing_is_stored(tmp_path):
    plain = recipe({}, {"surface.radius_mm": {"low": 20.0, "high": 30.0}})
    plain = plain.model_copy(update={"samples": 1})
    write_dataset(plain, tmp_path / "plain", make_engine())
    (record,) = read(tmp_path / "plain")
    assert not record["instrument"].any()
    assert "instrument_share" not in record["meta"]
    assert "instruments" not in record["meta"]["scene"]
    assert "instrument_share" not in pl.read_parquet(tmp_path / "plain" / SAMPLES).columns
    assert "on_instrument" not in pl.read_parquet(tmp_path / "plain" / ESTIMATES).columns
    assert "instrument" not in make_card(Plan(plain), read_manifest(tmp_path / "plain"))


def test_bad_draw_is_one_line():
    with pytest.raises(InputError, match=r"instruments\.0\.diameter_mm = 90"):
        Plan(recipe(INSTRUMENTS, {"instruments.0.diameter_mm": {"low": 3.0, "high": 90.0}}))


def realised(*instruments):
    listed = {"instruments": list(instruments)} if instruments else {}
    described = {
        "name": "metal",
        "groups": [{"label": "metal", "scene": "sphere", "set": CAMERA | listed | {"sensor.noise_sigma": 0.002}}],
        "realisations": 1,
        "estimators": ["cone_axis"],
    }
    experiment = validate(Experiment, described, "metal")
    (case,) = expand(experiment)
    from simtest.estimators import load_estimators

    made = Realiser(None).make(experiment, case, 0, load_estimators(experiment.estimators))
    return made, table(made.rows, swept_example([case]))


def test_detection_on_an_instrument_is_counted_as_such():
    # Beside the sphere's highlight, which stays.
    made, rows = realised({"tip": [0.72, 0.5], "depth_share": 0.7, "diameter_mm": 2.0, "alpha": 0.1, "azimuth_deg": 15})
    on = rows["on_instrument"].to_list()
    assert any(on)
    for i, specularity in enumerate(made.specularities):
        column, row = specularity.region.peak
        expected = bool(made.view.instruments[row, column]) and i not in made.matched
        assert {value for value, number in zip(on, rows["specularity"], strict=True) if number == i} == {expected}
    found = figures(rows)
    assert found.n_ok == 1
    assert found.n_instrument == sum(on)
    false = (not metal and true is None for metal, true in zip(on, rows["true_id"], strict=True))
    assert found.n_false == sum(false)
    assert found.model_dump(exclude_unset=True)["n_instrument"] == found.n_instrument


def test_without_instruments_results_have_no_further_column():
    _, rows = realised()
    assert "on_instrument" not in rows.columns
    assert "n_instrument" not in figures(rows).model_dump(exclude_unset=True)
