"""Regions of a core's answers by its calibration: how it is found, what its file holds, and what answers get by it."""

import json
from dataclasses import replace

import cv2
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import simtest
from simtest.advice import core_calibration
from simtest.advice.core_calibration import (
    batch_experiment,
    calibrate_core,
    kept_frame,
    quantile,
    shift_of,
    strata_of,
)
from simtest.advice.plan import Question
from simtest.advice.scope import read_scope
from simtest.bench.run import run_bench
from simtest.cli.commands import APP
from simtest.cli.common import RegionOptions
from simtest.dataset.scoring.frames import CaseFrames, Source, frames_of_cases
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.reconstruction.light_calibration.run import picture_readers
from simtest.reconstruction.options import Options
from simtest.reconstruction.outputs import REGION_COLUMNS, columns_of
from simtest.reconstruction.regions import (
    LEAST_SET,
    OF_ANSWER,
    OF_FRAME,
    SET_FRAMES,
    CoreCalibration,
    check_frames,
    of_frame,
    read_calibrations,
    statistics_of,
)
from simtest.reconstruction.sequence import _settings, reconstruct_sequence
from simtest.reconstruction.statistics import NAMES
from simtest.spec import Experiment
from simtest.spec.recipes import CoreRegions
from simtest.validation.cases import expand
from tests.bench_tiny import tiny_suite

# What is found --------------------------------------------------------------------------------------------------------


def clusters(rng, frames, each, alike):
    """Return errors in frames that share a part of them, and the frames' numbers."""
    of = np.repeat(np.arange(frames), rng.poisson(each, frames) + 1)
    shared = np.sqrt(alike) * rng.standard_normal(frames)[of]
    return np.exp(shared + np.sqrt(1 - alike) * rng.standard_normal(len(of))), of


def coverage(find, frames, each, alike, level, draws=400):
    """Return the share of new frames' answers within what is found."""
    rng, held = np.random.default_rng(7), []
    for _ in range(draws):
        limit = find(*clusters(rng, frames, each, alike), level)
        held.append(np.concatenate([clusters(rng, 1, each, alike)[0] <= limit for _ in range(10)]))
    return np.mean(np.concatenate(held)), np.std([each.mean() for each in held]) / np.sqrt(draws)


@settings(max_examples=6, deadline=None)
@given(
    st.integers(20, 60), st.sampled_from([0, 4, 12]), st.sampled_from([0.0, 0.5, 0.9]), st.sampled_from([0.68, 0.95])
)
def test_a_share_of_a_new_frames_answers_is_within_the_quantile(frames, each, alike, level):
    held, deviation = coverage(quantile, frames, each, alike, level)
    assert level - 4 * deviation < held < level + 0.05 + 1 / frames


def test_highlights_are_not_independent_so_a_plain_quantile_holds_less():
    held, deviation = coverage(lambda values, _, level: np.quantile(values, level), 20, 12, 0.9, 0.95)
    assert held < 0.95 - 4 * deviation


def test_too_few_frames_tell_no_quantile():
    values = np.arange(18.0)
    assert quantile(values, np.arange(18), 0.95) == np.inf
    assert quantile(np.arange(19.0), np.arange(19), 0.95) == 18.0


def drawn(seed, frames=120, each=10):
    """Return features and errors of answers whose reported deviation tells the error, and radius nothing."""
    rng = np.random.default_rng(seed)
    of = np.repeat(np.arange(frames), each)
    seen = {name: rng.uniform(0.1, 1.0, len(of)) for name in (*OF_ANSWER, *OF_FRAME)}
    seen["sigma_deg"] = rng.choice([0.2, 1.0, 8.0], len(of))
    seen["flags"], seen["kind"] = rng.integers(0, 3, len(of)).astype(float), np.full(len(of), -1.0)
    return seen, seen["sigma_deg"] * rng.rayleigh(1.0, len(of)), of


def test_strata_part_all_answers_once_and_hold_in_each():
    seen, errors, of = drawn(1)
    strata = strata_of(seen, errors, of)
    assert len(strata.parts) > 2
    assert sum(part.highlights for part in strata.parts) == len(errors)
    fresh, new, _ = drawn(2)
    rows = [{name: float(values[i]) for name, values in fresh.items()} for i in range(len(new))]
    assert all(sum(part.holds(row) for part in strata.parts) == 1 for row in rows)
    for level, share in enumerate((0.68, 0.95)):
        radii = np.array([strata.region(row, False)[level] for row in rows])
        assert np.mean(new <= radii) == pytest.approx(share, abs=0.03)
        for part in strata.parts:
            own = np.array([part.holds(row) for row in rows])
            assert np.mean(new[own] <= radii[own]) > share - 0.1


def test_the_expected_error_follows_what_tells_it():
    seen, errors, of = drawn(3)
    told = {**seen, "sigma_deg": np.full(len(of), -1.0), "radius_px": seen["sigma_deg"]}
    found = strata_of(told, errors, of)
    rows = [{name: float(values[i]) for name, values in told.items()} for i in range(0, len(of), 7)]
    radii = np.array([found.region(each, False)[1] for each in rows])
    assert np.median(radii[told["radius_px"][::7] == 8.0]) > 4 * np.median(radii[told["radius_px"][::7] == 0.2])
    # A shuffled error depends on nothing.
    shuffled = np.random.default_rng(0).permutation(errors)
    row = {name: float(values[0]) for name, values in told.items()}
    flat = strata_of(told, shuffled, of)
    assert flat.region({**row, "radius_px": 0.2}, False)[1] == pytest.approx(flat.parts[0].error_deg[1], rel=0.5)


def test_a_frames_statistics_tell_what_its_errors_are_and_what_is_not_told_counts_as_the_mean():
    seen, errors, of = drawn(4, frames=300)
    errors /= seen["sigma_deg"]
    rough = np.random.default_rng(5).uniform(0.0, 1.0, 300)[of]
    told = {**seen, "sigma_deg": np.full(len(of), -1.0), "halo": rough}
    told["vessels"] = np.where(of % 2, np.nan, told["vessels"])
    strata = strata_of(told, errors * np.exp(2 * rough), of)
    row = {name: float(values[0]) for name, values in told.items()} | {"vessels": np.nan}
    smooth, middle, wild, unknown = (strata.expected.of(row | {"halo": halo}) for halo in (0.1, 0.5, 0.9, np.nan))
    assert wild / smooth > 1.8
    assert unknown == pytest.approx(middle, rel=0.15)
    # Of a grey frame nothing is known.
    assert np.isfinite(strata.region(row | of_frame(None), False)).all()


def test_outside_an_answer_has_the_worst_region():
    seen, errors, of = drawn(1)
    strata = strata_of(seen, errors, of)
    row = {name: float(values[0]) for name, values in seen.items()}
    sure = {**row, "sigma_deg": 0.2}
    assert strata.region(sure, True)[1] >= max(part.error_deg[1] for part in strata.parts)
    assert strata.region(sure, False)[1] < 1.0
    # What reports no deviation, where all did in the calibration, is as uncertain, and so is what reports more.
    assert strata.region({**row, "sigma_deg": -1.0}, False) == strata.region({**row, "sigma_deg": -1.0}, True)
    assert strata.region({**row, "sigma_deg": 500.0}, False) == (180.0, 180.0)
    assert strata.region({**row, "sigma_deg": 9.0}, False)[1] >= max(
        18.0, *(part.error_deg[1] for part in strata.parts)
    )


def test_the_check_on_shift_finds_shifted_frames_and_few_others():
    rng = np.random.default_rng(4)
    mixing = rng.standard_normal((len(NAMES), len(NAMES)))
    frames = rng.standard_normal((300, len(NAMES))) @ mixing
    frames[::7, 3] = np.nan
    found = shift_of(frames)
    fresh = rng.standard_normal((600, len(NAMES))) @ mixing
    assert np.mean([found.distance(each) > found.limit for each in fresh]) < 0.09
    assert np.mean([found.distance(each + 6 * mixing[0]) > found.limit for each in fresh]) > 0.8


def test_many_frames_together_show_a_shift_that_one_hides():
    rng = np.random.default_rng(4)
    mixing = rng.standard_normal((len(NAMES), len(NAMES)))
    found = shift_of(rng.standard_normal((128, len(NAMES))) @ mixing)

    def unlike(shift, count=SET_FRAMES):
        sets = (rng.standard_normal((count, len(NAMES))) @ mixing + shift * mixing[0] for _ in range(200))
        told = [(found.set_distance(each) > found.set_limit, found.distance(each[0]) > found.limit) for each in sets]
        return np.mean(told, axis=0)

    assert unlike(0.0)[0] <= 0.05
    assert unlike(0.0, LEAST_SET)[0] <= 0.05
    together, alone = unlike(1.5)
    assert together > 0.9
    assert alone < 0.3


# Its file and what answers get ----------------------------------------------------------------------------------------


def calibration(tmp_path, name="calibration.json", **changes):
    """Write a calibration of cone_axis in grey frames of 160 x 120 px, and return its file."""
    seen, errors, of = drawn(1)
    strata = strata_of({**seen, "sigma_deg": np.full(len(of), -1.0)}, errors, of)
    made = CoreCalibration(
        core="cone_axis", scope="colocated", size=(160, 120), detector="peaks", every=False, highlights=1200,
        frames=120, strata={"fine": strata, "base": strata}, shift=None, made={},
    )  # fmt: skip
    path = tmp_path / name
    path.write_text(json.dumps(made.model_dump(mode="json") | changes))
    return path


def lobes():
    y, x = np.mgrid[:120, :160] + 0.5
    return sum(np.exp(-((x - at) ** 2 + (y - 60) ** 2) / 100) for at in (45, 115)).astype(np.float32)


CAMERA = simtest.Camera.from_fov(60.0, 160, 120)


def test_answers_have_their_regions_and_no_others_have(tmp_path):
    path = calibration(tmp_path)
    found = simtest.reconstruct(lobes(), CAMERA, ["cone_axis", "curved"], regions=path)
    plain = simtest.reconstruct(lobes(), CAMERA, ["cone_axis", "curved"])
    assert len(found) == 2
    for spot, same in zip(found, plain, strict=True):
        region = spot.estimates["cone_axis"].calibrated
        assert 0 < region.radius_68_deg < region.radius_95_deg
        assert region.region_source == "calibrated on 1200 highlights of colocated"
        assert spot.organ["cone_axis"].calibrated is not None
        assert spot.estimates["curved"].calibrated is None
        assert np.array_equal(spot.estimates["cone_axis"].covariance, same.estimates["cone_axis"].covariance)
        assert "radius_95_deg" in spot.to_json()["estimates"]["cone_axis"]
    table = found.to_polars()
    assert table.filter(pl.col("estimator") == "cone_axis")["radius_95_deg"].null_count() == 0
    assert table.filter(pl.col("estimator") == "curved")["radius_95_deg"].null_count() == 2
    # Without a calibration nothing is written of it.
    assert not {*REGION_COLUMNS} & {*columns_of([spot.to_json() for spot in plain])}
    assert all("calibrated" not in json.dumps(spot.to_json(), default=str) for spot in plain)


def test_too_wide_regions_are_refused(tmp_path):
    files = (str(calibration(tmp_path)),)
    found = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=CoreRegions(files=files, refuse_above_deg=0.01))
    assert [str(spot.estimates["cone_axis"].reason) for spot in found] == ["refused"] * 2
    assert "95 % radius" in found[0].estimates["cone_axis"].detail
    assert found[0].best is None
    kept = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=CoreRegions(files=files, refuse_above_deg=180))
    assert isinstance(kept[0].estimates["cone_axis"], Estimate)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"size": [320, 240]}, "160 x 120 px, not 320 x 240"),
        ({"detector": "colour"}, "isolated highlights by peaks"),
        ({"every": True}, "isolated highlights by peaks"),
        (
            {"shift": {"centre": [0.0] * 19, "whitening": np.eye(19).tolist(), "limit": 1.0, "set_limit": 1.0}},
            "inf standard deviations",
        ),
    ],
)
def test_other_frames_than_the_calibrations_are_told(tmp_path, change, why):
    files = (str(calibration(tmp_path, **change)),)
    near = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=calibration(tmp_path, "near.json"))
    widened = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=CoreRegions(files=files))
    region = widened[0].estimates["cone_axis"].calibrated
    assert why in region.region_source
    assert region.radius_95_deg > near[0].estimates["cone_axis"].calibrated.radius_95_deg
    refused = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=CoreRegions(files=files, shifted="refuse"))
    failure = refused[0].estimates["cone_axis"]
    assert isinstance(failure, Failure)
    assert failure.reason is Reason.REFUSED
    assert why in failure.detail


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"format": "simtest core calibration, version 2"}, "format"),
        ({"highlights": "many"}, "highlights = 'many'"),
        ({"strata": {}}, "strata"),
        ({"strata": {"middle": {}}}, "strata"),
        ({"shift": {"centre": [0.0], "whitening": [[1.0]], "limit": 1.0}}, "shift.centre"),
        ({"bias": 1}, "bias"),
    ],
)
def test_a_malformed_file_is_refused_in_a_line(tmp_path, change, told):
    path = calibration(tmp_path, **change)
    with pytest.raises(InputError) as error:
        read_calibrations([str(path)])
    assert str(path) in str(error.value)
    assert told in str(error.value)


def test_files_must_be_there_and_of_an_estimator_that_runs(tmp_path):
    with pytest.raises(InputError, match=r"gone\.json"):
        read_calibrations([str(tmp_path / "gone.json")])
    (tmp_path / "text.json").write_text("no JSON")
    with pytest.raises(InputError, match="not JSON"):
        read_calibrations([str(tmp_path / "text.json")])
    path = calibration(tmp_path)
    with pytest.raises(InputError, match="several files of one core"):
        read_calibrations([str(path), str(calibration(tmp_path, "again.json"))])
    with pytest.raises(InputError, match="of cone_axis; must be of an estimator that runs: curved"):
        simtest.reconstruct(lobes(), CAMERA, ["curved"], regions=path)


def test_another_search_than_the_calibrations_is_told(tmp_path):
    path = calibration(tmp_path)
    for how in ({"roi": (20, 30, 50, 60)}, {"smoothing_px": 3.0}):
        found = simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=[path], **how)
        assert "searched in a region" in found[0].estimates["cone_axis"].calibrated.region_source


@pytest.mark.parametrize("wrong", [5, [5], []])
def test_what_names_no_file_is_refused(wrong):
    with pytest.raises(InputError, match="regions"):
        simtest.reconstruct(lobes(), CAMERA, ["cone_axis"], regions=wrong)


def test_a_sequence_goes_on_with_the_same_calibration_alone(tmp_path):
    options = Options(fov_deg=60.0, regions=CoreRegions(files=(str(calibration(tmp_path)),)))
    before = _settings(tmp_path, options, None)
    assert _settings(tmp_path, options, None) == before
    calibration(tmp_path, highlights=1300)
    assert _settings(tmp_path, options, None) != before


# Rendered frames ------------------------------------------------------------------------------------------------------

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 140.0, "camera.fy": 140.0}


class Stray:
    """Answers beside every highlight, and beside the surface."""

    def estimate_frame(self, frame, camera, priors):
        """Return the sightline to the camera at two pixels."""
        normal = np.array([0.0, 0.0, -1.0])
        return [Estimate(normal, normal[None], np.array(look), covariance=1e-4 * np.eye(2))
                for look in ([45.5, 60.5], [1.0, 1.0])]  # fmt: skip


def test_false_answers_are_judged_where_they_look():
    # The corner sees past a sphere of radius 4, whose nearest point is 10 mm away.
    held = {**SMALL, "surface.radius_mm": 4.0, "surface.tilt_deg": 0.0}
    experiment = Experiment.model_validate(
        {"name": "stray", "realisations": 1, "groups": [{"scene": "sphere", "set": held}]}
    )
    (frame,) = CaseFrames(experiment, expand(experiment)[0], 0, None)
    answers = kept_frame(frame, {"stray": Stray()}, "peaks", True)["answers"]
    # In closed form: where the sightline meets the sphere, the normal's angle to the axis.
    axis = np.array([(45.5 - 80) / 140, (60.5 - 60) / 140, 1.0])
    ray, centre = axis / np.linalg.norm(axis), np.array([0.0, 0.0, 14.0])
    along = ray @ centre
    normal = (ray * (along - np.sqrt(along**2 - centre @ centre + 4.0**2)) - centre) / 4.0
    expected = np.degrees(np.arccos(-normal[2]))
    assert expected > 20
    told = sorted(each["error_deg"] for each in answers if each["target"] == "fine")
    assert told == pytest.approx([expected, 180.0], abs=0.01)


def test_a_run_has_the_regions_and_is_another_run(tmp_path):
    described = {"name": "regions", "realisations": 2, "seed": 3, "estimators": ["cone_axis", "curved"],
                 "groups": [{"scene": "cylinder", "set": SMALL}]}  # fmt: skip
    plain = Experiment.model_validate(described)
    regions = CoreRegions(files=(str(calibration(tmp_path)),))
    told = plain.model_copy(update={"regions": regions})
    assert "regions" not in plain.model_dump(mode="json")
    rows = simtest.validate(told, tmp_path / "told").results
    same = simtest.validate(plain, tmp_path / "plain").results
    own = rows.filter(pl.col("estimator") == "cone_axis", pl.col("status") == "ok")
    assert own.height == 2
    assert own["radius_95_deg"].null_count() == 0
    assert rows.drop(REGION_COLUMNS).equals(same)
    prints = [json.loads((tmp_path / each / "summary.json").read_text())["run"]["fingerprint"]
              for each in ("told", "plain")]  # fmt: skip
    assert prints[0] != prints[1]
    refused = plain.model_copy(update={"regions": regions.model_copy(update={"refuse_above_deg": 0.01})})
    assert {*simtest.validate(refused, tmp_path / "refused").results["status"]} == {"refused", "ok"}


def test_a_run_is_scored_by_the_given_calibrations_not_by_its_own(tmp_path):
    regions = CoreRegions(files=(str(calibration(tmp_path)),))
    experiment = Experiment.model_validate(
        {
            "name": "regions",
            "realisations": 1,
            "estimators": ["curved"],
            "groups": [{"scene": "cylinder", "set": SMALL}],
        }
    ).model_copy(update={"regions": regions})
    cases = expand(experiment)
    source = Source(
        tmp_path, frames_of_cases(experiment, cases, "llvm_ad_mono"), "run", "", "", "", "", experiment, cases
    )
    bare = source.with_regions(None)
    assert bare.recipe.regions is None
    assert all(part.experiment.regions is None for part in bare.parts)
    assert "region_source" not in bare.swept_example
    assert bare.with_regions(regions).parts[0].experiment.regions == regions
    # A calibration of none of the estimators is refused before the folder is touched.
    with pytest.raises(InputError, match="must be of an estimator that runs: curved"):
        simtest.validate(experiment, tmp_path / "run")
    assert not [*(tmp_path / "run").glob("*")]


def test_batches_differ_and_show_the_organs_colours():
    question = Question(read_scope("colocated"), seed=4)
    first, second, again = (batch_experiment(question, number) for number in (0, 1, 0))
    assert first == again
    assert first.groups[0].pool != second.groups[0].pool
    # An advice's walls have no vessels.
    assert "reflectance.albedo" not in first.groups[0].set
    (pool,) = first.groups[0].pool
    for key in ("reflectance.albedo.base.1", "reflectance.film.level", "surface.relief.bands.1.slope_deg",
                "sensor.coding.quality"):  # fmt: skip
        assert len({*pool[key]}) > 2, key


def test_what_a_scope_states_is_not_drawn(tmp_path):
    text = "[camera]\nwidth = 64\nheight = 64\nfx = 40.0\nfy = 40.0\n"
    for sensor, held, drawn in (
        ("[sensor]\npreset = 'colonoscope_hd'\ncoding = {type = 'jpeg', quality = 60, chroma = '4:2:0'}\n", 60, True),
        (
            "[sensor]\nfull_well = 9000.0\nbits = 8\ncoding = {type = 'jpeg', quality = 60, chroma = '4:2:0'}\n",
            60,
            False,
        ),
        ("", None, True),
    ):
        (tmp_path / "scope.toml").write_text(text + sensor + "[relief]\nslope_deg = [2.0, 4.0]\n")
        (group,) = batch_experiment(Question(read_scope(str(tmp_path / "scope.toml"))), 0).groups
        (pool,) = group.pool
        assert ("sensor.sharpening.amount" in pool) == drawn
        assert ("sensor.coding.quality" in pool) == (held is None)
        assert held is None or group.set["sensor"]["coding"]["quality"] == held
        assert not [key for key in pool if key.startswith("surface.relief.bands.1")]
        expand(batch_experiment(Question(read_scope(str(tmp_path / "scope.toml"))), 0))
    # A smooth phantom has neither relief nor a film's level.
    (group,) = batch_experiment(Question(read_scope("laparoscope"), "plane"), 0).groups
    assert not [key for key in group.pool[0] if key.startswith(("surface.relief", "reflectance.film.level"))]


@pytest.mark.slow
def test_a_stopped_calibration_goes_on_to_the_same_file(tmp_path, monkeypatch):
    monkeypatch.setattr(core_calibration, "LEAST_BATCHES", 5)
    monkeypatch.setattr(core_calibration, "LEAST_FRAMES", 19)
    text = "[camera]\nwidth = 64\nheight = 64\nfx = 40.0\nfy = 40.0\n[sensor]\npreset = 'colonoscope_hd'\n"
    (tmp_path / "scope.toml").write_text(text)
    question = Question(read_scope(str(tmp_path / "scope.toml")), "plane", seed=5)
    whole = calibrate_core("cone_axis", question, tmp_path / "whole.json", 10, "peaks", True)
    steps = []

    def stop(done, total, what):
        steps.append(done)
        if done == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        calibrate_core("cone_axis", question, tmp_path / "part.json", 10, "peaks", True, progress=stop)
    assert not (tmp_path / "part.json").exists()
    steps.clear()
    again = calibrate_core(
        "cone_axis", question, tmp_path / "part.json", 10, "peaks", True, progress=lambda *told: steps.append(told[0])
    )
    assert again == whole
    # The first batch was not rendered again.
    assert steps[0] == 9
    assert (tmp_path / "whole.json").read_bytes() == (tmp_path / "part.json").read_bytes()
    # Another seed's answers are kept apart.
    other = calibrate_core("cone_axis", replace(question, seed=6), tmp_path / "part.json", 10, "peaks", True)
    assert other.strata != whole.strata


def test_the_command_line_takes_calibrations(tmp_path, monkeypatch, capsys):
    calibration(tmp_path, detector="colour")
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("picture.png", np.round(255 * lobes()).astype(np.uint8))
    words = (
        "reconstruct picture.png --fov 60 --out out --detector peaks --estimator cone_axis --regions calibration.json"
    )
    with pytest.warns(UserWarning, match="no calibration"):
        APP(words.split(), exit_on_error=False, result_action="return_value")
    told = json.loads((tmp_path / "out" / "normals.json").read_text())["specularities"]
    assert len(told) == 2
    assert all("peaks" in each["estimates"]["cone_axis"]["region_source"] for each in told)
    assert "95 % within" in capsys.readouterr().out
    assert "region_source" in (tmp_path / "out" / "index.html").read_text()
    assert "radius_95_deg" in (tmp_path / "out" / "normals.csv").read_text().splitlines()[0]


def test_a_folder_of_frames_is_checked(tmp_path, capsys, monkeypatch):
    rng, frames = np.random.default_rng(2), tmp_path / "frames"
    frames.mkdir()
    tints = rng.uniform(0.4, 0.6, (LEAST_SET, 3))
    pictures = [np.clip(each * rng.uniform(0.8, 1.0, (96, 96, 1)), 0, 1) for each in tints]
    for number, each in enumerate(pictures):
        cv2.imwrite(str(frames / f"{number:02d}.png"), np.round(255 * each).astype(np.uint8))
    centre = np.nan_to_num([statistics_of(each[..., ::-1]) for each in pictures]).mean(axis=0).tolist()
    shift = {"centre": centre, "whitening": (0.01 * np.eye(len(NAMES))).tolist(), "limit": 5.0, "set_limit": 5.0}

    def told(**changes):
        path = calibration(tmp_path, shift=shift | changes)
        code = APP(["calibrate", "check", str(path), str(frames)], exit_on_error=False, result_action="return_value")
        return code, capsys.readouterr().out

    assert told() == (0, told()[1])
    assert "16 frames together are like those of colocated" in told()[1]
    code, text = told(centre=[each + 300 for each in centre], limit=5.0)
    assert code == 1
    assert "together are unlike" in text
    assert "unlike by itself: 00.png" in text
    (frames / "00.png").unlink()
    with pytest.raises(InputError, match="15 frames in colour"):
        check_frames(
            read_calibrations([str(calibration(tmp_path, shift=shift))])["cone_axis"], picture_readers([frames])
        )
    with pytest.raises(InputError, match="grey frames"):
        check_frames(read_calibrations([str(calibration(tmp_path))])["cone_axis"], [])


def test_each_row_of_a_timeline_has_its_region(tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for number in range(2):
        cv2.imwrite(str(frames / f"{number}.png"), np.round(255 * lobes()).astype(np.uint8))
    own = CoreRegions(files=(str(calibration(tmp_path)),))
    options = Options(fov_deg=60.0, detector="peaks", estimators=("cone_axis", "curved"), regions=own)
    for name, chosen in (("told", options), ("plain", replace(options, regions=None))):
        with pytest.warns(UserWarning, match="no calibration"):
            reconstruct_sequence(frames, tmp_path / name, chosen)
    told, plain = (pl.read_csv(tmp_path / name / "timeline.csv") for name in ("told", "plain"))
    assert told.drop(REGION_COLUMNS).equals(plain)
    assert told.filter(pl.col("estimator") == "cone_axis")["radius_95_deg"].null_count() == 0
    assert told.filter(pl.col("estimator") != "cone_axis")["region_source"].null_count() == told.height / 2


def test_scored_answers_have_their_regions(tmp_path, monkeypatch):
    """A run's own answers, scored with a calibration, are those of the run with it."""
    monkeypatch.chdir(tmp_path)
    experiment = Experiment.model_validate(
        {"name": "scored", "realisations": 2, "seed": 3, "estimators": ["cone_axis"],
         "groups": [{"scene": "cylinder", "set": SMALL}]}
    )  # fmt: skip
    own = CoreRegions(files=(str(calibration(tmp_path)),))
    run = simtest.validate(experiment, tmp_path / "run", export=tmp_path / "frames")
    direct = simtest.validate(experiment.model_copy(update={"regions": own}), tmp_path / "direct").results
    uses = pl.DataFrame(json.loads((tmp_path / "run" / "export.json").read_text())["uses"])
    rows = run.results.filter(pl.col("specularity").is_not_null())
    rows = rows.join(uses.select("frame", "setting", "realisation"), on=["setting", "realisation"])
    told = ("frame", "estimator", "specularity", "x_px", "y_px", "normal_x", "normal_y", "normal_z", "cov_11", "cov_12",
            "cov_22", "target", "axis_ratio", "flags", "status")  # fmt: skip
    rows.rename({"look_x_px": "x_px", "look_y_px": "y_px"}).select(told).write_csv("answers.csv")
    words = "score answers.csv --on run --out scored --regions calibration.json"
    APP(words.split(), exit_on_error=False, result_action="return_value")
    scored = pl.read_parquet("scored/results.parquet")
    assert scored["radius_95_deg"].to_list() == pytest.approx(direct["radius_95_deg"].to_list(), abs=1e-9)
    assert [*scored["region_source"]] == ["calibrated on 1200 highlights of colocated"] * 2
    APP([*words.split(), "--refuse-above", "0.01"], exit_on_error=False, result_action="return_value")
    assert {*pl.read_parquet("scored/results.parquet")["status"]} == {"refused"}


def test_a_certificate_tells_its_calibration(tmp_path):
    suite = tiny_suite(tmp_path / "v1")
    calibrated = CoreRegions(files=(str(calibration(tmp_path)),))
    plain = run_bench(suite, "cone_axis", tmp_path / "plain", parts=("smooth",))
    made = run_bench(suite, "cone_axis", tmp_path / "made", parts=("smooth",), regions=calibrated)
    assert "regions" not in plain.content["core"]
    assert len(made.content["core"]["regions"]) == 64
    refusing = calibrated.model_copy(update={"refuse_above_deg": 0.01})
    refused = run_bench(suite, "cone_axis", tmp_path / "refused", parts=("smooth",), regions=refusing)
    answered = [each.content["parts"]["smooth"]["answered"] for each in (plain, made, refused)]
    assert answered == [6, 6, 0]
    assert made.content["core"]["regions"] != refused.content["core"]["regions"]


def test_options_of_regions_need_a_file(tmp_path):
    with pytest.raises(InputError, match="--refuse-above and --shifted need --regions"):
        RegionOptions(refuse_above=20.0).read()
    with pytest.raises(InputError, match=r"gone\.json"):
        RegionOptions([tmp_path / "gone.json"]).read()
    read = RegionOptions([calibration(tmp_path)], 20.0, "refuse").read()
    assert read == CoreRegions(files=(str(tmp_path / "calibration.json"),), refuse_above_deg=20.0, shifted="refuse")
    with pytest.raises(InputError, match="not for maps"):
        RegionOptions([tmp_path / "gone.json"]).refuse()
    with pytest.raises(InputError, match="refuse_above_deg = 200"):
        RegionOptions([calibration(tmp_path)], 200.0).read()
