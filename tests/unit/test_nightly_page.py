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
from test_report import EVIL, make_item, make_rows

from benchmarks.nights import history_of, run_of, verdict_of
from simtest.nightly.gate.compare import compare
from simtest.nightly.page import write_nightly_page
from simtest.nightly.page.ladder_figures import FLOOR_DEG, ladder
from simtest.nightly.page.run_tables import comparisons
from simtest.nightly.page.trends import COSTS, LEFT_OUT, MEDIAN, NEWEST, trends
from simtest.nightly.phrases import bounds, headline_sentence, measure, short_commit, signed
from simtest.nightly.records import COMPARISONS, FIGURES, JudgedRun, NightlyRun, RunRecord, Verdict
from simtest.pages.chart_web import BUNDLE, packed
from simtest.pages.style import colours
from simtest.validation.results_table import SCHEMA
from simtest.validation.worst import WorstCase
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


def written(tmp_path, night, verdict, history=None, gallery=(), files=()):
    judged = JudgedRun(night, verdict, pl.DataFrame() if history is None else history, gallery)
    page = write_nightly_page(tmp_path, judged, files)
    text = page.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, night, history):
    folder = tmp_path_factory.mktemp("night")
    for i in range(2):
        make_item(folder / f"worst-{i}.npz", detail=3)
    gallery = tuple(sorted(folder.glob("*.npz")))
    return written(folder / "page", night, verdict_of(night), history, gallery, ("verdict.json",))


def test_the_verdict_comes_first_and_every_part_is_there(whole):
    text, page = whole
    told = page.text
    assert told.index("Regression:") < told.index("What got better or worse") < told.index("Trends over")
    for part in ("Bit-equal", "Canaries", "Error against curvature",
                 "Error against light offset", "Error against noise", "Worst cases", "Failures and coverage",
                 "Run time and memory", "Provenance"):  # fmt: skip
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
    (packed,) = re.findall(r'<script type="application/octet-stream" id="plotly-packed">(.*?)</script>', text)
    assert zlib.decompress(base64.b64decode(packed)) == zlib.decompress(BUNDLE.read_bytes())


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
        # Meanwhile: test_gate_notes for the sentences.
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
    assert "There is no baseline." in page.text
    assert "no baseline has been accepted" in page.text
    assert 'class="outcome new"' not in text


def test_a_canary_alone_can_make_a_regression(tmp_path, night):
    verdict = replace(verdict_of(night, state="fine"), state="regression")
    _, page = written(tmp_path, night, verdict)
    assert "Regression: no figure is worse than the baseline, but 1 canary is out of bounds: far ellipse." in page.text


def test_a_name_that_does_not_apply_is_a_dash_not_a_blank_choice(tmp_path, night):
    verdict = verdict_of(night)
    blank = verdict.comparisons.with_columns(pl.lit("").alias("estimator"), pl.lit(None, pl.String).alias("experiment"))
    made = comparisons(replace(verdict, comparisons=blank))
    assert made.choices["estimator"] == made.choices["experiment"] == ["–"]
    assert headline_sentence(JudgedRun(night, replace(verdict, comparisons=blank), pl.DataFrame())).endswith(
        "than the baseline."
    )
    empty = night.figures.with_columns(pl.col("estimator").fill_null(""), pl.col("setting").fill_null(""))
    costs = [name for name in unpacked(trends(pl.DataFrame(), replace(night, figures=empty))) if name[0] == COSTS]
    assert {name[2] for name in costs} == {"overview", "noise", "all"}


def test_an_empty_night_has_a_page(tmp_path):
    empty = NightlyRun(
        RunRecord(id="a", profile="quick", started=STARTED.isoformat()),
        pl.DataFrame(schema=SCHEMA),
        pl.DataFrame(schema=FIGURES),
    )
    _, page = written(tmp_path, empty, Verdict("no baseline", None, pl.DataFrame(schema=COMPARISONS), (), None))
    assert not page.stack
    assert "There is nothing to compare" in page.text


def test_a_gallery_file_that_is_none_is_told(tmp_path, night):
    broken = tmp_path / "worst-00.npz"
    broken.write_bytes(b"none")
    _, page = written(tmp_path / "page", night, verdict_of(night), gallery=(broken,))
    assert "worst-00.npz: not a gallery file" in page.text


@pytest.mark.ci  # meanwhile: test_worst: which results are the worst
def test_a_worst_case_shows_what_was_before(tmp_path, night):
    make_item(tmp_path / "worst-00.npz")
    row = {
        "experiment": "overview", "setting": "s", "realisation": 2, "estimator": "circle_pose", "true_id": 0,
        "status": "ok", "error_deg": 0.25, "normal_x": 0.0, "normal_y": 0.0, "normal_z": -1.0,
        "seed": 7, "truth_x": 0.1, "truth_y": 0.0, "truth_z": -0.9,
    }  # fmt: skip
    before = pl.DataFrame([row, {**row, "realisation": 3, "error_deg": 7.0}]).cast({"truth_x": pl.Float32})
    tonight = pl.DataFrame([{**row, "error_deg": 0.5}])
    night = replace(night, rows=pl.concat([night.rows, tonight], how="diagonal_relaxed"))
    case = WorstCase("overview", "s", 2, "circle_pose", "why")
    judged = JudgedRun(
        night, verdict_of(night), pl.DataFrame(), (tmp_path / "worst-00.npz",), cases=(case,), before=before
    )
    told = Page(write_nightly_page(tmp_path / "page", judged).read_text(encoding="utf-8")).text
    assert "In the baseline: highlight 0: 0.25°" in told
    assert "circle_pose (baseline)" in told
    # Another seed makes another frame.
    other = replace(judged, before=before.with_columns(seed=pl.lit(8)))
    assert "In the baseline" not in Page(write_nightly_page(tmp_path / "b", other).read_text(encoding="utf-8")).text
    # A baseline of an older version has no normals.
    older = write_nightly_page(tmp_path / "older", replace(judged, before=before.drop("normal_x")))
    assert "In the baseline" not in Page(older.read_text(encoding="utf-8")).text


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
    assert headline_sentence(JudgedRun(night, verdict, pl.DataFrame())).startswith(
        f"Regression: {worse.height} of {verdict.comparisons.height} figures"
    )


def test_numbers_have_signs_units_and_dashes():
    assert measure(0.25, "deg") == "0.25°"
    assert measure(0.25, "px") == "0.25\u00a0px"
    assert measure(None, "deg") == "–"
    assert signed(0.002, "deg") == "+0.002°"
    assert signed(-0.002, "deg") == "−0.002°"
    assert signed(0.0) == "0"
    assert bounds(20.0, 20.0) == "exactly 20"
    assert bounds(0.3, float("inf")) == "at least 0.3"
    assert bounds(None, 0.3) == "at most 0.3"
    assert short_commit("0123456789abcdef+") == "0123456789ab+"
    assert short_commit(None) == "unknown"


# Trends ---------------------------------------------------------------------------------------------------------------


def unpacked(found):
    """Do what the page's script does: curves by name, as (nights, values)."""
    data = found.data
    codes = np.frombuffer(base64.b64decode(data["values"]), "<u2").reshape(-1, len(data["nights"]["started"]))
    curves = {}
    for i, own in enumerate(codes):
        name = tuple(
            data["names"][key][data["series"][key][i]] for key in ("experiment", "setting", "estimator", "quantity")
        )
        nights = np.flatnonzero(own != LEFT_OUT)
        assert name not in curves
        curves[name] = (nights, data["low"][i] + (data["high"][i] - data["low"][i]) * own[nights] / (LEFT_OUT - 1))
    return curves


def test_a_short_history_is_kept_whole(night, history):
    found = trends(history, night)
    assert found.nights == 21
    assert found.left_out == 0
    curves = unpacked(found)
    past = history.sort("started")
    for name in [
        ("overview", "cylinder outside R = 10 mm", "cone_axis", "mean_deg"),
        ("noise", "noise 0.05", "circle_pose", "p95_deg"),
    ]:
        own = past.filter(
            (pl.col("experiment") == name[0]) & (pl.col("setting") == name[1]) & (pl.col("estimator") == name[2])
            & (pl.col("quantity") == name[3])
        )["value"].to_numpy()  # fmt: skip
        nights, values = curves[name]
        assert nights.tolist() == list(range(21))
        np.testing.assert_allclose(values[:20], own, atol=1e-5 * np.ptp(own) + 1e-6 * own.max())


def test_the_median_over_settings_is_one(night, history):
    curves = unpacked(trends(history, night))
    for estimator in ("cone_axis", "circle_pose"):
        parts = [
            v
            for (e, s, m, q), (_, v) in curves.items()
            if (e, m, q) == ("noise", estimator, "mean_deg") and s != MEDIAN
        ]
        assert len(parts) == 3
        np.testing.assert_allclose(
            curves["noise", MEDIAN, estimator, "mean_deg"][1], np.median(parts, axis=0), rtol=1e-3
        )


def test_a_long_history_keeps_its_extremes_and_its_newest_nights(night):
    long = history_of(night, 400)
    found = trends(long, night, budget=120_000)
    assert found.points < found.nights + found.left_out
    assert len(packed(found.data)) < 1.2 * 120_000
    newest = set(range(found.nights - NEWEST, found.nights))
    whole = unpacked(trends(long, night, budget=10**9))
    for name, (nights, values) in unpacked(found).items():
        assert newest <= set(nights.tolist())
        all_values = whole[name][1][-found.nights :]
        np.testing.assert_allclose(
            [values.min(), values.max()], [all_values.min(), all_values.max()], rtol=1e-3, atol=1e-9
        )


def test_nights_are_in_order_of_time_even_where_the_clock_went_back(night):
    past = history_of(night, 4)
    moved = past.with_columns(
        pl.when(pl.col("run_id") == "night-00003")
        .then(pl.col("started") - timedelta(days=30))
        .otherwise("started")
        .alias("started")
    )
    found = trends(moved, night)
    started = found.data["nights"]["started"]
    assert started == sorted(started)
    assert found.nights == 5


def test_tonight_is_not_shown_twice_nor_another_profile(night, history):
    own = history_of(night, 1).with_columns(pl.lit(night.record.id).alias("run_id"))
    assert trends(pl.concat([history, own]), night).nights == 21
    other = history.with_columns(pl.lit("quick").alias("profile"), (pl.col("run_id") + "q").alias("run_id"))
    assert trends(pl.concat([history, other]), night).nights == 21


def test_missing_nights_stay_missing(night, history):
    gone = history.filter(~((pl.col("run_id") == "night-00007") & (pl.col("experiment") == "noise")))
    curves = unpacked(trends(gone, night))
    assert 7 not in curves["noise", "noise 0.05", "cone_axis", "mean_deg"][0]
    assert 7 in curves["overview", "cylinder outside R = 10 mm", "cone_axis", "mean_deg"][0]


# The error ladder -----------------------------------------------------------------------------------------------------


def with_ladder(night, values):
    rungs = [
        {"kind": "ladder", "experiment": "error ladder", "setting": "a plane", "estimator": "cone_axis",
         "quantity": name, "unit": "deg", "value": value, "about": f"about {name}"}
        for name, value in values.items()
    ]  # fmt: skip
    return replace(night, figures=pl.concat([night.figures, pl.DataFrame(rungs, schema=FIGURES)]))


def test_the_ladder_names_the_step_that_takes_most_away(tmp_path, night):
    made = with_ladder(night, {"as it is": 1.0, "no noise": 0.9, "exact contour": 0.1, "exact pose": 0.0})
    found = ladder(made, colours(["cone_axis"]))
    assert found.rows[0].blame == "exact contour (80\u00a0%)"
    (mark,) = found.chart.panels[0].marks
    assert min(mark.y) == FLOOR_DEG
    _, page = written(tmp_path, made, verdict_of(night))
    assert "about exact contour" in page.text
