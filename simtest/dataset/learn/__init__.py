"""Learning from datasets with PyTorch (extra ``learn``).

`samples` yields a dataset as tensors, `crops` cuts out its highlights, `network` learns normals and shapes from them.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simtest.dataset.learn.crops import Crops, read_crops
    from simtest.dataset.learn.samples import Samples

_HOMES = {"Crops": "crops", "Samples": "samples", "read_crops": "crops"}

__all__ = ["Crops", "Samples", "read_crops"]


def __getattr__(name: str) -> Any:
    # Imported on demand: crops need no PyTorch.
    if name not in _HOMES:
        raise AttributeError(f"module 'simtest.dataset.learn' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"simtest.dataset.learn.{_HOMES[name]}"), name)
