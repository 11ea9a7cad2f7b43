"""Learning from datasets with PyTorch (extra ``learn``).

`samples` yields a dataset as tensors, `crops` cuts out its highlights, `network` learns normals and shapes from them.
"""

from simtest.dataset.learn.crops import Crops, read_crops
from simtest.dataset.learn.samples import Samples

__all__ = ["Crops", "Samples", "read_crops"]
