"""The page of realism in a real browser."""

import pytest
from test_realism_page import frames

from simtest.realism.compare import compare
from simtest.realism.page import write_comparison


@pytest.mark.slow
def test_page_in_a_browser(browser, tmp_path):
    """No complaint, nothing asked of the network, no sideways scrolling on a desktop and on a phone."""
    page = write_comparison(compare(frames(5), frames(5, first=9)), tmp_path, "plain")
    for width in (1280, 400):
        tab, heard = browser.new_page(viewport={"width": width, "height": 900}), []
        tab.on("console", lambda said, heard=heard: heard.append(said.text))
        tab.on("pageerror", lambda error, heard=heard: heard.append(str(error)))
        tab.on("request", lambda request, heard=heard: heard.append(request.url))
        tab.goto(page.as_uri())
        # Sections are folded on a phone.
        tab.evaluate("document.querySelectorAll('details').forEach(section => { section.open = true })")
        tab.wait_for_selector("[data-chart=distances] svg.marks", timeout=60_000)
        tab.locator("[data-chart=column_noise]").scroll_into_view_if_needed()
        tab.wait_for_selector("[data-chart=column_noise] svg.marks", timeout=60_000)
        assert tab.evaluate("document.documentElement.scrollWidth") == width
        assert [text for text in heard if not text.startswith(("file:", "data:", "blob:"))] == []
