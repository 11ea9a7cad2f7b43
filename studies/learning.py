"""Train the network of docs/gallery/learning.md, compare it with classical estimators, print a table, draw a figure.

simtest dataset learning --out data/learning
python -m studies.learning data/learning docs/images/learning.png
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from simtest.cli.progress import progress_bar
from simtest.dataset.learn.crops import Crops, read_crops
from simtest.dataset.learn.network import propose, train
from simtest.geometry.vectors import angle_deg
from simtest.pages.style import colours
from simtest.runtime.arrays import Array

NETWORK = "network"


def main() -> None:
    """Train, and compare on the anatomies of the test split."""
    folder, picture = Path(sys.argv[1]), Path(sys.argv[2])
    taught, tested = read_crops(folder, "train"), read_crops(folder, "test")
    print(f"{len(taught)} crops to learn from, {len(tested)} of other anatomies to test on\n")
    with progress_bar("testing") as progress:
        network = train(taught, on_epoch=progress)
    normal, ratio = propose(network, tested)
    errors = {NETWORK: (angle_deg(normal, tested.normal), ratio), **tested.classical}
    print(table(tested, errors))
    draw(tested, errors, picture)


def table(tested: Crops, errors: dict[str, tuple[Array, Array]]) -> str:
    """Return the table, of the crops on which every estimator answered."""
    everywhere = np.all([np.isfinite(error) for error, _ in errors.values()], axis=0)
    lines = ["| estimator | n | normal: median, deg | mean, deg | 95 % below, deg | axis ratio: median error |",
             "|---|---|---|---|---|---|"]  # fmt: skip
    for name, (error, ratio) in errors.items():
        e, r = error[everywhere], np.abs(ratio - tested.axis_ratio)[everywhere]
        said = f"{np.nanmedian(r):.3f}" if np.isfinite(r).any() else "none"
        numbers = f"{np.median(e):.2f} | {e.mean():.2f} | {np.percentile(e, 95):.2f}"
        lines.append(f"| {name} | {len(e)} | {numbers} | {said} |")
    return "\n".join(lines)


def draw(tested: Crops, errors: dict[str, tuple[Array, Array]], picture: Path) -> None:
    """Draw the distribution of the normals' errors, and the axis ratios against the true ones."""
    figure = Figure(figsize=(9.6, 4.0), dpi=110, layout="constrained")
    left, right = figure.subplots(1, 2)
    palette = {**colours(name for name in errors if name != NETWORK), NETWORK: "#333333"}
    for name, (error, _) in errors.items():
        known = np.sort(error[np.isfinite(error)])
        left.plot(known, np.arange(1, len(known) + 1) / len(known), label=name, color=palette[name], lw=1.8)
    left.set(xscale="log", xlabel="error of the normal, deg", ylabel="share of crops below", ylim=(0, 1))
    left.legend(frameon=False)
    for name in (NETWORK, "cone_axis"):
        right.plot(tested.axis_ratio, errors[name][1], ".", ms=4, alpha=0.6, color=palette[name], label=name)
    right.plot([0, 1], [0, 1], color="0.6", lw=1)
    right.set(xlabel="true axis ratio at the BP", ylabel="proposed axis ratio", xlim=(0, 1), ylim=(0, 1))
    right.legend(frameon=False)
    figure.savefig(picture)


if __name__ == "__main__":
    main()
