"""axe-core, which the package axe-playwright-python (extra test-extras) bundles, on a page in the browser."""

import importlib.util
from pathlib import Path


def violations(page):
    """Return what axe finds on an open page: the rule and the first element of each."""
    found = importlib.util.find_spec("axe_playwright_python")
    page.evaluate(Path(found.submodule_search_locations[0], "axe.min.js").read_text(encoding="utf-8"))
    # Charts that Vega draws are described by their boxes' labels, captions and tables; axe reads no MathML.
    left_out = [".chart svg", "iframe", "th:has(math)"]
    report = page.evaluate("exclude => axe.run({exclude}, {resultTypes: ['violations']})", left_out)
    return [(each["id"], each["nodes"][0]["html"]) for each in report["violations"]]
