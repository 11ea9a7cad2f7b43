"""Shares of a list of samples: of the processes that train together, and of the workers that load for one of them."""


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
