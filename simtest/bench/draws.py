"""From a suite and its seed to experiments: which scenes and frames a part has."""

import hashlib
import math
from pathlib import Path

from simtest.bench.suite import CaseSpec, Draw, Suite
from simtest.runtime.seeds import Stage, generator
from simtest.spec import Experiment, Group

DIGITS = 6
"""Of a drawn value: mathematical libraries differ in the last ones."""


def part_seed(suite: Suite, part: str) -> int:
    """Return the seed of a part, in [0, 2^63)."""
    text = f"{suite.spec.name} {suite.version} | {part} | {suite.spec.seed}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def experiment_name(suite: Suite, part: str) -> str:
    """Return the name that a part's seeds and rows bear."""
    return f"{suite.spec.name}-{suite.version}-{part}"


def experiment_of(suite: Suite, part: str, core: str) -> Experiment:
    """Return a part as an experiment of one estimator.

    Each drawn scene is a pooled value of its case, so that a case is one setting of the results.
    """
    seed, name = part_seed(suite, part), experiment_name(suite, part)
    groups = []
    for case in suite.of_part(part):
        pool = pooled(seed, name, case.spec)
        groups.append(
            Group(
                scene=str(Path(case.file).resolve()),
                label=case.spec.name,
                pool=(pool,) if pool else (),
                realisations=case.spec.realisations,
                isolated=case.spec.isolated,
            )
        )
    about = suite.part(part)
    return Experiment(
        name=name, title=f"{suite.spec.title}: {about.title}", description=about.description, seed=seed,
        estimators=(core,), groups=tuple(groups),
    )  # fmt: skip


def pooled(seed: int, experiment: str, case: CaseSpec) -> dict[str, tuple[float | int, ...]]:
    """Return the drawn values of a case's scenes by key path; each hangs on its key and its number alone."""
    return {
        key: tuple(_drawn(seed, experiment, f"{case.name} | {key}", n, draw) for n in _numbers(case.draws, draw))
        for key, draw in sorted(case.draw.items())
    }


def _numbers(scenes: int, draw: Draw) -> list[int]:
    """Return the number of the draw of each scene."""
    return [number if draw.blocks is None else number * draw.blocks // scenes for number in range(scenes)]


def _drawn(seed: int, experiment: str, name: str, number: int, draw: Draw) -> float | int:
    rng = generator(seed, experiment, name, number, Stage.SWEEP)
    low, high = draw.low or 0.0, draw.high
    if draw.kind == "normal":
        value = low + high * float(rng.standard_normal())
    elif draw.kind == "log_uniform":
        value = math.exp(float(rng.uniform(math.log(low), math.log(high))))
    elif draw.kind == "integer":
        return int(rng.integers(int(low), int(high), endpoint=True))
    else:
        value = float(rng.uniform(low, high))
    return float(f"{value:.{DIGITS}g}")
