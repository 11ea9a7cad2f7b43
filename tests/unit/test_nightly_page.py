"""The nightly page: what it says, what it embeds, and that it keeps its limits."""

import base64
import re
import zlib
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import polars as pl
import pytest
from test_report import EVIL, make_rows

from benchmarks.nights import history_of, run_of, verdict_of
from simtest.nightly.compare import compare
from simtest.nightly.page import comparisons, trends, write_nightly_page
from simtest.nightly.records import COMPARISONS, FIGURES, JudgedRun, NightlyRun, RunRecord, Verdict
from simtest.nightly.words import headline_sentence, measure, short_commit, signed
from simtest.pages.charts import packed_vega
from simtest.validation.columns import SCHEMA
from tests.unit.nightly_samples import make_run

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


def written(tmp_path, night, verdict, history=None, files=()):
    judged = JudgedRun(night, verdict, pl.DataFrame() if history is None else history)
    page = write_nightly_page(tmp_path, judged, files)
    text = page.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, night, history):
    folder = tmp_path_factory.mktemp("night")
    return written(folder / "page", night, verdict_of(night), history, ("verdict.json",))


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
    text, page = written(tmp_path, evil, verdict, history_of(evil, 3), files=(EVIL,))
    assert "<script>alert" not in text
    assert "<img src=https" not in text
    assert not page.stack


@pytest.mark.parametrize(
    ("state", "told"),
    [
        ("no baseline", "No baseline:"),
        ("regression", "figures are worse than"),
        # Meanwhile: test_gate for the sentences.
        pytest.param("fine", "Fine: nothing is worse", marks=pytest.mark.ci),
        pytest.param("changed", "Changed: nothing is worse, but ", marks=pytest.mark.ci),
    ],
)
def test_each_state_is_told(tmp_path, night, state, told):
    verdict = verdict_of(night, state=state)
    _, page = written(tmp_path, night, verdict)
    assert told in page.text
    bit_equal = {
        "fine": "yes: all rows",
        "no baseline": "not known",
        "regression": "no: some rows",
        "changed": "no: some rows",
    }[state]
    assert bit_equal in page.text


def test_the_causes_come_before_all_else(tmp_path, night):
    cause = "cone_axis in overview, plane: the mean error is 3 deg, was 1 deg (worse)."
    _, page = written(tmp_path, night, replace(verdict_of(night), causes=(cause, "<b>second</b>")))
    assert page.text.index("Regression:") < page.text.index(cause) < page.text.index("Bit-equal")
    assert "<b>second</b>" in page.text


def test_a_first_night_has_one_line_and_no_table_of_what_is_new(tmp_path):
    first = make_run()
    text, page = written(tmp_path, first, compare(first, None))
    assert "no baseline has been accepted" in page.text
    assert 'class="outcome new"' not in text


def test_a_name_that_does_not_apply_is_a_dash_not_a_blank_choice(tmp_path, night):
    verdict = verdict_of(night)
    blank = verdict.comparisons.with_columns(pl.lit("").alias("estimator"), pl.lit(None, pl.String).alias("experiment"))
    made = comparisons(replace(verdict, comparisons=blank))
    assert made.choices["estimator"] == made.choices["experiment"] == ["–"]
    assert headline_sentence(replace(verdict, comparisons=blank)).endswith("than the baseline.")


def test_an_empty_night_has_a_page(tmp_path):
    empty = NightlyRun(
        RunRecord(id="a", profile="quick", started=STARTED.isoformat()),
        pl.DataFrame(schema=SCHEMA),
        pl.DataFrame(schema=FIGURES),
    )
    _, page = written(tmp_path, empty, Verdict("no baseline", None, pl.DataFrame(schema=COMPARISONS), (), None))
    assert not page.stack
    assert "There is nothing to compare" in page.text


def test_reports_of_experiments_with_findings_are_linked(tmp_path, night):
    judged = JudgedRun(night, verdict_of(night), pl.DataFrame(), ("noise", "overview"))
    page = Page(write_nightly_page(tmp_path, judged).read_text(encoding="utf-8"))
    assert {"reports/noise/index.html", "reports/overview/index.html"} <= set(page.links)
    assert "Reports of the experiments with findings: noise, overview" in page.text


def test_the_same_night_gives_the_same_page(tmp_path, night, history):
    first, _ = written(tmp_path / "a", night, verdict_of(night), history)
    second, _ = written(tmp_path / "b", night, verdict_of(night), history)
    assert first == second


# The table of comparisons ---------------------------------------------------------------------------------------------


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
    assert measure(0.25, "deg") == "0.25°"
    assert measure(0.25, "px") == "0.25\u00a0px"
    assert measure(None, "deg") == "–"
    assert signed(0.002, "deg") == "+0.002°"
    assert signed(-0.002, "deg") == "−0.002°"
    assert signed(0.0) == "0"
    assert short_commit("0123456789abcdef+") == "0123456789ab+"
    assert short_commit(None) == "unknown"


# Trends ---------------------------------------------------------------------------------------------------------------


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


def test_without_a_history_there_is_no_chart(night):
    assert trends(pl.DataFrame(), None, {}) == []
    assert trends(history_of(night, 0), None, {}) == []
