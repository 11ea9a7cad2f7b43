"""Datasets of labelled frames on disk: planned, written in shards, verified, read, and learned from.

`plan` fixes what each sample is made of, `maker` makes it, `shard_writer` writes it (`fields`, `png`, `shard`), with
`manifest`, `index` and `card` beside the shards. `reader` reads them back, `verify` checks and repairs them and makes
one sample anew, `card` also draws a contact sheet. `sample_calibration` tells what reconstruction may know of a sample;
`export` and `scoring` are for methods that run elsewhere, `learn` needs PyTorch.
"""

from typing import TYPE_CHECKING

from simtest.dataset.fields import FIELDS
from simtest.dataset.reader import read
from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.dataset.sample_calibration import calibration_of

__all__ = ["FIELDS", "calibration_of", "read"]

# Scenes take a tenth of a second to import, and who reads arrays needs none.
__getattr__, *_ = lazy_names(__name__)
