"""One labelled frame: picture, radiance, ground truth and highlights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest import provenance
from simtest.errors import InputError
from simtest.files import make_folder, write_atomically, write_json
from simtest.geometry import Camera
from simtest.rendering import Progress, Radiance, Session, TruthMaps
from simtest.rendering.bitmap import write_exr
from simtest.seeds import from_integer
from simtest.sensor import expose, to_uint8
from simtest.spec import Scene
from simtest.validation.realise import view
from simtest.validation.truth import JudgedHighlight


@dataclass(frozen=True)
class LabelledFrame:
    """A rendered frame with everything that is known about it.

    Parameters
    ----------
    scene : Scene
        What was rendered.
    camera : Camera
        Calibration.
    image : ndarray of float32, shape (H, W) or (H, W, 3)
        The sensor's frame, full scale 1.
    radiance : Radiance
        Linear, split by its way.
    truth : TruthMaps
        At each pixel's centre, camera frame.
    highlights : list of JudgedHighlight
        All true highlights; `isolated` tells which count.
    full_scale : float
        Radiance that became 1.
    variant : str
        Mitsuba variant.
    """

    scene: Scene
    camera: Camera
    image: npt.NDArray[np.float32]
    radiance: Radiance
    truth: TruthMaps
    highlights: list[JudgedHighlight]
    full_scale: float
    variant: str


def make_frame(scene: Scene, variant: str | None = None, progress: Progress | None = None) -> LabelledFrame:
    """Render a labelled frame.

    Parameters
    ----------
    scene : Scene
        The scene; its noise hangs on ``sensor.seed``.
    variant : str, optional
        Mitsuba variant.
    progress : callable, optional
        Told after each part of the rendering: samples done, samples in all, and what is done.

    Returns
    -------
    LabelledFrame

    Raises
    ------
    InputError
        If no pixel sees the surface.
    BackendError
        If the rendering backend cannot be used.
    """
    session = Session(scene, variant, labelled=True)
    # The truth starts from the hits that the labels are made of.
    seen = view(session, scene, session.frame(progress).radiance)
    truth = session.truth()
    if not truth.mask.any():
        raise InputError(f"scene {scene.name}: no pixel sees the surface; move it, or widen the field of view")
    image = expose(seen.radiance.total, seen.full_scale, scene.sensor.noise_sigma, from_integer(scene.sensor.seed))
    return LabelledFrame(
        scene, session.camera, image, seen.radiance, truth, seen.truths, seen.full_scale, session.variant
    )


def write_frame(frame: LabelledFrame, out: Path) -> list[Path]:
    """Write frame.png, radiance.exr, truth.npz, frame.json and camera.toml.

    Parameters
    ----------
    frame : LabelledFrame
        What to write.
    out : Path
        Folder, made if need be.

    Returns
    -------
    list of Path
        The files.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    files = [out / name for name in ("frame.png", "radiance.exr", "truth.npz", "frame.json", "camera.toml")]
    make_folder(out)
    try:
        write_atomically(files[0], lambda part: part.write_bytes(_png(frame.image)))
        write_atomically(files[1], lambda part: write_exr(part, frame.radiance.total, frame.variant))
        write_atomically(files[2], lambda part: np.savez_compressed(part, **_truth(frame)))
        write_json(files[3], _description(frame))
        write_atomically(files[4], lambda part: part.write_text(_camera_file(frame.camera), encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    return files


def _camera_file(camera: Camera) -> str:
    """Give the calibration as `simtest reconstruct --camera` reads it."""
    names = ("width", "height", "fx", "fy", "cx", "cy", "skew")
    return "# Pinhole camera; pixel centres at integer + 0.5.\n" + "".join(
        f"{name} = {getattr(camera, name)!r}\n" for name in names
    )


def _png(image: npt.NDArray[np.float32]) -> bytes:
    picture = to_uint8(image)
    ok, encoded = cv2.imencode(".png", picture if picture.ndim == 2 else picture[:, :, ::-1])
    assert ok
    return bytes(encoded)


def _truth(frame: LabelledFrame) -> dict[str, Any]:
    truth, radiance = frame.truth, frame.radiance
    return {
        "depth_mm": truth.depth.astype(np.float32),
        "position_mm": truth.position.astype(np.float32),
        "normal": truth.normal.astype(np.float32),
        "shading_normal": truth.shading_normal.astype(np.float32),
        "geometric_normal": truth.geometric_normal.astype(np.float32),
        "curvature": np.stack([truth.k_min, truth.k_max], axis=-1).astype(np.float32),
        "direction_min": truth.direction_min.astype(np.float32),
        "direction_max": truth.direction_max.astype(np.float32),
        "radiance_specular": radiance.specular,
        "radiance_diffuse": radiance.diffuse,
        "radiance_indirect": radiance.indirect,
        "mask": truth.mask,
    }


FIELDS = {
    "frame.png": "sRGB-encoded picture of the sensor's frame, clipped to full scale",
    "radiance.exr": "linear radiance, power per steradian over mm^2",
    "depth_mm": "distance along the ray from the camera centre, mm; NaN off the surface, as in all fields below",
    "position_mm": "surface point, camera frame (x right, y down, z forward), mm",
    "normal": "unit normal of the smooth surface, facing the camera (N . P < 0), camera frame",
    "shading_normal": "unit normal that shading used, camera frame",
    "geometric_normal": "unit normal of the rendered triangle or shape, camera frame",
    "curvature": "principal curvatures k_min, k_max, 1/mm, convex towards the camera positive",
    "direction_min, direction_max": "unit principal directions, camera frame",
    "radiance_specular, radiance_diffuse, radiance_indirect": "parts of the radiance: direct off lobe, base; bounced",
    "mask": "where there is a surface",
}


def _description(frame: LabelledFrame) -> dict[str, Any]:
    camera = frame.camera
    return {
        "scene": frame.scene.model_dump(mode="json"),
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "pixel_centres": "integer + 0.5",
        },
        "full_scale": frame.full_scale,
        "highlights": [_highlight(judged) for judged in frame.highlights],
        "fields": FIELDS,
        "provenance": {**provenance.environment(), "variant": frame.variant},
    }


def _highlight(judged: JudgedHighlight) -> dict[str, Any]:
    highlight = judged.highlight
    return {
        "light": highlight.light,
        "bp_px": highlight.bp_px.tolist(),
        "position_mm": highlight.position.tolist(),
        "normal": highlight.normal.tolist(),
        "distance_mm": highlight.distance,
        "kd_min": highlight.kd_min,
        "kd_max": highlight.kd_max,
        "radiance": highlight.radiance,
        "isolated": judged.isolated,
        "why_not": judged.why_not or None,
    }
