"""A run of the benchmark on a tiny suite: its certificate, its verification and its place in the table."""

import json
import platform
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from simtest.bench.run import BenchRun, chosen_parts, core_record, export_frames, maps_record, run_bench, run_maps
from simtest.bench.scores import CERTIFICATE
from simtest.bench.suite import Suite, digest_of, experiment_of, layout_of
from simtest.bench.table import check_suite, read_certificate, read_entries
from simtest.cli import runs
from simtest.dataset.scoring.dense.maps import MapOptions
from simtest.errors import InputError
from simtest.runtime.processes import make_engine
from simtest.runtime.provenance import file_hash, version
from tests.bench_tiny import tiny_suite


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


def test_the_suite_of_the_tests_is_checked(suite: Suite, made: BenchRun) -> None:
    check_suite(read_certificate(made.certificate), suite)


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
