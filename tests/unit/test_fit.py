"""Fitting a recipe to frames: parameters, emulator, inference, and what is said of bad input. Nothing is rendered."""

import json
import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simtest.errors import InputError
from simtest.realism.fitting import bank as banks
from simtest.realism.fitting import inference
from simtest.realism.fitting.bank import (
    Bank,
    RecipeParameter,
    count_made,
    fitted_parameters,
    make_bank,
    missing_kinds,
    narrowed,
    one_family,
    read_bank,
)
from simtest.realism.fitting.fit import (
    check_out,
    fit_to_bank,
    ranges,
    recipe_toml,
    report_json,
    summarise_scenes,
    write_fit,
)
from simtest.realism.fitting.inference import FOLDS, PENALTIES, features, learn
from simtest.realism.frames import open_frames
from simtest.reconstruction.statistics import COLUMNS, NAMES, summarise
from simtest.runtime.seeds import from_integer
from simtest.spec.recipes import Dataset, Distribution, load_dataset
from simtest.spec.spec_model import validate

RECIPE = {
    "name": "small",
    "families": [{"scene": "plane", "per_sample": {
        "surface.distance_mm": {"low": 8.0, "high": 30.0, "log": True},
        "sensor.noise_sigma": {"low": 0.0, "high": 0.05},
    }}],
}  # fmt: skip


def small():
    return validate(Dataset, RECIPE, "small")


# Parameters ----------------------------------------------------------------------------------------------------------


@given(st.floats(0.001, 100), st.floats(1.1, 50), st.booleans(), st.floats(0, 1))
def test_shares_of_a_range_and_values_belong_together(low, factor, log, share):
    parameter = RecipeParameter(
        "noise", "sensor.full_well", Distribution(low=low, high=low * factor, log=log), "per_sample"
    )
    value = float(parameter.from_unit(np.array(share)))
    assert low * (1 - 1e-9) <= value <= low * factor * (1 + 1e-9)
    assert float(parameter.to_unit(np.array(value))) == pytest.approx(share, abs=1e-6)


def test_the_shipped_recipe_has_all_that_is_fitted():
    parameters = fitted_parameters(one_family(load_dataset("endoscopy"), "tissue_colon"))
    assert not missing_kinds(parameters)
    assert all(parameter.prior.ends[0] < parameter.prior.ends[1] for parameter in parameters)
    assert not any(parameter.key.endswith("seed") for parameter in parameters)


def test_a_recipe_without_relief_is_fitted_in_what_it_has():
    assert [p.kind for p in fitted_parameters(small())] == ["distance", "noise"]
    assert "relief slope" in missing_kinds(fitted_parameters(small()))


def test_a_recipe_without_ranges_and_an_unclear_family_are_refused():
    nothing = validate(Dataset, {"name": "none", "families": [{"scene": "plane"}]}, "none")
    with pytest.raises(InputError, match=r"none: no range .* must draw one of: relief slope"):
        fitted_parameters(nothing)
    with pytest.raises(InputError, match=r"--scene is needed .* tissue_colon, tissue_gallbladder"):
        one_family(load_dataset("endoscopy"))
    with pytest.raises(InputError, match="--scene sea; must name one of its base scenes"):
        one_family(load_dataset("endoscopy"), "sea")


def test_the_written_recipe_reads_back_the_same(tmp_path):
    dataset = one_family(load_dataset("endoscopy"), "tissue_colon")
    parameters = fitted_parameters(dataset)
    count = len(parameters)
    recipe = narrowed(dataset, parameters, np.full(count, 0.25), np.full(count, 0.75))
    path = tmp_path / "endoscopy.toml"
    path.write_text(recipe_toml(recipe))
    assert load_dataset(path) == recipe
    slope = tomllib.loads(path.read_text())["families"][0]["per_anatomy"]["surface.relief.bands.0.slope_deg"]
    low, high = dataset.families[0].per_anatomy["surface.relief.bands.0.slope_deg"].ends
    assert slope["low"] == pytest.approx(0.75 * low + 0.25 * high, rel=1e-4)
    assert slope["high"] == pytest.approx(0.25 * low + 0.75 * high, rel=1e-4)


# Inference -----------------------------------------------------------------------------------------------------------


def frames_of(shares, rng):
    """Return summaries that follow the first two parameters and not the third."""
    x = 2 * shares - 1
    values = rng.standard_normal((len(x), len(NAMES)))
    values[:, 0] += 2 * x[:, 0] + 0.5 * x[:, 0] ** 2
    values[:, 1] += 2 * x[:, 1] - x[:, 0] * x[:, 1]
    return values


@pytest.fixture(scope="module")
def bank():
    rng = np.random.default_rng(5)
    shares = rng.random((300, 3))
    return Bank(shares, frames_of(shares, rng), np.arange(300) // 2)


@pytest.fixture(scope="module")
def emulator(bank):
    return learn(bank, from_integer(0), 60)


def test_the_emulator_finds_the_form_that_made_the_bank(emulator):
    shares = np.random.default_rng(1).random((50, 3))
    x = 2 * shares - 1
    mean = emulator.mean(shares) * emulator.scale + emulator.centre
    assert emulator.parameters == 3
    assert mean[:, 0] == pytest.approx(2 * x[:, 0] + 0.5 * x[:, 0] ** 2, abs=0.5)
    assert mean[:, 1] == pytest.approx(2 * x[:, 1] - x[:, 0] * x[:, 1], abs=0.5)
    assert emulator.deviation[5] == pytest.approx(1.0, abs=0.15)
    # The stated error of the mean is its true one, about.
    error = np.sqrt(np.mean((mean[:, 0] - 2 * x[:, 0] - 0.5 * x[:, 0] ** 2) ** 2)) / emulator.scale[0]
    assert 0.3 < error / np.sqrt(emulator.error[0, 0]) < 3


def test_slopes_and_gradient_are_derivatives(emulator):
    rng = np.random.default_rng(2)
    values = emulator.standardised(frames_of(rng.random((12, 3)), rng))
    scenes, told = inference.moments(values, np.arange(12)), np.ones(len(NAMES), dtype=bool)
    spread, prior = rng.uniform(0, 0.2, 3), rng.random(3)
    point = np.append(rng.random(3), np.log(0.4))

    def value(at):
        return inference.negative_log(emulator, scenes, told, spread, prior, at)[0]

    numeric = [(value(point + 1e-5 * e) - value(point - 1e-5 * e)) / 2e-5 for e in np.eye(4)]
    gradient = inference.negative_log(emulator, scenes, told, spread, prior, point)[1]
    assert gradient == pytest.approx(numeric, rel=1e-4, abs=1e-4)
    steps = [(features(point[:3] + 1e-5 * e) - features(point[:3] - 1e-5 * e))[0] / 2e-5 for e in np.eye(3)]
    assert emulator.slopes(point[:3]) == pytest.approx(np.array(steps) @ emulator.weights, abs=1e-6)


def planted(emulator, number, rng, repeats):
    """Return which of three planted parameters a fit holds; it tells those alone that frames show."""
    truth = rng.uniform(0.2, 0.8, 3)
    shares = truth + rng.uniform(-0.05, 0.05, (30, 3))
    found = inference.infer(emulator, frames_of(shares, rng), from_integer(number), repeats=repeats)
    assert found.told.tolist() == [True, True, False]
    assert np.diff(found.interval[:2], axis=1).max() < 0.5
    return (found.interval[:, 0] <= truth) & (truth <= found.interval[:, 1])


def test_columns_are_fitted_as_if_alone_and_share_their_matrices(bank, monkeypatch):
    summaries = bank.summaries.copy()
    summaries[::7, 4] = np.nan
    summaries[5:, 6] = np.nan
    gaps = Bank(bank.shares, summaries, bank.radiance)
    solve, solved = np.linalg.solve, []
    monkeypatch.setattr(np.linalg, "solve", lambda *told: solved.append(1) or solve(*told))
    together = learn(gaps, from_integer(0), 3)
    # For columns with gaps and without: folds times penalties, and each penalty that is taken.
    assert len(solved) <= 2 * (FOLDS + 1) * len(PENALTIES)
    for column in (0, 4, 6, 9):
        alone = learn(Bank(bank.shares, summaries[:, [column]], bank.radiance), from_integer(0), 3)
        assert together.weights[:, [column]] == pytest.approx(alone.weights, abs=1e-10)
        assert together.draws[:, :, [column]] == pytest.approx(alone.draws, abs=1e-10)


def test_what_frames_do_not_show_is_not_told(emulator):
    assert planted(emulator, 0, np.random.default_rng(3), 5).sum() >= 2


@pytest.mark.slow
def test_planted_parameters_are_held_and_what_frames_do_not_show_is_not_told(emulator):
    rng = np.random.default_rng(3)
    assert np.mean([planted(emulator, number, rng, 20) for number in range(3)]) >= 7 / 9


def test_the_spread_of_scenes_is_found(emulator):
    rng = np.random.default_rng(4)
    wide, narrow = (
        inference.infer(emulator, frames_of(0.5 + rng.uniform(-w, w, (60, 3)), rng), from_integer(0), repeats=2)
        for w in (0.45, 0.01)
    )
    # A uniform distribution of half width w deviates by w / sqrt(3).
    assert wide.spread[:2] == pytest.approx(0.26, abs=0.1)
    assert narrow.spread[:2].max() < 0.1


def test_the_same_seed_gives_the_same_fit_and_gaps_are_filled(bank, emulator):
    rng = np.random.default_rng(6)
    scenes = frames_of(rng.random((5, 3)), rng)
    scenes[2, 3:] = np.nan
    scenes[:, 7] = np.nan
    first, second = (inference.infer(emulator, scenes, from_integer(1), repeats=3) for _ in range(2))
    assert np.array_equal(first.interval, second.interval)
    assert not first.summaries[7]
    assert np.isfinite(first.centres).all()
    with pytest.raises(InputError, match="bank of 10 radiances: must have at least 20"):
        learn(bank.chosen(np.arange(20)), from_integer(0), 2)


# Frames and files ----------------------------------------------------------------------------------------------------


def write_frames(folder, count, size=(96, 80)):
    """Write pictures of a reddish ground with a few white dots."""
    rng = np.random.default_rng(0)
    for number in range(count):
        picture = np.full((*size[::-1], 3), (60, 80, 160), dtype=np.uint8)
        picture += rng.integers(0, 12, picture.shape, dtype=np.uint8)
        for x, y in rng.integers(10, 70, (4, 2)):
            cv2.circle(picture, (int(x), int(y)), 2, (255, 255, 255), -1)
        cv2.imwrite(str(folder / f"frame_{size[0]}_{number}.png"), picture)


def test_one_frame_and_one_film_are_refused_in_one_line(tmp_path):
    film = tmp_path / "one.film"
    film.mkdir()
    write_frames(film, 4)
    for paths in ([film], [film / "frame_96_0.png"]):
        with pytest.raises(InputError, match="frames of 1 scene: a fit needs at least 3, and a film is one scene"):
            summarise_scenes(open_frames(paths))


def test_frames_of_several_sizes_and_without_highlights_are_noted(tmp_path, bank):
    write_frames(tmp_path, 3)
    write_frames(tmp_path, 2, size=(128, 96))
    flat = np.full((80, 96, 3), (60, 80, 160), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "flat.png"), flat)
    cv2.imwrite(str(tmp_path / "grey.png"), flat[..., 0])
    seen = summarise_scenes(open_frames([tmp_path]))
    assert list(seen[2]) == ["grey.png"]
    dataset = small()
    found = fit_to_bank(seen, dataset, fitted_parameters(dataset), bank_of_two(bank), repeats=5)
    assert any("frames of 96 x 80, 128 x 96 px, the recipe's of 406 x 406: what" in note for note in found.notes())
    # Frames of one size that is not the recipe's are noted too; those of the recipe's size are not.
    assert any("frames of 96 x 80 px, the recipe's" in note for note in replace(found, sizes={(96, 80)}).notes())
    assert not any("px" in note for note in replace(found, sizes={(406, 406)}).notes())
    report = report_json(found)
    json.dumps(report, allow_nan=False)
    assert [p["key"] for p in report["parameters"]] == ["surface.distance_mm", "sensor.noise_sigma"]
    recipe, figures = write_fit(found, tmp_path / "fitted.toml")
    assert load_dataset(recipe).families == found.recipe.families
    assert json.loads(figures.read_text())["scenes"] == 6


def bank_of_two(bank):
    return Bank(bank.shares[:, :2], bank.summaries, bank.radiance)


def test_ranges_are_those_of_the_fit_and_stay_inside():
    fitted = inference.Fitted(
        np.array([0.5, 0.95, 0.5]), np.array([0.1, 0.1, 0.1]), 0.1, np.zeros((1, 3)), np.zeros((1, 3)),
        np.array([[0.4, 0.6], [0.8, 1.0], [0.1, 0.9]]), np.ones(3, dtype=bool))  # fmt: skip
    low, high = ranges(fitted)
    assert low == pytest.approx([0.5 - 0.1 * 3**0.5, 0.95 - 0.1 * 3**0.5, 0.1])
    assert high == pytest.approx([0.5 + 0.1 * 3**0.5, 1.0, 0.9])


def test_summaries_of_a_frame_without_highlights_have_gaps():
    empty = {name: np.empty(0) for name in COLUMNS} | {"per_frame": np.array([0.0]), "noise": np.array([0.01])}
    told = dict(zip(NAMES, summarise(empty), strict=True))
    assert told["count"] == 0
    assert told["noise"] == pytest.approx(np.log(0.01))
    assert np.isnan(told["radius"])


def test_a_folder_of_another_bank_and_a_damaged_one_are_refused(tmp_path, monkeypatch):
    dataset = small()
    parameters = fitted_parameters(dataset)
    for index in range(3):
        row = {"values": {p.key: p.prior.ends[0] for p in parameters}, "summaries": [0.5] * len(NAMES)}
        (tmp_path / f"{index:06d}.json").write_text(json.dumps([row]))
    made = make_bank(dataset, parameters, tmp_path, 3, chains=1)
    assert made.shares.tolist() == [[0.0, 0.0]] * 3
    assert count_made(tmp_path) == 3
    with pytest.raises(InputError, match="holds the bank of another recipe, seed, size or release"):
        make_bank(dataset.model_copy(update={"seed": 9}), parameters, tmp_path, 3, chains=1)
    # Its frames were rendered and measured by other code.
    with monkeypatch.context() as other:
        other.setattr(banks, "source_hash", lambda: "of other code")
        with pytest.raises(InputError, match="or release of simtest"):
            make_bank(dataset, parameters, tmp_path, 3, chains=1)
    (tmp_path / "000001.json").write_text("[{]")
    with pytest.raises(InputError, match=r"000001\.json: no file of a bank"):
        read_bank(tmp_path, 3, parameters)


def test_out_must_be_a_toml_file(tmp_path):
    for path in (tmp_path, tmp_path / "fitted.json"):
        with pytest.raises(InputError, match=r"must be a file whose name ends in \.toml"):
            check_out(path)
