"""What reconstruction may know of a sample's picture: the calibration that the recipe tells, never the truth."""

import numpy as np

from simtest.calibration import Calibration
from simtest.dataset.metadata import SampleMeta
from simtest.runtime.arrays import Image, Picture
from simtest.simulation.sensor import to_uint8
from simtest.spec import Scene
from simtest.spec.sensor import Sensor, SrgbResponse


def calibration_of(meta: SampleMeta) -> Calibration:
    """Return the calibration of the field ``image`` of a sample, from its metadata.

    It states camera, response and noise, and of lights, distance and lobe what the scene's ``known`` tells.
    `simtest.reconstruct` takes it with the picture, and with the detector "peaks" gives the estimates of the metadata.
    """
    return calibration_of_picture(Scene.model_validate(meta["scene"]), meta["brightest_mm"])


def calibration_of_picture(scene: Scene, brightest_mm: float | None) -> Calibration:
    """Return what is known of a sample's picture; `brightest_mm` is the distance of its brightest highlight."""
    return scene.model_copy(update={"sensor": picture_sensor(scene.sensor)}).calibration(brightest_mm)


def picture_sensor(sensor: Sensor) -> Sensor:
    """Return the sensor that a sample's picture is of: 8 bits, of sRGB where the scene's sensor encodes nothing."""
    encoded = {} if sensor.encodes else {"response": SrgbResponse(), "response_known": True}
    return sensor.model_copy(update={"bits": 8, **encoded})


def stored_picture(frame: Image, sensor: Sensor) -> Picture:
    """Return a sensor's frame as a sample stores it, shape (H, W, 3)."""
    values = np.rint(np.clip(frame, 0, 1) * 255).astype(np.uint8) if sensor.encodes else to_uint8(frame)
    return values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)
