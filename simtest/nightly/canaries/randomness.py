"""Canaries of randomness: as many different noises as realisations, of the right size."""

from collections.abc import Sequence
from hashlib import sha256

import numpy as np
import polars as pl

from simtest.nightly.canaries.canary import canary
from simtest.nightly.records import Figure
from simtest.rendering import Session
from simtest.runtime.seeds import from_integer
from simtest.simulation.rendered_view import render_view
from simtest.spec import Experiment, scene_from_dict
from simtest.spec.paper import PaperSetting
from simtest.validation.cases import Case, expand
from simtest.validation.paper.published_pipeline import Pipeline
from simtest.validation.paper.rows import paper_rows
from simtest.validation.results_table import ResultRow

SLANT_OFF_DEG = 0.05
"""Bound of circle_pose's error without noise and smoothing; interpolation leaves 0.0085 deg."""

_SIGMA_PATH = "sensor.noise_sigma"

REALISATIONS = 8
SIGMA = 0.05


def noises(variant: str | None = None, seed: int = 0) -> list[Figure]:
    """Check the noise of some realisations' frames, rendered and of the published protocol."""
    small = {"camera.width": 64, "camera.height": 64, "camera.fx": 100.0, "camera.fy": 100.0}
    groups = [
        {"scene": "plane", "isolated": False, "set": {**small, "sensor.noise_sigma": SIGMA}, "label": "rendered"},
        {"scene": "published", "set": {"paper.size": 64, "paper.sigma": SIGMA}, "label": "published"},
    ]
    experiment = Experiment(name="canary", realisations=REALISATIONS, seed=seed, groups=groups)
    case, published = expand(experiment)
    # A session of its own, so that no other canary's scene is changed.
    scene = scene_from_dict(case.data, "canary")
    seen = render_view(Session(scene, variant), scene)
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
        canary("noise", "sigma", "", float(left), *_around(SIGMA, 5 * SIGMA / np.sqrt(2 * count)), count, about),
    ]


def protocol_noise() -> list[Figure]:
    """Measure the noise that the published protocol adds to its picture."""
    pipeline = Pipeline(PaperSetting(sigma=SIGMA), {})
    made = pipeline.stages(from_integer(60))
    left, count = float(np.std(made.noisy - made.clean)), made.clean.size
    about = f"{SIGMA:g} within 5 standard errors"
    bounds = _around(SIGMA, 5 * SIGMA / np.sqrt(2 * count))
    return [canary("noise", "protocol_sigma", "", left, *bounds, count, about)]


def published() -> list[Figure]:
    """Reconstruct the published protocol's plane without noise, at its default slant."""
    setting = PaperSetting(sigma=0.0, smoothing_px=0.0)
    rows = paper_rows(setting, ResultRow(), range(1), [0], ("circle_pose",))
    off = rows["error_deg"].fill_null(np.nan).item()
    about = "circle_pose at a slant of 58 deg, without noise; unsmoothed; interpolation leaves 0.01 deg"
    return [canary("published", "circle_pose_off", "deg", off, SLANT_OFF_DEG, about=about)]


def _around(value: float, gap: float) -> tuple[float, float]:
    """Return the upper and the lower bound."""
    return value + gap, value - gap


def _distinct(name: str, frames: list[np.ndarray]) -> Figure:
    found = len({sha256(np.ascontiguousarray(frame).tobytes()).digest() for frame in frames})
    count = len(frames)
    about = "hashes of the frames of one setting; all differ"
    return canary("noise", f"distinct_{name}", "", float(found), count, count, count, about)


def noises_of(rows: pl.DataFrame, experiments: Sequence[Experiment] | None = None) -> list[Figure]:
    """Count the realisations of noisy settings that repeat any other's seed, or one's results to the last bit.

    Parameters
    ----------
    rows : polars.DataFrame
        Results of all experiments.
    experiments : sequence of Experiment, optional
        What was run. Where one is defined with noise and its rows have none, the noise is lost and there is nothing to
        count: no value, which does not pass. Without them, rows that all state a noise of 0 are trusted.
    """
    lost = _without_noise(rows, experiments)
    setting = ("experiment", "setting")
    noisy = rows.filter(pl.col("noise_sigma") > 0)
    # Repeated seeds, of one setting or of two
    frames = noisy.select(*setting, "realisation", "seed").unique()
    seeds = frames.height - frames["seed"].n_unique()
    # Repeated results: three numbers of white noise are not equal by chance, it is the same noise.
    results = noisy.filter(pl.col("status") == "ok", pl.col("true_id").is_not_null(), pl.col("specularity") == 0)
    normals = pl.struct("normal_x", "normal_y", "normal_z")
    same = results.group_by(*setting, "estimator").agg(repeated=pl.len() - normals.n_unique())["repeated"].sum()
    # Without results there are no repeated ones, which proves nothing.
    silent = frames.height > 0 and results.is_empty()
    more = f"; no noise in {', '.join(lost)}" if lost else ""
    return [
        canary(
            "noise", "repeated_seeds", "", float("nan") if lost else float(seeds), 0, n=frames.height,
            about="of all noisy settings of the night" + more,
        ),
        canary(
            "noise", "repeated_answers", "", float("nan") if lost or silent else float(same), 0, n=results.height,
            about="normals of the brightest highlight of the night's noisy settings that are the same bits" + more,
        ),
    ]  # fmt: skip


def _without_noise(rows: pl.DataFrame, experiments: Sequence[Experiment] | None) -> list[str]:
    """Return the experiments whose noise is not in their rows."""
    found = rows.group_by("experiment", maintain_order=True).agg(
        noisy=(pl.col("noise_sigma").is_finite() & (pl.col("noise_sigma") > 0)).any(),
        stated=pl.col("noise_sigma").is_finite().any(),
    )
    if experiments is None:
        return found.filter(~pl.col("stated"))["experiment"].to_list()
    noisy = set(found.filter("noisy")["experiment"].to_list())
    return [own.name for own in experiments if own.name not in noisy and any(_sigma(case) > 0 for case in expand(own))]


def _sigma(case: Case) -> float:
    """Return the standard deviation of a case's noise; where it is drawn, the largest."""
    if case.is_paper:
        return case.paper_setting().sigma
    drawn = case.random.get(_SIGMA_PATH)
    return float(drawn.high) if drawn is not None else scene_from_dict(case.data, case.where).sensor.noise_sigma
