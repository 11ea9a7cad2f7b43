"""The worst cases: frames with overlays, each with the command that makes it again."""

from pathlib import Path

from simtest.errors import InputError
from simtest.nightly.records import JudgedRun
from simtest.report.run_folder import GalleryItem, read_item

MOST_CASES = 12


def read_cases(judged: JudgedRun) -> tuple[list[GalleryItem], list[str]]:
    """Read the gallery items; returns those that can be read, and a line for each that cannot."""
    items, lines = [], []
    for path in judged.gallery[:MOST_CASES]:
        try:
            items.append(read_item(Path(path)))
        except InputError as error:
            lines.append(str(error))
    return items, lines
