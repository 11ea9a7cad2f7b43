"""The page of a night: the verdict first, then what changed, trends, and what to look at."""

from simtest.report.nightly.extras import Extras
from simtest.report.nightly.page import write_nightly_page

__all__ = ["Extras", "write_nightly_page"]
