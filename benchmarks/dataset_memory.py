"""Memory of a process that makes 2,000 samples of 500 anatomies, one after the other; some 20 minutes.

An anatomy's mesh is larger or smaller than the last one's, and the memory goes up and down with it by a tenth. What
adds up over the run is the slope of a line through all readings.
"""

import subprocess
import sys

import numpy as np

from benchmarks.measuring import Figure

SAMPLES, EVERY = 2000, 50
"""Samples, and after how many the memory is read."""

_PROGRAM = """
import sys
from simtest.dataset.plan import Plan
from simtest.dataset.maker import Maker
from simtest.spec import load_dataset
maker = Maker(Plan(load_dataset("smooth", {"samples": 100000, "samples_per_anatomy": 4, "tries": 1,
    "camera.width": 64, "camera.height": 48, "camera.fx": 32.0, "camera.fy": 32.0, "render.samples_per_pixel": 1})))
samples, every = map(int, sys.argv[1:])
for index in range(samples):
    maker.make(index).encode()
    if (index + 1) % every == 0:
        with open("/proc/self/statm") as file:
            print(int(file.read().split()[1]) * 4096 / 2**20, flush=True)
"""


def figures() -> list[Figure]:
    """Measure how the memory grows over all samples."""
    command = [sys.executable, "-c", _PROGRAM, str(SAMPLES), str(EVERY)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    memory = np.array([float(line) for line in done.stdout.split()])
    slope, start = np.polyfit(np.arange(len(memory)), memory, 1)
    grown = 1 + slope * (len(memory) - 1) / start
    about = f"{memory[0]:.0f} MiB after {EVERY} samples, {memory[-1]:.0f} at the end"
    about += f"; {memory.min():.0f} to {memory.max():.0f}"
    return [Figure(f"memory from {EVERY} to {SAMPLES} samples, by a line through all", grown, 1.05, about=about)]
