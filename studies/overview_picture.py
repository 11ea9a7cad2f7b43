"""Take the gallery's picture of the page of a run with the system's Chromium.

python -m studies.overview_picture reports/runs/overview/index.html docs/images/overview.png
"""

import sys
from pathlib import Path

from PIL import Image

from studies.nightly_pictures import opened

VIEW = {"width": 1000, "height": 1280}
"""px; the height ends with the first table."""


def main(page: Path, out: Path) -> None:
    """Take the picture of what is seen first."""
    with opened() as browser:
        tab = browser.new_page(viewport=VIEW)  # type: ignore[arg-type]
        tab.goto(page.resolve().as_uri())
        tab.screenshot(path=out)
    with Image.open(out) as taken:
        # Not quantised: the squares that stand for estimators are too small to keep their colours.
        taken.convert("RGB").save(out, optimize=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
