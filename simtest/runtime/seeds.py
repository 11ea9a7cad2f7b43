"""One seed tree for all randomness: (run seed, experiment, case, realisation, stage) -> generator.

Every random number of a run hangs on its own branch. Each row of results can therefore be reproduced alone, and the
numbers depend neither on the order nor on the number of workers.
"""

from enum import IntEnum
from hashlib import blake2b

import numpy as np


class Stage(IntEnum):
    """Consumer of randomness within one realisation that a generator belongs to."""

    SWEEP = 0
    RENDER = 1
    SENSOR = 2
    VIEWPOINT = 3
    RIG = 4
    RELIEF = 5
    POSE = 6


def key(text: str) -> int:
    """Return a 64-bit integer for a name: the same on every machine and in every process (unlike `hash`)."""
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little")


def sequence(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> np.random.SeedSequence:
    """Return the branch of the seed tree for one stage of one realisation.

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
    """
    return np.random.SeedSequence(seed, spawn_key=(key(experiment), key(case), realisation, int(stage)))


def generator(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> np.random.Generator:
    """Return the random generator for one stage of one realisation (parameters as in `sequence`)."""
    return np.random.Generator(np.random.SFC64(sequence(seed, experiment, case, realisation, stage)))


def integer(seed: int, experiment: str, case: str, realisation: int, stage: Stage) -> int:
    """Return a seed in [0, 2^63) for one stage of one realisation (parameters as in `sequence`)."""
    # The shift drops one bit: TOML and Parquet hold signed 64-bit integers.
    return int(sequence(seed, experiment, case, realisation, stage).generate_state(1, np.uint64)[0] >> np.uint64(1))


def from_integer(seed: int) -> np.random.Generator:
    """Return the generator of a seed >= 0, such as `integer` makes."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed)))
