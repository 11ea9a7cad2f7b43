"""What a run writes beside its page: JSON and Markdown."""

import dataclasses
import json

import polars as pl
import pytest

from simtest.nightly.outputs import MAX_CHARACTERS, summary, write_outputs
from simtest.nightly.records import OUTCOMES, RunRecord, Verdict
from tests.unit.nightly_samples import RUN, compared, judged, make_run, no_baseline, regression

BASELINE = RunRecord(**RUN)


@pytest.fixture(scope="module")
def run():
    return make_run()


def written(folder, run, verdict):
    folder.mkdir(exist_ok=True)
    write_outputs(folder, judged(run, verdict))
    return {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}


def test_the_same_night_gives_the_same_bytes(tmp_path, run):
    first = written(tmp_path / "first", run, regression(run))
    assert written(tmp_path / "second", run, regression(run)) == first
    assert set(first) == {"verdict.json", "summary.md"}


# JSON ------------------------------------------------------------------------------------------------------------


def test_json_holds_the_verdict(tmp_path, run):
    verdict = regression(run, notes=["Versions differ."])
    data = json.loads(written(tmp_path, run, verdict)["verdict.json"])
    assert (data["schema"], data["state"], data["exit_code"], data["bit_equal"]) == (3, "regression", 1, False)
    assert data["counts"] == {**dict.fromkeys(OUTCOMES, 0), "worse": 2, "same": 2, "better": 2, "equivalent": 2}
    assert data["notes"] == ["Versions differ."]
    assert data["run"] == RUN
    assert data["baseline"]["reason"] == "first"
    assert data["reports"] == []
    # What is the same is counted, not listed.
    assert {row["outcome"] for row in data["comparisons"]} == {"worse", "better", "equivalent"}
    assert data["comparisons"][0]["p_holm"] == 1e-4


def test_json_without_a_baseline(tmp_path, run):
    data = json.loads(written(tmp_path, run, no_baseline())["verdict.json"])
    assert (data["state"], data["exit_code"], data["bit_equal"], data["baseline"]) == ("no baseline", 0, None, None)


def test_json_bears_figures_that_are_not_finite(tmp_path, run):
    text = written(tmp_path, run, regression(run, difference=float("inf"), low=float("nan")))["verdict.json"]
    row = json.loads(text, parse_constant=pytest.fail)["comparisons"][0]
    assert (row["difference"], row["low"]) == ("inf", "nan")


# Markdown --------------------------------------------------------------------------------------------------------


def test_the_summary_says_first_what_matters(run):
    lines = summary(judged(run, regression(run, notes=["Versions differ."]))).splitlines()
    assert lines[0] == "## Nightly quick: regression: 2 figures worse"
    assert lines[2].startswith('Not bit-equal to the baseline of 2026-03-01T02:30:00+00:00, commit 0123456789ab+: "fir')
    titles = [line for line in lines if line.startswith("#")]
    assert titles[1:] == ["### Worse: 2", "### Better: 2", "### By experiment"]
    assert "- Versions differ." in lines
    assert any(line.startswith("| first | plane, tilt_deg=0, cone_axis | mean_deg | 1 deg | 1.1 deg | 0.1 [")
               for line in lines)  # fmt: skip


def test_a_duration_that_is_not_known_is_not_said(run):
    known = judged(run, no_baseline())
    record = run.record.model_copy(update={"duration_s": None})
    unknown = judged(dataclasses.replace(run, record=record), no_baseline())
    assert " s on " in summary(known)
    assert " s on " not in summary(unknown)


def test_tables_are_whole(run):
    head = None
    for line in summary(judged(run, regression(run))).splitlines():
        if not line.startswith("|"):
            head = None
            continue
        cells = line.count("|") - line.count("\\|")
        head = head or cells
        assert cells == head


def test_the_counts_by_experiment(run):
    text = summary(judged(run, no_baseline()))
    assert "| first | 16 | 15 | 1 | 0 |" in text
    assert "| second | 16 | 16 | 0 | 1 |" in text


def test_a_huge_verdict_fits_a_comment(run):
    cells = pl.concat([compared(run, ("worse", "better"))] * 500)
    long = cells.with_columns(pl.lit("x" * 5000).alias("setting"))
    verdict = Verdict("regression", False, long, tuple("note " * 500 for _ in range(1000)), BASELINE)
    text = summary(judged(run, verdict))
    assert 10_000 < len(text) <= MAX_CHARACTERS


def test_texts_of_a_user_stay_texts(run):
    odd = "a|b <script>x</script> `c` @everyone\n# d"
    lines = summary(judged(run, regression(run, setting=odd, notes=[odd]))).splitlines()
    assert not [line for line in lines if "<script>" in line or "`c`" in line or "@everyone" in line]
    assert not [line for line in lines if line.startswith("# d")]
    assert any("a\\|b &lt;script>" in line for line in lines)


def test_causes_stand_first(run):
    changed = regression(run, outcomes=("changed", "same"))
    verdict = dataclasses.replace(
        changed, state="changed", causes=("cone_axis in first, plane: the law is 6 deg, was 1 deg.",)
    )
    text = summary(judged(run, verdict))
    assert text.splitlines()[0] == f"## Nightly quick: changed: {verdict.unexplained.height} figures to explain"
    assert text.splitlines()[2] == "- cone_axis in first, plane: the law is 6 deg, was 1 deg."
    assert "### Changed, to be explained" in text
