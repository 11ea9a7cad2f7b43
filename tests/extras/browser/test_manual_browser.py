"""The manual's site in a real browser."""

import pytest
from axe import violations
from test_manual import SITE

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pages():
    if not (SITE / "index.html").exists():
        pytest.skip("no site in build/manual: make docs")
    return sorted(path for path in SITE.rglob("*.html") if "_files" not in path.parts)


def test_no_page_of_the_site_is_wider_than_the_screen(browser, pages):
    wide = []
    for width in (1400, 1000, 390):
        page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
        for path in pages:
            page.goto(path.as_uri())
            if page.evaluate("document.documentElement.scrollWidth") > width:
                wide.append((width, path.relative_to(SITE).as_posix()))
    assert wide == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_axe_finds_nothing_on_the_site(browser, pages, scheme):
    page, found = browser.new_context(color_scheme=scheme).new_page(), {}
    for path in pages:
        page.goto(path.as_uri())
        for rule, element in violations(page):
            found.setdefault(rule, []).append((path.relative_to(SITE).as_posix(), element))
    assert found == {}
