"""Keeps one realisation of the published protocol for the gallery, with the pictures of the pipeline's stages."""

import shlex
from pathlib import Path

import numpy as np

from simtest.errors import Failure
from simtest.runtime.arrays import Array
from simtest.runtime.seeds import from_integer
from simtest.spec import Experiment
from simtest.spec.recipes import PaperSetting
from simtest.validation.cases import Case
from simtest.validation.kept_frames import (
    MAP_SIDE,
    KeptEstimate,
    write_item,
)
from simtest.validation.paper.isocurves import brightest_point
from simtest.validation.paper.protocol import Box, Stages, plane_from_image, texture, window_centre
from simtest.validation.paper.rows import SURFACE, pipeline_with

LENGTH_UNIT = "texture units"

TEXTURE_STEP = 2
"""The texture is smooth: every other sample is enough to look at."""


def save_realisation(path: Path, experiment: Experiment, case: Case, number: int) -> None:
    """Write the gallery item of one realisation, with the pictures `texture`, `clean` and `smoothed`.

    The picture with noise is the item's frame: noise is drawn in and around the region of interest alone, as nothing
    else of the frame is used.
    """
    setting, seed = case.paper_setting(), case.noise_seed(experiment, number)
    pipeline = pipeline_with(setting, experiment.estimators)
    stages = pipeline.stages(from_integer(seed))
    patch = pipeline.cut(stages)
    camera, normal = setting.camera, setting.normal
    bp = _on_plane(setting, _bp(setting, stages))
    peak = None if isinstance(patch, Failure) else patch.peak_px.tolist()
    meta = {
        "surface": SURFACE,
        "setting": case.setting,
        "label": case.label,
        "sigma": setting.sigma,
        "command": reproduce_command(setting, experiment.estimators, seed),
        "camera": camera,
        # Behind the imaging camera the BP is nowhere in the picture.
        "truth": [
            {
                "id": 0, "bp_px": camera.project(bp).tolist() if bp[2] > 0 else None, "normal": normal.tolist(),
                "position": bp.tolist(), "kd_min": 0.0, "kd_max": 0.0, "isolated": True,
            }
        ],
        "estimates": [
            KeptEstimate(specularity=0, true_id=0, bp_px=peak, estimator=name).answered(result, patch, camera, normal)
            for name, (result,) in pipeline.reconstruct([patch]).items()
        ],
        "length_unit": LENGTH_UNIT,
        "paper": setting,
        "light": stages.light.tolist(),
        "seed": seed,
        "outer": pipeline.outer,
        "peak_value": None if isinstance(patch, Failure) else patch.peak_value,
    }  # fmt: skip
    write_item(
        path, meta, _in_frame(setting, stages.noisy, pipeline.outer), *_truth_maps(setting),
        texture=texture(setting, stages.light)[::TEXTURE_STEP, ::TEXTURE_STEP],
        clean=stages.clean, smoothed=stages.smoothed,
    )  # fmt: skip


def reproduce_command(setting: PaperSetting, estimators: tuple[str, ...], seed: int) -> str:
    """Return the command that makes a realisation alone and prints its estimates."""
    values = ", ".join(f"{key}={value!r}" for key, value in setting.model_dump(exclude_defaults=True).items())
    code = (
        "from simtest.runtime.seeds import from_integer; from simtest.spec.recipes import PaperSetting; "
        "from simtest.validation.paper.rows import pipeline_with; "
        f"print(pipeline_with(PaperSetting({values}), {estimators!r}).realise([from_integer({seed})]))"
    )
    # Double quotes are easier to read, but the command of a core may hold what a shell would replace in them.
    plain = f'"{code}"' if not set(code) & set('"$`\\!') else shlex.quote(code)
    return f"python -c {plain}"


def _bp(setting: PaperSetting, stages: Stages) -> Array:
    """Return the BP in coordinates about the window's centre, shape (2,)."""
    overhead = np.array([0.0, 0.0, setting.height])
    return brightest_point(stages.light, overhead) - window_centre(setting, stages.light)


def _on_plane(setting: PaperSetting, xy: Array) -> Array:
    """Return points of the plane, shape (..., 2), in the imaging camera's frame, shape (..., 3)."""
    theta = np.radians(setting.theta_deg)
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x, y * np.cos(theta), y * np.sin(theta) + setting.height], axis=-1)


def _truth_maps(setting: PaperSetting) -> tuple[Array, Array]:
    """Compute the texture's window in the camera frame on a thinned grid of pixels, and its normals."""
    step = max(1, setting.size // MAP_SIDE)
    pixels = setting.camera.pixel_centres()[::step, ::step]
    plane = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1) @ plane_from_image(setting).T
    xy = plane[..., :2] / np.where(plane[..., 2:] > 0, plane[..., 2:], np.nan)
    inside = np.all(np.abs(xy) < setting.size / 2, axis=-1, keepdims=True)
    return np.where(inside, _on_plane(setting, xy), np.nan), np.where(inside, setting.normal, np.nan)


def _in_frame(setting: PaperSetting, picture: Array, box: Box) -> Array:
    """Return the whole picture, black except in a box, which holds the given part."""
    x, y, width, height = box
    frame = np.zeros((setting.size, setting.size))
    frame[y : y + height, x : x + width] = picture
    return frame
