"""The page of a run: the verdict first, then what changed, trends, figures, worst cases and the other tables.

`nightly_page` fills nightly.html.j2 with what the other modules make of a `JudgedRun`.
"""

from simtest.nightly.page.nightly_page import write_nightly_page

__all__ = ["write_nightly_page"]
