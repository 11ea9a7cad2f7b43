"""Writes a labelled frame: picture, radiance, truth, and what reconstruction may know of it; sheets of pictures."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration, Response
from simtest.rendering.bitmap import write_exr
from simtest.runtime import provenance
from simtest.runtime.arrays import Image, Picture, write_arrays
from simtest.runtime.files import Json, make_folder, write_atomically, write_json, written_together
from simtest.simulation.frame import LabelledFrame, preview
from simtest.simulation.highlights import cloud_json
from simtest.simulation.sensor import to_uint8
from simtest.spec import Scene, calibration_toml, camera_toml, describe_camera
from simtest.spec.sensor import Sensor

FIELDS = {
    "frame.png": "sRGB-encoded picture of the sensor's frame, clipped to full scale",
    "calibration.toml": "what reconstruction is told of frame.png: simtest reconstruct frame.png --camera "
    "calibration.toml",
    "preview.jpg": "the frame for the eye, exposed for the surface, with highlights clipped; a surface without diffuse "
    "light is shown as matt tissue; no data",
    "radiance.exr": "linear radiance, power per steradian over mm^2",
    "depth_mm": "distance along the ray from the camera centre, mm; NaN off the surface, as in all fields below",
    "position_mm": "surface point, camera frame (x right, y down, z forward), mm",
    "normal": "unit normal of the fine surface, with the relief, camera frame; facing the camera (N . P < 0) where "
    "there is no relief",
    "normal_base": "unit normal of the base, without the relief, facing the camera, camera frame; equal to normal "
    "where there is no relief",
    "shading_normal": "unit normal that the shading off the lobe used, camera frame; on a relief the fine one",
    "geometric_normal": "unit normal of the rendered triangle or shape, camera frame",
    "curvature": "principal curvatures k_min, k_max of the fine surface, 1/mm, convex towards the camera positive",
    "curvature_base": "the same of the base; equal to curvature where there is no relief",
    "direction_min, direction_max": "unit principal directions of the fine surface, camera frame",
    "pool": "where the liquid film fills a valley of the relief",
    "radiance_specular, radiance_diffuse, radiance_indirect": "parts of the radiance: direct off lobe, base; bounced",
    "mask": "where there is a surface",
    "world_from_camera": "frame.json: the camera's pose, 4 x 4, mm; the world is the surface's own frame",
    "highlights": "frame.json: points where the fine normal bisects light and camera, camera frame, mm; radius_px by "
    "the surface's shape, the lobe and the lights' size, cloud an index in clouds, lit whether its light reaches it, "
    "hidden whether metal or `covering` covers it, peak_snr null without noise, why_not the first condition of an "
    "isolated one that fails",
    "clouds": "frame.json: the same points of the base, without the relief; on a smooth surface the highlights",
    "visible_highlights": "frame.json: spots of the noise-free frame; value and specular are radiance, glints indices "
    "in highlights, area_px the pixels above half of the lobe's peak, light and cloud those of its brightest glint, or "
    "else of the nearest lit one",
}

INSTRUMENT_FIELDS = {
    "instrument": "1 + the index in the scene's instruments of what is seen, 0 where none is; where one is, depth_mm, "
    "position_mm and all normals are its own, curvature and directions NaN, pool false",
    "visible_highlights.instrument": "frame.json: index of the instrument on which the spot lies; such a one is no "
    "highlight of the surface",
}
"""Further fields of a scene with instruments."""

POLYP_FIELDS = {
    "polyp": "1 + the index in polyps of the polyp that is seen, 0 where none is: it is where it raises the wall by "
    "more than a tenth of its height",
    "polyps": "frame.json: those of the surface, as in a colon's recipe",
}
"""Further fields of a surface with polyps."""

SHEET_WIDTH, SHEET_COLUMNS = 1600, 10
"""Of a sheet of pictures: its width, px, and how many stand side by side."""

FILES = ("frame.png", "radiance.exr", "truth.npz", "frame.json", "camera.toml", "calibration.toml", "preview.jpg")
"""What a labelled frame is written as."""

MOTION_FIELD = (
    "scene.camera.motion: frame.png, radiance.exr and the radiance's parts are the mean over the exposure; labels, "
    "highlights, lights and poses are those of its middle"
)


def write_frame(frame: LabelledFrame, out: Path) -> list[Path]:
    """Write the files of `FILES`.

    The folder is made if need be; `InputError` is raised if it cannot be written,
    `SimtestError` if its disk is full. Returns the files.
    """
    calibration = calibration_toml(picture_calibration(frame.calibration, frame.scene.sensor), _note(frame.scene))
    make_folder(out)
    with written_together(out, FILES) as new:
        files = [new / name for name in FILES]
        write_atomically(files[0], lambda part: part.write_bytes(encoded_png(frame.image, frame.scene.sensor)))
        write_atomically(files[1], lambda part: write_exr(part, frame.radiance.total, frame.variant))
        write_atomically(files[2], lambda part: write_arrays(part, _truth(frame)))
        write_json(files[3], _description(frame))
        write_atomically(files[4], lambda part: part.write_text(camera_toml(frame.camera), encoding="utf-8"))
        write_atomically(files[5], lambda part: part.write_text(calibration, encoding="utf-8"))
        shown = _coded(preview(frame), ".jpg", (cv2.IMWRITE_JPEG_QUALITY, 90))
        write_atomically(files[6], lambda part: part.write_bytes(shown))
    return [out / name for name in FILES]


def _coded(picture: npt.NDArray[np.unsignedinteger], suffix: str = ".png", quality: Sequence[int] = ()) -> bytes:
    """Encode a picture, grey or red first."""
    # OpenCV wants blue first.
    ok, encoded = cv2.imencode(suffix, picture if picture.ndim == 2 else picture[:, :, ::-1], quality)
    assert ok
    return bytes(encoded)


def _png_bits(sensor: Sensor) -> int:
    """Return the bits of frame.png: 16 lose least of what is not quantised."""
    return 16 if sensor.encodes and (sensor.bits or 16) > 8 else 8


def picture_calibration(given: Calibration, sensor: Sensor) -> Calibration:
    """Return what is known of frame.png, from what reconstruction is told of the sensor's frame.

    A frame that the sensor encodes is the picture: nothing is added but the 16 bits of one that it does not quantise.
    Any other is encoded on writing, as sRGB of 8 bits, and clipped.
    """
    if sensor.encodes:
        bits = sensor.bits or _png_bits(sensor)
        return replace(given, noise=replace(given.noise, bits=bits))
    response = Response("srgb")
    noise = replace(given.noise, bits=_png_bits(sensor), response=response)
    return replace(given, response=response, noise=noise, saturation_level=1.0)


def _note(scene: Scene) -> str:
    """Return the comment of calibration.toml: of which picture it is, and what the scene keeps back."""
    sensor, rig, known = scene.sensor, scene.rig, scene.known
    given = {
        "response (taken as linear)": sensor.response_known or not sensor.encodes,
        "vignetting": sensor.vignetting_known, "emission": rig.emission_known, "lights": known.lights,
        "lobe": known.lobe,
    }  # fmt: skip
    kept = ", ".join(name for name, is_given in given.items() if not is_given)
    return "Of frame.png" + (f"; the scene does not tell: {kept}." if kept else ".")


def encoded_png(image: Image, sensor: Sensor) -> bytes:
    """Encode a sensor's frame as PNG: the sensor's own values, or else the sRGB-encoded frame."""
    if not sensor.encodes:
        return _coded(to_uint8(image))
    kind = np.uint8 if _png_bits(sensor) == 8 else np.uint16
    return _coded(np.rint(np.asarray(image, dtype=float) * np.iinfo(kind).max).astype(kind))


def _truth(frame: LabelledFrame) -> dict[str, npt.NDArray[np.generic]]:
    """Return the arrays of truth.npz."""
    truth, radiance = frame.truth, frame.radiance
    vectors = ("normal", "normal_base", "shading_normal", "geometric_normal")
    maps = {
        "depth_mm": truth.depth,
        "position_mm": truth.position,
        **{name: getattr(truth, name) for name in vectors},
        "curvature": np.stack([truth.k_min, truth.k_max], axis=-1),
        "curvature_base": np.stack([truth.k_min_base, truth.k_max_base], axis=-1),
        **{name: getattr(truth, name) for name in ("direction_min", "direction_max")},
    }
    return {
        **{name: values.astype(np.float32) for name, values in maps.items()},
        **{f"radiance_{part}": getattr(radiance, part) for part in ("specular", "diffuse", "indirect")},
        "pool": truth.pool,
        "mask": truth.mask,
        **({"instrument": truth.instrument} if frame.scene.shown_instruments else {}),
        **({} if truth.polyp is None else {"polyp": truth.polyp}),
        **({} if frame.covering is None else {"covering": frame.covering}),
    }


def _description(frame: LabelledFrame) -> Json:
    """Return the content of frame.json."""
    scene, sensor, rig = frame.scene, frame.scene.sensor, frame.scene.rig
    described: dict[str, Json] = {
        "scene": scene.model_dump(mode="json"),
        "camera": cast(Json, describe_camera(frame.camera)),
        "full_scale": frame.full_scale,
        "world_from_camera": frame.world_from_camera.tolist(),
    }
    fields: dict[str, Json] = {**FIELDS, **(INSTRUMENT_FIELDS if scene.shown_instruments else {})}
    if frame.polyps:
        fields |= POLYP_FIELDS
        described["polyps"] = [polyp.model_dump() for polyp in frame.polyps]
    if frame.covering is not None:
        fields["covering"] = "what covers tissue: 1 stool, 2 bile, 3 what is drawn; highlights below 1 and 3 are hidden"
    if sensor.encodes:
        fields["frame.png"] = "the sensor's own values, as encoding says; the largest is full scale"
        response = sensor.response.model_dump(mode="json")
        described["encoding"] = {"response": response, "bits": sensor.bits, "png_bits": _png_bits(sensor)}
    if scene.camera.moving is not None:
        fields["motion"] = MOTION_FIELD
    # The lights' true positions where the scene's keys do not show them: a preset's, and those that were drawn.
    if rig.preset is not None or rig.is_drawn:
        described["lights_mm"] = rig.true_mm().tolist()
    described["highlights"] = [{**point.to_json(), "radiance": point.radiance} for point in frame.highlights]
    described["clouds"] = [cloud_json(centre) for centre in frame.clouds]
    described["visible_highlights"] = [spot.to_json() for spot in frame.visible_highlights]
    origin = cast("dict[str, Json]", provenance.environment())
    return {**described, "fields": fields, "provenance": {**origin, "variant": frame.variant}}


def thumbnail(picture: Picture) -> Picture:
    """Return a picture, shape (H, W, 3), at the size it has on a sheet."""
    width = SHEET_WIDTH // SHEET_COLUMNS
    size = (width, max(round(width * picture.shape[0] / picture.shape[1]), 1))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def write_sheet(path: Path, pictures: list[Picture]) -> None:
    """Write pictures of one size, blue first, in rows, in order, as one picture."""
    columns = min(SHEET_COLUMNS, len(pictures))
    filled = [*pictures, *[np.zeros_like(pictures[0])] * (-len(pictures) % columns)]
    rows = [np.hstack(filled[first : first + columns]) for first in range(0, len(filled), columns)]
    data = _coded(np.vstack(rows)[:, :, ::-1])
    write_atomically(path, lambda part: part.write_bytes(data))
