"""Kill a dataset's writing process and its workers at random moments, until it is finished; some 15 minutes."""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.measuring import Figure, print_figures
from simtest.runtime.provenance import file_hash

KILLS = 50
PAUSE_S = (0.5, 6.0)
"""Range of the times between two kills."""

_COMMAND = [
    sys.executable, "-c", "from simtest.cli.main import main; main()", "dataset", "tiny", "--samples", "200",
    "--set", "samples_per_anatomy=10", "--set", "shard_mb=0.3", "--workers", "2", "--out",
]  # fmt: skip


def figures() -> list[Figure]:
    """Kill runs, and compare the result with that of an undisturbed run."""
    rng, killed = random.Random(1), {"writer": 0, "worker": 0}
    with tempfile.TemporaryDirectory() as scratch:
        whole, cut = Path(scratch) / "whole", Path(scratch) / "cut"
        subprocess.run([*_COMMAND, str(whole)], check=True, capture_output=True)
        differing = 0
        while sum(killed.values()) < KILLS:
            shutil.rmtree(cut, ignore_errors=True)
            _disturb([*_COMMAND, str(cut)], killed, rng)
            subprocess.run([*_COMMAND, str(cut)], check=True, capture_output=True)
            differing += len(set(_contents(whole).items()) ^ set(_contents(cut).items()))
    about = f"{killed['writer']} kills of the writer, {killed['worker']} of workers, signal 9"
    return [Figure("files that differ from an undisturbed run's", differing, 0, unit="", about=about)]


def _disturb(command: list[str], killed: dict[str, int], rng: random.Random) -> None:
    """Start and kill a run repeatedly, until it finishes or there were enough kills."""
    while sum(killed.values()) < KILLS:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and sum(killed.values()) < KILLS:
            time.sleep(rng.uniform(*PAUSE_S))
            workers = _workers(process.pid)
            if process.poll() is not None:
                return
            if workers and rng.random() < 0.5:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(rng.choice(workers), signal.SIGKILL)
                    killed["worker"] += 1
            else:
                process.kill()
                process.wait()
                killed["writer"] += 1
        process.kill()
        process.wait()


def _workers(pid: int) -> list[int]:
    with contextlib.suppress(OSError):
        children = [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        return [child for child in children if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()]
    return []


def _contents(folder: Path) -> dict[str, str]:
    return {path.name: file_hash(path) for path in folder.iterdir()}


if __name__ == "__main__":
    sys.exit(print_figures(figures()))
