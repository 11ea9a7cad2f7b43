"""What a night writes: its page, which says what happened and keeps its limits, JSON and Markdown."""

import base64
import json
import re
import zlib
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from made_nights import history_of, run_of, verdict_of
from test_report import EVIL, make_rows

from simtest.nightly.compare import compare
from simtest.nightly.outputs import MAX_CHARACTERS, summary, write_outputs
from simtest.nightly.page import comparisons, trends, write_nightly_page
from simtest.nightly.records import COMPARISONS, FIGURES, OUTCOMES, JudgedRun, NightlyRun, RunRecord, Verdict
from simtest.nightly.words import headline_sentence, measure, short_commit, signed
from simtest.pages.charts import packed_vega
from simtest.validation.columns import SCHEMA
from tests.marked import marked
from tests.unit.nightly_samples import RUN, compared, judged, make_run, no_baseline, regression

STARTED = datetime(2026, 3, 1, 2, 30, tzinfo=UTC)


def rows_of(*kinds):
    made = [pl.DataFrame(make_rows(kind, realisations=3), infer_schema_length=None) for kind in kinds]
    rows = pl.concat(made, how="diagonal_relaxed")
    missing = [pl.lit(None, dtype).alias(name) for name, dtype in SCHEMA.items() if name not in rows.columns]
    return rows.with_columns(missing)


@pytest.fixture(scope="module")
def night():
    return run_of(rows_of("overview", "noise"), STARTED)


@pytest.fixture(scope="module")
def history(night):
    return history_of(night, 20)


class Page(HTMLParser):
    """What a reader without eyes, or a test, finds in a page."""

    VOID = ("meta", "img", "br", "wbr", "input", "link", "hr")

    def __init__(self, text):
        super().__init__()
        self.stack, self.ids, self.links, self.headings, self.tags, self.text = [], [], [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.append((tag, attrs))
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [attrs["href"]] if "href" in attrs else []
        if tag not in self.VOID:
            self.stack.append(tag)
        if re.fullmatch(r"h[1-6]", tag):
            self.headings.append(int(tag[1]))

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.stack.pop() == tag

    def handle_data(self, data):
        if self.stack and self.stack[-1] not in ("script", "style"):
            self.text += data


def page_of(tmp_path, night, verdict, history=None, files=()):
    judged = JudgedRun(night, verdict, pl.DataFrame() if history is None else history)
    page = write_nightly_page(tmp_path, judged, files)
    text = page.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, night, history):
    folder = tmp_path_factory.mktemp("night")
    return page_of(folder / "page", night, verdict_of(night), history, ("verdict.json",))


def test_the_verdict_comes_first_and_every_part_is_there(whole):
    text, page = whole
    told = page.text
    assert told.index("Regression:") < told.index("What got better or worse") < told.index("The median over")
    for part in ("Bit-equal", "Trends", "Results", "Provenance"):
        assert part in told, part
    assert len(text) < 8e6


def test_the_page_stands_alone_and_is_sound_html(whole):
    text, page = whole
    assert not page.stack
    assert len(set(page.ids)) == len(page.ids)
    inner = [link[1:] for link in page.links if link.startswith("#")]
    assert inner
    assert set(inner) <= set(page.ids)
    assert [link for link in page.links if not link.startswith("#")] == ["verdict.json"]
    without_scripts = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    assert "http" not in re.sub(
        r'http-equiv|<script type="application/json".*?</script>', "", without_scripts, flags=re.S
    )
    (packed,) = re.findall(r'<script type="application/octet-stream" id="vega-packed">(.*?)</script>', text)
    assert packed == packed_vega()
    assert b"vegaEmbed" in zlib.decompress(base64.b64decode(packed))


def test_the_page_can_be_read_without_eyes_or_mouse(whole):
    _, page = whole
    levels = page.headings
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    for tag, attrs in page.tags:
        if tag == "img":
            assert attrs["alt"]
        if tag == "th":
            assert attrs["scope"] in ("col", "row")
        if attrs.get("role") in ("img", "region"):
            assert attrs["aria-label"]
        if "scroll" in attrs.get("class", "").split():
            assert attrs["tabindex"] == "0"
    labelled = [attrs for tag, attrs in page.tags if tag == "form"]
    assert all(attrs["aria-label"] for attrs in labelled)


def contrast(first, second):
    """Contrast of two colours by WCAG 2."""

    def light(colour):
        colour = colour.lstrip("#")
        colour = "".join(2 * c for c in colour) if len(colour) == 3 else colour
        parts = np.array([int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)])
        return np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4) @ [0.2126, 0.7152, 0.0722]

    low, high = sorted((light(first), light(second)))
    return (high + 0.05) / (low + 0.05)


def test_text_has_the_contrast_of_wcag_aa_in_light_and_dark(whole):
    style = re.search(r"<style>(.*?)</style>", whole[0], re.S)[1]
    screen = style[: style.index("@media print")] + style[style.index(":root { --bad") : style.rindex("@media print")]
    themes = {"light": {}, "dark": {}}
    for match in re.finditer(r"(@media \(prefers-color-scheme: dark\) \{\s*)?:root \{([^}]*)\}", screen):
        themes["dark" if match[1] else "light"] |= dict(re.findall(r"--(\w+): (#\w+)", match[2]))
    for name, found in themes.items():
        assert {"bg", "card", "fg", "soft", "link", "bad", "good", "open"} <= found.keys()
        for text in ("fg", "soft", "link", "bad", "good", "open"):
            for ground in ("bg", "card"):
                assert contrast(found[text], found[ground]) >= 4.5, (name, text, ground)


def test_no_text_of_the_night_becomes_markup(tmp_path, night):
    names = {"experiment": EVIL, "setting": EVIL, "label": EVIL}
    rows = night.rows.with_columns(pl.lit(value).alias(name) for name, value in names.items())
    evil = run_of(rows, STARTED)
    evil = replace(evil, record=evil.record.model_copy(update={"command": EVIL, "commit": EVIL}))
    verdict = replace(verdict_of(evil), notes=(EVIL,))
    text, page = page_of(tmp_path, evil, verdict, history_of(evil, 3), files=(EVIL,))
    assert "<script>alert" not in text
    assert "<img src=https" not in text
    assert not page.stack


STATES = {
    "no baseline": ("No baseline:", "not known"),
    "regression": ("figures are worse than", "no: some rows"),
    "fine": ("Fine: nothing is worse", "yes: all rows"),
    "changed": ("Changed: nothing is worse, but ", "no: some rows"),
}


# Meanwhile: test_gate for the sentences.
@pytest.mark.parametrize("state", marked([*STATES], ci=["fine", "changed"]))
def test_each_state_is_told_with_its_causes_first(tmp_path, night, state):
    cause = "cone_axis in overview, plane: the mean error is 3 deg, was 1 deg (worse)."
    verdict = replace(verdict_of(night, state=state), causes=(cause, "<b>second</b>"))
    _, page = page_of(tmp_path, night, verdict)
    headline, bit_equal = STATES[state]
    assert (
        page.text.index(headline) < page.text.index(cause) < page.text.index("Bit-equal") < page.text.index(bit_equal)
    )
    assert "<b>second</b>" in page.text


def test_a_name_that_does_not_apply_is_a_dash_not_a_blank_choice(tmp_path, night):
    verdict = verdict_of(night)
    blank = verdict.comparisons.with_columns(pl.lit("").alias("estimator"), pl.lit(None, pl.String).alias("experiment"))
    made = comparisons(replace(verdict, comparisons=blank))
    assert made.choices["estimator"] == made.choices["experiment"] == ["–"]
    assert headline_sentence(replace(verdict, comparisons=blank)).endswith("than the baseline.")


def test_an_empty_night_has_a_page_and_a_first_one_no_table_of_what_is_new(tmp_path, small):
    record = RunRecord(id="a", profile="quick", started=STARTED.isoformat())
    empty = NightlyRun(record, pl.DataFrame(schema=SCHEMA), pl.DataFrame(schema=FIGURES))
    _, page = page_of(tmp_path, empty, Verdict("no baseline", None, pl.DataFrame(schema=COMPARISONS), (), None))
    assert not page.stack
    assert "There is nothing to compare" in page.text
    text, page = page_of(tmp_path, small, compare(small, None))
    assert "no baseline has been accepted" in page.text
    assert 'class="outcome new"' not in text


def test_reports_of_experiments_with_findings_are_linked(tmp_path, night):
    judged = JudgedRun(night, verdict_of(night), pl.DataFrame(), ("noise", "overview"))
    page = Page(write_nightly_page(tmp_path, judged).read_text(encoding="utf-8"))
    assert {"reports/noise/index.html", "reports/overview/index.html"} <= set(page.links)
    assert "Reports of the experiments with findings: noise, overview" in page.text


def test_the_same_night_gives_the_same_bytes(tmp_path, night, history, small):
    first, second = (page_of(tmp_path / name, night, verdict_of(night), history)[0] for name in "ab")
    assert first == second
    outputs = outputs_of(tmp_path / "c", small, regression(small))
    assert outputs_of(tmp_path / "d", small, regression(small)) == outputs
    assert set(outputs) == {"verdict.json", "summary.md"}


def test_the_worst_come_first_and_nothing_vanishes_unsaid(night):
    verdict = verdict_of(night)
    worse = verdict.regressions
    assert worse.height > 1
    table = comparisons(verdict, most=worse.height + 3)
    rows = table.table.rows
    outcomes = [row[0].text for row in rows]
    assert outcomes[: worse.height] == ["worse"] * worse.height
    columns = [name.removeprefix("=") for name in table.table.heads]
    difference, margin = columns.index("difference"), columns.index("margin")
    sizes = [abs(row[difference].value) / row[margin].value for row in rows[: worse.height]]
    assert sizes == sorted(sizes, reverse=True)
    assert len(rows) + sum(table.left_out.values()) == verdict.comparisons.height
    assert headline_sentence(verdict).startswith(f"Regression: {worse.height} of {verdict.comparisons.height} figures")


def test_numbers_have_signs_units_and_dashes():
    assert [measure(0.25, "deg"), measure(0.25, "px"), measure(None, "deg")] == ["0.25°", "0.25\u00a0px", "–"]
    assert [signed(0.002, "deg"), signed(-0.002, "deg"), signed(0.0)] == ["+0.002°", "−0.002°", "0"]
    assert [short_commit("0123456789abcdef+"), short_commit(None)] == ["0123456789ab+", "unknown"]


def curves(charts):
    """Return the curves by experiment, panel and estimator, as (days, values)."""
    return {
        (chart.title, panel.y.title, mark.name): (np.asarray(mark.x), np.asarray(mark.y))
        for chart in charts for panel in chart.panels for mark in panel.marks if mark.line == "solid"
    }  # fmt: skip


def test_a_curve_is_the_median_over_the_settings_at_each_run(night, history):
    found = curves(trends(history, None, {}))
    days, values = found["noise", "mean error (deg)", "cone_axis"]
    assert len(days) == history["run_id"].n_unique() == 20
    assert (np.diff(days) > 0).all()
    own = history.filter(experiment="noise", estimator="cone_axis", quantity="mean_deg")
    expected = own.group_by("started").agg(pl.col("value").median()).sort("started")["value"].to_numpy()
    np.testing.assert_array_equal(values, expected)
    assert own["setting"].n_unique() == 3
    assert trends(pl.DataFrame(), None, {}) == trends(history_of(night, 0), None, {}) == []


def test_missing_runs_stay_missing_and_runs_are_in_order_of_time(night, history):
    """The clock of the last run went back before all others."""
    back = pl.when(pl.col("run_id") == "night-00019").then(pl.col("started") - timedelta(days=60)).otherwise("started")
    moved = history.with_columns(started=back).filter(
        ~((pl.col("run_id") == "night-00007") & (pl.col("experiment") == "noise"))
    )
    found = curves(trends(moved, None, {}))
    assert len(found["noise", "mean error (deg)", "cone_axis"][0]) == 19
    days, _ = found["overview", "mean error (deg)", "cone_axis"]
    assert len(days) == 20
    assert days[0] == 0
    assert (np.diff(days) > 0).all()


def test_regressions_are_crossed_and_the_baseline_is_marked(night, history):
    state = pl.when(pl.col("run_id") == "night-00004").then(pl.lit("regression")).otherwise(pl.lit("fine"))
    charts = trends(history.with_columns(state=state), night.record, {})
    marks = [mark for mark in charts[0].panels[0].marks if mark.symbol and not mark.line]
    assert {len(mark.x) for mark in marks} == {1}
    (baseline,) = (mark for mark in charts[0].panels[0].marks if mark.name == "baseline")
    assert baseline.x[0] == pytest.approx(20, abs=0.1)


BASELINE = RunRecord(**RUN)


@pytest.fixture(scope="module")
def small():
    return make_run()


def outputs_of(folder, small, verdict):
    folder.mkdir(exist_ok=True)
    write_outputs(folder, judged(small, verdict))
    return {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()}


def test_json_holds_the_verdict(tmp_path, small):
    verdict = regression(small, notes=["Versions differ."])
    data = json.loads(outputs_of(tmp_path, small, verdict)["verdict.json"])
    expected = {
        "schema": 3, "state": "regression", "exit_code": 1, "bit_equal": False, "notes": ["Versions differ."],
        "counts": {**dict.fromkeys(OUTCOMES, 0), "worse": 2, "same": 2, "better": 2, "equivalent": 2}, "run": RUN,
        "reports": [],
    }  # fmt: skip
    assert {key: data[key] for key in expected} == expected
    assert data["baseline"]["reason"] == "first"
    # What is the same is counted, not listed.
    assert {row["outcome"] for row in data["comparisons"]} == {"worse", "better", "equivalent"}
    assert data["comparisons"][0]["p_holm"] == 1e-4
    none = json.loads(outputs_of(tmp_path, small, no_baseline())["verdict.json"])
    assert (none["state"], none["exit_code"], none["bit_equal"], none["baseline"]) == ("no baseline", 0, None, None)


def test_json_bears_figures_that_are_not_finite(tmp_path, small):
    text = outputs_of(tmp_path, small, regression(small, difference=float("inf"), low=float("nan")))["verdict.json"]
    row = json.loads(text, parse_constant=pytest.fail)["comparisons"][0]
    assert (row["difference"], row["low"]) == ("inf", "nan")


def test_the_summary_says_first_what_matters(small):
    lines = summary(judged(small, regression(small, notes=["Versions differ."]))).splitlines()
    # The terminal's line is the same.
    assert lines[0] == "## Nightly quick: regression: 2 figures worse: cone_axis (2) in first (1) and second (1)"
    assert lines[2].startswith('Not bit-equal to the baseline of 2026-03-01T02:30:00+00:00, commit 0123456789ab+: "fir')
    titles = [line for line in lines if line.startswith("#")]
    assert titles[1:] == ["### Worse: 2", "### Better: 2", "### By experiment"]
    assert "- Versions differ." in lines
    assert any(line.startswith("| first | plane, tilt_deg=0, cone_axis | mean_deg | 1 deg | 1.1 deg | 0.1 [")
               for line in lines)  # fmt: skip


def test_a_duration_that_is_not_known_is_not_said(small):
    record = small.record.model_copy(update={"duration_s": None})
    assert " s on " in summary(judged(small, no_baseline()))
    assert " s on " not in summary(judged(replace(small, record=record), no_baseline()))


def test_tables_are_whole_and_count_by_experiment(small):
    head = None
    for line in summary(judged(small, regression(small))).splitlines():
        cells = line.count("|") - line.count("\\|")
        head = (head or cells) if line.startswith("|") else None
        assert head in (None, cells)
    text = summary(judged(small, no_baseline()))
    assert "| first | 16 | 15 | 1 | 0 |" in text
    assert "| second | 16 | 16 | 0 | 1 |" in text


@pytest.mark.parametrize("causes", [(), ("cause " * 500,) * 500])
def test_a_huge_verdict_fits_a_comment(small, causes):
    cells = pl.concat([compared(small, ("worse", "better"))] * 500)
    long = cells.with_columns(pl.lit("x" * 5000).alias("setting"))
    verdict = Verdict("regression", False, long, ("note " * 500,) * 1000, BASELINE, causes)
    text = summary(judged(small, verdict))
    assert 10_000 < len(text) <= MAX_CHARACTERS


def test_texts_of_a_user_stay_texts(small):
    odd = "a|b <script>x</script> `c` @everyone\n# d"
    lines = summary(judged(small, regression(small, setting=odd, notes=[odd]))).splitlines()
    assert not [line for line in lines if "<script>" in line or "`c`" in line or "@everyone" in line]
    assert not [line for line in lines if line.startswith("# d")]
    assert any("a\\|b &lt;script>" in line for line in lines)


def test_causes_stand_first(small):
    cause = "cone_axis in first, plane: the law is 6 deg, was 1 deg."
    verdict = replace(regression(small, outcomes=("changed", "same")), state="changed", causes=(cause,))
    text = summary(judged(small, verdict))
    said = f"changed: {verdict.unexplained.height} figures to explain: cone_axis (4) in first (2) and second (2)"
    assert text.splitlines()[0] == f"## Nightly quick: {said}"
    assert text.splitlines()[2] == f"- {cause}"
    assert "### Changed, to be explained" in text
