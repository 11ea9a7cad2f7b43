"""Memory at the resolution of real frames, 1280 x 720: of `simtest render anatomy`, and of a dataset's process.

Peaks are those of the whole process as the system counts them.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measuring import Figure

CAMERA = {"width": 1280, "height": 720, "fx": 800.0, "fy": 800.0}
SAMPLES, PER_ANATOMY = 12, 4

_DATASET = """
import json, sys
from simtest.dataset.plan import Plan
from simtest.dataset.maker import Maker
from simtest.spec import load_dataset
settings, samples = json.loads(sys.argv[1]), int(sys.argv[2])
maker = Maker(Plan(load_dataset("smooth", settings)))
for index in range(samples):
    maker.make(index).encode()
"""


# A process starts with its parent's peak, so it is started by a small one.
_LAUNCHER = """
import resource, subprocess, sys
code = subprocess.run([sys.executable, *sys.argv[1:]], stdout=subprocess.DEVNULL).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(code)
"""


@dataclass(frozen=True)
class Ended:
    """A process that has ended: its processor time, s, and its peak memory, GB."""

    processor_s: float
    peak_gb: float


def run(arguments: list[str]) -> Ended:
    """Run Python with some arguments, and wait for it.

    The system's account of the one process is used; what its children took is not in the peak.
    """
    done = subprocess.run(
        [sys.executable, "-S", "-c", _LAUNCHER, *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"benchmark memory: {' '.join(arguments[:4])}: exit {done.returncode}")
    processor, peak = (float(word) for word in done.stdout.split()[-2:])
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return Ended(processor, peak * unit / 1e9)


def figures() -> list[Figure]:
    """Render an anatomy twice, as a user does, and make some samples of a dataset."""
    settings = [word for key, value in CAMERA.items() for word in ("--set", f"camera.{key}={value}")]
    shown = []
    with tempfile.TemporaryDirectory() as folder:
        for number, when in enumerate(("first run of this folder", "again")):
            out = str(Path(folder) / str(number))
            used = run(["-m", "simtest", "render", "anatomy", "--out", out, *settings])
            last = number > 0
            name = f"simtest render anatomy, 1280 x 720, {when}"
            shown += [
                Figure(f"{name}: peak memory", used.peak_gb, 0.8 if last else None, unit="GB"),
                Figure(f"{name}: processor", used.processor_s, 6.0 if last else None, unit="s"),
            ]
    values = {f"camera.{key}": value for key, value in CAMERA.items()}
    values |= {"samples": 1000, "samples_per_anatomy": PER_ANATOMY}
    used = run(["-c", _DATASET, json.dumps(values), str(SAMPLES)])
    about = f"{used.processor_s / SAMPLES:.2f} s of processor a sample, imports and kernels included"
    name = f"{SAMPLES} samples of {SAMPLES // PER_ANATOMY} anatomies, 1280 x 720, one process: peak memory"
    return [*shown, Figure(name, used.peak_gb, 2.0, unit="GB", about=about)]
