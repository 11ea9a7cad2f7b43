"""Make a small labelled dataset and read it back as arrays.

`simtest dataset` writes shards (tar files), an index and a card; the same command goes on where it was stopped.
`simtest.dataset.read` yields one record for each sample: arrays by name, and the sample's metadata. The shipped dataset
`tiny` has frames of 64 x 48 px; `endoscopy` has tissue through the camera chain of an endoscope.

Picture: six samples with depth and normals. Takes 6 s of processor time.
"""

import subprocess
import sys

import matplotlib.pyplot as plt
import numpy as np
from common import TRUTH, options, save

from simtest.dataset import read

chosen = options(__doc__)
folder = chosen.out / "09_dataset"
samples = 6 if chosen.quick else 12
command = ["simtest", "dataset", "tiny", "--out", str(folder), "--samples", str(samples)]
subprocess.run([sys.executable, "-m", *command], check=True)

records = list(read(folder, fields=["image", "depth", "normal"]))
print(f"{len(records)} records")
for name, value in records[0].items():
    print(f"{name}: " + (f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else ", ".join(value)))

figure, axes = plt.subplots(3, 6, figsize=(10, 4.1), layout="constrained")
for column, record in zip(axes.T, records, strict=False):
    column[0].imshow(record["image"], interpolation="nearest")
    bps = [highlight["bp_px"] for highlight in record["meta"]["highlights"]]
    column[0].plot(*np.transpose(bps), "+", color=TRUTH, markersize=10, markeredgewidth=2)
    depth = column[1].imshow(record["depth"], cmap="viridis", vmin=8, vmax=16, interpolation="nearest")
    # x, y and -z, each from -1 to 1, are shown as red, green and blue
    column[2].imshow((record["normal"] * [1, 1, -1] + 1) / 2, interpolation="nearest")
    for axis in column:
        axis.set_xticks([])
        axis.set_yticks([])
figure.colorbar(depth, ax=axes[1], label="depth, mm")
for row, name in enumerate(("frame, + true BP", "depth", "normals as colours")):
    axes[row, 0].set_ylabel(name)
save(figure, chosen.out / "09_dataset_and_loader.png")
