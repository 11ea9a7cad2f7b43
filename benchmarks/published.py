"""The published protocol: its speed against making and blurring the noise alone."""

import math
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measuring import Figure
from simtest.geometry import Camera, circle_poses, cone_of_conic, fit_ellipses
from simtest.runtime.measuring import PeakMemory, in_turns
from simtest.runtime.resources import find
from simtest.runtime.seeds import from_integer
from simtest.spec import load_experiment
from simtest.spec.paper import PaperSetting
from simtest.validation.cases import Case, expand
from simtest.validation.execution import PAPER_CHUNK
from simtest.validation.paper.published_pipeline import kernel_radius
from simtest.validation.paper.rows import paper_rows, pipeline_with
from simtest.validation.paper.slanted_view import draw_light, picture
from simtest.validation.results_table import ResultRow

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
    whole, peak = _command()
    floors = {name: _floor(part) for name, part in (("44 settings", at_camera), ("light offset", offset))}
    floor = sum(floors.values())
    about = f"{whole:.1f} s against {floor:.1f} s (" + ", ".join(f"{k} {v:.1f} s" for k, v in floors.items()) + ")"
    shown += [
        Figure("simtest validate paper, whole command, 2 workers, over its floor", whole / floor, 1.8, about=about),
        Figure("simtest validate paper, whole command, 2 workers", whole, 90.0, unit="s"),
        Figure("simtest validate paper, peak memory of all processes", peak, 600.0, unit="MiB"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        # The light-offset sweep is the last group of the file.
        path = Path(folder) / "paper.toml"
        path.write_text(find("paper", "scenes", "experiments").read_text(encoding="utf-8").rsplit("[[groups]]", 1)[0])
        without, _ = _command(str(path))
    label = "the same without the light-offset sweep"
    about = f"its floor {floors['44 settings']:.1f} s; starting and the page are the rest"
    return [*shown, Figure(label, without, 60.0, unit="s", about=about)]


def _ratio(name: str, setting: PaperSetting, rounds: int = 15) -> Figure:
    """Compare the rows of one chunk of realisations with their floor, in this process."""
    seeds = list(range(PAPER_CHUNK))
    common = ResultRow(experiment="bench", label="", setting="")
    times = in_turns(
        {
            "rows": lambda: paper_rows(setting, common, range(PAPER_CHUNK), seeds, ("circle_pose",)),
            "floor": lambda: floor(setting, seeds),
        },
        rounds,
    )
    each = {key: 1e3 * value / PAPER_CHUNK for key, value in times.items()}
    about = f"{each['rows']:.3f} ms a realisation against {each['floor']:.3f} ms"
    return Figure(name, times["rows"] / times["floor"], about=about)


def floor(setting: PaperSetting, seeds: list[int]) -> None:
    """Make and blur the noise of realisations; with an offset light, make and warp each one's texture too."""
    pipeline = pipeline_with(setting, ("circle_pose",))
    width, height = pipeline.outer[2:]
    side = 2 * kernel_radius(setting) + 1
    for seed in seeds:
        rng = from_integer(seed)
        if setting.eps > 0:
            picture(setting, draw_light(setting, rng), pipeline.positions)
        noise = rng.standard_normal((height, width), dtype=np.float32).astype(np.float64)
        cv2.GaussianBlur(noise, (side, side), setting.smoothing_px, borderType=cv2.BORDER_REFLECT)


def _floor(cases: list[Case]) -> float:
    """Time the floor of all realisations of some cases on the workers, s."""
    tasks = []
    for case in cases:
        for first in range(0, case.realisations, PAPER_CHUNK):
            tasks.append((case.paper_setting(), list(range(first, min(first + PAPER_CHUNK, case.realisations)))))
    with multiprocessing.get_context("spawn").Pool(WORKERS, cv2.setNumThreads, (1,)) as pool:
        # The workers start before the clock does.
        pool.starmap(floor, [(PaperSetting(), list(range(20)))] * (4 * WORKERS), chunksize=1)
        start = time.perf_counter()
        pool.starmap(floor, tasks, chunksize=1)
        return time.perf_counter() - start


def _command(experiment: str = "paper") -> tuple[float, float]:
    """Run the whole command; give its wall time, s, and the peak memory of its processes, MiB."""
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.executable, "-c", _PROGRAM, "validate", experiment, "--workers", str(WORKERS)]
        start = time.perf_counter()
        process = subprocess.Popen([*program, "--out", str(Path(folder) / "run")], stdout=subprocess.DEVNULL)
        with PeakMemory(process.pid) as memory:
            process.wait()
        if process.returncode:
            raise SystemExit(f"simtest validate paper: exit {process.returncode}")
        return time.perf_counter() - start, memory.peak_mib or math.nan


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
