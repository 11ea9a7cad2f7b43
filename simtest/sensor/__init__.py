"""From radiance to a frame: exposure and noise."""

from simtest.sensor.exposure import expose, from_srgb, to_uint8

__all__ = ["expose", "from_srgb", "to_uint8"]
