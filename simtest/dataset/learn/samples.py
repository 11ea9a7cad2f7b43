"""A dataset as an iterable of PyTorch tensors, for training loops of one's own (extra ``learn``)."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import IterableDataset, default_collate, get_worker_info
from torch.utils.data._utils.collate import default_collate_fn_map

from simtest.dataset.fields import COVERING, INSTRUMENT, POLYP
from simtest.dataset.reader import Record, SamplePosition, read, read_at, sample_positions
from simtest.errors import InputError

Item = dict[str, Any]
"""A sample as tensors by field name, and ``meta``: the form that PyTorch's loaders pass on."""


class Meta(dict[str, Any]):
    """Metadata of a sample; a batch holds a list of them, since tables with missing values cannot be stacked."""


def _listed(batch: list[Meta], *, collate_fn_map: object = None) -> list[Meta]:
    return batch


# The way to extend it that PyTorch documents (`torch.utils.data.default_collate`).
default_collate_fn_map[Meta] = _listed


class Samples(IterableDataset[Item]):
    """Samples of one split, shard after shard, divided among ranks and the workers of a `DataLoader`.

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
    rank, world : int, optional
        Number of this process among those that train together, and how many there are. Default: the environment's
        RANK and WORLD_SIZE, which torchrun sets, or else one process alone.
    even : bool
        Whether each rank gets equally many samples, as `DistributedSampler` does it: some of the first are then read
        twice. False divides the samples without repetition, as a test of them all needs it.

    Notes
    -----
    Each item is a dict: images as tensors, channels first, in the units of the card (8-bit pictures as float32 in
    [0, 1], NaN where there is no surface), and ``meta``, the sample's metadata. In a batch ``meta`` is a list.

    Ranks and workers divide samples, not shards, so there may be more of them than shards. No process group is needed.
    """

    def __init__(
        self,
        folder: str | Path,
        split: str = "train",
        fields: Sequence[str] = ("image", "normal", "depth"),
        shuffle: int = 0,
        seed: int = 0,
        rank: int | None = None,
        world: int | None = None,
        even: bool = True,
    ) -> None:
        super().__init__()
        if shuffle < 0:
            raise InputError(f"shuffle = {shuffle}: must be 0 or more")
        self._rank, self._world = _rank_of(rank, world)
        self._folder, self._fields = Path(folder), tuple(fields)
        # Read here, not in the workers: polars, which reads the index, must not be used after a fork.
        self._positions = sample_positions(self._folder, split)
        # Raises for unknown fields; no shard is opened.
        read(self._folder, fields=self._fields, shards=())
        self._shuffle, self._seed, self._even = shuffle, seed, even
        self._epoch = 0

    def __len__(self) -> int:
        """Return how many samples this rank yields."""
        return len(share_of_rank(len(self._positions), self._rank, self._world, self._even))

    def set_epoch(self, epoch: int) -> None:
        """Shuffle in another order from now on."""
        self._epoch = epoch

    def __iter__(self) -> Iterator[Item]:
        worker = get_worker_info()
        number, count = (0, 1) if worker is None else (worker.id, worker.num_workers)
        # The same order in all ranks and workers, so that their shares do not overlap.
        positions = self._ordered()
        mine = share_of_worker(share_of_rank(len(positions), self._rank, self._world, self._even), number, count)
        records = read_at(self._folder, [positions[i] for i in mine], self._fields)
        if self._shuffle:
            stream = np.random.default_rng((self._seed, self._epoch, self._rank * count + number))
            records = _shuffled(records, self._shuffle, stream)
        yield from map(_tensors, records)

    def _ordered(self) -> list[SamplePosition]:
        """Return the positions of all samples, the shards in random order where samples are shuffled."""
        if not self._shuffle:
            return self._positions
        by_shard: dict[str, list[SamplePosition]] = {}
        for position in self._positions:
            by_shard.setdefault(position.shard, []).append(position)
        shards = list(by_shard.values())
        order = np.random.default_rng((self._seed, self._epoch)).permutation(len(shards))
        return [position for i in order for position in shards[i]]

    @staticmethod
    def collate(items: list[Item]) -> Item:
        """Stack the images of samples of one size, as a `DataLoader` does; metadata stays a list.

        Raises `InputError` where the sizes differ.
        """
        for name in items[0]:
            sizes = {tuple(item[name].shape) for item in items if isinstance(item[name], torch.Tensor)}
            if len(sizes) > 1:
                raise InputError(f"{name}: samples of shapes {sorted(sizes)} in one batch; must be of one shape")
        batch: Item = default_collate(items)
        return batch


def _rank_of(rank: int | None, world: int | None) -> tuple[int, int]:
    """Return rank and world as given, or as the environment states them."""
    given = {"rank": rank, "world": world}
    for name, variable, default in (("rank", "RANK", 0), ("world", "WORLD_SIZE", 1)):
        # An environment of a cluster counts as a whole: half of it would be another division.
        if given[name] is None and rank is None and world is None:
            text = os.environ.get(variable, str(default))
            if not text.isdecimal():
                raise InputError(f"{variable} = {text!r}: must be a whole number")
            given[name] = int(text)
    number, count = given["rank"] or 0, 1 if given["world"] is None else given["world"]
    if count < 1:
        raise InputError(f"world = {count}: must be 1 or more")
    if not 0 <= number < count:
        raise InputError(f"rank = {number}: must be 0 to {count - 1}")
    return number, count


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
    made: Item = {}
    for name, array in record.items():
        if name == "meta":
            continue
        first = np.moveaxis(array, -1, 0) if array.ndim == 3 else array
        tensor = torch.from_numpy(np.ascontiguousarray(first))
        is_picture = tensor.dtype == torch.uint8 and name not in (INSTRUMENT, POLYP, COVERING)
        made[name] = tensor.float() / 255 if is_picture else tensor
    return made | {"meta": Meta(record["meta"])}


def share_of_rank(count: int, rank: int, world: int, even: bool) -> list[int]:
    """Return the indices of `count` samples that a rank reads: neighbours, since those stand in one shard.

    With `even` each rank has ceil(count / world) of them; the last ranks go on with the first samples. Without, the
    samples are divided, and the first ranks have one more where there is a remainder.
    """
    if not even or count == 0:
        return _block(count, rank, world)
    each = -(-count // world)
    return [i % count for i in range(rank * each, (rank + 1) * each)]


def share_of_worker(indices: list[int], number: int, workers: int) -> list[int]:
    """Return the part of a rank's indices that one of its workers reads: neighbours, each index in one part."""
    return [indices[i] for i in _block(len(indices), number, workers)]


def _block(count: int, number: int, blocks: int) -> list[int]:
    """Return the indices of one of several blocks of `count`, whose lengths differ by one at most."""
    least, left = divmod(count, blocks)
    first = number * least + min(number, left)
    return list(range(first, first + least + (number < left)))
