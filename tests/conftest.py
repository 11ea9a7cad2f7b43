"""What tests share: the rendering backend's cache, and where the reference meshes lie."""

import os
from pathlib import Path

import pytest

# Tests change constants and functions that the key of a kept array does not know of.
os.environ["SIMTEST_CACHE"] = "off"

SHARED = Path(__file__).resolve().parents[1].parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data():
    """Folder of real meshes and frames beside the checkout; tests that need it skip where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"no reference data at ../shared/data (looked beside {SHARED.parents[1].name})")
    return SHARED
