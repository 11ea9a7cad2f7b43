"""Canaries pass on the code as it is, and each planted fault kills the one that watches for it."""

import warnings

import polars as pl
import pytest
from gate_nights import rows

import simtest.nightly.canaries as all_canaries
from simtest.estimators import bisector
from simtest.geometry import Camera
from simtest.nightly.canaries import geometry, measures, run_canaries
from simtest.nightly.canaries import randomness as noise
from simtest.nightly.records import FIGURES
from simtest.spec import Experiment
from studies.gate.faults import FAULTS, HARMLESS, Mutation, planted

DETECTORS = {
    "sign flip of an axis": ("circle_pose", "normal_off"),
    "half-pixel shift of the isophotes": ("sub_pixel", "place_off"),
    "wrong K: focal length told 2 % too long": ("plane", "cone_axis_off"),
    "degree for radian: tilt of a surface": ("truth", "normal_off"),
    "degree for radian: the metric": ("light_offset", "error_over_law"),
    "isovalue off: traced at 0.9 t": ("isovalue", "radius_off"),
    "noise seed reused": ("noise", "distinct_rendered"),
    "falloff dropped": ("photometry", "residual"),
    "normals in the world frame": ("rotated_camera", "normal_off"),
    "light moved 1 mm": ("photometry", "residual"),
    "ellipse fit unscaled": ("conditioning", "circle_off"),
}
IN_GEOMETRY = ("sign flip of an axis", "half-pixel shift of the isophotes", "isovalue off: traced at 0.9 t",
               "ellipse fit unscaled")  # fmt: skip


def failed(canaries):
    dead = canaries.filter(~pl.col("passed"))
    return set(dead.select("experiment", "quantity").iter_rows())


@pytest.mark.render
def test_all_canaries_live():
    canaries = run_canaries()
    assert not failed(canaries)
    assert dict(canaries.schema) == FIGURES
    assert set(DETECTORS.values()) <= set(canaries.select("experiment", "quantity").iter_rows())
    assert canaries.select("experiment", "quantity").n_unique() == canaries.height
    assert canaries["value"].null_count() == 0


@pytest.mark.parametrize("fault", IN_GEOMETRY)
def test_a_fault_of_the_geometry_kills_its_canary(fault):
    with planted(*FAULTS[fault]):
        found = [c for measure in (geometry.conditioning, geometry.pose, geometry.isophotes) for c in measure()]
    assert DETECTORS[fault] in {(canary.cell.experiment, canary.quantity) for canary in found if not canary.passed}


@pytest.mark.render
@pytest.mark.parametrize(
    "fault", [name if name == "falloff dropped" else pytest.param(name, marks=pytest.mark.slow) for name in FAULTS]
)
def test_a_planted_fault_kills_its_canary(fault):
    with planted(*FAULTS[fault]), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert DETECTORS[fault] in failed(run_canaries())
    # And is gone afterwards.
    with pytest.raises(LookupError):
        Mutation(FAULTS[fault][0].function, FAULTS[fault][0].new + "nowhere", "").code()


@pytest.mark.render
@pytest.mark.parametrize("share", ["0.0", "2.0"])
def test_the_falloffs_shift_is_undone_once(share):
    with planted(Mutation(bisector._normals, "sightline - slope", f"sightline - {share} * slope")):
        assert ("bisector", "plane_off") in failed(measures()["told_light"]())
    assert not failed(measures()["told_light"]())


def test_the_noise_of_canaries_is_the_same_each_time():
    own = [measures()[name] for name in ("photon_noise", "stated_noise", "rigs", "glints")]
    assert pl.concat(measure() for measure in own).equals(pl.concat(measure() for measure in own))


@pytest.mark.render
@pytest.mark.slow
@pytest.mark.parametrize("change", HARMLESS)
def test_a_harmless_change_kills_none(change):
    with planted(*HARMLESS[change]):
        assert not failed(run_canaries())


def test_a_canary_that_breaks_has_failed(monkeypatch):
    # Two of all: each is measured for itself, and test_all_canaries_live measures them all.
    few = {name: measures()[name] for name in ("sightlines", "branches")}
    monkeypatch.setattr(all_canaries, "measures", lambda _: few)
    monkeypatch.setattr(Camera, "unproject", lambda *_: 1 / 0)
    canaries = run_canaries()
    assert canaries.filter(passed=True).height
    broken = canaries.filter(pl.col("experiment") == "sightlines").row(0, named=True)
    assert (broken["value"], broken["passed"], broken["quantity"]) == (None, False, "error")
    assert "ZeroDivisionError" in broken["about"]


def test_repeated_noise_shows_in_the_rows():
    table = rows(count=6).with_columns(noise_sigma=0.05, normal_x=pl.col("error_deg"), normal_y=0.0, normal_z=-1.0)
    assert all(canary.passed for canary in noise.noises_of(table))
    again = table.with_columns(normal_x=0.1)
    assert [canary.quantity for canary in noise.noises_of(again) if not canary.passed] == ["repeated_answers"]
    seeds = table.with_columns(seed=pl.lit(5, pl.Int64))
    assert [canary.value for canary in noise.noises_of(seeds)] == [5, 0]
    # Two settings that share their seeds have the same noise.
    other = table.with_columns(setting=pl.lit("another"), normal_x=pl.col("normal_x") + 1)
    assert [canary.value for canary in noise.noises_of(pl.concat([table, other]))] == [6, 0]


def experiment(sigma, **group):
    small = {"camera.width": 64, "camera.height": 64, "sensor.noise_sigma": sigma}
    return Experiment(name="e", groups=[{"scene": "plane", "set": small, **group}])


def test_noise_that_is_lost_does_not_pass():
    table = rows(count=6).with_columns(noise_sigma=0.05, normal_x=pl.col("error_deg"), normal_y=0.0, normal_z=-1.0)
    clean = table.with_columns(noise_sigma=0.0)
    published = Experiment(name="e", groups=[{"scene": "published"}])
    drawn = experiment(0.0, random={"sensor.noise_sigma": {"low": 0.0, "high": 0.1}})
    for defined in (experiment(0.05), published, drawn):
        assert all(canary.passed for canary in noise.noises_of(table, [defined]))
        unknown = [table.with_columns(noise_sigma=pl.lit(value, pl.Float64)) for value in (None, float("nan"))]
        for lost in (clean, *unknown, table.clear()):
            dead = noise.noises_of(lost, [defined])
            assert not any(canary.passed for canary in dead)
            assert all("no noise in e" in canary.about for canary in dead)
    # One noisy experiment does not stand for another.
    other = experiment(0.05).model_copy(update={"name": "f"})
    assert not any(canary.passed for canary in noise.noises_of(table, [experiment(0.05), other]))
    # Where the definition has none, realisations are the same by right.
    assert all(canary.passed for canary in noise.noises_of(clean.with_columns(normal_x=0.1), [experiment(0.0)]))
    # Without a definition 0 is taken at its word, and nothing is not.
    assert all(canary.passed for canary in noise.noises_of(clean))
    assert not any(canary.passed for canary in noise.noises_of(table.with_columns(noise_sigma=float("nan"))))


def test_noisy_settings_without_an_answer_do_not_pass():
    table = rows(count=6, status="no_peak").with_columns(noise_sigma=0.05)
    assert [canary.quantity for canary in noise.noises_of(table) if not canary.passed] == ["repeated_answers"]
