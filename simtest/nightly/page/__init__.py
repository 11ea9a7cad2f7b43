"""The page of a night: the verdict first, then what changed, trends, and what to look at."""

from simtest.nightly.page.extras import Extras
from simtest.nightly.page.writer import write_nightly_page

__all__ = ["Extras", "write_nightly_page"]
