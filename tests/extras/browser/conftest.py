"""The system's Chromium, driven by playwright."""

import pytest
from playwright.sync_api import sync_playwright

from tests.extras.needs import program


@pytest.fixture(scope="session")
def browser():
    with sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=program("chromium"), args=["--no-sandbox"])
        yield launched
        launched.close()
