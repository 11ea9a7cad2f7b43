"""The nightly page in a real browser: Chromium of the system, driven by playwright."""

import re
from datetime import UTC, datetime

import pytest
from made_nights import history_of, run_of, verdict_of
from playwright.sync_api import expect
from test_nightly_page import rows_of

from simtest.nightly.compare import compare
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import JudgedRun

TREND = "#trends [data-chart=trend0]"
LIGHT, DARK, PAPER = "rgb(27, 31, 36)", "rgb(231, 234, 238)", "rgb(0, 0, 0)"  # of texts
DESKTOP, PHONE = {"width": 1200, "height": 900}, {"width": 390, "height": 844}


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("browser")
    run = run_of(rows_of("overview", "noise"), datetime(2026, 3, 1, 2, 30, tzinfo=UTC))
    judged = JudgedRun(run, verdict_of(run), history_of(run, 30))
    page = write_nightly_page(folder / "page", judged)
    return page.as_uri()


class Reader:
    """Opens the page, and hears what it complains of and what it asks of the network."""

    def __init__(self, browser, address):
        self.browser, self.address, self.complaints, self.asked, self.contexts = browser, address, [], [], []

    def open(self, viewport=DESKTOP, **more):
        self.contexts.append(self.browser.new_context(viewport=viewport, **more))
        page = self.contexts[-1].new_page()
        page.set_default_timeout(60_000)
        page.on(
            "console", lambda said: self.complaints.append(said.text) if said.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.asked.append(request.url))
        page.goto(self.address)
        # Charts are drawn once they come into view.
        page.locator(TREND).scroll_into_view_if_needed()
        page.wait_for_selector("#trends svg.marks")
        return page

    def close(self):
        for context in self.contexts:
            context.close()
        assert self.complaints == []
        assert [url for url in self.asked if not url.startswith(("file:", "data:", "blob:"))] == []


@pytest.fixture
def opened(browser, address):
    reader = Reader(browser, address)
    yield reader.open
    reader.close()


@pytest.fixture(scope="module")
def desktop(browser, address):
    """A page that several tests use, each after a reset."""
    reader = Reader(browser, address)
    yield reader.open()
    reader.close()


@pytest.fixture
def page(desktop):
    desktop.click("#filters [type=reset]")
    desktop.wait_for_function("document.getElementById('filter-outcome').value === '*changed'")
    desktop.evaluate("scrollTo(0, 0)")
    return desktop


def visible_rows(page):
    return page.locator("#comparisons tbody tr:visible")


def test_all_plots_are_drawn_where_the_reader_comes_by(page):
    for box in page.locator("[data-chart]:visible").all():
        box.scroll_into_view_if_needed()
        box.locator("svg.marks").first.wait_for()
        assert box.locator(".mark-symbol path").count() > 0
    assert page.locator("#trends [data-chart]:visible").count() == 1


def test_filters_choose_rows_and_say_how_many(page):
    outcomes = set(page.locator("#comparisons tbody tr:visible td:first-child").all_inner_texts())
    assert outcomes
    assert not outcomes & {"same", "equivalent"}
    page.select_option("#filter-outcome", "worse")
    page.select_option("#filter-estimator", "cone_axis")
    shown = visible_rows(page)
    assert shown.count() > 0
    for row in shown.all():
        assert row.locator("td").nth(0).inner_text().endswith("worse")
        assert row.locator("td").nth(3).inner_text() == "cone_axis"
    assert f"Showing {shown.count()} of {shown.count()} figures that fit" in page.inner_text("#filtered")
    page.select_option("#filter-outcome", "")
    page.select_option("#filter-estimator", "")
    assert visible_rows(page).count() == 100
    page.click("#more")
    assert visible_rows(page).count() > 100


def test_headings_sort_what_the_filters_left(page):
    page.select_option("#filter-outcome", "worse")
    before = visible_rows(page).count()
    head = page.locator("#comparisons thead button", has_text="difference")
    head.focus()
    page.keyboard.press("Enter")
    values = [
        float(cell.get_attribute("data-v"))
        for cell in page.locator("#comparisons tbody tr:visible td:nth-child(6)").all()
    ]
    assert values == sorted(values, reverse=True)
    assert len(values) == before
    assert page.locator("#comparisons th[aria-sort=descending]").count() == 1


def test_hover_tells_commit_and_night(page):
    page.locator(TREND).scroll_into_view_if_needed()
    place = page.locator(f"{TREND} .mark-symbol path").nth(5).bounding_box()
    x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    page.mouse.move(x - 30, y)
    page.mouse.move(x, y, steps=4)
    told = page.locator("#tooltip")
    for part in ("brightest_point: ", " UTC", "commit "):
        expect(told).to_contain_text(part)


def test_links_lead_to_their_sections(page):
    links = page.locator("nav a")
    assert links.count() == 4
    for link in links.all():
        target = link.get_attribute("href")
        link.click()
        page.wait_for_function(
            "id => Math.abs(document.querySelector(id).getBoundingClientRect().top) < innerHeight", arg=target
        )


def test_one_experiment_is_shown_at_a_time(page):
    choice = page.locator("[data-switch=trends]")
    shown = page.locator("[data-of=trends]:visible")
    assert shown.count() == 1
    last = choice.locator("option").last.get_attribute("value")
    choice.select_option(last)
    assert shown.count() == 1
    assert shown.first.get_attribute("data-key") == last
    shown.scroll_into_view_if_needed()
    shown.locator("svg.marks").first.wait_for()


def test_a_phone_needs_no_sideways_scrolling(opened):
    page = opened(PHONE, is_mobile=True, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert visible_rows(page).first.locator("td").nth(6).is_visible()


def test_dark_colours_reach_the_plots_and_paper_shows_what_was_folded(opened):
    page = opened(color_scheme="dark")
    ink = f"getComputedStyle(document.querySelector('{TREND} .role-axis-label text')).fill"
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(20, 23, 27)"
    assert page.evaluate(ink) == DARK
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    # The headings that sort and the names of the legends are buttons too, but look like text.
    assert page.locator(":not(th):not(li) > button:visible, select:visible, nav:visible").count() == 0
    assert page.locator("details:not([open])").count() == 0
    for box in page.locator("[data-chart]:visible").all():
        box.locator("svg.marks").first.wait_for()
        text = box.locator(".role-axis-label text").first
        assert text.evaluate("text => getComputedStyle(text).fill") == PAPER
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    page.emulate_media(media="screen")
    assert page.evaluate(ink) == DARK
    page.emulate_media(color_scheme="light")
    page.wait_for_function(f"{ink} === '{LIGHT}'")


def test_the_axis_of_a_night_alone_shows_days(browser, tmp_path):
    run = run_of(rows_of("overview"), datetime(2026, 3, 1, 2, 30, tzinfo=UTC))
    reader = Reader(
        browser, write_nightly_page(tmp_path, JudgedRun(run, compare(run, None), history_of(run, 1))).as_uri()
    )
    ticks = reader.open().locator(f"{TREND} .role-axis-label text").all_text_contents()
    reader.close()
    # Neither hours nor shares of a second; the other ticks are numbers of y.
    days = [tick for tick in ticks if not re.fullmatch(r"−?[\d.]+", tick)]
    assert days
    assert all(re.fullmatch(r"\d{4}-\d{2}-\d{2}", day) for day in days), days
