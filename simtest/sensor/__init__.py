"""From radiance to a frame: exposure and noise."""

from simtest.sensor.exposure import expose, to_uint8

__all__ = ["expose", "to_uint8"]
