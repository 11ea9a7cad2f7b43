"""How much of all cores each command uses: (user + system time) / wall time / cores, of the whole command.

Each command runs as a child, as a user starts it, twice: the first run fills the caches, the second one counts. Only a
machine with nothing else to do gives true shares, and so the limits are those of the commands that run for long.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from benchmarks.measuring import Figure

LIMIT = 0.8


@dataclass(frozen=True)
class Used:
    """Processor and wall time of a command with all its children, s."""

    processor_s: float
    wall_s: float

    @property
    def share(self) -> float:
        """Share of all cores."""
        return self.processor_s / self.wall_s / cores()


def cores() -> int:
    """Return the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def commands(folder: Path) -> dict[str, tuple[list[str], float | None]]:
    """Return the commands by name, each with the share that it must reach, if any; `{n}` is the number of the run."""
    workers = ["--workers", str(cores())]

    def out(name: str) -> list[str]:
        return ["--out", str(folder / (name + "-{n}"))]

    picture = str(folder / "picture-0" / "frame.png")
    return {
        # First: the next one reads its picture.
        "render cylinder": (["render", "cylinder", *out("picture")], None),
        "reconstruct a picture": (["reconstruct", picture, "--fov", "60", *out("reconstructed")], None),
        "render anatomy": (["render", "anatomy", *out("anatomy")], None),
        "validate overview": (["validate", "overview", *out("overview")], LIMIT),
        "validate overview, a worker a core": (["validate", "overview", *workers, *out("overview-w")], LIMIT),
        "validate anatomy, a worker a core": (["validate", "anatomy", *workers, *out("anatomies")], LIMIT),
        "dataset smooth, 40 samples": (["dataset", "smooth", "--samples", "40", *out("dataset")], None),
        "nightly": (["nightly", "--profile", "quick", "--reports", str(folder / "nightly-{n}")], LIMIT),
    }


def figures(only: tuple[str, ...] = (), runs: int = 2) -> list[Figure]:
    """Run the commands, all or those that are named."""
    shown = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, (words, limit) in commands(Path(scratch)).items():
            if only and name not in only:
                continue
            used = [run([word.replace("{n}", str(number)) for word in words]) for number in range(runs)][-1]
            about = f"{used.processor_s:.1f} s of processor in {used.wall_s:.1f} s on {cores()} cores"
            shown.append(Figure(f"simtest {name}: share of all cores", used.share, limit, True, "", about))
    return shown


def run(words: list[str]) -> Used:
    """Run a command of simtest; return what it and its children used."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "simtest", *words], capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    # A night without a baseline ends with 0, one with a regression with 1: either has done its work.
    if done.returncode not in ((0, 1) if words[0] == "nightly" else (0,)):
        said = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise SystemExit(f"benchmark cores: simtest {' '.join(words)}: exit {done.returncode}: {said[0]}")
    return Used(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall)
