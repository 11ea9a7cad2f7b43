"""The pages of the reference that are made from the code, before Sphinx reads its sources; none of them is in git."""

from pathlib import Path

from sphinx.application import Sphinx

from studies.manual.pages import write_pages


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages at each build."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir)))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
