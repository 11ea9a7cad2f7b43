"""The frozen benchmark: its cases are pinned, and a changed one is refused."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import Field

from simtest.bench.suite import (
    SUITE,
    CaseSpec,
    Draw,
    PartSpec,
    Suite,
    SuiteSpec,
    canonical,
    experiment_of,
    load_suite,
    pooled,
    suite_folder,
)  # fmt: skip
from simtest.errors import InputError
from simtest.spec import scene_from_dict
from simtest.surfaces.factory import make_surface
from simtest.validation.cases import expand
from studies.bench_cases import unfrozen_keys
from tests.bench_tiny import tiny_suite
from tests.refusals import refused

V1 = "d4ca908db0cf32f945db653d3cdff8a803ddec1b4946d63b1fee0de21422a6b3"
"""Never changed: a changed case, seed or part is a new version of the suite."""


@pytest.fixture(scope="module")
def suite() -> Suite:
    return load_suite("v1")


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(suite_folder("v1"), tmp_path / "v1"))


def test_the_suite_is_pinned(suite: Suite) -> None:
    assert suite.digest == V1


def test_the_parts_have_cases(suite: Suite) -> None:
    assert [part.name for part in suite.spec.parts] == ["smooth", "tissue", "hard", "real-chain", "dense"]
    assert all(suite.of_part(part.name) for part in suite.spec.parts)


def test_every_default_is_frozen(suite: Suite) -> None:
    """A key that a later release adds must be told here, with a default that means what was done before."""
    assert {case.name: unfrozen_keys(case) for case in suite.cases if unfrozen_keys(case)} == {}


def test_an_added_default_is_seen(copied: Path) -> None:
    file = copied / "smooth" / "plane.toml"
    file.write_text(file.read_text().replace("skew = 0.0\n", ""))
    (case,) = [case for case in _read(copied).cases if case.name == "smooth/plane"]
    assert unfrozen_keys(case) == ["camera.skew"]


def test_a_value_that_is_read_as_another_is_refused(suite: Suite) -> None:
    case = replace(suite.cases[0], scene=suite.cases[0].scene | {"sensor": {"preset": "old_sd"}})
    refused(lambda: unfrozen_keys(case), f"{case.file}: sensor.preset = 'old_sd' is read as None")


def _read(folder: Path) -> Suite:
    from simtest.bench.suite import read_suite

    return read_suite(folder)


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("smooth/plane.toml", "noise_sigma = 0.03", "noise_sigma = 0.02", "case smooth/plane"),
        ("hard/colon.toml", "fold_depth_mm = 7.0", "fold_depth_mm = 7.1", "case hard/colon"),
        ("suite.toml", "draws = 32", "draws = 31", "case smooth/plane"),
        ("suite.toml", "seed = 22", "seed = 23", "parts, seed or list of cases"),
        ("suite.toml", 'name = "dense"\n', 'name = "dense2"\n', "not listed"),
    ],
)
def test_a_changed_case_is_refused(copied: Path, name: str, old: str, new: str, told: str) -> None:
    text = (copied / name).read_text()
    assert old in text
    (copied / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=told) as raised:
        load_suite("v1", copied)
    assert "\n" not in str(raised.value)


def test_hashes_are_of_content_and_not_of_layout(copied: Path, suite: Suite) -> None:
    file = copied / "smooth" / "plane.toml"
    head, *tables = file.read_text().split("\n\n")
    file.write_text("# a comment\n" + "\n\n".join([head, *reversed(tables)]) + "\n")
    prose = copied / "suite.toml"
    prose.write_text(prose.read_text().replace("Smooth laws", "Other words"))
    assert load_suite("v1", copied).digest == suite.digest


def test_canonical_json_is_the_same_for_equal_content() -> None:
    assert canonical({"b": 1.0, "a": [True, None, "é"]}) == b'{"a":[true,null,"\\u00e9"],"b":1.0}'


def test_presets_and_recipes_are_written_out(suite: Suite) -> None:
    for case in suite.cases:
        assert "preset" not in json.dumps(case.scene)
        if case.scene["surface"]["type"] == "anatomy":
            assert len(case.scene["surface"]["recipe"]) > 5


def test_the_seed_draws_pinned_scenes(suite: Suite) -> None:
    experiment = experiment_of(suite, "smooth", "cone_axis")
    assert experiment.seed == 4242855185012620933
    assert experiment.groups[0].pool[0]["surface.distance_mm"][:3] == (13.0514, 16.64, 13.8769)
    hard = experiment_of(suite, "hard", "cone_axis")
    assert hard.groups[0].pool[0]["surface.seed"][::12] == (958227, 286475, 670874)


def test_every_drawn_scene_is_valid(suite: Suite) -> None:
    for part in suite.spec.parts:
        for case in expand(experiment_of(suite, part.name, "cone_axis")):
            scene_from_dict(case.data, case.where)


def test_a_part_or_version_that_is_unknown_is_told(suite: Suite) -> None:
    with pytest.raises(InputError, match=r"did you mean smooth\?"):
        suite.part("smoth")
    with pytest.raises(InputError, match="allowed: v1"):
        load_suite("v9")


SURFACES = {
    "colon": (-21.4451, -22.5975, -2.4337, 67.5371, 20.9011, 110.3139, 5.7061, -0.1302, 31.7267),
    "liver": (-102.8511, -76.4292, -56.134, 109.4487, 74.1469, 56.1142, -34.7472, -59.2632, 180.4235),
    "gallbladder": (-20.7456, -20.7456, -15.0633, 20.7456, 20.7456, -0.0, -0.0602, 0.6576, 20.7351),
}
"""Of the first public scene of some tissue cases: the box of the shape's vertices and the camera's position, mm."""


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SURFACES))
def test_frozen_scenes_keep_their_surfaces(suite: Suite, name: str) -> None:
    """The hashes pin what is asked of the program that makes meshes; this pins what it makes of it."""
    experiment = experiment_of(suite, "tissue", "cone_axis")
    case = next(case for case in expand(experiment) if case.setting == name)
    surface = make_surface(case.scene(experiment, 0)[0].surface)
    mesh = surface.shape().mesh
    assert mesh is not None
    box = (*mesh.vertices.min(axis=0), *mesh.vertices.max(axis=0))
    found = [*box, *surface.model_from_camera[:3, 3]]
    np.testing.assert_allclose(found, SURFACES[name], rtol=0, atol=2e-3)


def test_a_later_key_changes_no_hash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A release that adds a key with a default to cases, draws or parts reads the frozen suite with the same hashes."""
    told = tiny_suite(tmp_path / "v1")

    class LaterDraw(Draw):
        later: int = 0

    class LaterCase(CaseSpec):
        draw: dict[str, LaterDraw] = Field(default_factory=dict)
        later: float = 1.0

    class LaterPart(PartSpec):
        later: str = "x"

    class LaterSuite(SuiteSpec):
        parts: tuple[LaterPart, ...]
        cases: tuple[LaterCase, ...]
        later: bool = False

    monkeypatch.setattr("simtest.bench.suite.SuiteSpec", LaterSuite)
    later = load_suite("v1", tmp_path / "v1")
    assert later.cases[0].spec.later == 1.0
    assert (later.digest, later.hashes) == (told.digest, told.hashes)
    # What the file itself says still counts.
    text = (tmp_path / "v1" / SUITE).read_text()
    (tmp_path / "v1" / SUITE).write_text(text.replace("draws = 3", "draws = 3\nlater = 1.0"))
    with pytest.raises(InputError, match=r"case smooth/plane .*; a changed case must be a new version"):
        load_suite("v1", tmp_path / "v1")


@pytest.mark.parametrize(
    ("draw", "mean", "sd"),
    [({"kind": "normal", "low": 3.0, "high": 0.2}, 3.0, 0.2), ({"low": 2.0, "high": 6.0}, 4.0, 4 / np.sqrt(12)),
     ({"kind": "log_uniform", "low": 1.0, "high": np.e}, np.e - 1, 0.492)],
)  # fmt: skip
def test_drawn_values_have_the_mean_and_deviation_of_their_distribution(draw, mean, sd):
    case = CaseSpec.model_validate({"part": "p", "name": "c", "draws": 1000, "draw": {"surface.tilt_deg": draw}})
    values = pooled(0, "e", case)["surface.tilt_deg"]
    # 1000 values: the mean to 3 %, the deviation to 2 %, of the deviation, one standard error.
    assert np.mean(values) == pytest.approx(mean, abs=0.13 * sd)
    assert np.std(values) == pytest.approx(sd, rel=0.1)
