"""Labelled frames on disk: what a rendered frame holds and how it is written."""

from simtest.dataset.frame import LabelledFrame, make_frame, write_frame

__all__ = ["LabelledFrame", "make_frame", "write_frame"]
