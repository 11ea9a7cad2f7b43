"""Train the network of `learned_spot` without an organ, and test it on that organ.

python -m studies.learned_without data/highlights liver stomach

Each network has the shipped recipe (`studies.networks.spots`) on the train split without that organ. Its
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
from pathlib import Path

import numpy as np
import torch

from simtest.cli.progress import progress_bar
from simtest.estimators.learned import normal_of
from simtest.estimators.learned_spot import ROTATION_SCALE, SURFACES, LearnedSpot, SpotNetwork, log_deviation
from simtest.geometry.vectors import angle_deg
from simtest.runtime import chi_squared
from simtest.runtime.arrays import AnyArray, Array
from simtest.runtime.statistics import CONFIDENCE
from studies.networks.examples import Examples, read_spots
from studies.networks.spots import SpotNormals, squared_distance
from studies.networks.training import batch_of, train

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
        tested = _chosen(splits["test"], splits["test"]["family"] == number)
        with tempfile.TemporaryDirectory() as out:
            others = {name: _chosen(split, split["family"] != number) for name, split in splits.items()}
            without = LearnedSpot(_trained(others["train"], others["validation"], Path(out)))
            for name, network in ((f"without {organ}", without), ("of all organs", LearnedSpot())):
                for row, cells in _rows(network, tested):
                    print(f"| {organ} | {name}{row} | {' | '.join(cells)} |", flush=True)


def _chosen(spots: Examples, which: AnyArray) -> Examples:
    return {name: values[which] for name, values in spots.items()}


def _spots(folder: Path, split: str, kept: Path | None) -> Examples:
    """Return the examples of a split, from the arrays kept where there are any."""
    path = kept / f"spots_{split}.npz" if kept else None
    if path and path.exists():
        with np.load(path) as arrays:
            return dict(arrays)
    with progress_bar("reading") as progress:
        spots = read_spots(folder, split, progress=progress)
    if path:
        np.savez(path, **spots)
    return spots


def _trained(taught: Examples, judged: Examples, out: Path) -> Path:
    """Train, and return the network's file."""
    task, batches = SpotNormals(), [batch_of(split) for split in (taught, judged)]
    with progress_bar("training") as progress:
        trained = train(task, task.recipe, *batches, progress)
    return task.export(trained.network, *batches, out / "model.onnx", {})


def _rows(estimator: LearnedSpot, spots: Examples) -> Iterator[tuple[str, list[str]]]:
    """Yield the figures of the highlights that are answered, and of those that are refused."""
    network = estimator._network
    outputs, inflated, refusals = network.run(spots["crops"].astype(np.float32), spots["extras"].astype(np.float32))
    refused = np.array([refusal is not None for refusal in refusals])
    reasons = Counter(re.split(" is | at ", refusal.detail)[0].split(": ")[-1] for refusal in refusals if refusal)
    for row, chosen in ((", answered", ~refused), (", refused", refused)):
        told = "; ".join(f"{reason}: {count}" for reason, count in reasons.most_common(3)) if chosen is refused else ""
        yield row, [*_cells(network, outputs[chosen, BASE], inflated[chosen], _chosen(spots, chosen)), told]


def _cells(network: SpotNetwork, made: Array, inflated: Array, spots: Examples) -> Iterator[str]:
    """Yield number, median and 95th percentile of the base's errors, and the coverage."""
    count = len(spots["rays"])
    yield str(count)
    if not count:
        yield from ("none",) * 3
        return
    truth, rays = spots["base"].astype(float), spots["rays"]
    off = angle_deg(normal_of(rays, made[:, :2] * ROTATION_SCALE), normal_of(rays, truth))
    yield f"{np.median(off):.2f}"
    yield f"{np.percentile(off, 95):.2f}"
    distances = squared_distance(torch.from_numpy(made), torch.from_numpy(truth)).numpy()
    inside = distances <= CHI2_95 * network.scales["base"].at(log_deviation(made)) * inflated
    yield f"{inside.mean():.3f}"


if __name__ == "__main__":
    main()
