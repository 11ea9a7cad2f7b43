"""Keeps one realisation of the published protocol for the gallery and the pictures of the pipeline."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure
from simtest.geometry.isocurves import brightest_point
from simtest.runtime.seeds import from_integer
from simtest.spec import camera_table
from simtest.spec.paper import PaperSetting
from simtest.validation.gallery_items import MAP_SIDE, drawn, write_item
from simtest.validation.paper.pipeline import Stages
from simtest.validation.paper.protocol import Box, plane_from_image, texture, window_centre
from simtest.validation.paper.rows import SURFACE, pipeline_with

Array = npt.NDArray[np.float64]

LENGTH_UNIT = "texture units"

TEXTURE_STEP = 2
"""The texture is smooth: every other sample is enough to look at."""


def save_realisation(
    path: Path, setting: PaperSetting, estimators: tuple[str, ...], seed: int, names: dict[str, str]
) -> None:
    """Write the gallery item of one realisation, with the pictures `texture`, `clean` and `smoothed`.

    The picture with noise is the item's frame: noise is drawn in and around the region of interest alone, as nothing
    else of the frame is used.

    Parameters
    ----------
    path : Path
        The .npz file.
    setting : PaperSetting
        The setting.
    estimators : tuple of str
        Names.
    seed : int
        The realisation's, as in its row.
    names : dict
        `label` and `setting` of its case.
    """
    pipeline = pipeline_with(setting, estimators)
    stages = pipeline.stages(from_integer(seed))
    patch = pipeline.cut(stages)
    camera = setting.camera
    spot = _on_plane(setting, _bp(setting, stages))
    # Behind the imaging camera the BP is nowhere in the picture.
    bp_px = camera.project(spot).tolist() if spot[2] > 0 else None
    peak = None if isinstance(patch, Failure) else patch.peak_px.tolist()
    entries = [
        {
            "specularity": 0,
            "true_id": 0,
            "estimator": name,
            "bp_px": peak,
            **drawn(result, patch, camera, setting.normal),
        }
        for name, (result,) in pipeline.reconstruct([patch]).items()
    ]
    true = {
        "id": 0, "bp_px": bp_px, "normal": setting.normal.tolist(), "position": spot.tolist(),
        "kd_min": 0.0, "kd_max": 0.0, "isolated": True,
    }  # fmt: skip
    meta: dict[str, Any] = {
        **names, "surface": SURFACE, "sigma": setting.sigma, "command": again(setting, estimators, seed),
        "camera": camera_table(camera),
        "truth": [true], "estimates": entries, "length_unit": LENGTH_UNIT,
        "paper": setting.model_dump(), "light": stages.light.tolist(), "seed": seed, "outer": list(pipeline.outer),
        "peak_value": None if isinstance(patch, Failure) else patch.peak_value,
    }  # fmt: skip
    position, normal = _truth_maps(setting)
    write_item(
        path, meta, _in_frame(setting, stages.noisy, pipeline.outer), position, normal,
        texture=texture(setting, stages.light)[::TEXTURE_STEP, ::TEXTURE_STEP],
        clean=stages.clean, smoothed=stages.smoothed,
    )  # fmt: skip


def again(setting: PaperSetting, estimators: tuple[str, ...], seed: int) -> str:
    """Give the command that makes a realisation again alone: it prints the estimates."""
    values = ", ".join(f"{key}={value!r}" for key, value in setting.model_dump(exclude_defaults=True).items())
    return (
        'python -c "from simtest.runtime.seeds import from_integer; from simtest.spec.paper import PaperSetting; '
        "from simtest.validation.paper.rows import pipeline_with; "
        f'print(pipeline_with(PaperSetting({values}), {estimators!r}).realise([from_integer({seed})]))"'
    )


def _bp(setting: PaperSetting, stages: Stages) -> Array:
    """Give the BP in coordinates about the window's centre, shape (2,)."""
    overhead = np.array([0.0, 0.0, setting.height])
    return brightest_point(stages.light, overhead) - window_centre(setting, stages.light)


def _on_plane(setting: PaperSetting, xy: Array) -> Array:
    """Give points of the plane, shape (..., 2), in the imaging camera's frame, shape (..., 3)."""
    theta = np.radians(setting.theta_deg)
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x, y * np.cos(theta), y * np.sin(theta) + setting.height], axis=-1)


def _truth_maps(setting: PaperSetting) -> tuple[Array, Array]:
    """Give the texture's window in the camera frame on a thinned grid of pixels, and its normals."""
    step = max(1, setting.size // MAP_SIDE)
    pixels = setting.camera.pixel_centres()[::step, ::step]
    plane = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], axis=-1) @ plane_from_image(setting).T
    xy = plane[..., :2] / np.where(plane[..., 2:] > 0, plane[..., 2:], np.nan)
    inside = np.all(np.abs(xy) < setting.size / 2, axis=-1, keepdims=True)
    return np.where(inside, _on_plane(setting, xy), np.nan), np.where(inside, setting.normal, np.nan)


def _in_frame(setting: PaperSetting, picture: Array, box: Box) -> Array:
    """Put a part of the picture at its place in the whole one, which is black elsewhere."""
    x, y, width, height = box
    frame = np.zeros((setting.size, setting.size))
    frame[y : y + height, x : x + width] = picture
    return frame
