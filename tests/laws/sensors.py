"""Laws of the sensor: noise, curve, vignetting, point spread and smoothing against their definitions.

Nothing is rendered: pictures are made by hand, and expected values are formulas written down anew.
"""

import math
from typing import Any

import numpy as np

from simtest.calibration import Calibration, NoiseModel, Response, estimate_noise
from simtest.calibration.photometry import AngularProfile
from simtest.geometry import Camera, smooth
from simtest.geometry.patch import share_of_noise
from simtest.runtime.arrays import Array, Image
from simtest.simulation.sensor import capture, collect, to_uint8
from simtest.spec.sensor import Sensor
from tests.laws import by_hand
from tests.laws.law import Law, law

SIDE_PX = 192
LEVELS = (0.15, 0.4, 0.8)
FULL_WELL, READ_NOISE = 2000.0, 24.0
GAMMA = 2.2

PLAIN: dict[str, Any] = {}
PROCESSED: dict[str, Any] = {"overlay": {}}
"""A sensor without, and with, a stage behind its response: each has a way of its own through the camera chain."""

SRGB = ((0.001, 0.01292), (0.05, 0.247801), (0.18, 0.461356), (0.5, 0.735357), (0.9, 0.954687))
"""Linear light and value of sRGB (IEC 61966-2-1), worked out apart from this package, to six digits."""


def photon_noise() -> list[Law]:
    """Compare variances of pixels with the Poisson law: the variance of electrons is their mean."""
    rng = np.random.default_rng(20)
    count = len(LEVELS) * SIDE_PX**2
    made = []
    for name, more in (("variance_over_mean", PLAIN), ("variance_over_mean_processed", PROCESSED)):
        sensor = Sensor.model_validate({"full_well": FULL_WELL, **more})
        shares = [np.mean((_captured(level, sensor, rng) - level) ** 2) * FULL_WELL / level for level in LEVELS]
        bounds = _about(1.0, 5 * math.sqrt(2 / count))
        about = f"{FULL_WELL:g} electrons at full scale; 5 standard errors of {count} numbers"
        made.append(law("shot_noise", name, "x", float(np.mean(shares)), *bounds, count, about))
    dark = _captured(0.0, Sensor(full_well=FULL_WELL, read_noise=READ_NOISE), rng)
    bounds = _about(1.0, 5 / math.sqrt(2 * dark.size))
    left = float(np.std(dark)) * FULL_WELL / READ_NOISE
    about = f"{READ_NOISE:g} electrons without light; 5 standard errors"
    return [*made, law("read_noise", "sigma", "x", left, *bounds, dark.size, about)]


def stated_noise() -> list[Law]:
    """Compare the noise that reconstruction is told, and the one it estimates, with variances added by hand."""
    levels = np.array([0.0, 0.02, 0.2, 0.6, 0.95])
    told = NoiseModel(0.01, FULL_WELL, READ_NOISE, 8, Response("gamma", GAMMA)).at(levels, 3)
    value = levels ** (1 / GAMMA)
    step = np.clip(value + 0.5 / 255, 0, 1) ** GAMMA - np.clip(value - 0.5 / 255, 0, 1) ** GAMMA
    variance = 0.01**2 + levels / FULL_WELL + (READ_NOISE / FULL_WELL) ** 2 + step**2 / 12
    off = float(np.abs(told / np.sqrt(variance / 3) - 1).max())
    # Second differences of a parabola are constant: noise alone is left.
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX] / SIDE_PX
    noisy = 0.3 + 0.5 * x**2 - 0.2 * x * y + 0.02 * np.random.default_rng(21).standard_normal(x.shape)
    found = estimate_noise(noisy) / 0.02
    return [
        law("noise_model", "sigma_off", "", off, 1e-9, n=len(levels), about="variances of all parts, added by hand"),
        law("noise_estimate", "sigma", "x", found, *_about(1.0, 0.03), noisy.size,
               "white noise of 0.02 on a parabola; the median's own error is 0.006"),
    ]  # fmt: skip


def curves() -> list[Law]:
    """Compare values and light of the response curves with powers taken by hand, and with sRGB's table."""
    light = np.linspace(0, 1, 23)
    picture = light.astype(np.float32)[None]
    own, srgb = Response("gamma", GAMMA), Response("srgb")
    values = light ** (1 / GAMMA)
    off = max(
        np.abs(own.encode(light) - values).max(), np.abs(own.encode_picture(picture)[0] - values).max(),
        np.abs(own.decode(values) - light).max(),
        np.abs(own.decode_picture(values.astype(np.float32)[None])[0] - light).max(),
    )  # fmt: skip
    linear, encoded = np.array(SRGB).T
    off_srgb = max(
        np.abs(srgb.encode(linear) - encoded).max(), np.abs(srgb.decode(encoded) - linear).max(),
        np.abs(srgb.encode_picture(linear.astype(np.float32)[None])[0] - encoded).max(),
        np.abs(to_uint8(linear) / 255 - encoded).max() - 0.5 / 255,
    )  # fmt: skip
    # The sensor's own way, with and without a stage behind the curve.
    sensors = [Sensor.model_validate({"response": {"type": "gamma", "gamma": GAMMA}, **m}) for m in (PLAIN, PROCESSED)]
    whole = max(float(np.abs(capture(picture, 1.0, s, None)[0] - values).max()) for s in sensors)
    about = "light^(1/2.2) and back; tables of 16 bits leave 5e-5"
    return [
        law("response", "gamma_off", "", float(off), 1e-4, n=4 * light.size, about=about),
        law("response", "srgb_off", "", float(off_srgb), 2e-5, n=4 * len(SRGB), about="IEC 61966-2-1, six digits"),
        law("response", "sensor_off", "", whole, 1e-5, n=2 * light.size, about="frames of a sensor with that gamma"),
    ]


def quantisation() -> list[Law]:
    """Check the rounding of 8 bits: whole numbers, at most half a step off, on average none; no light above 1."""
    light = np.linspace(0, 1.2, 50_001, dtype=np.float32)[None]
    counts = capture(light, 1.0, Sensor(bits=8), None).astype(float) * 255
    wanted = np.minimum(light.astype(float), 1.0) * 255
    whole = float(np.abs(counts - np.rint(counts)).max())
    gap = counts - wanted
    return [
        law("quantisation", "not_whole", "", whole, 1e-4, n=light.size, about="values times 255; single precision"),
        law("quantisation", "off", "", float(np.abs(gap).max()), 0.5 + 1e-4, n=light.size, about="half a step"),
        law("quantisation", "mean_off", "", float(abs(gap.mean())), 1e-3, n=light.size, about="rounded, not cut off"),
    ]


def vignetting() -> list[Law]:
    """Compare the falloff of an even picture with powers of the sightlines' cosine, and its correction with 1."""
    camera = Camera(**by_hand.CAMERA)
    even = np.ones((camera.height, camera.width), dtype=np.float32)
    cosine = by_hand.sightlines()[..., 2]
    seen = collect(even, Sensor.model_validate({"vignetting": {"type": "cosine", "power": 3.0}}), camera)
    off = float(np.abs(seen / cosine**3 - 1).max())
    angles, shares = [0.0, 20.0, 60.0], [1.0, 0.8, 0.2]
    table = {"type": "table", "angle_deg": angles, "value": shares}
    tabled = collect(even, Sensor.model_validate({"vignetting": table}), camera)
    wanted = np.interp(np.arccos(cosine) * 180 / math.pi, angles, shares)
    # What reconstruction divides by, of a picture that fell off by hand.
    calibration = Calibration(camera, vignetting=AngularProfile(2.0), emission=AngularProfile(1.0))
    mended = calibration.correct((cosine**3).astype(np.float32)).intensity
    about = "cos^3 of the angle off the axis, pixel by pixel; single precision"
    return [
        law("vignetting", "power_off", "", off, 1e-6, n=even.size, about=about),
        law("vignetting", "table_off", "", float(np.abs(tabled - wanted).max()), 1e-6, n=even.size, about="a table"),
        law("vignetting", "left", "", float(np.abs(mended - 1).max()), 1e-6, n=even.size, about="cos^3, undone"),
    ]


def widths() -> list[Law]:
    """Measure second moments of a point after lens and smoothing: the squared widths that are stated."""
    point = np.zeros((81, 81), dtype=np.float32)
    point[40, 40] = 1.0
    spread = collect(point, Sensor(point_spread_px=2.5), Camera(81, 81, 100.0, 100.0, 40.5, 40.5))
    smoothed = smooth(point, 3.0)
    # Beside a view mask an even picture stays even.
    mask = np.hypot(*(np.mgrid[:81, :81] - 40.0)) < 30
    inside = smooth(np.where(mask, 1.0, 0.0), 3.0, mask)[mask]
    left = math.sqrt(float((smoothed.astype(float) ** 2).sum()))
    about = "root of the second moment, over what is stated; the kernel ends at 4 of its widths"
    return [
        law("point_spread", "width", "x", _width(spread) / 2.5, *_about(1.0, 0.005), about=about),
        law("smoothing", "width", "x", _width(smoothed) / 3.0, *_about(1.0, 0.005), about=about),
        law("smoothing", "at_mask", "", float(np.abs(inside - 1).max()), 1e-5, n=inside.size, about="1 inside"),
        law("smoothing", "noise_left", "x", share_of_noise(3.0) / left, *_about(1.0, 0.01),
               about="root of the kernel's sum of squares; the formula is that of a wide kernel"),
    ]  # fmt: skip


def _captured(level: float, sensor: Sensor, rng: np.random.Generator) -> Array:
    """Capture an even picture whose radiance is twice its level, at a full scale of 2."""
    frame = capture(np.full((SIDE_PX, SIDE_PX), 2 * level, dtype=np.float32), 2.0, sensor, rng)
    return frame.astype(float)


def _width(image: Image) -> float:
    """Compute the root of the mean second moment about the centre, px."""
    y, x = (grid - 40.0 for grid in np.mgrid[: image.shape[0], : image.shape[1]])
    weight = image.astype(float)
    moments: list[Any] = [(weight * grid**2).sum() / weight.sum() for grid in (x, y)]
    return math.sqrt(float(np.mean(moments)))


def _about(value: float, gap: float) -> tuple[float, float]:
    """Return the upper and the lower bound."""
    return value + gap, value - gap
