"""Learning from datasets with PyTorch (extra ``learn``).

`samples` yields a dataset as tensors, `crops` cuts out its highlights, `network` learns normals and shapes from them.
"""

from typing import TYPE_CHECKING

from simtest.dataset.learn.crops import Crops, read_crops
from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.dataset.learn.samples import Samples

__all__ = ["Crops", "Samples", "read_crops"]

# Crops need no PyTorch.
__getattr__, _ = lazy_names(__name__, {"simtest.dataset.learn.samples": ("Samples",)})
