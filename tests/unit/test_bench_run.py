"""A run of the benchmark on a tiny suite: its certificate, its verification and its place in the table."""

import copy
import io
import json
import platform
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest

from simtest.bench.certificate import CERTIFICATE, OF_CERTIFICATE, check_suite, read_certificate, write_certificate
from simtest.bench.compare import Verified, compare
from simtest.bench.cores import core_record
from simtest.bench.draws import Seeds, experiment_of, public_seeds
from simtest.bench.leaderboard import ranked, read_entries, write_leaderboard
from simtest.bench.maps import export_frames, maps_record
from simtest.bench.run import BenchRun, chosen_parts, run_bench, run_maps
from simtest.bench.seal import SEALED, seal
from simtest.bench.suite import HASHES, SUITE, Suite, digest_of, frames_of, load_suite, read_suite, resolved_tables
from simtest.bench.verified import keep_verified, read_verified
from simtest.bench.verify import check_quick, check_seeds, verify_run
from simtest.cli import bench
from simtest.dataset.scoring.dense.conventions import MapOptions
from simtest.errors import InputError
from simtest.runtime.engines import make_engine
from simtest.runtime.files import write_json
from simtest.runtime.provenance import file_hash
from simtest.spec import load_scene
from simtest.spec.toml_files import toml_tables

COMMITMENT = "5" * 64

SUITE_TEXT = """
name = "tiny"
title = "Tiny"
description = "Two small planes."
format = 1
seed = 5
[[parts]]
name = "smooth"
title = "Smooth"
description = "Planes."
[[parts]]
name = "dense"
title = "Dense"
description = "Maps."
kind = "maps"
[[cases]]
part = "smooth"
name = "plane"
draws = 3
realisations = 2
[cases.draw]
"surface.tilt_deg" = { kind = "uniform", low = 1.0, high = 8.0 }
[[cases]]
part = "dense"
name = "plane"
draws = 2
[cases.draw]
"surface.tilt_deg" = { kind = "uniform", low = 1.0, high = 8.0 }
"""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    folder = tmp_path_factory.mktemp("suites") / "v1"
    small = {"camera.width": 96, "camera.height": 96, "camera.fx": 96.0, "camera.fy": 96.0}
    tables = resolved_tables(load_scene("plane", small | {"sensor.noise_sigma": 0.02}))
    tables.pop("name")
    for part in ("smooth", "dense"):
        (folder / part).mkdir(parents=True)
        (folder / part / "plane.toml").write_text(toml_tables(tables))
    (folder / SUITE).write_text(SUITE_TEXT)
    read = read_suite(folder)
    write_json(folder / HASHES, {"suite": read.digest, "cases": read.hashes})
    return load_suite("v1", folder)


@pytest.fixture(scope="module")
def made(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> BenchRun:
    return run_bench(suite, "cone_axis", tmp_path_factory.mktemp("run"), public_seeds(suite))


def _copied(made: BenchRun, folder: Path, change: Any = None) -> Path:
    """Write a certificate with a change and a hash that fits it."""
    content = copy.deepcopy(made.content)
    if change:
        change(content)
    folder.mkdir(parents=True, exist_ok=True)
    return write_certificate(folder, content)


@pytest.mark.render
def test_a_certificate_tells_what_was_run(suite: Suite, made: BenchRun) -> None:
    told = read_certificate(made.certificate).content
    assert told["cases"] == {"smooth/plane": suite.hashes["smooth/plane"]}
    assert told["core"]["name"] == "cone_axis"
    assert told["core"]["version"].startswith("simtest ")
    assert told["seeds"] == {"kind": "public", "seed": 5}
    part = told["parts"]["smooth"]
    assert (part["n"], part["answered"], part["missed"]) == (6, 6, 0)
    assert 0 < part["median_deg"] < 0.5
    assert told["overall"] == {
        "complete": True, "penalised_deg": part["penalised_deg"],
        "penalised_interval": pytest.approx(told["overall"]["penalised_interval"]),
    }  # fmt: skip
    assert told["timing"]["request"]["n"] >= 1


@pytest.mark.render
def test_a_certificate_tells_nothing_of_the_machine_s_owner(made: BenchRun) -> None:
    text = made.certificate.read_text()
    assert str(made.certificate.parent) not in text
    assert str(Path.home()) not in text
    assert platform.node() not in text or len(platform.node()) < 4


@pytest.mark.slow
@pytest.mark.render
def test_a_run_goes_on_and_is_the_same_by_two_workers(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    again = run_bench(suite, "cone_axis", made.certificate.parent, public_seeds(suite))
    assert again.content["parts"] == made.content["parts"]
    two = run_bench(suite, "cone_axis", tmp_path / "two", public_seeds(suite), engine=make_engine(workers=2))
    assert two.content["parts"] == made.content["parts"]
    rows = [(run.certificate.parent / "smooth" / "results.parquet").read_bytes() for run in (made, two)]
    assert rows[0] == rows[1]


@pytest.mark.render
def test_a_certificate_is_verified_by_running_again(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    told = read_certificate(made.certificate)
    found = verify_run(told, suite, tmp_path / "again", public_seeds(suite))
    assert found.holds
    assert "smooth: the same rows" in found.notes
    assert check_quick(told, suite).holds


@pytest.mark.render
def test_other_seeds_are_other_frames(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    sealed = run_bench(suite, "cone_axis", tmp_path, Seeds("secret", COMMITMENT))
    assert sealed.content["seeds"] == {"kind": "sealed", "commitment": COMMITMENT}
    assert sealed.content["parts"]["smooth"]["results"] != made.content["parts"]["smooth"]["results"]
    told = read_certificate(sealed.certificate)
    check_seeds(told, suite, Seeds("secret", COMMITMENT))
    for seeds, words in (
        (public_seeds(suite), "--sealed must name"),
        (Seeds("x", "other"), "was run with other seeds"),
    ):
        with pytest.raises(InputError, match=words):
            check_seeds(told, suite, seeds)
    with pytest.raises(InputError, match="leave out --sealed"):
        check_seeds(read_certificate(made.certificate), suite, Seeds("x", "other"))


@pytest.mark.render
@pytest.mark.parametrize("kind", ["command", "toml"])
def test_a_certificate_runs_no_command(suite: Suite, made: BenchRun, tmp_path: Path, kind: str) -> None:
    """A stranger's certificate names a command in place of an installed estimator: it is not started."""
    command = f"touch {tmp_path / 'started'}"
    (tmp_path / "core.toml").write_text(f"[core]\nname = 'x'\ncommand = '{command}'\n")
    name = f"command: {command}" if kind == "command" else str(tmp_path / "core.toml")
    path = _copied(made, tmp_path / "entry", lambda content: content["core"].update(name=name))
    with pytest.raises(InputError, match="is not installed here"):
        verify_run(read_certificate(path), suite, tmp_path / "run", public_seeds(suite))
    assert not (tmp_path / "started").exists()


@pytest.mark.render
@pytest.mark.parametrize("results", ["same", "other"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("penalised_deg", 1e-5), ("mean_deg", 1e-5), ("p95_deg", 1e-5), ("median_deg", 1e-5),
        ("median_interval", [0.0, 1e-5]), ("penalised_interval", [0.0, 1e-5]), ("answered", 3), ("n", 9),
        ("refused", {"core_died": 3}), ("uncertainty.verdict", "calibrated"), ("uncertainty.coverage", 0.5),
        ("uncertainty.n", 500), ("uncertainty.interval", [0.0, 0.1]), ("uncertainty.semi_axis_deg", 1e-5),
        ("uncertainty.inflation", 9.0), ("uncertainty.energy_deg", 1e-5), ("more", 1), ("refused", 5),
        ("p95_deg", None),
    ],
)  # fmt: skip
def test_no_figure_is_taken_on_trust(made: BenchRun, results: str, key: str, value: Any) -> None:
    """A stated figure that the run again does not have speaks against the certificate, whatever its rows' hash."""
    told = copy.deepcopy(made.content)
    part = told["parts"]["smooth"]
    if results == "other":
        part["results"] = "0" * 64
    assert compare(told, made.content).holds
    *above, last = key.split(".")
    (part[above[0]] if above else part)[last] = value
    (problem,) = compare(told, made.content).problems[:1]
    assert problem.startswith("smooth")
    assert key.split(".")[0] in problem


@pytest.mark.render
def test_what_processors_differ_by_is_allowed(made: BenchRun) -> None:
    """Highlights that one processor refuses change means by 90 deg over their number; figures else by 5 %."""
    found = copy.deepcopy(made.content)
    part = found["parts"]["smooth"]
    part.update(n=600, answered=600, mean_deg=0.4, penalised_deg=0.4, p95_deg=1.0, results="0" * 64)
    told = copy.deepcopy(found)
    stated = told["parts"]["smooth"]
    stated["results"] = "1" * 64
    stated["median_deg"] += 9e-4
    stated.update(penalised_deg=0.415, mean_deg=0.385, p95_deg=1.04)
    assert compare(told, found).holds
    stated["penalised_deg"] = 0.43
    (problem,) = compare(told, found).problems
    assert problem == "smooth.penalised_deg: differs by 0.03 deg; at most 0.021 is allowed"
    # two of 600 refused: 0.3 deg
    stated.update(answered=598, refused={"not_converged": 2}, penalised_deg=0.7)
    compared = compare(told, found)
    assert compared.holds
    assert "smooth.answered: 598, here 600: contours changed their topology" in compared.notes
    stated["median_deg"] += 2e-4
    assert "smooth.median_deg: differs by 0.0011 deg; at most 0.001" in compare(told, found).problems[0]


@pytest.mark.render
def test_another_core_or_machine_is_told(made: BenchRun) -> None:
    found = copy.deepcopy(made.content)
    found["environment"]["processor"] = "another one"
    assert any("another one" in note for note in compare(made.content, found).notes)
    assert compare(made.content, found).holds
    found["core"]["sha256"] = "abc"
    assert compare(made.content, found).problems == ("core sha256: stated None, here abc",)


@pytest.mark.render
def test_an_altered_certificate_is_refused(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    held = json.loads(made.certificate.read_text())
    held["parts"]["smooth"]["median_deg"] *= 0.5
    path = tmp_path / CERTIFICATE
    path.write_text(json.dumps(held))
    with pytest.raises(InputError, match="was altered"):
        read_certificate(path)
    # with a hash that fits, the figures do not follow from the rows beside it
    del held[OF_CERTIFICATE]
    (tmp_path / "smooth").mkdir()
    (tmp_path / "smooth" / "results.parquet").write_bytes(
        (made.certificate.parent / "smooth" / "results.parquet").read_bytes()
    )
    path.write_text(json.dumps({**held, OF_CERTIFICATE: digest_of(held)}))
    assert check_quick(read_certificate(path), suite).problems == (
        "smooth: median_deg does not follow from the results",
    )


@pytest.mark.render
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c["suite"].update(version="v2"), "is of version .v2."),
        (lambda c: c["cases"].update({"smooth/plane": "0" * 64}), "case smooth/plane is not that of"),
        (lambda c: c.update(format=9), "format = 9; this release reads 1"),
        (lambda c: c.update(kind="other"), "is no certificate"),
        (lambda c: c.pop("core"), "has no key core"),
        (lambda c: c["parts"]["smooth"].update(missed=3), "do not add up to n = 6"),
        (lambda c: c["overall"].update(penalised_deg=0.0), "overall: does not follow"),
        (lambda c: c["cases"].clear(), "case smooth/plane is not that of"),
        (lambda c: c["parts"].update(soft=c["parts"]["smooth"]), "part soft is none of|part 'soft' is none of"),
        (lambda c: c["seeds"].update(seed=6), "neither a commitment nor the public seed 5"),
        (lambda c: c["parts"]["smooth"].update(penalised_deg=0.001), "does not follow from the mean and the counts"),
        (lambda c: c["parts"]["smooth"].update(mean_deg=None), "do not go with 6 answers"),
        (lambda c: c["parts"]["smooth"].pop("n"), r"parts.smooth.n"),
        (lambda c: c["parts"]["smooth"].update(median_deg="0.1"), r"parts.smooth.median_deg"),
        (lambda c: c["parts"]["smooth"]["uncertainty"].update(verdict="best"), r"uncertainty.verdict"),
        (lambda c: c.update(parts=[]), "parts"),
        (lambda c: c["core"].update(name=["a"]), r"core.name"),
        (lambda c: c.update(timing={}), r"timing.request"),
    ],
)
def test_the_table_refuses_what_is_not_right(
    suite: Suite, made: BenchRun, tmp_path: Path, change: Any, told: str
) -> None:
    _copied(made, tmp_path / "entry", change)
    with pytest.raises(InputError, match=told) as raised:
        read_entries(tmp_path, suite)
    assert "\n" not in str(raised.value)


_REMOVED = object()


@pytest.mark.render
@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("parts.smooth", None), ("parts.smooth.refused", _REMOVED), ("parts.smooth.uncertainty", _REMOVED),
        ("parts.smooth.penalised_deg", -5.0), ("parts.smooth.penalised_deg", 10**400), ("parts.smooth.p95_deg", 181.0),
        ("parts.smooth.penalised_interval", [90.0, 0.0]), ("parts.smooth.median_interval", [0.1]),
        ("parts.smooth.median_deg", 179.0), ("parts.smooth.refused", {"core_died": -1}), ("parts.smooth.more", 1),
        ("parts.smooth.uncertainty.n", 500), ("parts.smooth.uncertainty.verdict", "calibrated"),
        ("parts.smooth.uncertainty.interval", [0.3, 0.2]), ("parts", {}), ("parts.smooth.zones", {"all": {}}),
        ("cases", []), ("suite", "v1"), ("core", "x"), ("core", {}), ("core.sha256", 5), ("core.name", "\ud800"),
        ("core.version", 1), ("seeds", [1]), ("seeds", {}), ("seeds.commitment", [1]), ("seeds.kind", "sealed"),
        ("seeds.commitment", "5" * 64), ("seeds.seed", True), ("environment", {}), ("environment.processor", _REMOVED),
        ("environment.versions", {"numpy": 1}), ("timing.request", _REMOVED), ("timing.parts_s", {"smooth": -1.0}),
        ("overall", "x"), ("extra", 1),
    ],
)  # fmt: skip
def test_what_has_not_the_form_of_a_certificate_is_refused(
    made: BenchRun, tmp_path: Path, path: str, value: Any
) -> None:
    """A stranger wrote it, and gave it the hash that fits."""

    def change(content: Any) -> None:
        *above, last = path.split(".")
        for key in above:
            content = content[key]
        if value is _REMOVED:
            del content[last]
        else:
            content[last] = value

    with pytest.raises(InputError) as raised:
        read_certificate(_copied(made, tmp_path, change))
    assert "\n" not in str(raised.value)
    assert str(raised.value).isprintable()


@pytest.mark.render
@pytest.mark.parametrize(
    "number", ["NaN", "1e999", "-Infinity", "1" * 5000, "[" * 900 + "]" * 900, "[" * 10**6, '1, "kind": 2']
)
def test_what_has_no_hash_is_refused(made: BenchRun, tmp_path: Path, number: str) -> None:
    text = made.certificate.read_text()
    (tmp_path / CERTIFICATE).write_text(text.rstrip().removesuffix("}") + f', "x": {number}}}')
    with pytest.raises(InputError, match=r"cannot be read as a certificate|was altered") as raised:
        read_certificate(tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.render
def test_the_table_ranks_and_ties(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    def named(name: str, low: float, high: float, seeds: Any = None) -> None:
        def change(content: Any) -> None:
            content["core"]["name"] = name
            content["seeds"] = seeds or content["seeds"]
            figures = {"penalised_deg": (low + high) / 2, "penalised_interval": [low, high]}
            content["parts"]["smooth"].update(figures, mean_deg=(low + high) / 2)
            # the headline of a single part is that part's
            content["overall"].update(figures)

        _copied(made, tmp_path / "all" / name, change)

    named("best", 1.0, 2.0)
    named("tied", 1.5, 2.5)
    named("middle", 2.2, 3.0)
    named("<worst>", 4.0, 5.0)
    named("sealed one", 1.0, 2.0, {"kind": "sealed", "commitment": COMMITMENT})
    boards = read_entries(tmp_path / "all", suite)
    ranks = [(row.certificate.core["name"], row.rank) for row in boards[0].overall]
    assert ranks == [("best", "1–2"), ("tied", "1–3"), ("middle", "2–3"), ("<worst>", "4")]
    assert [row.rank for row in boards[1].overall] == ["1"]
    page = write_leaderboard(suite, boards, tmp_path / "table").read_text()
    assert "&lt;worst&gt;" in page
    assert "<worst>" not in page
    assert page.count("<h1>") == 1
    assert page.count("as stated</td>") == 5
    # the first headline is of the seeds in text order, and each part's name is that of the command
    assert "best has the smallest error over all parts" in page
    assert "(<code>smooth</code>)" in page


@pytest.mark.render
def test_the_table_marks_what_was_run_again(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    """The list of verified certificates is the organiser's, and is of the certificates' hashes."""
    other = _copied(made, tmp_path / "all" / "other", lambda content: content["core"].update(name="other"))
    third = _copied(made, tmp_path / "all" / "third", lambda content: content["core"].update(name="third"))
    _copied(made, tmp_path / "all" / "held")
    listed = tmp_path / "mine" / "verified.jsonl"
    keep_verified(listed, read_certificate(made.certificate), Verified((), ()))
    keep_verified(listed, read_certificate(other), Verified((), ()))
    keep_verified(listed, read_certificate(other), Verified(("smooth: other rows",), ()))
    board = read_entries(tmp_path / "all", suite, read_verified(listed))[0]
    marks = {name.split()[0]: mark for name, mark in board.to_json()["verified"].items()}
    assert marks == {"cone_axis": "run again", "other": "does not hold", "third": "as stated"}
    assert read_certificate(third).digest not in read_verified(listed)
    for text in ("no JSON", "[]", '{"holds": true}'):
        listed.write_text(text)
        with pytest.raises(InputError, match="cannot be read as a list of verified certificates"):
            read_verified(listed)
    assert read_verified(tmp_path / "missing") == {}
    with pytest.raises(InputError, match="No such file"):
        read_verified(tmp_path / "missing", required=True)


def test_a_core_without_a_figure_has_no_rank(tmp_path: Path) -> None:
    from simtest.bench.certificate import Certificate

    held = [Certificate(tmp_path / name, {"value": value}) for name, value in (("a", None), ("b", 1.0))]
    rows = ranked(held, lambda certificate: (certificate.content["value"], None))
    assert [(row.certificate.path.name, row.rank) for row in rows] == [("b", "1"), ("a", "–")]


@pytest.mark.render
def test_maps_are_scored_on_the_dense_part(suite: Suite, tmp_path: Path) -> None:
    """A stranger gets frames without truth, and maps that face the camera err by the tilt."""
    frames = export_frames(suite, tmp_path / "given", public_seeds(suite))
    pictures = sorted(file.stem for file in (frames / "frames").iterdir())
    assert len(set(pictures)) == 2
    assert not [file for file in frames.rglob("*") if "truth" in file.name]
    maps = tmp_path / "facing"
    maps.mkdir()
    for name in set(pictures):
        np.save(maps / f"{name}.npy", np.tile([0.0, 0.0, -1.0], (96, 96, 1)))
    options = MapOptions(encoding="components", frame="opencv")
    made = run_maps(suite, maps, tmp_path / "run", public_seeds(suite), options)
    told = read_certificate(made.certificate)
    tilts = experiment_of(suite, "dense", "x", public_seeds(suite)).groups[0].pool[0]["surface.tilt_deg"]
    part = told.parts["dense"]
    assert part["mean_deg"] == pytest.approx(np.mean(tilts), abs=1e-3)
    assert part["n"] == part["answered"] == part["zones"]["all"]["n"] > 10_000
    assert told.core["kind"] == "maps"
    assert not told.content["overall"]["complete"]
    assert check_quick(told, suite).holds
    with pytest.raises(InputError, match="--maps must name their folder"):
        verify_run(told, suite, tmp_path / "again", public_seeds(suite))
    assert read_entries(tmp_path / "run", suite)[0].parts["dense"][0].rank == "1"
    # Axes that were stated are stated again: these maps do not tell them.
    assert part["stated"] == {"encoding": "components", "frame": "opencv", "depth": None, "unit_mm": None}
    again = verify_run(told, suite, tmp_path / "again", public_seeds(suite), maps=maps)
    assert again.problems == ()
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


def test_frames_of_a_scene_are_those_of_its_part(suite: Suite) -> None:
    assert frames_of(suite, "smooth") == {"plane": 2}
    assert frames_of(suite, "dense") == {"plane": 1}


def test_parts_that_cannot_be_run_are_told(suite: Suite) -> None:
    assert chosen_parts(suite, None) == ["smooth"]
    for wanted, told in ((["dense"], "scored by maps"), (["smooth", "smooth"], "named twice"), (["x"], "unknown")):
        with pytest.raises(InputError, match=told):
            chosen_parts(suite, wanted)


def test_an_unknown_core_is_told_before_anything_is_made(suite: Suite, tmp_path: Path) -> None:
    for core in ("con_axis", "  "):
        with pytest.raises(InputError):
            run_bench(suite, core, tmp_path / "run", public_seeds(suite))
    assert not (tmp_path / "run").exists()


def test_an_empty_folder_has_no_table(suite: Suite, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds 0 certificates"):
        read_entries(tmp_path, suite)


@pytest.mark.render
def test_a_command_is_run_as_a_core(suite: Suite, tmp_path: Path) -> None:
    """A core that answers with the sightline of the peak, in a process of its own."""
    core = tmp_path / "core.py"
    core.write_text(CORE)
    made = run_bench(suite, f"command: {sys.executable} {core}", tmp_path / "run", public_seeds(suite))
    told = made.content["core"]
    assert (told["kind"], told["name"], told["version"]) == ("command", "core", "1.5")
    # The hash is of the script: another machine has another interpreter.
    assert told["sha256"] == digest_of({"files": [["core.py", file_hash(core)]], "words": ["core.py"]})
    assert told["program"] == {"name": Path(sys.executable).name, "sha256": file_hash(Path(sys.executable))}
    found = copy.deepcopy(made.content)
    found["core"]["program"]["sha256"] = "0" * 64
    assert compare(made.content, found).holds
    assert any("core program" in note for note in compare(made.content, found).notes)
    assert made.content["parts"]["smooth"]["answered"] == 6
    assert str(tmp_path) not in made.certificate.read_text()
    rows = pl.read_parquet(tmp_path / "run" / "smooth" / "results.parquet")
    assert rows["estimator"].unique().to_list() == ["core"]
    with pytest.raises(InputError, match="--core must say"):
        verify_run(read_certificate(made.certificate), suite, tmp_path / "again", public_seeds(suite))


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
def test_the_commands_say_what_they_have_checked(
    suite: Suite, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sealed run warns of its folders; --quick runs nothing and says so; a run again is listed and marked."""
    monkeypatch.setattr("simtest.bench.suite.load_suite", lambda *_: suite)
    seal(suite, tmp_path)
    file = tmp_path / SEALED
    bench.run(out=tmp_path / "run", core="brightest_point", sealed=file)
    told = " ".join(capsys.readouterr().out.split())
    assert f"tell what the seeds draw; publish {CERTIFICATE} alone" in told
    secret = json.loads(file.read_text())["secret"]
    part_seed = Seeds(secret).of_part(suite, "smooth")
    text = (tmp_path / "run" / CERTIFICATE).read_text()
    assert secret not in text
    assert str(part_seed) not in text
    monkeypatch.setattr("sys.stdin", io.StringIO(file.read_text()))
    assert bench.verify(tmp_path / "run", sealed=Path("-"), verified=tmp_path / "list") == 0
    assert "the certificate holds: it was run again" in capsys.readouterr().out
    assert bench.verify(tmp_path / "run", quick=True) == 0
    assert "the certificate is consistent; nothing was run" in capsys.readouterr().out
    with pytest.raises(InputError, match="leave out --quick"):
        bench.verify(tmp_path / "run", quick=True, verified=tmp_path / "list")
    bench.table(tmp_path / "run", out=tmp_path / "table", verified=tmp_path / "list")
    assert "run again</td>" in (tmp_path / "table" / "index.html").read_text()
