"""Learning from datasets with PyTorch (extra ``learn``): `Samples` yields a dataset as tensors, for your own loops."""

from typing import TYPE_CHECKING

from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.dataset.learn.samples import Samples

__all__ = ["Samples"]

# Who imports the package alone needs no PyTorch.
__getattr__, *_ = lazy_names(__name__)
