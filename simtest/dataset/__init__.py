"""Datasets of many labelled frames on disk: planned, written in shards, checked, read, and learned from."""

from simtest.dataset.fields import FIELDS
from simtest.dataset.reader import read

__all__ = ["FIELDS", "read"]
