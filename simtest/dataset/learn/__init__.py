"""Learning from datasets with PyTorch (extra ``learn``).

`samples` yields a dataset as tensors, `crops` cuts out its highlights, `network` learns normals and shapes from them.
"""

from typing import TYPE_CHECKING, Any

from simtest.dataset.learn.crops import Crops, read_crops

if TYPE_CHECKING:
    from simtest.dataset.learn.samples import Samples

__all__ = ["Crops", "Samples", "read_crops"]


def __getattr__(name: str) -> Any:
    # Crops need no PyTorch.
    if name != "Samples":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from simtest.dataset.learn.samples import Samples

    return Samples
