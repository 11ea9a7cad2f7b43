"""Write the pages of docs/ that are made from the code: commands, Python API, files and columns, keys, changes."""

import re
from pathlib import Path

from studies.manual.api_page import api_page
from studies.manual.commands_page import commands_page, shipped_page
from studies.manual.files_page import files_page
from studies.manual.keys_page import keys_page

ROOT = Path(__file__).resolve().parents[2]


def changes_page() -> str:
    """Return CHANGELOG.md with its links as they are seen from docs/."""
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    return re.sub(r"\]\((?!https?:)(?:docs/)?", lambda m: "](" if "docs/" in m[0] else "](../", text)


PAGES = {
    "reference/commands.md": commands_page,
    "reference/api.rst": api_page,
    "reference/files.md": files_page,
    "reference/keys.md": keys_page,
    "reference/shipped.md": shipped_page,
    "changes.md": changes_page,
}
"""Pages that are not in git, by their path below docs/."""


def write_pages(docs: Path) -> list[Path]:
    """Write the generated pages into docs/; one whose text has not changed is left as it is, for a quick rebuild."""
    for name, make in PAGES.items():
        path, text = docs / name, make()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    return [docs / name for name in PAGES]
