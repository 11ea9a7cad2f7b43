"""Find dead links, offline: in the built manual every href, src and anchor.

What a page of the site would load from elsewhere is found too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {"script": "src", "img": "src", "link": "href", "source": "src", "iframe": "src"}
"""What a browser loads with a page, by tag; a link that is followed by hand may lead elsewhere."""

UNREACHED = ("search.html", "py-modindex.html")
"""Pages of Sphinx's own that a page need not link to."""


@dataclass
class Page(HTMLParser):
    """What a page holds: its anchors, the links to other places, and what it loads."""

    path: Path
    ids: set[str] = field(default_factory=set)
    links: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep the anchors and links of an element."""
        found = dict(attrs)
        self.ids |= {value for name in ("id", "name") if (value := found.get(name))}
        target = found.get(LOADED.get(tag, "href"))
        # Relations such as rel="canonical" are not loaded.
        if target and tag in LOADED and not (tag == "link" and found.get("rel") not in ("stylesheet", "icon")):
            self.loaded.append(target)
        elif target and tag == "a":
            self.links.append(target)


def pages_of(site: Path) -> dict[Path, Page]:
    """Read all pages of a site."""
    return {path.resolve(): Page(path) for path in sorted(site.rglob("*.html")) if "_files" not in path.parts}


def dead_links(site: Path) -> Iterator[str]:
    """Yield a line for each dead link, each thing loaded from elsewhere, and each page that no other links to."""
    pages = pages_of(site)
    reached = {(site / "index.html").resolve()}
    for path, page in pages.items():
        here = path.relative_to(site.resolve())
        yield from (f"{here}: loads {target} from elsewhere" for target in page.loaded if urlsplit(target).netloc)
        for target in page.links + page.loaded:
            parts = urlsplit(target)
            if parts.scheme or parts.netloc:
                continue
            file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            file = file / "index.html" if file.is_dir() else file
            if not file.exists():
                yield f"{here}: {target}: no such file"
            elif file != path:
                reached.add(file)
            # An empty fragment, or #top, is the page itself.
            anchor = unquote(parts.fragment)
            if anchor not in ("", "top") and file in pages and anchor not in pages[file].ids:
                yield f"{here}: {target}: no such anchor"
    alone = [path for path in pages if path not in reached and path.name not in UNREACHED]
    yield from (f"{path.relative_to(site.resolve())}: no page links here" for path in alone)
