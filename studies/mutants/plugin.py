"""A plugin of pytest that plants the fault of `--plant NAME` once tests are collected, and says which test fails."""

from typing import Any

import pytest

from studies.mutants.planting import plant
from studies.mutants.rows import BY_NAME

CAUGHT = "caught by: "
"""How the line begins that names the first test that fails."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that names the fault."""
    parser.addoption("--plant", metavar="NAME", help="of a row of studies/mutants/rows.py")


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session: pytest.Session) -> None:
    """Plant the fault: what test files made while they were imported was made by sound code."""
    if name := session.config.getoption("plant"):
        plant(BY_NAME[name].mutations())


def pytest_runtest_logreport(report: Any) -> None:
    """Print the name of a test that fails."""
    if report.failed:
        print(f"\n{CAUGHT}{report.nodeid}", flush=True)
