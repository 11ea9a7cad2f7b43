"""Train a small network on rendered frames, and run it as an estimator beside `bisector`.

`simtest dataset` renders 50 frames of ten colons. `simtest train` learns the normals at the highlights of six colons,
chooses the epoch on two, and writes model.onnx, which runs by its name wherever an estimator does; the last two test
it. No GPU is needed, but the extra learn: pip install -e ".[learn]" (docs/start/install.md says how without CUDA).

Picture: a test frame with the network's normals, and all errors. Takes 100 s of processor time.
"""

import subprocess
import sys
from importlib.util import find_spec

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, TRUTH, angle_deg, options, save

import simtest
from simtest.dataset import calibration_of, read

chosen = options(__doc__)
if missing := [name for name in ("torch", "safetensors", "onnx", "onnxruntime") if find_spec(name) is None]:
    sys.exit(f'missing: {", ".join(missing)}; pip install -e ".[learn]" brings them (docs/start/install.md)')
from torch.utils.data import DataLoader  # noqa: E402 (not before its absence is known)

from simtest.dataset.learn import Samples  # noqa: E402

folder, trained = chosen.out / "11_dataset", chosen.out / "11_training"
few = ["--samples=6", "--set=samples_per_anatomy=2"] if chosen.quick else []
command = [sys.executable, "-m", "simtest"]
subprocess.run([*command, "dataset", "highlights_tiny", f"--out={folder}", *few], check=True)
subprocess.run([*command, "train", "spot_normals", str(folder), f"--out={trained}", "--set=epochs=40"], check=True)
# What a loop of your own would read.
batch = next(iter(DataLoader(Samples(folder, fields=["image", "normal_base"], shuffle=20), batch_size=2)))
print({name: tuple(values.shape) for name, values in batch.items() if name != "meta"})

names = ["bisector", f"learned_spot:{trained / 'model.onnx'}"]
rows = {}  # by estimator: error and stated deviation, deg, of highlights at which both answer
for record in read(folder, "test", fields=["image", "normal_base"]):
    found = simtest.reconstruct(record["image"], calibration_of(record["meta"]), names, isolated=False, target="base")
    answers = [
        spot.estimates for spot in found if all(isinstance(e, simtest.Estimate) for e in spot.estimates.values())
    ]
    for name, estimate in (pair for estimates in answers for pair in estimates.items()):
        column, row = estimate.look_px.astype(int)
        error = angle_deg(estimate.normal, record["normal_base"][row, column])
        rows.setdefault(name, []).append((error, estimate.deviation_deg))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.imshow(record["image"])
for name, colour in zip(sorted(rows), (COLOURS["bisector"], TRUTH), strict=True):
    error, stated = np.array(rows[name], float).T
    print(f"{name}: {len(error)} normals, median error {np.median(error):.1f} deg, stated {np.median(stated):.1f} deg")
    right.plot(np.sort(error), np.arange(1, len(error) + 1) / len(error), color=colour, label=name)
    for estimate in (estimates[name] for estimates in answers):
        left.quiver(*estimate.look_px, *estimate.normal[:2], color=colour, angles="xy", scale=8, width=0.006)
right.set(xlabel="error of the base's normal, deg", ylabel="share of the normals below", xlim=(0, 40), ylim=(0, 1))
right.legend(loc="lower right")
left.set(xticks=[], yticks=[], xlabel="normals of the base, seen from the camera")
save(figure, chosen.out / "11_train_a_network.jpg")
