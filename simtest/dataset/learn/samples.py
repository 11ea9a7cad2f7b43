"""A dataset as an iterable of PyTorch tensors."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import IterableDataset, get_worker_info

from simtest.dataset.reader import Record, read, shard_names
from simtest.errors import InputError

Item = dict[str, Any]
"""A sample as tensors by field name, and ``meta``: the form that PyTorch's loaders pass on."""


class Samples(IterableDataset[Item]):
    """Samples of one split, shard after shard; each worker of a `DataLoader` reads shards of its own.

    Parameters
    ----------
    folder : str or Path
        The dataset's.
    split : str
        train, validation or test.
    fields : sequence of str
        Images to decode (see `simtest.dataset.FIELDS`).
    shuffle : int
        Size of the buffer from which samples are drawn at random, with the shards in random order; 0 reads in order.
    seed : int
        Of the shuffling.
    rank, world : int
        Number of this process among those that train together, and how many there are: they divide the shards.

    Notes
    -----
    Each item is a dict: images as tensors, channels first, in the units of the card (8-bit pictures as float32 in
    [0, 1], NaN where there is no surface), and ``meta``, the sample's metadata. Pass ``collate_fn=Samples.collate``,
    since metadata cannot be stacked.

    Raises
    ------
    InputError
        If the folder holds no finished dataset, or there is no such split or field.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "train",
        fields: Sequence[str] = ("image", "normal", "depth"),
        shuffle: int = 0,
        seed: int = 0,
        rank: int = 0,
        world: int = 1,
    ) -> None:
        super().__init__()
        if shuffle < 0:
            raise InputError(f"shuffle = {shuffle}: must be 0 or more")
        if not 0 <= rank < world:
            raise InputError(f"rank = {rank}: must be 0 to {world - 1}")
        self._folder, self._fields = Path(folder), tuple(fields)
        self._shards = shard_names(self._folder, split)
        # Raises for unknown fields; no shard is opened.
        read(self._folder, fields=self._fields, shards=())
        self._shuffle, self._seed, self._rank, self._world = shuffle, seed, rank, world
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Shuffle in another order from now on."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[Item]:
        worker = get_worker_info()
        number, count = (0, 1) if worker is None else (worker.id, worker.num_workers)
        names = list(self._shards)
        rng = np.random.default_rng((self._seed, self._epoch))
        if self._shuffle:
            names = [names[i] for i in rng.permutation(len(names))]
        # Ranks and their workers take turns over the shards.
        mine = names[self._rank * count + number :: self._world * count]
        records = read(self._folder, fields=self._fields, shards=mine)
        if self._shuffle:
            records = _shuffled(records, self._shuffle, np.random.default_rng((self._seed, self._epoch, number)))
        yield from map(_tensors, records)

    @staticmethod
    def collate(items: list[Item]) -> Item:
        """Stack the images of samples of one size; metadata stays a list."""
        names = [name for name in items[0] if name != "meta"]
        return {**{name: torch.stack([item[name] for item in items]) for name in names},
                "meta": [item["meta"] for item in items]}  # fmt: skip


def _shuffled(records: Iterator[Record], size: int, rng: np.random.Generator) -> Iterator[Record]:
    """Draw records at random from a buffer of the next `size`."""
    waiting: list[Record] = []
    for record in records:
        waiting.append(record)
        if len(waiting) > size:
            yield waiting.pop(int(rng.integers(len(waiting))))
    for i in rng.permutation(len(waiting)):
        yield waiting[i]


def _tensors(record: Record) -> Item:
    made: Item = {"meta": record["meta"]}
    for name, array in record.items():
        if name == "meta":
            continue
        first = np.moveaxis(array, -1, 0) if array.ndim == 3 else array
        tensor = torch.from_numpy(np.ascontiguousarray(first))
        is_picture = tensor.dtype == torch.uint8 and name != "instance"
        made[name] = tensor.float() / 255 if is_picture else tensor
    return made
