"""The benchmark: its frozen suite, a run on a tiny one, certificates, which of them are refused, and their table."""

import json
import platform
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from pydantic import Field

from simtest.bench.run import (
    BenchRun,
    _scene_sums,
    chosen_parts,
    core_record,
    export_frames,
    maps_record,
    overall_of,
    run_bench,
    run_maps,
)
from simtest.bench.scores import CERTIFICATE
from simtest.bench.suite import (
    HASHES,
    SUITE,
    CaseSpec,
    Draw,
    PartSpec,
    Suite,
    SuiteSpec,
    canonical,
    digest_of,
    experiment_of,
    layout_of,
    load_suite,
    pooled,
    read_suite,
    suite_folder,
)  # fmt: skip
from simtest.bench.table import (
    Board,
    Certificate,
    ranked,
    read_certificate,
    read_entries,
    write_leaderboard,
)
from simtest.cli import runs
from simtest.dataset.scoring.dense.maps import MapOptions
from simtest.errors import InputError
from simtest.runtime.processes import make_engine
from simtest.runtime.provenance import file_hash, version
from simtest.spec import scene_from_dict
from simtest.surfaces.factory import make_surface
from simtest.validation.cases import expand
from studies.bench_cases import freeze, unfrozen_keys
from tests.bench_tiny import copied, tiny_suite
from tests.refusals import refused

V1 = "d4ca908db0cf32f945db653d3cdff8a803ddec1b4946d63b1fee0de21422a6b3"
"""Never changed: a changed case, seed or part is a new version of the suite."""


@pytest.fixture(scope="module")
def frozen() -> Suite:
    return load_suite("v1")


@pytest.fixture
def frozen_copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(suite_folder("v1"), tmp_path / "v1"))


def test_the_suite_is_pinned(frozen: Suite) -> None:
    assert frozen.digest == V1


def test_the_same_cases_are_frozen_with_the_same_hashes(frozen_copy: Path) -> None:
    refused(lambda: freeze(frozen_copy), "is frozen; a changed case must be a new version")
    hashes, plane = frozen_copy / HASHES, frozen_copy / "smooth" / "plane.toml"
    before = hashes.read_bytes(), plane.read_bytes()
    hashes.unlink()
    plane.write_text(plane.read_text().replace("skew = 0.0\n", ""))
    freeze(frozen_copy)
    assert (hashes.read_bytes(), plane.read_bytes()) == before


def test_every_default_is_frozen(frozen: Suite) -> None:
    """A key that a later release adds must be told here, with a default that means what was done before."""
    assert {case.name: unfrozen_keys(case) for case in frozen.cases if unfrozen_keys(case)} == {}


def test_an_added_default_is_seen(frozen_copy: Path) -> None:
    file = frozen_copy / "smooth" / "plane.toml"
    file.write_text(file.read_text().replace("skew = 0.0\n", ""))
    (case,) = [case for case in read_suite(frozen_copy).cases if case.name == "smooth/plane"]
    assert unfrozen_keys(case) == ["camera.skew"]


def test_a_value_that_is_read_as_another_is_refused(frozen: Suite) -> None:
    case = replace(frozen.cases[0], scene=frozen.cases[0].scene | {"sensor": {"preset": "old_sd"}})
    refused(lambda: unfrozen_keys(case), f"{case.file}: sensor.preset = 'old_sd' is read as None")


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        ("smooth/plane.toml", "noise_sigma = 0.03", "noise_sigma = 0.02", "case smooth/plane"),
        ("suite.toml", "draws = 32", "draws = 31", "case smooth/plane"),
        ("suite.toml", "seed = 22", "seed = 23", "parts, seed or list of cases"),
        ("suite.toml", 'name = "dense"\n', 'name = "dense2"\n', "not listed"),
    ],
)
def test_a_changed_case_is_refused(frozen_copy: Path, name: str, old: str, new: str, told: str) -> None:
    text = (frozen_copy / name).read_text()
    assert old in text
    (frozen_copy / name).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=told) as raised:
        load_suite("v1", frozen_copy)
    assert "\n" not in str(raised.value)


def test_hashes_are_of_content_and_not_of_layout(frozen_copy: Path, frozen: Suite) -> None:
    file = frozen_copy / "smooth" / "plane.toml"
    head, *tables = file.read_text().split("\n\n")
    file.write_text("# a comment\n" + "\n\n".join([head, *reversed(tables)]) + "\n")
    prose = frozen_copy / "suite.toml"
    prose.write_text(prose.read_text().replace("Smooth laws", "Other words"))
    assert load_suite("v1", frozen_copy).digest == frozen.digest


def test_canonical_json_is_the_same_for_equal_content() -> None:
    assert canonical({"b": 1.0, "a": [True, None, "é"]}) == b'{"a":[true,null,"\\u00e9"],"b":1.0}'


def test_presets_and_recipes_are_written_out(frozen: Suite) -> None:
    for case in frozen.cases:
        assert "preset" not in json.dumps(case.scene)
        if case.scene["surface"]["type"] == "anatomy":
            assert len(case.scene["surface"]["recipe"]) > 5


def test_the_seed_draws_pinned_scenes(frozen: Suite) -> None:
    experiment = experiment_of(frozen, "smooth", "cone_axis")
    assert experiment.seed == 4242855185012620933
    assert experiment.groups[0].pool[0]["surface.distance_mm"][:3] == (13.0514, 16.64, 13.8769)
    hard = experiment_of(frozen, "hard", "cone_axis")
    assert hard.groups[0].pool[0]["surface.seed"][::12] == (958227, 286475, 670874)


def test_every_drawn_scene_is_valid(frozen: Suite) -> None:
    for part in frozen.spec.parts:
        for case in expand(experiment_of(frozen, part.name, "cone_axis")):
            scene_from_dict(case.data, case.where)


def test_a_part_or_version_that_is_unknown_is_told(frozen: Suite) -> None:
    with pytest.raises(InputError, match=r"did you mean smooth\?"):
        frozen.part("smoth")
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
def test_frozen_scenes_keep_their_surfaces(frozen: Suite, name: str) -> None:
    """The hashes pin what is asked of the program that makes meshes; this pins what it makes of it."""
    experiment = experiment_of(frozen, "tissue", "cone_axis")
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


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return tiny_suite(tmp_path_factory.mktemp("suites") / "v1")


@pytest.fixture(scope="module")
def made(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> BenchRun:
    return run_bench(suite, "cone_axis", tmp_path_factory.mktemp("run"))


@pytest.mark.render
def test_a_certificate_tells_what_was_run(suite: Suite, made: BenchRun) -> None:
    told = read_certificate(made.certificate).content
    assert told["cases"] == {"smooth/plane": suite.hashes["smooth/plane"]}
    assert told["core"]["name"] == "cone_axis"
    assert told["core"]["version"].startswith("simtest ")
    part = told["parts"]["smooth"]
    assert (part["n"], part["answered"], part["missed"]) == (6, 6, 0)
    assert 0 < part["median_deg"] < 0.5
    assert [n for n, _ in part["scenes"]["plane"]] == [2, 2, 2]
    assert part["score_deg"] == pytest.approx(part["mean_deg"], abs=1e-6)
    assert told["overall"] == {
        "complete": True, "score_deg": part["score_deg"],
        "score_interval": pytest.approx(told["overall"]["score_interval"]),
    }  # fmt: skip


@pytest.mark.render
def test_a_certificate_tells_nothing_of_the_machine_s_owner(made: BenchRun) -> None:
    text = made.certificate.read_text()
    assert str(made.certificate.parent) not in text
    assert str(Path.home()) not in text
    assert platform.node() not in text or len(platform.node()) < 4


@pytest.mark.slow
@pytest.mark.render
def test_a_run_goes_on_and_is_the_same_by_two_workers(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    again = run_bench(suite, "cone_axis", made.certificate.parent)
    assert again.content["parts"] == made.content["parts"]
    two = run_bench(suite, "cone_axis", tmp_path / "two", engine=make_engine(workers=2))
    assert two.content["parts"] == made.content["parts"]
    rows = [(run.certificate.parent / "smooth" / "results.parquet").read_bytes() for run in (made, two)]
    assert rows[0] == rows[1]


@pytest.mark.render
def test_maps_are_scored_on_the_dense_part(suite: Suite, tmp_path: Path) -> None:
    """A stranger gets frames without truth, and maps that face the camera err by the tilt."""
    frames = export_frames(suite, tmp_path / "given")
    pictures = sorted(file.stem for file in (frames / "frames").iterdir())
    assert len(set(pictures)) == 2
    assert not [file for file in frames.rglob("*") if "truth" in file.name]
    maps = tmp_path / "facing"
    maps.mkdir()
    for name in set(pictures):
        np.save(maps / f"{name}.npy", np.tile([0.0, 0.0, -1.0], (96, 96, 1)))
    options = MapOptions(encoding="components", frame="opencv")
    made = run_maps(suite, maps, tmp_path / "run", options)
    told = read_certificate(made.certificate)
    tilts = experiment_of(suite, "dense", "x").groups[0].pool[0]["surface.tilt_deg"]
    part = told.parts["dense"]
    assert part["mean_deg"] == pytest.approx(np.mean(tilts), abs=1e-3)
    assert part["n"] == part["answered"] == part["zones"]["all"]["n"] > 10_000
    assert [total / n for n, total in part["scenes"]["plane"]] == pytest.approx(tilts, abs=1e-3)
    assert told.core["kind"] == "maps"
    assert not told.content["overall"]["complete"]
    assert read_entries(tmp_path / "run", suite).parts["dense"][0].rank == "1"
    assert part["stated"] == {"encoding": "components", "frame": "opencv", "depth": None, "unit_mm": None}
    # What is no map is no part of the method.
    (maps / "notes.txt").write_text("mine")
    assert maps_record(maps, made_score(maps))["sha256"] == told.core["sha256"]
    np.save(maps / f"{pictures[0]}.npy", np.tile([0.0, 0.6, -0.8], (96, 96, 1)))
    assert maps_record(maps, made_score(maps))["sha256"] != told.core["sha256"]


def made_score(maps: Path) -> Any:
    """Return what of a score a record reads."""
    return SimpleNamespace(name=maps.name)


def test_a_folder_that_is_called_as_the_baseline_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert maps_record("shading", made_score(Path("shading")))["kind"] == "baseline"
    (tmp_path / "shading").mkdir()
    np.save(tmp_path / "shading" / "a.npy", np.zeros((4, 4, 3)))
    assert maps_record("shading", made_score(Path("shading")))["kind"] == "maps"


def test_layout_of_a_scene_are_those_of_its_part(suite: Suite) -> None:
    assert layout_of(suite, "smooth") == {"plane": (3, 2)}
    assert layout_of(suite, "dense") == {"plane": (2, 1)}


def test_parts_that_cannot_be_run_are_told(suite: Suite) -> None:
    assert chosen_parts(suite, None) == ["smooth"]
    for wanted, told in ((["dense"], "scored by maps"), (["smooth", "smooth"], "named twice"), (["x"], "unknown")):
        with pytest.raises(InputError, match=told):
            chosen_parts(suite, wanted)


def test_an_unknown_core_is_told_before_anything_is_made(suite: Suite, tmp_path: Path) -> None:
    for core in ("con_axis", "  "):
        with pytest.raises(InputError):
            run_bench(suite, core, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_an_empty_folder_has_no_table(suite: Suite, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds 0 certificates"):
        read_entries(tmp_path, suite)


@pytest.mark.render
def test_a_command_is_run_as_a_core(suite: Suite, tmp_path: Path) -> None:
    """A core that answers with the sightline of the peak, in a process of its own."""
    core = tmp_path / "core.py"
    core.write_text(CORE)
    made = run_bench(suite, f"command: {sys.executable} {core}", tmp_path / "run")
    told = made.content["core"]
    assert (told["kind"], told["name"], told["version"]) == ("command", "core", "1.5")
    # The hash is of the script: another machine has another interpreter.
    assert told["sha256"] == digest_of({"files": [["core.py", file_hash(core)]], "words": ["core.py"]})
    assert told["program"] == {"name": Path(sys.executable).name, "sha256": file_hash(Path(sys.executable))}
    assert made.content["parts"]["smooth"]["answered"] == 6
    assert str(tmp_path) not in made.certificate.read_text()
    rows = pl.read_parquet(tmp_path / "run" / "smooth" / "results.parquet")
    assert rows["estimator"].unique().to_list() == ["core"]


@pytest.mark.render
def test_a_core_s_hash_is_of_its_words_and_files(tmp_path: Path) -> None:
    """Another option, another file or another content is another core; another folder is not."""

    def sha256(folder: Path, words: str) -> Any:
        return core_record(f"command: {sys.executable} {folder / 'core.py'} {words}")["sha256"]

    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        (folder / "core.py").write_text(CORE)
        (folder / "weights.bin").write_bytes(b"1")
    plain = sha256(tmp_path / "a", "--fast")
    assert plain == sha256(tmp_path / "b", "--fast")
    weights = sha256(tmp_path / "a", f"--weights={tmp_path / 'a' / 'weights.bin'}")
    assert weights == sha256(tmp_path / "b", f"--weights={tmp_path / 'b' / 'weights.bin'}")
    (tmp_path / "b" / "weights.bin").write_bytes(b"2")
    others = {sha256(tmp_path / "b", f"--weights={tmp_path / 'b' / 'weights.bin'}"), sha256(tmp_path / "a", "--slow")}
    assert len({plain, weights, *others}) == 4


CORE = """
import json, math, sys
source, sink = sys.stdin.buffer, sys.stdout.buffer

def send(message):
    sink.write(json.dumps(message).encode() + b"\\n")
    sink.flush()

source.readline()
send({"type": "hello", "protocol": 1, "name": "peak", "version": "1.5", "kind": "patch", "arrays": ["saturated"]})
for line in source:
    request = json.loads(line)
    for array in request.get("arrays", []):
        source.read(math.prod(array["shape"]) * int(array["dtype"][-1]))
    if request["type"] != "patch":
        continue
    camera, patch = request["camera"]["K"], request["patch"]
    x, y = patch["peak_px"]
    ray = [(x - camera[0][2]) / camera[0][0], (y - camera[1][2]) / camera[1][1], 1.0]
    length = math.sqrt(sum(part * part for part in ray))
    normal = [-part / length for part in ray]
    send({"type": "estimate", "id": request["id"], "normal": normal, "look_px": [x, y]})
"""


@pytest.mark.render
def test_the_commands_run_and_rank(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("simtest.bench.suite.load_suite", lambda *_: suite)
    runs.run(out=tmp_path / "run", core="brightest_point")
    assert str(tmp_path / "run" / CERTIFICATE) in capsys.readouterr().out
    runs.table(tmp_path / "run", out=tmp_path / "table", as_json=True)
    assert json.loads(capsys.readouterr().out)["parts"]["smooth"] == {f"brightest_point simtest {version()}": "1"}
    assert "brightest_point ranks first over all parts" in (tmp_path / "table" / "index.html").read_text()


def test_a_stop_says_what_is_kept(
    suite: Suite, made: BenchRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums over maps are not gone on with; a core's run is."""

    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("simtest.bench.suite.load_suite", lambda *_: suite)
    for name in ("run.run_maps", "run.run_bench"):
        monkeypatch.setattr(f"simtest.bench.{name}", stopped)
    for command, told in (
        (
            lambda: runs.run(out=tmp_path / "run", maps=tmp_path),
            "frames are kept; the same command scores all maps anew",
        ),
        (lambda: runs.run(out=tmp_path / "run", core="cone_axis"), "^$"),
    ):
        with pytest.raises(KeyboardInterrupt, match=told):
            command()


@pytest.mark.render
def test_an_altered_certificate_is_refused(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    held = json.loads(made.certificate.read_text())
    held["parts"]["smooth"]["median_deg"] *= 0.5
    path = tmp_path / CERTIFICATE
    path.write_text(json.dumps(held))
    with pytest.raises(InputError, match="was altered"):
        read_certificate(path)


@pytest.mark.render
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c["suite"].update(version="v2"), "is of version .v2."),
        (lambda c: c["cases"].update({"smooth/plane": "0" * 64}), "case smooth/plane is not that of"),
        (lambda c: c.update(format=9), "format = 9; this release reads 2"),
        (lambda c: c.update(kind="other"), "is no certificate"),
        (lambda c: c.pop("core"), "has no key core"),
        (lambda c: c["cases"].clear(), "case smooth/plane is not that of"),
        (lambda c: c["parts"].update(soft=c["parts"]["smooth"]), "part soft is none of|part 'soft' is none of"),
        (lambda c: c["parts"]["smooth"].update(scenes={"plane": [[2, 0.0], [2, 0.0]]}), "scenes: must be 3 of plane"),
    ],
)
def test_the_table_refuses_what_is_not_right(
    suite: Suite, made: BenchRun, tmp_path: Path, change: Any, told: str
) -> None:
    copied(made, tmp_path / "entry", change)
    with pytest.raises(InputError, match=told) as raised:
        read_entries(tmp_path, suite)
    assert "\n" not in str(raised.value)


_REMOVED = object()


@pytest.mark.render
@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("parts.smooth", None), ("parts.smooth.uncertainty", _REMOVED), ("parts.smooth.scenes", _REMOVED),
        ("parts.smooth.score_deg", -5.0), ("parts.smooth.score_deg", 10**400), ("parts.smooth.median_deg", "0.1"),
        ("parts.smooth.score_interval", [90.0, 0.0]), ("parts.smooth.median_interval", [0.1]),
        ("parts.smooth.refused", {"core_died": -1}), ("parts.smooth.more", 1),
        ("parts.smooth.scenes", {"plane": [[2, -1.0]]}), ("parts.smooth.uncertainty.interval", [0.3, 0.2]),
        ("parts.smooth.uncertainty.verdict", "best"), ("parts", {}), ("core.name", "\ud800"),
        ("environment.versions", {"numpy": 1}),
    ],
)  # fmt: skip
def test_what_has_not_the_form_of_a_certificate_is_refused(
    made: BenchRun, tmp_path: Path, path: str, value: Any
) -> None:
    """Its hash fits."""

    def change(content: Any) -> None:
        *above, last = path.split(".")
        for key in above:
            content = content[key]
        if value is _REMOVED:
            del content[last]
        else:
            content[last] = value

    with pytest.raises(InputError) as raised:
        read_certificate(copied(made, tmp_path, change))
    assert "\n" not in str(raised.value)
    assert str(raised.value).isprintable()


@pytest.mark.render
@pytest.mark.parametrize("number", ["NaN", "1e999", "1" * 5000, "[" * 10**6])
def test_what_has_no_hash_is_refused(made: BenchRun, tmp_path: Path, number: str) -> None:
    text = made.certificate.read_text()
    (tmp_path / CERTIFICATE).write_text(text.rstrip().removesuffix("}") + f', "x": {number}}}')
    with pytest.raises(InputError, match=r"cannot be read as a certificate|was altered") as raised:
        read_certificate(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.render
def test_the_table_ranks_and_ties(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    """Cores that differ by the same in each scene are ranked, however much the scenes differ; else they are tied."""

    def named(name: str, sums: list[float]) -> None:
        def change(content: Any) -> None:
            content["core"]["name"] = name
            figures = {"score_deg": sum(sums) / 6, "score_interval": [0.0, 10.0]}
            content["parts"]["smooth"].update(
                figures, mean_deg=sum(sums) / 6, scenes={"plane": [[2, total] for total in sums]}
            )
            # the headline of a single part is that part's
            content["overall"] = overall_of(suite, content["parts"])
            assert content["overall"]["score_interval"] == pytest.approx([0.0, 10.0])

        copied(made, tmp_path / "all" / name, change)

    named("best", [0.2, 3.0, 6.0])
    named("middle", [2.2, 5.0, 8.0])
    named("unsteady", [6.4, 3.0, 6.0])
    named("<worst>", [12.2, 15.0, 18.0])
    board = read_entries(tmp_path / "all", suite)
    ranks = [(row.certificate.core["name"], row.rank) for row in board.overall]
    assert ranks == [("best", "1–2"), ("middle", "2–3"), ("unsteady", "1–4"), ("<worst>", "3–4")]
    assert [row.rank for row in board.parts["smooth"]] == [rank for _, rank in ranks]
    page = write_leaderboard(suite, board, tmp_path / "table").read_text()
    assert "&lt;worst&gt;" in page
    assert "<worst>" not in page
    assert page.count("<h1>") == 1
    assert "best and unsteady share the first rank over all parts" in page
    assert "clear at 5&nbsp;% for the whole table" in page
    assert "(<code>smooth</code>)" in page


def test_a_core_without_a_score_has_no_rank(tmp_path: Path) -> None:
    held = [
        Certificate(tmp_path / name, {"value": value, "parts": {"smooth": {"scenes": {"plane": scenes}}}})
        for name, value, scenes in (("a", None, [[0, 0.0], [0, 0.0]]), ("b", 1.0, [[1, 1.0], [1, 1.0]]))
    ]
    rows = ranked(held, ["smooth"], lambda certificate: certificate.content["value"])
    assert [(row.certificate.path.name, row.rank) for row in rows] == [("b", "1"), ("a", "–")]
    assert [row.rank for row in ranked(held[:1], ["smooth"], lambda _: None)] == ["–"]


def test_certificates_of_one_name_each_have_a_rank(tmp_path: Path) -> None:
    """A command with two options has one name."""
    held = [
        Certificate(
            tmp_path / name,
            {"core": {"name": core, "version": None}, "value": value,
             "parts": {"smooth": {"scenes": {"plane": [[1, value], [1, value], [1, value]]}}}},
        )
        for name, core, value in (("fast", "my_core", 8.0), ("slow", "my_core", 1.0), ("other", "cone_axis", 4.0))
    ]  # fmt: skip
    rows = ranked(held, ["smooth"], lambda certificate: certificate.content["value"])
    assert Board(rows, {}).to_json()["overall"] == {
        f"my_core ({tmp_path / 'slow'})": "1", "cone_axis": "2", f"my_core ({tmp_path / 'fast'})": "3"
    }  # fmt: skip


def test_a_frame_without_a_row_moves_no_other_frame() -> None:
    """Two scenes of two frames, the first of which shows no surface; a name that stands for two equal frames is one."""

    def row(frame: str, error: float) -> dict[str, object]:
        return {"frame": frame, "setting": "plane", "source": "normal", "quantity": "angle_deg", "surface": "fine",
                "group": "zone", "label": "all", "n": 10, "mean_penalised": error}  # fmt: skip

    score = SimpleNamespace(rows=[row("b", 1.0), row("c", 5.0), row("d", 5.0)])
    numbers = {"a": 0, "b": 1, "c": 2, "d": 3}
    assert _scene_sums(score, "normal", {"plane": (2, 2)}, numbers) == {"plane": [(10, 10.0), (20, 100.0)]}
    score.rows = [row("b", 1.0), row("c", 5.0)]
    assert _scene_sums(score, "normal", {"plane": (2, 2)}, numbers) == {"plane": [(10, 10.0), (10, 50.0)]}
