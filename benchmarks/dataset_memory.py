"""Memory of a process that makes 2,000 samples of 100 anatomies, one after the other; some 15 minutes."""

import subprocess
import sys

from benchmarks.measuring import Figure

COUNTS = (50, 200, 2000)
"""Samples after which the memory is read."""

_PROGRAM = """
import sys
from simtest.dataset.plan import Plan
from simtest.dataset.sample import Maker
from simtest.spec import load_dataset
maker = Maker(Plan(load_dataset("endoscopy", {"samples": 100000, "samples_per_anatomy": 20, "tries": 1,
    "camera.width": 64, "camera.height": 48, "camera.fx": 32.0, "camera.fy": 32.0, "render.samples_per_pixel": 1})))
counts = [int(count) for count in sys.argv[1:]]
for index in range(counts[-1]):
    maker.make(index).encode()
    if index + 1 in counts:
        with open("/proc/self/statm") as file:
            print(int(file.read().split()[1]) * 4096 / 2**20, flush=True)
"""


def figures() -> list[Figure]:
    """Measure."""
    command = [sys.executable, "-c", _PROGRAM, *map(str, COUNTS)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    first, middle, last = (float(line) for line in done.stdout.split())
    about = f"{first:.0f}, {middle:.0f}, {last:.0f} MiB after {', '.join(map(str, COUNTS))} samples"
    return [
        Figure("memory after 2000 samples over that after 50", last / first, 1.05, about=about),
        Figure("memory after 2000 samples over that after 200", last / middle),
    ]
