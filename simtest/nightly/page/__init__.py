"""The page of a run: the verdict first, then what changed, trends, results and provenance.

`nightly_page` fills nightly.html.j2 with what the other modules make of a `JudgedRun`.
"""

from simtest.nightly.page.nightly_page import REPORTS, write_nightly_page

__all__ = ["REPORTS", "write_nightly_page"]
