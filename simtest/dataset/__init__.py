"""Labelled frames on disk: what a rendered frame holds and how it is written."""

from simtest.dataset.frame import LabelledFrame, make_frame, write_frame
from simtest.dataset.views import ViewWriter

__all__ = ["LabelledFrame", "ViewWriter", "make_frame", "write_frame"]
