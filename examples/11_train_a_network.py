"""Train a small network on rendered frames, and run it as an estimator beside `bisector`.

`simtest dataset` renders 50 frames of ten colons. `simtest train` learns the normals at the highlights of six colons,
chooses the epoch on two, and writes model.onnx, which runs by its name wherever an estimator does; the last two test
it. No GPU is needed, but the extra learn: pip install ".[learn]" (docs/start/install.md says how without CUDA).

Picture: a test frame with the network's normals, and all errors. Takes 90 s of processor time.
"""

import subprocess
import sys
from importlib.util import find_spec

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, TRUTH, angle_deg, options, save

import simtest
from simtest.dataset import calibration_of, read
from simtest.dataset.learn import Samples

chosen = options(__doc__)
if missing := [name for name in ("torch", "safetensors", "onnx", "onnxruntime") if find_spec(name) is None]:
    sys.exit(f'missing: {", ".join(missing)}; pip install ".[learn]" brings them (docs/start/install.md)')
from torch.utils.data import DataLoader  # noqa: E402 (not before its absence is told)

folder, trained = chosen.out / "11_dataset", chosen.out / "11_training"
few = ["--samples=6", "--set=samples_per_anatomy=2"] if chosen.quick else []
for command in (
    ["dataset", "highlights_tiny", f"--out={folder}", *few],
    ["train", "spot_normals", str(folder), f"--out={trained}", "--set=epochs=40"],
):
    subprocess.run([sys.executable, "-m", "simtest", *command], check=True)
# What a loop of your own would read.
batch = next(iter(DataLoader(Samples(folder, fields=["image", "normal_base"], shuffle=20), batch_size=2)))
print({name: tuple(values.shape) for name, values in batch.items() if name != "meta"})

names = ["bisector", f"learned_spot:{trained / 'model.onnx'}"]
rows = {}  # by estimator: error and stated deviation, deg
for record in read(folder, "test", fields=["image", "normal_base"]):
    image, calibration = record["image"], calibration_of(record["meta"])
    found = simtest.reconstruct(image, calibration, names, isolated=False, target="base")
    for name, made in (pair for spot in found for pair in spot.estimates.items()):
        if isinstance(made, simtest.Estimate):
            column, row = made.look_px.astype(int)
            truth = record["normal_base"][row, column]
            rows.setdefault(name, []).append((angle_deg(made.normal, truth), made.deviation_deg))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.imshow(image, interpolation="nearest")
for (name, made), colour in zip(rows.items(), (COLOURS["bisector"], TRUTH), strict=True):
    error, stated = np.array(made, float).T
    print(f"{name}: {len(made)} normals, median error {np.median(error):.1f} deg, stated {np.median(stated):.1f} deg")
    right.plot(np.sort(error), np.arange(1, len(error) + 1) / len(error), color=colour, label=name)
right.set(xlabel="error of the base's normal, deg", ylabel="share of the normals below", xlim=(0, 40), ylim=(0, 1))
right.legend(loc="lower right")
network = [made for spot in found for name, made in spot.estimates.items() if name != "bisector"]
for made in (made for made in network if isinstance(made, simtest.Estimate)):
    left.quiver(*made.look_px, *made.normal[:2], color=TRUTH, angles="xy", scale=10, width=0.006)
save(figure, chosen.out / "11_train_a_network.png")
