"""Certificates: which are refused, and the table of them."""

import json
from pathlib import Path
from typing import Any

import pytest

from simtest.bench.run import BenchRun, overall_of, run_bench
from simtest.bench.scores import CERTIFICATE
from simtest.bench.suite import Suite
from simtest.bench.table import Board, ranked, read_certificate, read_entries, write_leaderboard
from simtest.errors import InputError
from tests.bench_tiny import copied, tiny_suite


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Suite:
    return tiny_suite(tmp_path_factory.mktemp("suites") / "v1")


@pytest.fixture(scope="module")
def made(suite: Suite, tmp_path_factory: pytest.TempPathFactory) -> BenchRun:
    return run_bench(suite, "cone_axis", tmp_path_factory.mktemp("run"))


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
        (lambda c: c["parts"]["smooth"].pop("n"), r"parts.smooth.n"),
        (lambda c: c["parts"]["smooth"].update(median_deg="0.1"), r"parts.smooth.median_deg"),
        (lambda c: c["parts"]["smooth"]["uncertainty"].update(verdict="best"), r"uncertainty.verdict"),
        (lambda c: c.update(parts=[]), "parts"),
        (lambda c: c["core"].update(name=["a"]), r"core.name"),
        (lambda c: c.update(timing={}), "timing"),
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
        ("parts.smooth.refused", {"core_died": -1}), ("parts.smooth.more", 1),
        ("parts.smooth.scenes", _REMOVED), ("parts.smooth.scenes", {"plane": [[2, -1.0]]}),
        ("parts.smooth.scenes", {"plane": [[2]]}), ("parts.smooth.scenes", [[2, 0.1]]),
        ("parts.smooth.uncertainty.n", -1),
        ("parts.smooth.uncertainty.interval", [0.3, 0.2]), ("parts", {}), ("parts.smooth.zones", {"all": {}}),
        ("cases", []), ("suite", "v1"), ("core", "x"), ("core", {}), ("core.sha256", 5), ("core.name", "\ud800"),
        ("core.version", 1), ("environment", {}), ("environment.processor", _REMOVED),
        ("environment.versions", {"numpy": 1}), ("overall", "x"), ("extra", 1),
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
@pytest.mark.parametrize("number", ["NaN", "1e999", "-Infinity", "1" * 5000, "[" * 900 + "]" * 900, "[" * 10**6])
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
    from simtest.bench.table import Certificate

    held = [
        Certificate(tmp_path / name, {"value": value, "parts": {"smooth": {"scenes": {"plane": scenes}}}})
        for name, value, scenes in (("a", None, [[0, 0.0], [0, 0.0]]), ("b", 1.0, [[1, 1.0], [1, 1.0]]))
    ]
    rows = ranked(held, ["smooth"], lambda certificate: certificate.content["value"])
    assert [(row.certificate.path.name, row.rank) for row in rows] == [("b", "1"), ("a", "–")]
    assert [row.rank for row in ranked(held[:1], ["smooth"], lambda _: None)] == ["–"]


def test_certificates_of_one_name_each_have_a_rank(tmp_path: Path) -> None:
    """A command with two options has one name."""
    from simtest.bench.table import Certificate

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
