"""Labelled frames on disk: one rendered frame with its truth, and datasets of many."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtest.dataset.fields import FIELDS
    from simtest.dataset.reader import read
    from simtest.simulation.labelled_frame import LabelledFrame, make_frame, write_frame
    from simtest.simulation.view_files import ViewWriter

_HOMES = {
    "FIELDS": "fields", "LabelledFrame": "frame", "ViewWriter": "views", "make_frame": "frame", "read": "reader",
    "write_frame": "frame",
}  # fmt: skip

__all__ = ["FIELDS", "LabelledFrame", "ViewWriter", "make_frame", "read", "write_frame"]


def __getattr__(name: str) -> Any:
    # Reading a dataset needs no renderer.
    if name not in _HOMES:
        raise AttributeError(f"module 'simtest.dataset' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"simtest.dataset.{_HOMES[name]}"), name)
