"""Train a network of the task `spot_normals` without an organ, and test it on that organ.

python -m studies.learned_without data/highlights liver stomach

Each network is the shipped training (scenes/learning/spot_normals.toml) on the train split without that organ. Its
covariances, and the limit of the features beyond which it refuses, come from the validation split without that organ.
The table shows the test split's highlights of the organ: detected by colour, at most 64 of a frame. A second row shows
what the network would have said where it refuses: whether it was right to. The network of all organs is the shipped
one. `--kept DIR` keeps the examples as arrays there, and reads them the next time.
"""

import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import torch

from simtest.cli.progress import progress_bar
from simtest.dataset.learn.engine import train
from simtest.dataset.learn.spot_task import SpotNormals, batch_of, squared_distance
from simtest.dataset.learn.spots import Spots, read_spots
from simtest.dataset.learn.training import load_training
from simtest.estimators.learned_spot import LearnedSpot, _Network, log_deviation
from simtest.estimators.spot_inputs import ROTATION_SCALE, SURFACES, normal_of
from simtest.geometry import chi_squared
from simtest.geometry.vectors import angle_deg
from simtest.runtime.arrays import Array
from simtest.runtime.statistics import CONFIDENCE

FAMILIES = ("colon", "stomach", "liver")
CHI2_95 = chi_squared.quantile(CONFIDENCE, 2)
BASE = SURFACES.index("base")


def main() -> None:
    """Train without each organ named, test on it, print the table."""
    arguments, kept = sys.argv[1:], None
    if "--kept" in arguments:
        at = arguments.index("--kept")
        kept = Path(arguments[at + 1])
        del arguments[at : at + 2]
    folder, organs = Path(arguments[0]), arguments[1:]
    splits = {split: _spots(folder, split, kept) for split in ("train", "validation", "test")}
    heads = ("tested on", "network", "highlights", "base: median, deg", "95 % below", "inside its 95 % ellipse", "why")
    print(f"| {' | '.join(heads)} |")
    print("|---|---|---|---|---|---|---|")
    for organ in organs:
        number = FAMILIES.index(organ)
        tested = splits["test"].chosen(splits["test"].family == number)
        with tempfile.TemporaryDirectory() as out:
            others = {name: split.chosen(split.family != number) for name, split in splits.items()}
            without = LearnedSpot(_trained(others["train"], others["validation"], Path(out)))
            for name, network in ((f"without {organ}", without), ("of all organs", LearnedSpot())):
                for row, cells in _rows(network, tested):
                    print(f"| {organ} | {name}{row} | {' | '.join(cells)} |", flush=True)


def _spots(folder: Path, split: str, kept: Path | None) -> Spots:
    """Return the examples of a split, from the arrays kept where there are any."""
    path = kept / f"spots_{split}.npz" if kept else None
    if path and path.exists():
        with np.load(path) as arrays:
            return Spots(**arrays)
    with progress_bar("reading") as progress:
        spots = read_spots(folder, split, progress=progress)
    if path:
        np.savez(path, **{field.name: getattr(spots, field.name) for field in fields(spots)})
    return spots


def _trained(taught: Spots, judged: Spots, out: Path) -> Path:
    """Train, and return the network's file."""
    task, batches = SpotNormals(), [batch_of(split) for split in (taught, judged)]
    with progress_bar("training") as progress:
        trained = train(load_training("spot_normals"), task, *batches, out, progress)
    return task.finish(trained.network, *batches, out, {})[0]


def _rows(estimator: LearnedSpot, spots: Spots) -> Iterator[tuple[str, list[str]]]:
    """Yield the figures of the highlights that are answered, and of those that are refused."""
    network = estimator._network
    outputs, inflated, refusals = network.run(spots.crops.astype(np.float32), spots.extras.astype(np.float32))
    refused = np.array([refusal is not None for refusal in refusals])
    reasons = Counter(re.split(" is | at ", refusal.detail)[0].split(": ")[-1] for refusal in refusals if refusal)
    for row, chosen in ((", answered", ~refused), (", refused", refused)):
        told = "; ".join(f"{reason}: {count}" for reason, count in reasons.most_common(3)) if chosen is refused else ""
        yield row, [*_cells(network, outputs[chosen, BASE], inflated[chosen], spots.chosen(chosen)), told]


def _cells(network: _Network, made: Array, inflated: Array, spots: Spots) -> Iterator[str]:
    """Yield number, median and 95th percentile of the base's errors, and the coverage."""
    yield str(len(spots))
    if not len(spots):
        yield from ("none",) * 3
        return
    truth, rays = spots.base.astype(float), spots.rays
    off = angle_deg(normal_of(rays, made[:, :2] * ROTATION_SCALE), normal_of(rays, truth))
    yield f"{np.median(off):.2f}"
    yield f"{np.percentile(off, 95):.2f}"
    distances = squared_distance(torch.from_numpy(made), torch.from_numpy(truth)).numpy()
    inside = distances <= CHI2_95 * network.scales["base"].at(log_deviation(made)) * inflated
    yield f"{inside.mean():.3f}"


if __name__ == "__main__":
    main()
