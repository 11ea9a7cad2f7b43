"""Take the gallery's picture of the page of a run with the system's Chromium.

python -m studies.overview_picture reports/runs/overview/index.html docs/images/overview.png
"""

import os
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from studies.nightly_pictures import BROWSERS

VIEW = {"width": 1000, "height": 1280}
"""px; the height ends with the first table."""


def main(page: Path, out: Path) -> None:
    """Take the picture of what is seen first."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        sys.exit(f"no browser: install one of {', '.join(BROWSERS)}")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox"] if os.geteuid() == 0 else [])
        tab = browser.new_page(viewport=VIEW)  # type: ignore[arg-type]
        tab.goto(page.resolve().as_uri())
        tab.screenshot(path=out)
        browser.close()
    with Image.open(out) as taken:
        # Not quantised: the squares that stand for estimators are too small to keep their colours.
        taken.convert("RGB").save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
