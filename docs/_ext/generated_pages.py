"""The pages of the reference that are made from the code, before Sphinx reads its sources; none of them is in git.

The index of the reference names them with an asterisk, since no link works in the repository; the site links them.
"""

import re
from pathlib import Path

from sphinx.application import Sphinx

from studies.manual.pages import write_pages

INDEX = "reference/index"
LINKS = {"Commands": "commands.md", "Python API": "api.rst", "Files": "files.md", "Keys": "keys.md"}
"""Generated pages, as the index names them."""


def link(_: Sphinx, name: str, source: list[str]) -> None:
    """Make links of the names of generated pages in the index of the reference."""
    if name == INDEX:
        source[0] = re.sub(
            r"^\| ([\w ]+) \* \|",
            lambda match: f"| [{match[1]}]({LINKS[match[1]]}) * |" if match[1] in LINKS else match[0],
            source[0],
            flags=re.MULTILINE,
        )


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages at each build, and link them."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir)))
    app.connect("source-read", link)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
