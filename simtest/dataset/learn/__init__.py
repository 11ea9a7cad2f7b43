"""Learning from datasets with PyTorch (extra ``learn``).

`samples` yields a dataset as tensors, for loops of one's own; `shares` divides it among ranks and workers.

`runs` trains a network as a file of `training` says: `engine` is the loop, with `checkpoint` and `page`, and knows a
task of `tasks` alone. The task of `spot_task` learns from the highlights that `spots` reads; `spot_export` writes its
network for `simtest.estimators.learned_spot`. The task of `dense_task` learns from the frames that `dense_frames`
reads; `dense_export` writes its network for `simtest.estimators.learned_dense`. Both fit their uncertainty with
`calibration` and write through `onnx_export`.

`crops` and `network` are those of docs/gallery/learning.md: smooth colons, without uncertainty.
"""

from typing import TYPE_CHECKING

from simtest.dataset.learn.crops import Crops, read_crops
from simtest.runtime.lazy_names import lazy_names

if TYPE_CHECKING:
    from simtest.dataset.learn.samples import Samples

__all__ = ["Crops", "Samples", "read_crops"]

# Crops need no PyTorch.
__getattr__, *_ = lazy_names(__name__)
