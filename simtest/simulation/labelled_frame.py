"""One labelled frame: picture, radiance, ground truth and highlights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering import Progress, Radiance, Session, TruthMaps
from simtest.rendering.bitmap import write_exr
from simtest.runtime import provenance
from simtest.runtime.files import make_folder, write_atomically, write_json
from simtest.simulation.camera_chain import to_uint8
from simtest.simulation.rendered_view import view
from simtest.simulation.true_highlights import JudgedHighlight
from simtest.spec import Scene, camera_toml, describe_camera
from simtest.spec.sensor import Sensor
from simtest.spec.toml_files import toml_tables


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
        The sensor's frame, full scale 1, as encoded by the sensor's response.
    radiance : Radiance
        Linear, split by its way.
    truth : TruthMaps
        At each pixel's centre, camera frame.
    highlights : list of JudgedHighlight
        All true highlights; `isolated` tells which count.
    full_scale : float
        Radiance behind the lens that became 1.
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
    radiance = session.frame(progress).radiance
    truth = session.truth()
    if not truth.mask.any():
        raise InputError(f"scene {scene.name}: no pixel sees the surface; move it, or widen the field of view")
    seen = view(session, scene, radiance)
    image = seen.frame(scene.sensor.seed)
    return LabelledFrame(
        scene, session.camera, image, seen.radiance, truth, seen.truths, seen.full_scale, session.variant
    )


def write_frame(frame: LabelledFrame, out: Path) -> list[Path]:
    """Write frame.png, radiance.exr, truth.npz, frame.json, camera.toml; calibration.toml where there is more to know.

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
        write_atomically(files[0], lambda part: part.write_bytes(encoded_png(frame.image, frame.scene.sensor)))
        write_atomically(files[1], lambda part: write_exr(part, frame.radiance.total, frame.variant))
        write_atomically(files[2], lambda part: np.savez_compressed(part, **_truth(frame)))
        write_json(files[3], _description(frame))
        write_atomically(files[4], lambda part: part.write_text(camera_toml(frame.camera), encoding="utf-8"))
        if _is_calibrated(frame.scene):
            files.append(out / "calibration.toml")
            write_atomically(files[5], lambda part: part.write_text(_calibration_file(frame.scene), encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--out {out}: cannot be written ({error.strerror})") from error
    return files


def _is_calibrated(scene: Scene) -> bool:
    """Tell whether there is more to know of a frame than its camera."""
    sensor, emission = scene.sensor, scene.rig.known_emission()
    vignetted = not sensor.vignetting.model().is_uniform
    return sensor.clips or sensor.full_well is not None or vignetted or emission is not None


def _png_bits(sensor: Sensor) -> int:
    """Give the bits of frame.png: what is not quantised loses least with 16."""
    return 16 if sensor.encodes and (sensor.bits or 16) > 8 else 8


def _calibration_file(scene: Scene) -> str:
    """Give what reconstruction may know of frame.png, as `simtest reconstruct --camera` reads it."""
    sensor = scene.sensor
    stated: dict[str, dict[str, Any]] = {"camera": scene.camera.model_dump(exclude_none=True)}
    if not sensor.encodes:
        stated["response"] = {"type": "srgb"}
    else:
        stated["response"] = sensor.response.model_dump() if sensor.response_known else {"type": "linear"}
    if sensor.vignetting_known and not sensor.vignetting.model().is_uniform:
        stated["vignetting"] = sensor.vignetting.model_dump()
    if (profile := scene.rig.known_emission()) is not None:
        stated["emission"] = profile.model_dump()
    electrons = {"full_well": sensor.full_well, "read_noise": sensor.read_noise} if sensor.full_well else {}
    bits = (sensor.bits or _png_bits(sensor)) if sensor.encodes else 8
    stated["sensor"] = {**electrons, "bits": bits, "saturation_level": 1.0}
    return "# What is known of frame.png; pixel centres at integer + 0.5.\n" + toml_tables(stated)


def encoded_png(image: npt.NDArray[np.float32], sensor: Sensor) -> bytes:
    """Give the picture of a sensor's frame: what the sensor itself encoded, or else the sRGB-encoded frame."""
    picture: npt.NDArray[Any]
    if sensor.encodes:
        kind = np.uint8 if _png_bits(sensor) == 8 else np.uint16
        picture = np.rint(np.asarray(image, dtype=float) * np.iinfo(kind).max).astype(kind)
    else:
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
    sensor = frame.scene.sensor
    fields = dict(FIELDS)
    encoding: dict[str, Any] = {}
    if sensor.encodes:
        fields["frame.png"] = "the sensor's own values, as encoding says; the largest is full scale"
        encoding["encoding"] = {
            "response": sensor.response.model_dump(mode="json"),
            "bits": sensor.bits,
            "png_bits": _png_bits(sensor),
        }
    return {
        "scene": frame.scene.model_dump(mode="json"),
        "camera": describe_camera(frame.camera),
        "full_scale": frame.full_scale,
        **encoding,
        **_places(frame.scene),
        "highlights": [
            {**describe_highlight(judged), "radiance": judged.highlight.radiance} for judged in frame.highlights
        ],
        "fields": fields,
        "provenance": {**provenance.environment(), "variant": frame.variant},
    }


def _places(scene: Scene) -> dict[str, Any]:
    """Give the lights' true places where the scene's keys do not show them: a preset's, and those that were drawn."""
    rig = scene.rig
    return {} if rig.preset is None and not rig.is_drawn else {"lights_mm": rig.true_mm().tolist()}


def describe_highlight(judged: JudgedHighlight) -> dict[str, Any]:
    """Describe a true highlight for JSON: place, normal, curvature, and whether it counts as isolated."""
    highlight = judged.highlight
    return {
        "light": highlight.light,
        "bp_px": highlight.bp_px.tolist(),
        "position_mm": highlight.position.tolist(),
        "normal": highlight.normal.tolist(),
        "distance_mm": highlight.distance,
        "kd_min": highlight.kd_min,
        "kd_max": highlight.kd_max,
        "isolated": judged.isolated,
        "why_not": judged.why_not or None,
    }
