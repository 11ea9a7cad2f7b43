"""The camera chain: lens, sensor and video processor, in the order of `spec.Sensor`.

`collect` is the lens, `capture` the sensor, and `encode` what follows its linear values; `noise_at` is the noise behind
all of them. Images are float32, shape (H, W) or (H, W, 3), red, green, blue; encoded ones lie in [0, 1] where the
sensor clips.
"""

import io
import math
from collections.abc import Callable
from fractions import Fraction
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from simtest.calibration import AngularProfile, srgb_encode
from simtest.calibration.calibration import falloff_map, mean_channel
from simtest.errors import InputError
from simtest.geometry import Camera, smooth
from simtest.runtime.arrays import Array, Image, IntArray, Mask, Picture
from simtest.runtime.seeds import from_integer
from simtest.spec.sensor import (
    Box,
    Caption,
    Coding,
    ColourProcessing,
    Denoising,
    H264Coding,
    Inset,
    Interlacing,
    JpegCoding,
    Mosaic,
    Overlay,
    Scaling,
    Sensor,
    Sharpening,
)

MAX_COUNT = 1e15
"""Beyond this many electrons shot noise is below the resolution of a float32 frame, and no Poisson numbers exist."""

LEAST_MEAN = 50.0
"""Below it NumPy draws. From it on the distribution of the expansion differs from Poisson's by a total variation of at
most 5e-5, and by 2e-8 at a mean of 8000."""

PIECE = 2**14
"""Numbers that are made at a time."""

METERED = 20_000
"""Pixels by which the automatic exposure measures a frame, evenly spread over it."""

CLOSE, TINY = 1e-7, 1e-30
"""Error of the automatic exposure's full scale, as a share of it, and a mean that stands for 0."""

LEVELS = (np.arange(256) / 255).astype(np.float32)
"""Values of a picture of 8 bits."""

_CHANNEL = {"r": 0, "g": 1, "b": 2}

_16_BITS, _8_BITS = 65535, 255

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of red, green and blue in the luma of encoded pictures (ITU-R BT.601)."""

_METHODS = {
    "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "area": cv2.INTER_AREA, "lanczos": cv2.INTER_LANCZOS4,
}  # fmt: skip

_FONT, _CAPITAL_PX = cv2.FONT_HERSHEY_SIMPLEX, 20.0
"""Font of captions, and the height of its capitals at scale 1, px."""

_SAMPLING = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}

CELL, BLOCK = 32, 16
"""Pixels along a side of what is drawn around a pixel, and of the blocks of lossy coding, with which it keeps step: at
least 8 px are around the pixel, as far as sharpening reaches."""

UNCLIPPED, NEARLY_CLIPPED = 0.7, 0.9
"""Of full scale: so bright the light is made where more would be clipped, which has no noise, and its brightest channel
where that alone would be."""

CELLS = 2**10
"""Cells of one picture."""


def collect(radiance: Image, sensor: Sensor, camera: Camera) -> Image:
    """Compute the light that reaches the sensor's pixels: linear radiance after the lens.

    The camera gives each pixel's angle from the optical axis. The point spread mirrors the frame at its borders.
    """
    # Point spread, then vignetting.
    light = smooth(radiance, sensor.point_spread_px)
    vignetting = sensor.vignetting.model()
    if vignetting.is_uniform:
        return light
    share = _falloff(camera, vignetting)
    return np.asarray(light * (share if light.ndim == 2 else share[:, :, None]), dtype=np.float32)


@lru_cache(maxsize=1)
def _falloff(camera: Camera, vignetting: AngularProfile) -> Image:
    """Return the share of light at each pixel, shape (H, W): a frame asks for it twice."""
    return falloff_map(camera, vignetting).astype(np.float32)


def capture(
    light: Image, full_scale: float, sensor: Sensor, rng: np.random.Generator | None, seen: Mask | None = None
) -> Image:
    """Compute the sensor's frame, as encoded: in [0, 1] where the sensor clips.

    Parameters
    ----------
    light : ndarray of float32, shape (H, W) or (H, W, 3)
        Radiance after the lens (`collect`).
    full_scale : float
        Radiance that becomes 1. Where it is not positive no light reached the sensor: no signal.
    sensor : Sensor
        The sensor.
    rng : numpy.random.Generator or None
        Draws shot noise, then read noise, then white noise; may be None where there is no noise.
    seen : ndarray of bool, shape (H, W), optional
        The pixels inside the camera's view mask; default all.

    Returns
    -------
    ndarray of float32
        Of the light's shape, (H, W, 3) with a mosaic or colour processing.

    Raises
    ------
    InputError
        If a package for the coding is missing.
    ValueError
        If noise is asked for without a generator.
    """
    if sensor.fringe is not None and light.ndim == 3:
        scales = (1 + sensor.fringe.red, 1.0, 1 + sensor.fringe.blue)
        light = np.asarray(cv2.merge([_moved(light[..., i], scale) for i, scale in enumerate(scales)]))
    # The sensor's own colours, each pixel behind its filter.
    if sensor.colour is not None or sensor.mosaic is not None:
        light, full_scale = expose(light, full_scale, 0.0, None), 1.0
        light = light if sensor.colour is None else as_seen_by_sensor(light, sensor.colour)
        light = light if sensor.mosaic is None else behind_filters(light, sensor.mosaic)
    # Electrons: shot and read noise.
    if sensor.full_well is not None:
        light = _electrons(expose(light, full_scale, 0.0, None), sensor, rng)
        full_scale = 1.0
    # White noise, then the sensor's values.
    frame = expose(light, full_scale, sensor.noise_sigma, rng)
    # The picture's colours.
    if sensor.mosaic is not None:
        frame = demosaic(frame, sensor.mosaic)
    if sensor.colour is not None:
        frame = develop(frame, sensor.colour, sensor.clips)
    return encode(frame, sensor, seen) if sensor.clips or sensor.is_processed else frame


def encode(frame: Image, sensor: Sensor, seen: Mask | None = None) -> Image:
    """Turn a linear frame into the picture: clip it, apply the response, then the stages behind it in their order.

    `seen`, shape (H, W), are the pixels inside the camera's view mask, default all.
    """
    response, linear = sensor.response.model(), np.clip(frame, 0.0, 1.0) if sensor.clips else frame
    if not sensor.is_processed:
        return _quantised(response.encode(linear), sensor.bits)
    picture = response.encode_picture(linear)
    if sensor.denoising is not None:
        picture = denoise(picture, sensor.denoising)
    if sensor.sharpening is not None:
        picture = sharpen(picture, sensor.sharpening)
        picture = np.clip(picture, 0.0, 1.0, out=picture) if sensor.clips else picture
    if sensor.scaling is None and sensor.interlacing is not None:
        picture = weave(picture, sensor.interlacing)
    if sensor.scaling is not None:
        picture = rescale(picture, sensor.scaling, sensor.interlacing)
        picture = np.clip(picture, 0.0, 1.0, out=picture) if sensor.clips else picture
    if sensor.overlay is not None:
        picture = draw(picture, sensor.overlay, seen)
    if sensor.coding is None:
        return _quantised(picture, sensor.bits)
    levels = picture * np.float32(255)
    coded = code(np.rint(levels, out=levels).astype(np.uint8), sensor.coding)
    return np.asarray(cv2.LUT(coded, LEVELS))


def _quantised(values: npt.NDArray[np.floating], bits: int | None) -> Image:
    """Return encoded values in the steps of so many bits; None: as they are."""
    if bits is None:
        return values.astype(np.float32)
    largest = 2**bits - 1
    return np.asarray(np.rint(values * np.float64(largest)) / largest, dtype=np.float32)


def _electrons(frame: Image, sensor: Sensor, rng: np.random.Generator | None) -> Image:
    """Count electrons, Poisson about the light's mean, and add the normal noise of the readout; share of full scale."""
    full_well, read_noise = sensor.full_well, sensor.read_noise
    assert full_well is not None
    if rng is None:
        raise ValueError("shot noise needs a generator")
    if sensor.is_processed:
        # A picture to look at, in single precision; plain frames, of which errors are measured, keep NumPy's numbers.
        levels = np.maximum(frame, 0)
        levels *= np.float32(full_well)
        levels = poisson(levels, rng)
        levels *= np.float32(1 / full_well)
        if read_noise > 0:
            noise = rng.standard_normal(levels.shape, dtype=np.float32)
            noise *= np.float32(read_noise / full_well)
            levels += noise
        return levels
    # Shot noise: beyond `MAX_COUNT` the mean stands for itself.
    mean = np.maximum(frame.astype(float), 0.0) * full_well
    counts = np.where(mean > MAX_COUNT, mean, rng.poisson(np.minimum(mean, MAX_COUNT)))
    if read_noise > 0:
        counts = counts + read_noise * rng.standard_normal(counts.shape)
    return (counts / full_well).astype(np.float32)


def poisson(mean: Image, rng: np.random.Generator) -> Image:
    """Return Poisson numbers of given means, an array of float32 of the same shape, none of them negative.

    A normal number w becomes floor(m + sqrt(m) w + (2 + w^2)/6 - (2 w + w^3)/(72 sqrt(m))), the first terms of the
    quantile function (Giles 2016, ACM Trans. Math. Softw. 42(1), 7). It takes 0.4 of the time of NumPy's
    rejection. The normal numbers are drawn for all pixels, so that a few dark ones do not change the others.
    """
    counts = np.empty(mean.size, dtype=np.float32)
    means = mean.ravel()
    # In pieces that stay in the processor's cache.
    for first in range(0, means.size, PIECE):
        piece = np.s_[first : first + PIECE]
        normal = rng.standard_normal(means[piece].size, dtype=np.float32)
        root = np.sqrt(np.maximum(means[piece], np.float32(LEAST_MEAN)))
        square = normal * normal
        square += np.float32(2)
        # floor(m + sqrt(m) w + (2 + w^2) (1/6 - w / (72 sqrt(m))))
        square *= np.float32(1 / 6) - normal / (np.float32(72) * root)
        np.floor(means[piece] + root * normal + square, out=counts[piece])
    few = means < LEAST_MEAN
    if few.any():
        counts[few] = rng.poisson(means[few].astype(float))
    return counts.reshape(mean.shape)


def expose(radiance: Image, full_scale: float, noise_sigma: float, rng: np.random.Generator | None) -> Image:
    """Scale radiance to full scale 1 and add white Gaussian noise; the frame is not clipped.

    Where the full scale is not positive no light reached the sensor, and the signal is 0. `noise_sigma` is a share of
    full scale (theory.md section 0); `rng` may be None where there is no noise: `ValueError` is raised where there is.
    """
    if full_scale == 1:
        frame = radiance
    else:
        # In double precision: a small full scale is 0 in single precision.
        frame = (radiance / np.float64(full_scale)).astype(np.float32) if full_scale > 0 else np.zeros_like(radiance)
    if noise_sigma > 0:
        if rng is None:
            raise ValueError("noise needs a generator")
        frame = frame + np.float32(noise_sigma) * rng.standard_normal(radiance.shape, dtype=np.float32)
    return np.asarray(frame, dtype=np.float32)


def full_scale_of_average(light: Image, average: float, sensor: Sensor, weights: Image | None = None) -> float:
    """Return the radiance at full scale for which the mean of the clipped, encoded light is `average`.

    `light` is noise-free, any shape; at least one value is positive. Values of 0 do not count: no surface is seen
    there, and a real scene has one everywhere. Where even the smallest full scale leaves the mean below `average`,
    since most of the light falls on few pixels, it is the smallest. `weights` are of the light's shape.
    """
    response, peak = sensor.response.model(), float(light.max())
    # An automatic exposure measures fields, not single pixels.
    metered = np.flatnonzero(light > 0)
    metered = metered[:: max(1, metered.size // METERED)]
    values, shares = light.ravel()[metered], None if weights is None else weights.ravel()[metered]

    def excess(log_scale: float) -> float:
        levels = response.encode_picture(np.clip(values / np.float64(math.exp(log_scale)), 0, 1).astype(np.float32))
        # In logarithms both are nearly linear: few steps lead to the zero.
        mean = levels.mean(dtype=np.float64) if shares is None else np.average(levels, weights=shares)
        return math.log(max(float(mean), TINY) / average)

    # Between the brightest pixel and a tiny share of it the mean falls steadily with the full scale.
    return math.exp(_zero_of(excess, math.log(peak * 1e-6), math.log(peak * 1e3)))


def _zero_of(falling: Callable[[float], float], low: float, high: float) -> float:
    """Return where a falling function is 0, to `CLOSE`, by Ridders' method; an end, where it is 0 at neither side."""
    at_low, at_high = falling(low), falling(high)
    if at_low <= 0 or at_high >= 0:
        return low if at_low <= 0 else high
    last = math.inf
    while high - low > CLOSE:
        middle = (low + high) / 2
        at_middle = falling(middle)
        # Through both ends and the middle goes an exponential times a straight line; its zero lies in the bracket.
        root = math.sqrt(at_middle**2 - at_low * at_high)
        crossing = middle + (middle - low) * at_middle / root if root > 0 else middle
        if abs(crossing - last) < CLOSE:
            return crossing
        last, value = crossing, falling(crossing)
        # The narrowest bracket of the four values.
        points = sorted([(low, at_low), (middle, at_middle), (crossing, value), (high, at_high)])
        low, at_low = max(point for point in points if point[1] > 0)
        high, at_high = min(point for point in points if point[1] <= 0)
    return (low + high) / 2


def to_uint8(frame: Image) -> Picture:
    """Return the sRGB-encoded 8-bit picture of a linear frame, clipped to [0, 1]."""
    linear = np.clip(np.nan_to_num(frame, nan=0.0), 0, 1)
    return np.asarray(np.round(255 * srgb_encode(linear)), dtype=np.uint8)


def displayed(frame: Image, sensor: Sensor) -> Image:
    """Return a frame as a screen gets it, shape (H, W, 3), float32: as the sensor encoded it, or sRGB of 8 bits."""
    values = np.clip(frame, 0, 1) if sensor.encodes else to_uint8(frame).astype(np.float32) / 255
    return np.asarray(values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2), dtype=np.float32)


def behind_filters(frame: Image, mosaic: Mosaic) -> Image:
    """Return what the pixels behind the filters measure, shape (H, W), of a linear frame, shape (H, W, 3) or (H, W)."""
    if frame.ndim == 2:
        # White light: all filters pass the same share of it.
        return frame
    plane = np.empty(frame.shape[:2], dtype=frame.dtype)
    for i, letter in enumerate(mosaic.pattern):
        cells = np.s_[i // 2 :: 2, i % 2 :: 2]
        plane[cells] = frame[..., _CHANNEL[letter]][cells]
    return plane


def demosaic(plane: Image, mosaic: Mosaic) -> Image:
    """Fill in the colours that the pixels of a linear plane, shape (H, W), did not measure; return (H, W, 3) in [0, 1].

    Values outside [0, 1] are clipped, as by a converter. Steps are 1/65535, with "vng" 1/255 of the square root.
    """
    pattern, clipped = mosaic.pattern.upper(), np.clip(plane, 0.0, 1.0)
    if mosaic.demosaicing == "vng":
        # OpenCV has it for 8 bits alone; the square root makes the noise of light alike at all levels.
        values = np.rint(np.sqrt(clipped) * _8_BITS).astype(np.uint8)
        root = cv2.demosaicing(values, getattr(cv2, f"COLOR_Bayer{pattern}2RGB_VNG")).astype(np.float32)
        return np.square(root / np.float32(_8_BITS))
    suffix = "_EA" if mosaic.demosaicing == "edge_aware" else ""
    clipped *= np.float32(_16_BITS)
    values = np.rint(clipped, out=clipped).astype(np.uint16)
    filled = cv2.demosaicing(values, getattr(cv2, f"COLOR_Bayer{pattern}2RGB{suffix}")).astype(np.float32)
    filled /= np.float32(_16_BITS)
    return np.asarray(filled)


def as_seen_by_sensor(frame: Image, colour: ColourProcessing) -> Image:
    """Return the light that the sensor's own colours receive, shape (H, W, 3); none is negative."""
    inverse = np.asarray(np.linalg.inv(np.array(colour.matrix) * colour.gains), dtype=float)
    return np.asarray(np.maximum(_mix(frame, inverse), 0.0), dtype=np.float32)


def develop(frame: Image, colour: ColourProcessing, clips: bool) -> Image:
    """Apply white balance and colour matrix to the sensor's values, shape (H, W, 3).

    With `clips` values end at 1 before and behind the gains, so that what fills the wells becomes white, not magenta.
    """
    balanced = _mix(np.clip(frame, 0.0, 1.0) if clips else frame, np.diag(colour.gains))
    if clips:
        np.minimum(balanced, np.float32(1), out=balanced)
    return _mix(balanced, np.array(colour.matrix))


def _mix(frame: Image, matrix: Array) -> Image:
    colours = frame if frame.ndim == 3 else np.repeat(frame[..., None], 3, axis=2)
    return np.asarray(cv2.transform(np.ascontiguousarray(colours, dtype=np.float32), matrix.astype(np.float32)))


def luma(picture: Image) -> Image:
    """Return the luma of an encoded picture, shape (H, W)."""
    return picture if picture.ndim == 2 else np.asarray(cv2.transform(picture, LUMA[None]))


def denoise(picture: Image, denoising: Denoising) -> Image:
    """Return an encoded picture without the noise that is small beside `level`; it reaches as far as 2 deviations."""
    diameter = 2 * math.ceil(2 * denoising.radius_px) + 1
    widths = denoising.level, denoising.radius_px
    return np.asarray(cv2.bilateralFilter(picture, diameter, *widths, borderType=cv2.BORDER_REFLECT_101))


def sharpen(picture: Image, sharpening: Sharpening) -> Image:
    """Return an encoded picture whose luma was unsharp masked; all channels change alike. It is not clipped."""
    value = luma(picture)
    smooth = cv2.GaussianBlur(value, (0, 0), sharpening.radius_px, borderType=cv2.BORDER_REFLECT_101)
    # In place: fresh arrays of a large picture cost more than the arithmetic.
    change = np.subtract(value, smooth, out=smooth)
    change *= np.float32(sharpening.amount)
    change = change if picture.ndim == 2 else np.asarray(cv2.merge([change] * 3))
    return np.asarray(cv2.add(picture, change, dst=change))


def weave(picture: Image, interlacing: Interlacing) -> Image:
    """Return a recorded picture whose odd rows are those of the moved view; whole pixels keep the noise as it is."""
    woven = picture.copy()
    woven[1::2] = _moved(picture, interlacing.zoom, interlacing.shift_px, cv2.INTER_NEAREST)[1::2]
    return woven


def _moved(picture: Image, scale: float, shift: tuple[float, float] = (0, 0), method: int = cv2.INTER_LINEAR) -> Image:
    """Return a picture scaled about its centre, then shifted; beyond its border the last pixels are repeated."""
    size = picture.shape[1::-1]
    centre = (np.array(size) - 1) / 2
    # Where in the given picture each pixel lies.
    matrix = np.column_stack([np.eye(2) / scale, centre - (centre + shift) / scale])
    flags = method | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(picture, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def rescale(picture: Image, scaling: Scaling, interlacing: Interlacing | None = None) -> Image:
    """Return a picture that was recorded at another size, with a comb or without, and scaled back to its own."""
    height, width = picture.shape[:2]
    size = (max(round(width * scaling.factor), 1), max(round(height * scaling.factor), 1))
    method = _METHODS[scaling.method]
    # Towards a smaller size areas are averaged, or else fine detail would alias.
    smaller = scaling.factor < 1
    recorded = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA if smaller else method))
    recorded = recorded if interlacing is None else weave(recorded, interlacing)
    return np.asarray(cv2.resize(recorded, (width, height), interpolation=method if smaller else cv2.INTER_AREA))


def draw(picture: Image, overlay: Overlay, seen: Mask | None) -> Image:
    """Return an encoded picture with what the processor draws: black outside `seen`, boxes, insets, captions."""
    drawn = picture.copy() if seen is None else np.asarray(cv2.copyTo(picture, seen.astype(np.uint8)))
    live, size = drawn.copy() if overlay.insets else drawn, (drawn.shape[0], drawn.shape[1])
    for box in overlay.boxes:
        drawn[_area(box, size)] = _paint(box.colour, drawn)
    for inset in overlay.insets:
        part = drawn[_area(inset, size)]
        if part.size:
            part[:] = cv2.resize(cv2.flip(live, 1), part.shape[1::-1], interpolation=cv2.INTER_AREA)
    for caption in overlay.captions:
        cover = _cover(caption, size)
        cover = cover if drawn.ndim == 2 else cover[..., None]
        drawn += cover * (_paint(caption.colour, drawn) - drawn)
    return drawn


def overlaid(overlay: Overlay, size: tuple[int, int]) -> Mask:
    """Return the pixels, shape (H, W), that boxes, insets and captions cover or touch."""
    over = np.zeros(size, dtype=bool)
    for part in overlay.boxes + overlay.insets:
        over[_area(part, size)] = True
    for caption in overlay.captions:
        over |= _cover(caption, size) > 0
    return over


def _area(part: Box | Inset, size: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a rectangle."""
    starts, ends = (part.y, part.x), (part.y + part.height, part.x + part.width)
    rows, columns = (slice(round(a * n), round(b * n)) for a, b, n in zip(starts, ends, size, strict=True))
    return rows, columns


def _paint(colour: tuple[float, float, float], picture: Image) -> Image:
    values = np.array(colour, dtype=np.float32)
    return values if picture.ndim == 3 else np.asarray(values @ LUMA)


def _cover(caption: Caption, size: tuple[int, int]) -> Image:
    """Return the share of each pixel, shape (H, W), that a caption covers."""
    height, width = size
    # OpenCV smooths the edges of letters in pictures of 8 bits alone.
    cover = np.zeros(size, np.uint8)
    thickness = max(1, round(caption.height_px / 12))
    scale = caption.height_px / _CAPITAL_PX
    corner = (round(caption.x * width), round(caption.y * height))
    cv2.putText(cover, caption.text, corner, _FONT, scale, 255, thickness, cv2.LINE_AA)
    return np.asarray(cover.astype(np.float32) / 255)


def check_codec(coding: Coding | None) -> None:
    """Raise `InputError` where the package of a coding is missing: before anything is rendered for it."""
    if isinstance(coding, H264Coding):
        try:
            import av  # noqa: F401
        except ImportError as error:
            raise InputError('sensor.coding.type = "h264": needs the package av; install simtest[video]') from error


def code(picture: Picture, coding: Coding) -> Picture:
    """Return a picture as it is after lossy coding."""
    return _jpeg(picture, coding) if isinstance(coding, JpegCoding) else _h264(picture, coding)


def _jpeg(picture: Picture, coding: JpegCoding) -> Picture:
    options = [cv2.IMWRITE_JPEG_QUALITY, coding.quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, _SAMPLING[coding.chroma]]
    # OpenCV wants blue first.
    values = np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    for _ in range(coding.generations):
        ok, data = cv2.imencode(".jpg", values, options)
        assert ok
        values = np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    return np.asarray(values if values.ndim == 2 else cv2.cvtColor(values, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _h264(picture: Picture, coding: H264Coding) -> Picture:
    check_codec(coding)
    import av

    height, width = picture.shape[:2]
    # Chroma of half size needs even sides.
    even = cv2.copyMakeBorder(picture, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    colour = even if even.ndim == 3 else np.repeat(even[..., None], 3, axis=2)
    film = io.BytesIO()
    with av.open(film, "w", format="matroska") as container:
        # One thread: the number of threads changes the bytes.
        stream = container.add_stream("libx264", rate=Fraction(25), options={"crf": str(coding.crf), "threads": "1"})
        stream.width, stream.height, stream.pix_fmt = even.shape[1], even.shape[0], "yuv420p"
        for _ in range(coding.frames):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(colour, format="rgb24")))
        container.mux(stream.encode())
    film.seek(0)
    with av.open(film) as container:
        *_, last = container.decode(video=0)
    decoded = last.to_ndarray(format="gray" if picture.ndim == 2 else "rgb24")
    return np.ascontiguousarray(decoded[:height, :width])


def noise_at(light: Image, full_scale: float, sensor: Sensor, rows: IntArray, columns: IntArray, draws: int) -> Array:
    """Return the standard deviation, radiance, of the mean of the frame's channels at pixels, shape (N,).

    Where a sensor has no stage that mixes pixels or channels, or draws no noise, the noise model has it in closed form.
    Else the noise-free radiance `light` behind the lens around each pixel goes through the chain `draws` times, at
    least 2, and the deviation is that over the 3 x 3 pixels around it, linear again. That of clipped light is the one
    below the clip. Where the full scale is 0 there is no noise.
    """
    if full_scale <= 0 or not len(rows):
        return np.zeros(len(rows))
    colour = light if light.ndim == 3 else light[..., None]
    level = colour[rows, columns].mean(axis=1, dtype=float) / full_scale
    mixes = sensor.is_processed or sensor.mosaic is not None or sensor.colour is not None
    if not mixes or (sensor.full_well is None and sensor.noise_sigma == 0):
        noise = sensor.noise_model().at(np.minimum(level, 1) if sensor.clips else level, colour.shape[2])
        return np.asarray(noise) * full_scale
    share = np.minimum(1, UNCLIPPED / np.maximum(level, 1e-12)) if sensor.clips else np.ones(len(rows))
    if sensor.clips:
        brightest = colour[rows, columns].max(axis=1) / full_scale
        share = np.where(share * brightest < 1, share, NEARLY_CLIPPED / np.maximum(brightest, 1e-12))
    # What moves light or covers it has no noise of its own.
    plain = sensor.model_copy(update=dict.fromkeys(("overlay", "fringe", "interlacing")))
    rng, at_once = from_integer(0), max(1, CELLS // draws)
    if plain.scaling is not None:
        # All cells are scaled alike: where a pixel falls between those recorded is no noise.
        whole = plain.scaling.model_copy(update={"factor": round(CELL * plain.scaling.factor) / CELL})
        plain = plain.model_copy(update={"scaling": whole})
    deviations = []
    for first in range(0, len(rows), at_once):
        batch = slice(first, first + at_once)
        # A row of equal cells for each pixel, in step with the blocks.
        down, right = ((at[batch] - BLOCK // 2) // BLOCK * BLOCK for at in (rows, columns))
        inside = [np.clip(start[:, None] + np.arange(CELL), 0, size - 1)
                  for start, size in ((down, light.shape[0]), (right, light.shape[1]))]  # fmt: skip
        cells = colour[inside[0][:, :, None], inside[1][:, None, :]] * share[batch, None, None, None]
        picture = np.tile(cells.reshape(-1, CELL, cells.shape[3]), (1, draws, 1)).astype(np.float32)
        frame = capture(picture if light.ndim == 3 else picture[..., 0], full_scale, plain, rng)
        linear = mean_channel(sensor.response.model().decode_picture(frame))
        variance = linear.reshape(len(cells), CELL, draws, CELL).var(axis=2, ddof=1, dtype=float)
        # Cells begin left of and above the frame where the pixel is near its border.
        number, (row, column) = np.arange(len(cells)), (rows[batch] - down, columns[batch] - right)
        around = [variance[number, row + i, column + j] for i in (-1, 0, 1) for j in (-1, 0, 1)]
        deviations.append(np.sqrt(np.mean(around, axis=0)) * full_scale)
    return np.concatenate(deviations)
