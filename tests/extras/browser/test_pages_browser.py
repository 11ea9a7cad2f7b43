"""A page of each kind in a real browser: nothing overflows or is overprinted, axe is content."""

from functools import cache

import pytest
from axe import violations
from page_kinds import KINDS

pytestmark = pytest.mark.slow

PAGES = tuple(KINDS)
WIDTHS = (1400, 1000, 390)
SCHEMES = ("light", "dark")
PHONE_HEIGHT = 844
MOST_SCREENS = 8
"""Screens of a phone that a page takes before the reader opens a section."""

# What sticks out of the page, or out of its own box without scrolling there. Vega clips what it draws itself, and
# what lies within a box that scrolls is reached by scrolling.
OVERFLOWS = """() => {
  const width = document.documentElement.clientWidth, found = [];
  for (const part of document.body.querySelectorAll("*")) {
    const box = part.getBoundingClientRect();
    if (!box.width || !box.height || part.closest("svg, .skip")) continue;
    const frame = part.parentElement.closest(".scroll, [data-scrolls]");
    if (frame) continue;
    const style = getComputedStyle(part), name = part.tagName + "." + part.className;
    if (box.right > width + 1 || box.left < -1) found.push(`${name}: ${box.left} to ${box.right} of ${width}`);
    const inside = style.overflowX === "visible" && style.display !== "inline" && part.clientWidth;
    if (inside && part.scrollWidth > part.clientWidth + 1)
      found.push(`${name}: ${part.scrollWidth} in ${part.clientWidth}`);
  }
  return found;
}"""

# A box that scrolls says so, and where to.
SILENT = """() => [...document.querySelectorAll(".scroll")].filter(box => {
  const hint = box.previousElementSibling;
  const ways = [[box.scrollWidth > box.clientWidth + 1, "sideways"], [box.scrollHeight > box.clientHeight + 1, "down"]];
  const told = hint?.classList.contains("hint") && !hint.hidden ? hint.textContent : "";
  return box.getClientRects().length && ways.some(([cut, way]) => cut && !told.includes(way));
}).map(box => box.getAttribute("aria-label"))"""

# Texts at the ticks of a chart's axis that are seen and lie on each other, by more than the blank rim of their boxes.
OVERPRINTS = """() => {
  const found = [];
  for (const axis of document.querySelectorAll(".role-axis-label")) {
    const texts = [...axis.querySelectorAll("text")].filter(
      text => text.textContent.trim() && getComputedStyle(text).opacity > 0);
    const boxes = texts.map(text => text.getBoundingClientRect());
    for (let i = 0; i < boxes.length; i++) for (let j = 0; j < i; j++) {
      const [a, b] = [boxes[i], boxes[j]];
      const across = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const down = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (across > 1 && down > 3) found.push(`${texts[i].textContent} on ${texts[j].textContent}`);
    }
  }
  return found;
}"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Return the page of a kind, which is made when it is first asked for."""
    return cache(lambda name: KINDS[name](tmp_path_factory.mktemp(name)))


@pytest.fixture
def opened(browser, pages):
    contexts = []

    def visit(name, width, scheme="light"):
        size = {"width": width, "height": PHONE_HEIGHT}
        contexts.append(browser.new_context(viewport=size, color_scheme=scheme, is_mobile=width < 600))
        page = contexts[-1].new_page()
        page.set_default_timeout(60_000)
        page.goto(pages(name).as_uri())
        page.wait_for_load_state("networkidle")
        return page

    yield visit
    for context in contexts:
        context.close()


def open_all(page):
    """Open every section, and come by every chart, so that all are drawn."""
    page.evaluate("document.querySelectorAll('details').forEach(box => { box.open = true; })")
    for box in page.locator("[data-chart]:visible").all():
        box.scroll_into_view_if_needed()
        box.locator("svg.marks").first.wait_for()


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("name", PAGES)
def test_nothing_overflows(opened, name, width, scheme):
    page = opened(name, width, scheme)
    assert page.evaluate(OVERFLOWS) == []
    open_all(page)
    assert page.evaluate(OVERFLOWS) == []
    assert page.evaluate(OVERPRINTS) == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(SILENT) == []


@pytest.mark.parametrize("name", PAGES)
def test_a_phone_shows_at_most_eight_screens_before_more(opened, name):
    page = opened(name, 390)
    assert page.evaluate("document.documentElement.scrollHeight") <= MOST_SCREENS * PHONE_HEIGHT


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("name", PAGES)
def test_axe_finds_nothing(opened, name, width, scheme):
    page = opened(name, width, scheme)
    open_all(page)
    assert violations(page) == []


def test_axe_sees_a_planted_fault(opened):
    page = opened("realism", 1400)
    page.evaluate("document.querySelector('img').removeAttribute('alt')")
    assert "image-alt" in [name for name, _ in violations(page)]


def test_the_overflow_check_sees_a_planted_fault(opened):
    page = opened("realism", 390)
    page.evaluate("document.querySelector('h1').style.width = '600px'")
    assert any(text.startswith("H1") for text in page.evaluate(OVERFLOWS))


@pytest.mark.parametrize("width", [1400, 390])
def test_a_link_opens_the_section_that_is_folded(opened, width):
    page = opened("run", width)
    chart = page.locator("#axis_ratio .chart")
    assert not chart.is_visible()
    page.locator("nav a[href='#axis_ratio']").click()
    page.wait_for_selector("#axis_ratio svg.marks")
    assert chart.is_visible()


def test_paper_shows_what_is_folded_and_folds_it_again(opened):
    page = opened("run", 390)
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    assert page.locator("details:not([open])").count() == 0
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert page.locator("details.fold:not([open])").count() > 3


def test_a_run_s_first_screen_shows_the_answer_and_a_chart(opened):
    page = opened("run", 1400)
    bottom = "part => document.querySelector(part).getBoundingClientRect().bottom"
    assert page.evaluate(bottom, ".answer .chart") < PHONE_HEIGHT
    assert page.evaluate(bottom, "#answer h2") < PHONE_HEIGHT / 4


def test_the_run_page_is_small(pages):
    assert pages("run").stat().st_size <= 1_500_000


def test_the_overprint_check_sees_a_planted_fault(opened):
    page = opened("realism", 1400)
    open_all(page)
    page.evaluate("""() => {
      const [one, other] = document.querySelectorAll(".role-axis-label text");
      other.setAttribute("transform", one.getAttribute("transform"));
    }""")
    assert page.evaluate(OVERPRINTS) != []


def test_a_chart_is_enlarged_by_dragging_and_its_names_hide_marks(opened):
    page = opened("run", 1400)
    box = page.locator("#error_vs_curvature .chart")
    box.scroll_into_view_if_needed()
    points = box.locator(".mark-symbol path")
    points.first.wait_for()
    axes, count, ticks = box.locator(".background[stroke]").bounding_box(), points.count(), ticks_of(box)
    name = page.locator("#error_vs_curvature [data-name]").first
    name.click()
    assert 0 < points.count() < count
    page.mouse.move(axes["x"] + 0.2 * axes["width"], axes["y"] + 0.2 * axes["height"])
    page.mouse.down()
    page.mouse.move(axes["x"] + 0.6 * axes["width"], axes["y"] + 0.6 * axes["height"], steps=3)
    page.mouse.up()
    page.wait_for_function(
        "old => document.querySelector('#error_vs_curvature .role-axis-label').textContent != old", arg=ticks
    )
    # What was hidden stays so.
    assert points.count() < count
    box.dblclick(position={"x": 300, "y": 100})
    page.wait_for_function(
        "old => document.querySelector('#error_vs_curvature .role-axis-label').textContent == old", arg=ticks
    )
    name.click()
    assert points.count() == count


def ticks_of(box):
    return box.locator(".role-axis-label").first.text_content()


def test_a_point_tells_its_setting(opened):
    page = opened("run", 1400)
    box = page.locator("#error_vs_curvature .chart")
    box.scroll_into_view_if_needed()
    box.locator(".mark-symbol path").last.hover(force=True)
    page.locator("#tooltip:not([hidden])").wait_for()
    assert "mean " in page.locator("#tooltip").text_content()


def test_the_parts_of_a_3d_view_are_hidden_by_their_names(opened):
    page = opened("view", 1400)
    shown = "part => document.querySelector('.scene').contentWindow.scene?.getObjectByName(part)?.visible"
    # Of the two surfaces one is shown.
    page.wait_for_function(f"({shown})('part0') === true && ({shown})('part1') === false")
    page.locator("[data-part=part1]").click()
    page.locator("[data-part=part2]").click()
    assert [page.evaluate(shown, f"part{i}") for i in range(4)] == [False, True, False, True]
