"""Train a small network on rendered frames, and run it as an estimator beside `bisector`.

`simtest dataset` renders frames of ten colons. `simtest train` learns the normal at a highlight from six of them and
writes model.onnx, which runs by name wherever an estimator does. Two colons, which the network has not seen, are the
test. It needs no GPU, but the extra `learn`: pip install ".[learn]"; docs/start/install.md says how without CUDA.

Picture: how large the errors are, and a frame with the network's normals. Takes 90 s of processor time.
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
    sys.exit(f'missing: {", ".join(missing)}; pip install ".[learn]" brings them (docs/start/install.md)')
from torch.utils.data import DataLoader

from simtest.dataset.learn import Samples


def run(*arguments: object) -> None:
    """Run a command of simtest."""
    subprocess.run([sys.executable, "-m", "simtest", *map(str, arguments)], check=True)


data, trained = chosen.out / "11_dataset", chosen.out / "11_training"
run("dataset", "highlights_tiny", "--out", data, *(["--samples=6", "--set=samples_per_anatomy=2"] * chosen.quick))
# A loop of one's own begins so; `simtest train` has its own, with checkpoints and a page of curves.
loader = DataLoader(Samples(data, "train", fields=["image", "normal_base"], shuffle=20), batch_size=2, num_workers=2)
print({name: tuple(values.shape) for name, values in next(iter(loader)).items() if name != "meta"})
run("train", "spot_normals", data, "--out", trained, "--set", "epochs=40")

names = ["bisector", f"learned_spot:{trained / 'model.onnx'}"]
errors, frames = {}, []
for record in read(data, "test", fields=["image", "normal_base"]):
    found = simtest.reconstruct(
        record["image"], calibration_of(record["meta"]), names, isolated=False, detector="colour", target="base"
    )
    frames.append((record["image"], found))
    for name, result in [pair for spot in found for pair in spot.estimates.items()]:
        if isinstance(result, simtest.Estimate):
            column, row = result.look_px.astype(int)
            truth = record["normal_base"][row, column]
            errors.setdefault(name, []).append((angle_deg(result.normal, truth), result.deviation_deg))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
for name, rows in errors.items():
    error, stated = np.array(rows, float).T
    print(f"{name}: {len(rows)} normals, median error {np.median(error):.1f} deg, stated ± {np.median(stated):.1f} deg")
    colour = COLOURS["bisector"] if name == "bisector" else TRUTH
    left.plot(np.sort(error), np.arange(1, len(rows) + 1) / len(rows), color=colour, label=name)
