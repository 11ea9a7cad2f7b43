"""From radiance to a frame: lens, exposure, noise, saturation, response, quantisation."""

from simtest.sensor.capture import capture, encode
from simtest.sensor.exposure import expose, to_uint8
from simtest.sensor.optics import collect

__all__ = ["capture", "collect", "encode", "expose", "to_uint8"]
