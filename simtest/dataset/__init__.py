"""Datasets of labelled frames on disk: planned, written in shards, verified, read, and learned from.

`plan` fixes what each sample is made of, `maker` makes it, `shard_writer` writes it (`fields`, `png`, `shard`), with
`manifest`, `index`, `card` and `croissant` beside the shards. `reader` reads them back, `verify` checks and repairs,
`reproduce` makes one sample anew, `preview` draws a contact sheet. `learn` needs PyTorch.
"""

from simtest.dataset.fields import FIELDS
from simtest.dataset.reader import read

__all__ = ["FIELDS", "read"]
