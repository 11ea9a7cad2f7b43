"""Take pictures of a nightly page with the system's Chromium: a desktop's, a phone's in the dark, the trends.

python -m studies.nightly_pictures reports/nightly/full/index.html docs/images
"""

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, sync_playwright

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
COLOURS = 128


@contextmanager
def opened() -> Iterator[Browser]:
    """Open the system's browser."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        sys.exit(f"no browser: install one of {', '.join(BROWSERS)}")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=["--no-sandbox"] if os.geteuid() == 0 else [])
        yield browser
        browser.close()


def picture(browser: Browser, page: Path, out: Path, section: str | None, **context: object) -> None:
    """Take one picture: of what is seen first, or of a section."""
    tab = browser.new_context(**context).new_page()  # type: ignore[arg-type]
    tab.goto(page.resolve().as_uri())
    tab.wait_for_selector("#trends svg.marks")
    if section:
        tab.locator(section).scroll_into_view_if_needed()
        tab.wait_for_timeout(500)
        tab.locator(section).screenshot(path=out)
    else:
        tab.screenshot(path=out)
    with Image.open(out) as taken:
        taken.convert("RGB").quantize(COLOURS).save(out, optimize=True)
    tab.context.close()


def main(page: Path, folder: Path) -> None:
    """Take the pictures."""
    desktop = {"viewport": {"width": 1100, "height": 1000}}
    phone = {"viewport": {"width": 390, "height": 844}, "color_scheme": "dark", "device_scale_factor": 2}
    with opened() as browser:
        picture(browser, page, folder / "nightly.png", None, **desktop)
        picture(browser, page, folder / "nightly_phone.png", None, **phone)
        picture(browser, page, folder / "nightly_trends.png", "#trends", **desktop)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
