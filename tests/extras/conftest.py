"""Tests that need an extra or another program: a folder whose needs are not met is left out with one line."""

from pathlib import Path

import pytest

from tests.extras.needs import missing

MISSING = missing()


def pytest_ignore_collect(collection_path: Path) -> bool | None:
    """Leave out the folders whose needs are not met."""
    return True if collection_path.parent.name == "extras" and collection_path.name in MISSING else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what stands here."""
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker("extra")


@pytest.fixture(scope="module")
def one_torch_thread():
    """Run PyTorch on one thread: several take turns at small networks, and wait for each other."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
