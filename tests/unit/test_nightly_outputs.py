"""What a run writes beside its page: JSON, JUnit XML, Markdown, a badge."""

import dataclasses
import json
from xml.etree import ElementTree as ET

import polars as pl
import pytest

from simtest.nightly.outputs import write_outputs
from simtest.nightly.outputs.badge import COLOURS, badge
from simtest.nightly.outputs.junit import junit
from simtest.nightly.outputs.summary import MAX_CHARACTERS, summary
from simtest.nightly.records import CELL, COMPARISONS, OUTCOMES, RunRecord, Verdict
from tests.unit.nightly_samples import RUN, canary, compared, judged, make_run, no_baseline, regression

BASELINE = RunRecord(**RUN)

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def run():
    return make_run(canaries=[canary(), canary("rotated camera", 0.2, False)])


def written(folder, run, verdict):
    folder.mkdir(exist_ok=True)
    write_outputs(folder, judged(run, verdict))
    return {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}


def test_the_same_night_gives_the_same_bytes(tmp_path, run):
    first = written(tmp_path / "first", run, regression(run))
    assert written(tmp_path / "second", run, regression(run)) == first
    assert set(first) == {"verdict.json", "junit.xml", "summary.md", "badge.svg"}


# JSON ------------------------------------------------------------------------------------------------------------


def test_json_holds_the_verdict(tmp_path, run):
    verdict = regression(run, notes=["Versions differ."])
    data = json.loads(written(tmp_path, run, verdict)["verdict.json"])
    assert (data["schema"], data["state"], data["exit_code"], data["bit_equal"]) == (2, "regression", 1, False)
    assert data["counts"] == {**dict.fromkeys(OUTCOMES, 0), "worse": 2, "same": 2, "better": 2, "equivalent": 2}
    assert data["notes"] == ["Versions differ."]
    assert data["run"] == RUN
    assert data["baseline"]["reason"] == "first"
    assert data["canaries"]["n"] == 2
    assert [row["experiment"] for row in data["canaries"]["failed"]] == ["rotated camera"]
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


# JUnit -----------------------------------------------------------------------------------------------------------


def test_junit_counts_what_it_lists(run):
    root = ET.fromstring(junit(judged(run, regression(run))))
    assert root.tag == "testsuites"
    suites = {suite.get("name"): suite for suite in root}
    assert set(suites) == {"quick.first", "quick.second", "quick.canaries"}
    for suite in suites.values():
        cases = suite.findall("testcase")
        assert int(suite.get("tests")) == len(cases) > 0
        assert int(suite.get("failures")) == sum(case.find("failure") is not None for case in cases)
        assert int(suite.get("skipped")) == sum(case.find("skipped") is not None for case in cases)
        assert all(case.get("classname") == suite.get("name") and case.get("name") for case in cases)
        assert len({case.get("name") for case in cases}) == len(cases)
    for count in ("tests", "failures", "errors"):
        assert int(root.get(count)) == sum(int(suite.get(count)) for suite in root)
    (failure, *_) = suites["quick.first"].iter("failure")
    assert failure.get("message") == "worse: mean_deg: 1.1 deg, baseline 1 deg, margin 0.02 deg, p 0.0001 (Holm)"
    (failed,) = suites["quick.canaries"].iter("failure")
    assert failed.get("message") == "axis_ratio = 0.2: must be 0.9 to 1.1"


JUNIT = {
    "testsuites": {"name", "time", "tests", "failures", "errors"},
    "testsuite": {"name", "tests", "failures", "errors", "skipped", "time", "timestamp"},
    "testcase": {"name", "time", "classname"},
    "failure": {"type", "message"},
    "skipped": {"type", "message"},
}
"""Elements and attributes of the schema that the Jenkins plugin xunit publishes (junit-10.xsd), those that we use."""


def test_junit_has_what_its_readers_know(run):
    for verdict in (regression(run), no_baseline()):
        for element in ET.fromstring(junit(judged(run, verdict))).iter():
            assert set(element.attrib) <= JUNIT[element.tag]
            if "time" in element.attrib:
                assert float(element.get("time")) >= 0


def test_junit_skips_what_it_cannot_compare(run):
    root = ET.fromstring(junit(judged(run, no_baseline())))
    assert len(list(root.iter("skipped"))) == 8
    assert int(root.get("failures")) == 1  # the canary
    new = Verdict("fine", False, compared(run, ("new", "same")), (), BASELINE)
    assert len(list(ET.fromstring(junit(judged(run, new))).iter("skipped"))) == 4


def test_junit_names_cells_that_are_gone(run):
    gone = compared(run, ("gone",)).with_columns(pl.lit("third").alias("experiment"))
    root = ET.fromstring(junit(judged(run, Verdict("fine", False, gone, (), BASELINE))))
    assert {case.find("skipped").get("message") for case in root.iter("testcase")
            if case.get("classname") == "quick.third"} == {"the cell is gone"}  # fmt: skip


def test_junit_bears_any_label(run):
    odd = 'a<b> & "c" \x00\x1b ]]> \ud800'.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
    rows = run.rows.with_columns(pl.lit(odd).alias("setting"))
    text = junit(judged(make_run(rows=rows), no_baseline()))
    names = [case.get("name") for case in ET.fromstring(text.encode()).iter("testcase")]
    assert any('a<b> & "c"' in name for name in names)


def test_canaries_are_told_apart_from_what_they_watch():
    """A canary that has failed, of the name of an experiment; the gate's comparisons hold it too."""
    watching = canary("first", 0.5, False)
    run = make_run(canaries=[watching])
    own = {name: watching[name] for name in (*CELL, "quantity", "unit", "value", "low", "high")}
    row = {**own, "tonight": own.pop("value"), "method": "none", "outcome": "worse"}
    row.pop("value")
    comparisons = pl.concat([compared(run, ("same",)), pl.DataFrame([row], schema=COMPARISONS)])
    verdict = Verdict("regression", False, comparisons, (), BASELINE)
    root = ET.fromstring(junit(judged(run, verdict)))
    (suite,) = [suite for suite in root if suite.get("name") == "quick.first"]
    assert (suite.get("tests"), suite.get("failures")) == ("4", "0")
    assert int(root.get("failures")) == 1
    text = summary(judged(run, verdict))
    assert "### Worse" not in text
    assert "### Canaries failed: 1" in text
    assert "| first | 16 | 15 | 1 | 0 | 4 | 0 | 0 | 0 | 0 | 0 | 0 |" in text


# Markdown --------------------------------------------------------------------------------------------------------


def test_the_summary_says_first_what_matters(run):
    lines = summary(judged(run, regression(run, notes=["Versions differ."]))).splitlines()
    assert lines[0] == "## Nightly quick: regression: 2 figures worse"
    assert lines[2].startswith('Not bit-equal to the baseline of 2026-03-01T02:30:00+00:00, commit 0123456789ab+: "fir')
    titles = [line for line in lines if line.startswith("#")]
    assert titles[1:] == ["### Worse: 2", "### Canaries failed: 1", "### Better: 2", "### By experiment"]
    assert "- Versions differ." in lines
    assert any(line.startswith("| first | plane, tilt_deg=0, cone_axis | mean_deg | 1 deg | 1.1 deg | 0.1 [")
               for line in lines)  # fmt: skip


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
    many = make_run(canaries=[canary("c" * 4000, passed=False)] * 500)
    text = summary(judged(many, verdict))
    assert 10_000 < len(text) <= MAX_CHARACTERS


def test_texts_of_a_user_stay_texts(run):
    odd = "a|b <script>x</script> `c` @everyone\n# d"
    lines = summary(judged(run, regression(run, setting=odd, notes=[odd]))).splitlines()
    assert not [line for line in lines if "<script>" in line or "`c`" in line or "@everyone" in line]
    assert not [line for line in lines if line.startswith("# d")]
    assert any("a\\|b &lt;script>" in line for line in lines)


# Badge -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", COLOURS)
def test_the_badge_is_told_to_those_who_do_not_see_it(run, state):
    verdict = Verdict(state, state == "fine", pl.DataFrame(schema=COMPARISONS), (), None)
    root = ET.fromstring(badge(judged(run, verdict)))
    assert root.get("role") == "img"
    title = root.find(f"{SVG}title")
    assert root.get("aria-labelledby") == title.get("id")
    assert title.text.startswith("nightly quick: ")
    assert state in title.text
    drawn = [rect.get("fill") for rect in root.iter(f"{SVG}rect")]
    assert COLOURS[state] in drawn
    assert all(contrast_with_white(colour) >= 4.5 for colour in drawn)
    # Both halves are drawn side by side, as wide as the picture.
    widths = [int(rect.get("width")) for rect in root.iter(f"{SVG}rect")]
    assert sum(widths) == int(root.get("width"))


def contrast_with_white(colour):
    """Contrast ratio of WCAG 2."""
    shares = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 1.05 / (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05)


def test_the_badge_tells_equal_bytes(run):
    fine = Verdict("fine", True, pl.DataFrame(schema=COMPARISONS), (), BASELINE)
    assert "fine, bit-equal" in badge(judged(run, fine))
    assert "bit-equal" not in badge(judged(run, dataclasses.replace(fine, bit_equal=False)))


def test_causes_stand_first_and_changes_fail_their_cell(run):
    changed = regression(run, outcomes=("changed", "same"))
    verdict = dataclasses.replace(
        changed, state="changed", causes=("cone_axis in first, plane: the law is 6 deg, was 1 deg.",)
    )
    text = summary(judged(run, verdict))
    assert text.splitlines()[0] == f"## Nightly quick: changed: {verdict.unexplained.height} figures to explain"
    assert text.splitlines()[2] == "- cone_axis in first, plane: the law is 6 deg, was 1 deg."
    assert "### Changed, to be explained" in text
    failures = list(ET.fromstring(junit(judged(run, verdict))).iter("failure"))
    of_cells = [failure.get("message") for failure in failures][: verdict.unexplained.height]
    assert all(message.startswith("changed: ") for message in of_cells)
    assert "changed: " in badge(judged(run, verdict))
