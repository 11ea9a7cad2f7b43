"""Certificates: which are refused, which figures are compared, and the table of them."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from simtest.bench.certificate import CERTIFICATE, OF_CERTIFICATE, read_certificate
from simtest.bench.compare import Verified, compare
from simtest.bench.draws import public_seeds
from simtest.bench.leaderboard import ranked, read_entries, write_leaderboard
from simtest.bench.run import BenchRun, overall_of, run_bench
from simtest.bench.suite import Suite, digest_of
from simtest.bench.verified import keep_verified, read_verified
from simtest.bench.verify import check_quick
from simtest.errors import InputError
from tests.bench_tiny import COMMITMENT, copied, tiny_suite


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return tiny_suite(tmp_path_factory.mktemp("suites") / "v1")


@pytest.fixture(scope="module")
def made(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> BenchRun:
    return run_bench(suite, "cone_axis", tmp_path_factory.mktemp("run"), public_seeds(suite))


@pytest.mark.render
@pytest.mark.parametrize("results", ["same", "other"])
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("score_deg", 1e-5), ("mean_deg", 1e-5), ("p95_deg", 1e-5), ("median_deg", 1e-5),
        ("median_interval", [0.0, 1e-5]), ("score_interval", [0.0, 1e-5]), ("answered", 3), ("n", 9),
        ("refused", {"core_died": 3}), ("uncertainty.verdict", "calibrated"), ("uncertainty.coverage", 0.5),
        ("uncertainty.n", 500), ("uncertainty.interval", [0.0, 0.1]), ("uncertainty.semi_axis_deg", 1e-5),
        ("uncertainty.inflation", 9.0), ("uncertainty.energy_deg", 1e-5), ("more", 1), ("refused", 5),
        ("p95_deg", None), ("scenes", {"plane": [[2, 0.0], [2, 0.0], [2, 60.0]]}), ("scenes", {"plane": [[6, 0.1]]}),
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
    part.update(n=600, answered=600, mean_deg=0.4, score_deg=0.4, p95_deg=1.0, results="0" * 64)
    told = copy.deepcopy(found)
    stated = told["parts"]["smooth"]
    stated["results"] = "1" * 64
    stated["median_deg"] += 9e-4
    stated.update(score_deg=0.415, mean_deg=0.385, p95_deg=1.04)
    assert compare(told, found).holds
    stated["score_deg"] = 0.43
    (problem,) = compare(told, found).problems
    assert problem == "smooth.score_deg: differs by 0.03 deg; at most 0.021 is allowed"
    # two of 600 refused: 0.3 deg
    stated.update(answered=598, refused={"not_converged": 2}, score_deg=0.7)
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


def _scored(content: Any, scenes: list[list[float]]) -> None:
    """State other sums by scene, and the score that follows from them."""
    score = sum(total for _, total in scenes) / sum(number for number, _ in scenes)
    content["parts"]["smooth"].update(scenes={"plane": scenes}, score_deg=score)


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
        (lambda c: c.update(format=9), "format = 9; this release reads 2"),
        (lambda c: c.update(kind="other"), "is no certificate"),
        (lambda c: c.pop("core"), "has no key core"),
        (lambda c: c["parts"]["smooth"].update(missed=3), "do not add up to n = 6"),
        (lambda c: c["overall"].update(score_deg=0.0), "overall: does not follow"),
        (lambda c: c["cases"].clear(), "case smooth/plane is not that of"),
        (lambda c: c["parts"].update(soft=c["parts"]["smooth"]), "part soft is none of|part 'soft' is none of"),
        (lambda c: c["seeds"].update(seed=6), "neither a commitment nor the public seed 5"),
        (lambda c: c["parts"]["smooth"].update(score_deg=0.001), "score 0.001 does not follow from the scenes' sums"),
        (lambda c: _scored(c, [[2, 8.0], [2, 8.0], [2, 8.0]]), "score 4 does not go with the mean and the counts"),
        (lambda c: _scored(c, [[1, 12.0], [3, 0.0], [2, 0.0]]), "a scene's sum exceeds 10 deg for each of its"),
        (lambda c: _scored(c, [[2, 0.0], [2, 0.0]]), "scenes: must be 3 of plane"),
        (lambda c: _scored(c, [[2, 0.0], [2, 0.0], [3, 0.0]]), "numbers do not add up to n = 6"),
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
    copied(made, tmp_path / "entry", change)
    with pytest.raises(InputError, match=told) as raised:
        read_entries(tmp_path, suite)
    assert "\n" not in str(raised.value)


_REMOVED = object()


@pytest.mark.render
@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("parts.smooth", None), ("parts.smooth.refused", _REMOVED), ("parts.smooth.uncertainty", _REMOVED),
        ("parts.smooth.score_deg", -5.0), ("parts.smooth.score_deg", 10**400), ("parts.smooth.p95_deg", 181.0),
        ("parts.smooth.score_interval", [90.0, 0.0]), ("parts.smooth.median_interval", [0.1]),
        ("parts.smooth.median_deg", 179.0), ("parts.smooth.refused", {"core_died": -1}), ("parts.smooth.more", 1),
        ("parts.smooth.scenes", _REMOVED), ("parts.smooth.scenes", {"plane": [[2, -1.0]]}),
        ("parts.smooth.scenes", {"plane": [[2]]}), ("parts.smooth.scenes", [[2, 0.1]]),
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
        read_certificate(copied(made, tmp_path, change))
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
    """Cores that differ by the same in each scene are ranked, however much the scenes differ; else they are tied."""

    def named(name: str, sums: list[float], seeds: Any = None) -> None:
        def change(content: Any) -> None:
            content["core"]["name"] = name
            content["seeds"] = seeds or content["seeds"]
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
    named("sealed one", [0.2, 3.0, 6.0], {"kind": "sealed", "commitment": COMMITMENT})
    boards = read_entries(tmp_path / "all", suite)
    ranks = [(row.certificate.core["name"], row.rank) for row in boards[0].overall]
    assert ranks == [("best", "1–2"), ("middle", "2–3"), ("unsteady", "1–4"), ("<worst>", "3–4")]
    assert [row.rank for row in boards[0].parts["smooth"]] == [rank for _, rank in ranks]
    assert [row.rank for row in boards[1].overall] == ["1"]
    page = write_leaderboard(suite, boards, tmp_path / "table").read_text()
    assert "&lt;worst&gt;" in page
    assert "<worst>" not in page
    assert page.count("<h1>") == 1
    assert page.count("as stated</td>") == 5
    # the first headline is of the seeds in text order, and each part's name is that of the command
    assert "best and unsteady share the first rank over all parts" in page
    assert "sealed one ranks first over all parts" in page
    assert "clear at 5&nbsp;% for the whole table" in page
    assert "(<code>smooth</code>)" in page


@pytest.mark.render
def test_the_table_marks_what_was_run_again(suite: Suite, made: BenchRun, tmp_path: Path) -> None:
    """The list of verified certificates is the organiser's, and is of the certificates' hashes."""
    other = copied(made, tmp_path / "all" / "other", lambda content: content["core"].update(name="other"))
    third = copied(made, tmp_path / "all" / "third", lambda content: content["core"].update(name="third"))
    copied(made, tmp_path / "all" / "held")
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


def test_a_core_without_a_score_has_no_rank(tmp_path: Path) -> None:
    from simtest.bench.certificate import Certificate

    held = [
        Certificate(tmp_path / name, {"value": value, "parts": {"smooth": {"scenes": {"plane": scenes}}}})
        for name, value, scenes in (("a", None, [[0, 0.0], [0, 0.0]]), ("b", 1.0, [[1, 1.0], [1, 1.0]]))
    ]
    rows = ranked(held, ["smooth"], lambda certificate: certificate.content["value"])
    assert [(row.certificate.path.name, row.rank) for row in rows] == [("b", "1"), ("a", "–")]
    assert [row.rank for row in ranked(held[:1], ["smooth"], lambda _: None)] == ["–"]
