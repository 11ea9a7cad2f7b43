"""The camera chain on a colour frame of 640 x 480, by the presets of the sensor, beside a Gaussian blur of it."""

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any
from unittest import mock

import cv2
import numpy as np

from benchmarks.measuring import Figure
from benchmarks.timing import times_in_turns
from simtest.calibration import Response
from simtest.geometry import Camera, ViewMask, smooth
from simtest.runtime.arrays import Image
from simtest.simulation import sensor as camera_chain
from simtest.spec.sensor import PRESETS, Sensor

WIDTH, HEIGHT = 640, 480
ROUNDS = 21
LIMIT_MS, LIMIT_BLURS = 60.0, 25.0
"""Of processor; 60 ms are 25 blurs of 2.4 ms."""

STAGES: dict[str, tuple[Any, str]] = {
    "lens": (camera_chain, "collect"),
    "exposure": (camera_chain, "full_scale_of_average"),
    "sensor's colours": (camera_chain, "as_seen_by_sensor"),
    "mosaic": (camera_chain, "behind_filters"),
    "noise": (camera_chain, "_electrons"),
    "demosaicing": (camera_chain, "demosaic"),
    "colour": (camera_chain, "develop"),
    "response": (Response, "encode_picture"),
    "sharpening": (camera_chain, "sharpen"),
    "scaling": (camera_chain, "rescale"),
    "overlay": (camera_chain, "draw"),
    "coding": (camera_chain, "code"),
}
"""The functions of the chain's stages."""


def radiance() -> Image:
    """Return the linear radiance of shaded, mottled tissue with 40 clipping highlights, shape (480, 640, 3)."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mottled = smooth(rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32), 6.0)
    shading = 0.35 + 0.2 * np.sin(x / 90) * np.cos(y / 70) + 0.5 * mottled
    linear = shading[..., None] * np.array([0.55, 0.28, 0.22])
    for column, row in zip(rng.uniform(20, WIDTH - 20, 40), rng.uniform(20, HEIGHT - 20, 40), strict=True):
        linear += 4 * np.exp(-0.5 * ((x - column) ** 2 + (y - row) ** 2) / rng.uniform(1, 4) ** 2)[..., None]
    return np.maximum(linear, 0.0).astype(np.float32)


def chain(name: str, light: Image, camera: Camera) -> Image:
    """Return the picture of a preset: lens, automatic exposure, sensor and video processor."""
    sensor = Sensor.model_validate({"preset": name})
    collected = camera_chain.collect(light, sensor, camera)
    assert sensor.exposure.average is not None
    scale = camera_chain.full_scale_of_average(collected.mean(axis=2)[camera.seen], sensor.exposure.average, sensor)
    return camera_chain.capture(collected, scale, sensor, np.random.default_rng(1), camera.seen)


def figures() -> Iterator[Figure]:
    """Yield the figures."""
    light = radiance()
    camera = Camera(WIDTH, HEIGHT, 400.0, 400.0, WIDTH / 2, HEIGHT / 2, view_mask=ViewMask(320, 240, 310, 120, 230))
    runs: dict[str, Callable[[], object]] = {name: lambda name=name: chain(name, light, camera) for name in PRESETS}
    runs["blur"] = lambda: cv2.GaussianBlur(light, (0, 0), 2.0)
    times = times_in_turns(runs, ROUNDS, time.process_time)
    blur = 1e3 * statistics.median(times["blur"])
    for name in PRESETS:
        own = 1e3 * statistics.median(times[name])
        # Round by round: what the machine does meanwhile slows both alike.
        ratio = statistics.median(a / b for a, b in zip(times[name], times["blur"], strict=True))
        yield Figure(f"{name}, chain on {WIDTH} x {HEIGHT}, processor", own, LIMIT_MS, unit="ms",
                     about=_shares(runs[name]))  # fmt: skip
        yield Figure(f"{name}, chain over a Gaussian blur of 2 px", ratio, LIMIT_BLURS, about=f"blur {blur:.1f} ms")


def _shares(run: Callable[[], object]) -> str:
    """Return the median times of a run's stages, the longest first."""
    spent: dict[str, list[float]] = {}
    within: list[float] = []

    def timed(stage: str, function: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object, **keys: object) -> object:
            start = time.process_time()
            within.append(0.0)
            try:
                return function(*args, **keys)
            finally:
                # Without the stages that it calls: the exposure asks for the response.
                lasted = time.process_time() - start
                spent[stage][-1] += lasted - within.pop()
                if within:
                    within[-1] += lasted

        return call

    with ExitStack() as stack:
        for stage, (home, name) in STAGES.items():
            stack.enter_context(mock.patch.object(home, name, timed(stage, getattr(home, name))))
        for _ in range(ROUNDS):
            for stage in STAGES:
                spent.setdefault(stage, []).append(0.0)
            run()
    medians = {stage: 1e3 * statistics.median(times) for stage, times in spent.items()}
    longest = sorted(medians.items(), key=lambda item: -item[1])
    return ", ".join(f"{stage} {value:.1f} ms" for stage, value in longest if value > 0.05)
