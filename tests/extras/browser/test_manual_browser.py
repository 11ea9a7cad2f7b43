"""The manual's site in a real browser."""

import pytest
from test_manual import SITE


@pytest.mark.slow
def test_no_page_of_the_site_is_wider_than_the_screen(browser):
    if not (SITE / "index.html").exists():
        pytest.skip("no site in build/manual: make docs")
    pages = sorted(path for path in SITE.rglob("*.html") if "_files" not in path.parts)
    wide = []
    for width in (1400, 1000, 390):
        page = browser.new_context(viewport={"width": width, "height": 900}).new_page()
        for path in pages:
            page.goto(path.as_uri())
            if page.evaluate("document.documentElement.scrollWidth") > width:
                wide.append((width, path.relative_to(SITE).as_posix()))
    assert wide == []
