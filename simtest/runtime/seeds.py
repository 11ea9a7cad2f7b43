"""One seed tree for all randomness: (run seed, experiment, case, realisation, stage) -> generator.

Every random number of a run hangs on its own branch, so any row of results can be made again alone and the
numbers do not depend on the order or the number of workers.
"""

from enum import IntEnum
from hashlib import blake2b

import numpy as np


class Stage(IntEnum):
    """Which consumer of randomness within one realisation a generator belongs to."""

    SWEEP = 0
    RENDER = 1
    SENSOR = 2
    VIEWPOINT = 3
    RIG = 4


def key(text: str) -> int:
    """Give a stable 64-bit integer for a name.

    Parameters
    ----------
    text : str
        Any name.

    Returns
    -------
    int
        The same number on every machine and in every process (unlike `hash`).
    """
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def sequence(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> np.random.SeedSequence:
    """Give the branch of the seed tree of one stage of one realisation.

    Parameters
    ----------
    seed : int
        Run seed, >= 0.
    experiment, case : str
        Names; they enter by a stable hash.
    realisation : int
        Number of the realisation within its case, >= 0.
    stage : Stage
        The consumer.

    Returns
    -------
    numpy.random.SeedSequence
    """
    return np.random.SeedSequence(seed, spawn_key=(key(experiment), key(case), realisation, int(stage)))


def generator(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> np.random.Generator:
    """Give the random generator of one stage of one realisation (see `sequence` for the parameters)."""
    return np.random.Generator(np.random.SFC64(sequence(seed, experiment, case, realisation, stage)))


def integer(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> int:
    """Give a seed in [0, 2^63) of one stage of one realisation (see `sequence` for the parameters)."""
    return int(sequence(seed, experiment, case, realisation, stage).generate_state(1, np.uint64)[0] >> np.uint64(1))


def from_integer(seed: int) -> np.random.Generator:
    """Give the generator of a seed made by `integer`, or of any other, >= 0."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed)))
