"""The published protocol: its speed against making and blurring the noise alone, in single precision.

The floor holds nothing of ours: no texture is warped, and no picture is made. With a light offset each realisation has
a texture of its own to warp, so its ratio shows what that costs.
"""

import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import Figure
from benchmarks.timing import PeakMemory, in_turns, times_in_turns
from simtest.geometry import Camera, circle_poses, cone_of_conic, fit_ellipses
from simtest.runtime.resources import find
from simtest.runtime.seeds import from_integer
from simtest.spec import load_experiment
from simtest.spec.recipes import PaperSetting
from simtest.validation.case_work import PAPER_CHUNK
from simtest.validation.cases import Case, expand
from simtest.validation.columns import Row
from simtest.validation.paper.protocol import kernel_radius
from simtest.validation.paper.rows import paper_rows, pipeline_with

WORKERS = 2
CONICS, POINTS = 1000, 100
_PROGRAM = "from simtest.cli.main import main; main()"


def figures() -> list[Figure]:
    """Return the figures: parts in turns on one core, then the whole command on two."""
    cv2.setNumThreads(1)
    cases = expand(load_experiment("paper"))
    shown = [
        _ratio("published protocol, defaults, one core", PaperSetting()),
        _ratio("published protocol, light offset, one core", PaperSetting(exponent=100.0, eps=400.0)),
        _batched_pose(),
    ]
    offset = [case for case in cases if case.paper_setting().eps > 0 or "light offset" in case.label]
    at_camera = [case for case in cases if case not in offset]
    whole = _command()
    floors = {name: _floor(part) for name, part in (("44 settings", at_camera), ("light offset", offset))}
    least = sum(floors.values())
    about = f"{whole.processor_s:.1f} s against {least:.1f} s of processor ("
    about += ", ".join(f"{name} {value:.1f} s" for name, value in floors.items()) + ")"
    label = "simtest validate paper, 2 workers"
    shown += [
        Figure(f"{label}: whole command over its floor", whole.processor_s / least, about=about),
        Figure(f"{label}: whole command", whole.wall_s, 90.0, unit="s"),
        Figure(f"{label}: peak memory of all processes", whole.peak_mib, 600.0, unit="MiB"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        # The light-offset sweep is the last group of the file.
        path = Path(folder) / "paper.toml"
        path.write_text(find("paper", "scenes", "experiments").read_text(encoding="utf-8").rsplit("[[groups]]", 1)[0])
        without = _command(str(path))
    floor_s = floors["44 settings"]
    about = f"{without.processor_s:.1f} s against {floor_s:.1f} s; starting and the page are the rest"
    label += ", without the light-offset sweep"
    return [
        *shown,
        Figure(f"{label}: whole command over its floor", without.processor_s / floor_s, 1.8, about=about),
        Figure(f"{label}: whole command", without.wall_s, 60.0, unit="s"),
    ]


def _ratio(name: str, setting: PaperSetting, rounds: int = 15) -> Figure:
    """Compare the rows of one chunk of realisations with their floor, in this process."""
    seeds = list(range(PAPER_CHUNK))
    common: Row = {"experiment": "bench", "label": "", "setting": ""}
    functions: dict[str, Callable[[], object]] = {
        "rows": lambda: paper_rows(setting, common, range(PAPER_CHUNK), seeds, ("circle_pose",)),
        "floor": lambda: floor(setting, seeds),
    }
    times = times_in_turns(functions, rounds, time.process_time)
    each = {key: 1e3 * statistics.median(value) / PAPER_CHUNK for key, value in times.items()}
    about = f"{each['rows']:.3f} ms a realisation against {each['floor']:.3f} ms, processor"
    ratio = statistics.median(a / b for a, b in zip(times["rows"], times["floor"], strict=True))
    return Figure(name, ratio, about=about)


def floor(setting: PaperSetting, seeds: list[int]) -> None:
    """Make and blur the noise of realisations, all in single precision: what nobody's protocol can do without."""
    pipeline = pipeline_with(setting, ("circle_pose",))
    width, height = pipeline.outer[2:]
    side = 2 * kernel_radius(setting) + 1
    for seed in seeds:
        noise = from_integer(seed).standard_normal((height, width), dtype=np.float32)
        cv2.GaussianBlur(noise, (side, side), setting.smoothing_px, borderType=cv2.BORDER_REFLECT)


def _floor(cases: list[Case]) -> float:
    """Return the processor time of the floor of all realisations of some cases, s, from one chunk of each."""
    total = 0.0
    for case in cases:
        setting, count = case.paper_setting(), min(PAPER_CHUNK, case.realisations)
        start = time.process_time()
        floor(setting, list(range(count)))
        total += (time.process_time() - start) * case.realisations / count
    return total


@dataclass(frozen=True)
class _Command:
    """What a command took: wall time and processor time of all its processes, s, and their peak memory, MiB."""

    wall_s: float
    processor_s: float
    peak_mib: float


def _command(experiment: str = "paper") -> _Command:
    """Run the whole command."""
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.executable, "-c", _PROGRAM, "validate", experiment, "--workers", str(WORKERS)]
        start, before = time.perf_counter(), _children_s()
        process = subprocess.Popen([*program, "--out", str(Path(folder) / "run")], stdout=subprocess.DEVNULL)
        with PeakMemory(process.pid) as memory:
            process.wait()
        if process.returncode:
            raise SystemExit(f"simtest validate paper: exit {process.returncode}")
        return _Command(time.perf_counter() - start, _children_s() - before, memory.peak_mib or math.nan)


def _children_s() -> float:
    """Return the processor time of all children that have ended, and of theirs, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _batched_pose() -> Figure:
    """Time fit and pose of many conics at once."""
    rng = np.random.default_rng(0)
    phase = np.linspace(0, 2 * np.pi, POINTS, endpoint=False)
    contours = []
    for _ in range(CONICS):
        (x, y), (a, b) = rng.uniform(150, 250, 2), rng.uniform(10, 60, 2)
        points = np.stack([x + a * np.cos(phase), y + b * np.sin(phase)], axis=1)
        contours.append(points + rng.normal(0, 0.1, points.shape))
    camera = Camera(406, 406, 406.0, 406.0, 203.0, 203.0)
    work: Callable[[], object] = lambda: circle_poses(cone_of_conic(fit_ellipses(contours), camera.K))  # noqa: E731
    each = 1e6 * in_turns({"pose": work}, 25)["pose"] / CONICS
    return Figure(f"ellipse fit and pose, batches of {CONICS}, {POINTS} points each", each, 6.0, unit="µs a conic")
