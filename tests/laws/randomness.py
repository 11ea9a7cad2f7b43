"""Laws of randomness: as many different noises as realisations, of the right size."""

from hashlib import sha256

import numpy as np

from simtest.rendering import Session
from simtest.runtime.seeds import from_integer
from simtest.simulation.frame import render_view
from simtest.spec import Experiment, scene_from_dict
from simtest.spec.recipes import PaperSetting
from simtest.validation.cases import expand
from simtest.validation.paper.protocol import Pipeline
from simtest.validation.paper.rows import paper_rows
from tests.laws.law import Law, law

SLANT_OFF_DEG = 0.05
"""Bound of circle_pose's error without noise and smoothing; interpolation leaves 0.0085 deg."""

REALISATIONS = 8
SIGMA = 0.05


def noises(seed: int = 0) -> list[Law]:
    """Check the noise of some realisations' frames, rendered and of the published protocol."""
    small = {"camera.width": 64, "camera.height": 64, "camera.fx": 100.0, "camera.fy": 100.0}
    groups = [
        {"scene": "plane", "isolated": False, "set": {**small, "sensor.noise_sigma": SIGMA}, "label": "rendered"},
        {"scene": "published", "set": {"paper.size": 64, "paper.sigma": SIGMA}, "label": "published"},
    ]
    experiment = Experiment(name="law", realisations=REALISATIONS, seed=seed, groups=groups)
    case, published = expand(experiment)
    # A session of its own, so that no other law's scene is changed.
    scene = scene_from_dict(case.data, "law")
    seen = render_view(Session(scene), scene)
    frames = [seen.frame(case.noise_seed(experiment, number)) for number in case.numbers()]
    # The published protocol
    pipeline = Pipeline(PaperSetting(size=64, sigma=SIGMA), {})
    generators = [from_integer(published.noise_seed(experiment, number)) for number in published.numbers()]
    pictures = [pipeline.stages(rng).noisy for rng in generators]
    # The noise that the rendered frames have beside their light
    clean = seen.light / np.float32(seen.full_scale)
    left = np.std([frame - clean for frame in frames])
    count = len(frames) * clean.size
    about = f"{SIGMA:g} within 5 standard errors"
    return [
        _distinct("rendered", frames),
        _distinct("published", pictures),
        law("noise", "sigma", "", float(left), *_around(SIGMA, 5 * SIGMA / np.sqrt(2 * count)), count, about),
    ]


def protocol_noise() -> list[Law]:
    """Measure the noise that the published protocol adds to its picture."""
    pipeline = Pipeline(PaperSetting(sigma=SIGMA), {})
    made = pipeline.stages(from_integer(60))
    left, count = float(np.std(made.noisy - made.clean)), made.clean.size
    about = f"{SIGMA:g} within 5 standard errors"
    bounds = _around(SIGMA, 5 * SIGMA / np.sqrt(2 * count))
    return [law("noise", "protocol_sigma", "", left, *bounds, count, about)]


def published() -> list[Law]:
    """Reconstruct the published protocol's plane without noise, at its default slant."""
    setting = PaperSetting(sigma=0.0, smoothing_px=0.0)
    (row,) = paper_rows(setting, {}, range(1), [0], ("circle_pose",))
    off = float(row.get("error_deg", np.nan))
    about = "circle_pose at a slant of 58 deg, without noise; unsmoothed; interpolation leaves 0.01 deg"
    return [law("published", "circle_pose_off", "deg", off, SLANT_OFF_DEG, about=about)]


def _around(value: float, gap: float) -> tuple[float, float]:
    """Return the upper and the lower bound."""
    return value + gap, value - gap


def _distinct(name: str, frames: list[np.ndarray]) -> Law:
    found = len({sha256(np.ascontiguousarray(frame).tobytes()).digest() for frame in frames})
    count = len(frames)
    about = "hashes of the frames of one setting; all differ"
    return law("noise", f"distinct_{name}", "", float(found), count, count, count, about)
