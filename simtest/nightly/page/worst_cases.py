"""The worst cases: frames with overlays, each with the command that makes it again."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from simtest.errors import InputError
from simtest.nightly.records import JudgedRun
from simtest.pages.html import picture
from simtest.report import labels as words
from simtest.report import static
from simtest.report.run_folder import GalleryItem, read_item

MOST_CASES = 12
PICTURE_BYTES, PICTURE_DPI = 48_000, 130


def read_cases(judged: JudgedRun) -> tuple[list[GalleryItem], list[str]]:
    """Read the gallery items; gives those that can be read, and a line for each that cannot."""
    items, lines = [], []
    for path in judged.gallery[:MOST_CASES]:
        try:
            items.append(read_item(Path(path)))
        except InputError as error:
            lines.append(str(error))
    return items, lines


def draw_cases(items: list[GalleryItem], colours: Mapping[str, str], folder: Path) -> list[dict[str, Any]]:
    """Draw the cases as PNG files in a folder; gives what the template shows of each."""
    with static.settings():
        paths = static.draw_gallery(items, colours, folder, PICTURE_DPI)
    return [
        {
            **words.gallery_caption(item),
            "why": str(item.meta.get("why") or ""),
            "picture": picture(path, PICTURE_BYTES),
            "file": path.name,
        }
        for item, path in zip(items, paths, strict=True)
    ]
