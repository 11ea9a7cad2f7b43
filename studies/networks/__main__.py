"""Train a shipped network: `python -m studies.networks learned_spot data/highlights FILE.onnx [--bits 32]`.

    simtest dataset highlights --out data/highlights
    python -m studies.networks learned_spot data/highlights scenes/learning/weights/learned_spot.onnx
    python -m studies.networks learned_dense data/highlights scenes/learning/weights/learned_dense.onnx

Two and three minutes of one core; no GPU. The weights are stored with the digits of the shipped file, or those of
`--bits`: 8, 16 or 32. Equal weights need the same versions and processor. The card beside the file is made from it;
what stands below its last heading, the figures on unseen anatomies, is kept. `--epochs` and `--seed` replace those of
the recipe (the attribute `recipe` of `studies.networks.spots.SpotNormals` and `studies.networks.dense.DenseNormals`).
"""

import argparse
import os
from dataclasses import replace
from pathlib import Path

import onnx
import torch

from simtest.cli.progress import progress_bar
from simtest.runtime.files import make_folder
from studies.networks.card import origin_of, write_card
from studies.networks.dense import DenseNormals
from studies.networks.onnx_file import stored
from studies.networks.spots import SpotNormals
from studies.networks.training import Recipe, Task, Trained, batch_of, train

TASKS: dict[str, type[Task]] = {"learned_spot": SpotNormals, "learned_dense": DenseNormals}


def made_network(task: Task, recipe: Recipe, data: Path, path: Path, bits: int) -> Trained:
    """Train a network on a dataset, and write its file and card."""
    with progress_bar("writing the network") as progress:
        taught, judged = (batch_of(task.examples(data, split, progress)) for split in ("train", "validation"))
        trained = train(task, recipe, taught, judged, progress)
    task.export(trained.network, taught, judged, path, origin_of(recipe, data, trained))
    onnx.save(stored(onnx.load(path), bits), path)
    write_card(path)
    return trained


def main() -> None:
    """Train the network that is named, and print its figures on the validation split."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("network", choices=list(TASKS))
    parser.add_argument("data", type=Path, help="folder of a dataset")
    parser.add_argument("file", type=Path)
    parser.add_argument("--bits", type=int, choices=(8, 16, 32))
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--seed", type=int)
    given = parser.parse_args()
    if "OMP_NUM_THREADS" not in os.environ:
        # Several threads wait for each other at small networks, and the order of their sums changes the last digits.
        torch.set_num_threads(1)
    task = TASKS[given.network]()
    told = {name: getattr(given, name) for name in ("epochs", "seed") if getattr(given, name) is not None}
    make_folder(given.file.absolute().parent)
    trained = made_network(task, replace(task.recipe, **told), given.data, given.file, given.bits or task.bits)
    print(f"{given.file}: epoch {trained.best + 1} of {len(trained.history)}")
    for name, value in trained.history[trained.best].items():
        print(f"  {name}: {value:.4g}")


if __name__ == "__main__":
    main()
