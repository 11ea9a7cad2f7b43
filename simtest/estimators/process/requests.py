"""What a core is told of a highlight or a frame: the header and the arrays of a request."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.calibration import NO_PRIORS, Frame, Priors
from simtest.calibration.priors import Distribution, LogUniform, Normal
from simtest.conventions import PIXEL_CENTRE
from simtest.errors import Failure
from simtest.estimators.process.core import Hello, outline_names
from simtest.geometry import Array, Camera, Patch

Named = dict[str, npt.NDArray[Any]]
Offer = Mapping[str, Callable[[], npt.NDArray[Any] | str]]
"""How each array on offer is made; the making returns a text where there is none, which says why."""

MOST_KEPT_RAYS = 1_000_000
"""Pixels of the largest camera whose sightlines are kept: they take 24 bytes each."""


@lru_cache(maxsize=8)
def camera_message(camera: Camera) -> dict[str, Any]:
    """Return a camera as a request holds it: size and K in px, pixel centres at integer + 0.5."""
    lens = camera.distortion
    return {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion": None if lens is None else {"model": lens.type, **asdict(lens)},
        "view_mask": None if camera.view_mask is None else asdict(camera.view_mask),
    }


@lru_cache(maxsize=8)
def priors_message(priors: Priors) -> dict[str, Any]:
    """Return what is known beforehand as a request holds it (see `simtest.calibration.Priors`), lengths in mm."""
    named = {name: getattr(priors, name) for name in ("lobe_curvature", "light_offset_mm", "falloff_power")}
    # Where no distance is told its default holds.
    named |= {"distance_mm": priors.distance, "relief_slope": priors.relief_slope}
    return {
        "lights_mm": [list(light) for light in priors.lights_mm],
        **{
            name: None if prior is None else _distribution(prior) | {"told": _is_told(priors, name)}
            for name, prior in named.items()
        },
        "camera": priors.camera.deviations,
        "plane": priors.plane,
        # A core that was written before this key existed gets the messages that it knows.
        **({"lights_covariance_mm2": priors.lights_covariance_mm2} if priors.lights_covariance_mm2 else {}),
    }


def _is_told(priors: Priors, name: str) -> bool:
    return bool(getattr(priors, name) != getattr(NO_PRIORS, name))


def _distribution(prior: Distribution) -> dict[str, Any]:
    if isinstance(prior, Normal):
        name = "normal" if prior.sd > 0 else "exact"
        parameters = {"mean": prior.mean, "sd": prior.sd} if prior.sd > 0 else {"value": prior.mean}
    else:
        name = "log_uniform" if isinstance(prior, LogUniform) else "uniform"
        parameters = {"low": prior.low, "high": prior.high}
    return {"distribution": name, "parameters": parameters, "mean": prior.mean, "sd": prior.sd}


def patch_request(patch: Patch, camera: Camera, priors: Priors, hello: Hello) -> tuple[dict[str, Any], Named]:
    """Return the header and the arrays of a request about one highlight."""
    height, width = patch.values.shape
    offer: dict[str, Callable[[], npt.NDArray[Any] | str]] = {
        "values": lambda: patch.values,
        "raw": lambda: _known(patch.raw),
        "noise": lambda: _known(patch.noise, patch.values.shape),
        "saturated": lambda: _known(patch.saturated),
        "seen": lambda: _seen(patch.seen, (height, width)),
        "rays": lambda: _rays(camera, patch.origin_px, (height, width)),
    }
    for level in hello.isophotes:
        points, sightlines = outline_names(level)
        offer[points] = lambda level=level: _outline(patch, level)  # type: ignore[misc]
        offer[sightlines] = lambda level=level: _outline(patch, level, camera)  # type: ignore[misc]
    arrays, missing = _taken(hello.arrays, offer)
    about = {
        "origin_px": list(patch.origin_px),
        "size_px": [width, height],
        "peak_px": patch.peak_px.tolist(),
        "peak_value": float(patch.peak_value),
        "peak_pixel": list(patch.peak_pixel),
        "smoothing_px": float(patch.smoothing_px),
        "noise": None if isinstance(patch.noise, np.ndarray) or patch.noise is None else float(patch.noise),
        "others_px": None if patch.others_px is None else [list(other) for other in patch.others_px],
        "others_value": [float(value) for value in patch.others_value],
    }
    return _header("patch", camera, priors, about, missing), arrays


def frame_request(frame: Frame, camera: Camera, priors: Priors, hello: Hello) -> tuple[dict[str, Any], Named]:
    """Return the header and the arrays of a request about a whole frame."""
    shape = (camera.height, camera.width)
    noise = frame.noise
    offer: Offer = {
        "encoded": lambda: frame.encoded,
        "channels": lambda: frame.channels,
        "intensity": lambda: frame.corrected.intensity,
        "smoothed": lambda: frame.smoothed,
        "noise": lambda: _known(noise, shape),
        "clipped": lambda: frame.clipped,
        "seen": lambda: _seen(frame.seen, shape),
        "rays": lambda: _rays(camera, (0, 0), shape),
    }
    arrays, missing = _taken(hello.arrays, offer)
    about = {
        "smoothing_px": float(frame.smoothing_px),
        "noise": None if isinstance(noise, np.ndarray) else float(noise),
        "channels": 1 if frame.encoded.ndim == 2 else frame.encoded.shape[2],
        "saturation_level": frame.calibration.saturation_level,
    }
    return _header("frame", camera, priors, about, missing), arrays


def _header(
    kind: str, camera: Camera, priors: Priors, about: dict[str, Any], missing: dict[str, str]
) -> dict[str, Any]:
    shared = {"camera": camera_message(camera), "priors": priors_message(priors)}
    return {"type": kind, **shared, kind: about, "missing": missing}


def _taken(wanted: tuple[str, ...], offer: Offer) -> tuple[Named, dict[str, str]]:
    """Return the wanted arrays, and why others are missing."""
    arrays: Named = {}
    missing: dict[str, str] = {}
    for name in wanted:
        made = offer[name]()
        if isinstance(made, str):
            missing[name] = made
        else:
            arrays[name] = made
    return arrays, missing


def _known(value: object, shape: tuple[int, ...] = ()) -> npt.NDArray[Any] | str:
    """Return an array, or a number as an array of this shape."""
    if value is None:
        return "not known"
    return value if isinstance(value, np.ndarray) else np.full(shape, value, dtype=np.float32)


def _seen(seen: npt.NDArray[np.bool_] | None, shape: tuple[int, int]) -> npt.NDArray[Any]:
    return np.ones(shape, dtype=bool) if seen is None else seen


@lru_cache(maxsize=2)
def _whole_rays(camera: Camera) -> Array:
    return camera.unproject(camera.pixel_centres())


def _rays(camera: Camera, origin: tuple[int, int], shape: tuple[int, int]) -> Array:
    """Return the unit sightlines of a region's pixels, shape (h, w, 3); those of a small camera are computed once."""
    (x, y), (height, width) = origin, shape
    inside = min(x, y) >= 0 and x + width <= camera.width and y + height <= camera.height
    if inside and camera.width * camera.height <= MOST_KEPT_RAYS:
        return _whole_rays(camera)[y : y + height, x : x + width]
    across, down = np.arange(width) + x + PIXEL_CENTRE, np.arange(height) + y + PIXEL_CENTRE
    return camera.unproject(np.stack(np.meshgrid(across, down), axis=-1))


def _outline(patch: Patch, level: float, camera: Camera | None = None) -> npt.NDArray[Any] | str:
    """Return an isophote as a closed polygon, px, or its sightlines; or why it does not close."""
    points = patch.isophote(level)
    if isinstance(points, Failure):
        return str(points)
    return points if camera is None else camera.unproject(points)
