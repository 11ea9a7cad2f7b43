"""Dead links of the manual's Markdown: files and anchors that are not there."""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import unquote, urlsplit

LINK = re.compile(r"!?\[(?:[^\[\]]|!?\[[^\]]*\]\([^)]*\))*\]\(([^)\s]+)\)")
CODE = re.compile(r"^(`{3,}|~{3,}).*?^\1|`[^`\n]+`", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ +(.*?) *#*$", re.MULTILINE)


def anchors_of(text: str) -> set[str]:
    """Return the anchors that GitHub and the site give to a page's headings."""
    found: set[str] = set()
    for title in HEADING.findall(re.sub(r"^(`{3,}).*?^\1", "", text, flags=re.MULTILINE | re.DOTALL)):
        plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", title).lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        count = 0
        while (numbered := f"{slug}-{count}" if count else slug) in found:
            count += 1
        found.add(numbered)
    return found


def dead_in_markdown(page: Path, generated: Collection[Path] = ()) -> Iterator[str]:
    """Yield a line for each link of a page in Markdown whose file or anchor is not there.

    `generated` are the pages that exist in the site alone.
    """
    text = page.read_text(encoding="utf-8")
    for target in LINK.findall(CODE.sub("", text)):
        name, _, anchor = unquote(target).partition("#")
        file = (page.parent / name).resolve() if name else page
        if urlsplit(target).scheme or file in generated:
            continue
        if not file.exists():
            yield f"{page.name}: {target}: no such file"
        elif anchor and file.suffix == ".md" and anchor not in anchors_of(file.read_text(encoding="utf-8")):
            yield f"{page.name}: {target}: no such anchor"
