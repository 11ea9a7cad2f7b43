"""The camera chain by plain references and closed forms: its stages, their order, and the noise behind all of them."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage, stats

from simtest.calibration import Response
from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering import Session
from simtest.simulation import sensor as camera_chain
from simtest.simulation.frame import _metered, make_frame, render_view
from simtest.simulation.highlights import examine
from simtest.simulation.sensor import capture, noise_at
from simtest.spec import load_scene
from simtest.spec.scene import scene_from_dict
from simtest.spec.sensor import (
    PRESETS,
    Box,
    Caption,
    Denoising,
    H264Coding,
    Interlacing,
    JpegCoding,
    Mosaic,
    Overlay,
    Scaling,
    Sensor,
    Sharpening,
)
from tests.refusals import refused

PATTERNS = ("rggb", "bggr", "grbg", "gbrg")


def picture(shape=(48, 64, 3), seed=0, smooth=2.0):
    """Return a smooth random picture in [0, 1]."""
    noise = np.random.default_rng(seed).standard_normal(shape)
    blurred = ndimage.gaussian_filter(noise, (smooth, smooth, 0)[: len(shape)])
    return ((blurred - blurred.min()) / np.ptp(blurred)).astype(np.float32)


def sensor(**keys):
    return Sensor.model_validate(keys)


# Lens and noise -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.6, 4.0])
def test_the_point_spread_is_scipys_gaussian(sigma):
    radiance = np.random.default_rng(0).exponential(1.0, (50, 60, 3)).astype(np.float32)
    found = camera_chain.collect(radiance, Sensor(point_spread_px=sigma), Camera(60, 50, 60.0, 60.0, 30.0, 25.0))
    # OpenCV takes the Gaussian of floats out to 4 sigma, and mirrors the frame at its border.
    radius = (round(sigma * 4 * 2 + 1) | 1) // 2
    expected = ndimage.gaussian_filter(radiance.astype(float), (sigma, sigma, 0), radius=(radius, radius, 0))
    np.testing.assert_allclose(found, expected, rtol=2e-6, atol=2e-6)


class Normals:
    """Draws numbers that are given, one after the other."""

    def __init__(self, numbers):
        self.numbers = numbers

    def standard_normal(self, size, dtype):
        given, self.numbers = np.split(self.numbers, [size])
        return given.astype(dtype)


@pytest.mark.parametrize("mean", [camera_chain.LEAST_MEAN, 400.0, 8000.0])
def test_electrons_are_the_poisson_quantiles_of_normal_numbers(mean):
    """But for a share, where a sum in single precision ends on the other side of a whole number."""
    shares = (np.arange(50_000) + 0.5) / 50_000
    found = camera_chain.poisson(np.full(shares.size, mean, np.float32), Normals(stats.norm.ppf(shares)))
    gap = found - stats.poisson.ppf(shares, mean)
    assert np.abs(gap).max() <= 1
    assert np.count_nonzero(gap) < 6e-4 * shares.size


def test_pixels_of_one_picture_have_numbers_of_their_own():
    mean = np.repeat(np.float32([0.0, 10.0, 100.0, 1e9]), 5000)
    numbers = camera_chain.poisson(mean, np.random.default_rng(0))
    np.testing.assert_array_equal(numbers, camera_chain.poisson(mean, np.random.default_rng(0)))
    assert not np.array_equal(numbers, camera_chain.poisson(mean, np.random.default_rng(1)))
    for first, level in zip(range(0, 20000, 5000), [0.0, 10.0, 100.0, 1e9], strict=True):
        own = numbers[first : first + 5000].astype(float)
        assert own.mean() == pytest.approx(level, abs=5 * np.sqrt(level / 5000))
    # A pixel that darkens changes no other that is bright.
    darker = mean.copy()
    darker[-1] = 5.0
    np.testing.assert_array_equal(camera_chain.poisson(darker, np.random.default_rng(0))[5000:-1], numbers[5000:-1])


# Mosaic ---------------------------------------------------------------------------------------------------------------


def colour_at(pattern, row, column):
    return "rgb".index(pattern[2 * (row % 2) + column % 2])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_each_pixel_measures_the_colour_of_its_filter(pattern):
    frame = picture((5, 7, 3))
    plane = camera_chain.behind_filters(frame, Mosaic(pattern=pattern))
    expected = [[frame[i, j, colour_at(pattern, i, j)] for j in range(7)] for i in range(5)]
    np.testing.assert_array_equal(plane, np.array(expected))


def bilinear(plane, pattern):
    """Fill in each colour by the mean of its nearest measured neighbours."""
    height, width = plane.shape
    filled = np.zeros((height, width, 3))
    for i in range(1, height - 1):
        for j in range(1, width - 1):
            for channel in range(3):
                if colour_at(pattern, i, j) == channel:
                    filled[i, j, channel] = plane[i, j]
                    continue
                near = [(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
                own = [p for p in near if colour_at(pattern, *p) == channel]
                closest = min(abs(p[0] - i) + abs(p[1] - j) for p in own)
                filled[i, j, channel] = np.mean([plane[p] for p in own if abs(p[0] - i) + abs(p[1] - j) == closest])
    return filled


def edge_aware(plane, pattern):
    """The same, but green at red and blue pixels along the direction in which green changes less."""
    filled = bilinear(plane, pattern)
    for i in range(1, plane.shape[0] - 1):
        for j in range(1, plane.shape[1] - 1):
            if colour_at(pattern, i, j) != 1:
                across, down = plane[i, [j - 1, j + 1]], plane[[i - 1, i + 1], j]
                chosen = across if abs(across[0] - across[1]) < abs(down[0] - down[1]) else down
                filled[i, j, 1] = chosen.mean()
    return filled


@pytest.mark.parametrize(
    ("pattern", "method", "reference"),
    zip(PATTERNS, ("bilinear", "edge_aware") * 2, (bilinear, edge_aware) * 2, strict=True),
)
def test_demosaicing_equals_a_plain_reference_to_rounding(pattern, method, reference):
    spec = Mosaic(pattern=pattern, demosaicing=method)
    plane = camera_chain.behind_filters(picture((24, 30, 3), smooth=1.0), spec)
    found = camera_chain.demosaic(plane, spec)
    inside = np.s_[2:-2, 2:-2]
    gap = np.abs(found[inside] - reference(plane, pattern)[inside])
    # Red and blue of the edge-aware method differ in how they are rounded and, at edges, filled.
    channels = [1] if method == "edge_aware" else [0, 1, 2]
    assert gap[..., channels].max() <= 1.5 / 65535
    # Negative control: another pattern is not this one.
    other = PATTERNS[(PATTERNS.index(pattern) + 1) % 4]
    assert np.abs(found[inside] - reference(plane, other)[inside]).max() > 0.01


@pytest.mark.parametrize("method", ["bilinear", "vng", "edge_aware"])
def test_demosaicing_keeps_a_constant_and_the_measured_values(method):
    spec = Mosaic(demosaicing=method)
    constant = np.broadcast_to(np.float32([0.2, 0.5, 0.7]), (16, 16, 3))
    step = 1 / 65535 if method != "vng" else 2 / 255
    found = camera_chain.demosaic(camera_chain.behind_filters(constant, spec), spec)
    np.testing.assert_allclose(found, constant, atol=step)
    frame = picture(seed=3)
    found = camera_chain.demosaic(camera_chain.behind_filters(frame, spec), spec)[4:-4, 4:-4]
    again = camera_chain.behind_filters(found, spec)
    np.testing.assert_allclose(again, camera_chain.behind_filters(frame[4:-4, 4:-4], spec), atol=step)


def test_vng_follows_slopes_and_edges():
    """A plane in the root of the light is filled in to rounding, and along an edge colours mix less than bilinearly."""
    y, x = np.mgrid[:40, :48]
    for slopes in [(0.006, 0.0), (0.0, 0.006), (0.003, -0.004)]:
        root = 0.4 + slopes[0] * x + slopes[1] * y
        white = np.repeat(np.square(root).astype(np.float32)[..., None], 3, axis=2)
        found = camera_chain.demosaic(camera_chain.behind_filters(white, Mosaic()), Mosaic(demosaicing="vng"))
        gap = np.sqrt(found[4:-4, 4:-4]) - root[4:-4, 4:-4, None]
        # Sums of codes are divided in whole numbers, each by less than one code.
        assert np.abs(gap).max() < 2 / 255
    edge = np.repeat(np.where(x > 22, 0.6, 0.1).astype(np.float32)[..., None], 3, axis=2)
    tint = [
        np.ptp(
            camera_chain.demosaic(camera_chain.behind_filters(edge, Mosaic()), Mosaic(demosaicing=way))[4:-4, 4:-4],
            axis=2,
        ).mean()
        for way in ("vng", "bilinear")
    ]
    assert tint[0] < 0.85 * tint[1]


def test_demosaicing_of_an_edge_shows_false_colour():
    """What a mosaic does to a white edge: grey pixels become coloured; without one they do not."""
    edge = np.repeat((np.arange(32) > 15).astype(np.float32)[None, :], 32, axis=0)
    white = np.repeat(edge[..., None], 3, axis=2)
    found = camera_chain.capture(white, 1.0, sensor(mosaic={"demosaicing": "bilinear"}), None)
    assert np.ptp(found[4:-4, 4:-4], axis=2).max() > 0.4
    assert np.ptp(camera_chain.capture(white, 1.0, sensor(saturation=True), None), axis=2).max() == 0
    # A mono frame is white light.
    np.testing.assert_array_equal(
        camera_chain.capture(edge, 1.0, sensor(mosaic={"demosaicing": "bilinear"}), None), found
    )


# Colour ---------------------------------------------------------------------------------------------------------------

WARM = {"white_balance": [2.0, 1.0, 1.6], "matrix": [[1.6, -0.4, -0.2], [-0.3, 1.5, -0.2], [0.0, -0.6, 1.6]]}


def test_colour_processing_undoes_the_sensors_colours():
    frame = 0.3 + 0.3 * picture()
    found = camera_chain.capture(frame, 1.0, sensor(colour=WARM), None)
    np.testing.assert_allclose(found, frame, atol=2e-6)
    assert found.dtype == np.float32


def test_a_highlight_of_a_tinted_sensor_is_white():
    """Behind gains of at least 1 a pixel that fills all wells is white, whatever the gains."""
    bright = np.full((8, 8, 3), 50.0, np.float32)
    found = camera_chain.capture(bright, 1.0, sensor(colour=WARM, saturation=True), None)
    np.testing.assert_allclose(found, 1.0, atol=2e-7)


# Detail ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(30, 40), (30, 40, 3)])
def test_denoising_is_the_bilateral_filter(shape):
    frame, spec = picture(shape, smooth=1.0), Denoising(radius_px=0.9, level=0.2)
    found = camera_chain.denoise(frame, spec)
    # Summed as Tomasi and Manduchi have it, over a disc of the filter's reach.
    colour = frame.reshape(*frame.shape[:2], -1).astype(float)
    around = np.pad(colour, ((2, 2), (2, 2), (0, 0)), mode="reflect")
    total, weights = np.zeros_like(colour), np.zeros((*frame.shape[:2], 1))
    for row, column in itertools.product(range(-2, 3), repeat=2):
        if (away := row**2 + column**2) <= 4:
            other = around[2 + row : 32 + row, 2 + column : 42 + column]
            apart = np.abs(other - colour).sum(axis=-1, keepdims=True)
            weight = np.exp(-away / (2 * 0.9**2) - apart**2 / (2 * 0.2**2))
            total, weights = total + weight * other, weights + weight
    np.testing.assert_allclose(found.reshape(colour.shape), total / weights, atol=2e-4)


def test_denoising_takes_noise_and_leaves_edges():
    steps = np.where(np.arange(64) < 32, 0.3, 0.8)[None, :, None] * np.ones((64, 1, 3))
    noisy = (steps + 0.01 * np.random.default_rng(3).standard_normal(steps.shape)).astype(np.float32)
    found = camera_chain.capture(noisy, 1.0, sensor(denoising={"level": 0.1}), None)
    assert np.std(found - steps) < 0.4 * np.std(noisy - steps)
    assert np.abs(found - steps).max() < np.abs(noisy - steps).max()
    # Uncertainty is told of the noise that is left.
    keys, at = {"full_well": 2000, "response": {"type": "srgb"}}, (np.array([20]), np.array([12]), 16)
    plain, reduced = (noise_at(noisy, 1.0, sensor(**keys, **more), *at) for more in ({}, {"denoising": {"level": 0.3}}))
    assert reduced < 0.5 * plain


def test_sharpening_equals_direct_convolution():
    frame = picture((40, 50, 3))
    spec = Sharpening(radius_px=1.3, amount=0.9)
    found = camera_chain.sharpen(frame, spec)
    value = frame @ np.float32([0.299, 0.587, 0.114])
    # OpenCV takes the Gaussian of floats out to 4 sigma.
    radius = (round(1.3 * 4 * 2 + 1) | 1) // 2
    smooth = ndimage.gaussian_filter(value.astype(float), 1.3, radius=radius, mode="mirror")
    np.testing.assert_allclose(found, frame + (0.9 * (value - smooth))[..., None], atol=2e-6)


@given(st.floats(0.3, 0.95), st.sampled_from(["linear", "cubic", "area", "lanczos"]))
@settings(max_examples=20, deadline=None)
def test_scaling_keeps_size_and_mean_and_loses_detail(factor, method):
    frame = picture((40, 60), seed=1, smooth=1.0)
    found = camera_chain.rescale(frame, Scaling(factor=factor, method=method))
    assert found.shape == frame.shape
    assert found.mean() == pytest.approx(frame.mean(), abs=0.01)
    assert np.abs(np.diff(found)).mean() < np.abs(np.diff(frame)).mean()


def overlaps(size, count):
    """Return the matrix that averages `size` pixels to `count`, by how much of each the new ones cover."""
    ends = np.arange(count + 1) * size / count
    covered = np.minimum(ends[1:, None], np.arange(1, size + 1)) - np.maximum(ends[:-1, None], np.arange(size))
    return np.maximum(covered, 0) * count / size


def between(size, count):
    """Return the matrix of linear interpolation from `size` pixels to `count`, about the pixels' centres."""
    at = np.clip((np.arange(count) + 0.5) * size / count - 0.5, 0, size - 1)
    return np.maximum(1 - np.abs(at[:, None] - np.arange(size)), 0)


@pytest.mark.parametrize("factor", [0.6, 2.0])
def test_scaling_equals_plain_matrices(factor):
    """Smaller: areas are averaged, then lines are drawn between the centres; larger: the other way round."""
    frame = np.random.default_rng(0).uniform(0, 1, (30, 48)).astype(np.float32)
    found = camera_chain.rescale(frame, Scaling(factor=factor, method="linear"))
    there, back = (overlaps, between) if factor < 1 else (between, overlaps)
    expected = frame
    for _ in range(2):
        size = len(expected)
        expected = (back(round(size * factor), size) @ there(size, round(size * factor)) @ expected).T
    np.testing.assert_allclose(found, expected, atol=2e-6)


# What moves light -----------------------------------------------------------------------------------------------------


def centroid(plane):
    weight, (y, x) = plane.sum(), np.mgrid[: plane.shape[0], : plane.shape[1]] + 0.5
    return np.array([(x * plane).sum(), (y * plane).sum()]) / weight


@pytest.mark.parametrize("at", [(20.0, 15.0), (140.0, 90.0), (80.0, 60.0)])
def test_a_fringe_moves_red_and_blue_by_their_shares_of_the_distance_from_the_centre(at):
    y, x = np.mgrid[:120, :160] + 0.5
    spot = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 3.0**2)).astype(np.float32)
    light = np.repeat(spot[..., None], 3, axis=2)
    found = camera_chain.capture(light, 1.0, sensor(fringe={"red": 0.01, "blue": -0.008}), None)
    away = np.array(at) - [80.0, 60.0]
    for channel, share in enumerate((0.01, 0.0, -0.008)):
        np.testing.assert_allclose(centroid(found[..., channel]) - at, share * away, atol=0.03)
    np.testing.assert_array_equal(found[..., 1], spot)
    # Grey light has no colours, and without the stage nothing moves.
    np.testing.assert_array_equal(camera_chain.capture(spot, 1.0, sensor(fringe={}), None), spot)
    np.testing.assert_array_equal(camera_chain.capture(light, 1.0, sensor(), None), light)


def test_a_comb_moves_the_odd_rows_alone_and_by_whole_pixels():
    frame = picture((60, 80, 3), smooth=0.0)
    told = sensor(interlacing={"shift_px": [5.3, -2.0]})
    found = camera_chain.capture(frame, 1.0, told, None)
    np.testing.assert_array_equal(found[::2], frame[::2])
    np.testing.assert_array_equal(found[1:57:2, 5:], frame[3:59:2, :-5])
    # Where it grows, a pixel comes from where it was, half a pixel off at most.
    y, x = (axis.astype(np.float32) for axis in np.mgrid[:60, :80])
    for values, centre, at in ((x, 39.5, x), (y, 29.5, y)):
        grown = camera_chain.weave(values, Interlacing(zoom=1.1))[1::2]
        assert np.abs(grown - (centre + (at[1::2] - centre) / 1.1)).max() <= 0.51


def test_a_comb_has_the_rows_of_the_recorded_picture():
    frame = picture((60, 80, 3))
    told = sensor(interlacing={"shift_px": [4.0, 0.0]}, scaling={"factor": 0.5})
    woven = camera_chain.rescale(frame, told.scaling, told.interlacing)
    plain = camera_chain.rescale(frame, told.scaling)
    moved = np.abs(woven - plain)[:, 16:-16].max(axis=(1, 2))
    # A row recorded is two of the picture: those between are mixed, and the middle of each even one stays.
    assert moved[2::4].min() > 3 * moved[[0, -1]].min()
    np.testing.assert_allclose(camera_chain.capture(frame, 1.0, told, None), woven, atol=1e-6)


def test_what_moves_or_covers_light_leaves_its_noise():
    light = np.full((64, 64, 3), 0.5, np.float32)
    keys = {"full_well": 2000, "response": {"type": "srgb"}, "sharpening": {}}
    extra = {"fringe": {"red": 0.01}, "interlacing": {"shift_px": [9, 0]}, "overlay": OVERLAY}
    at = (np.array([20, 41]), np.array([30, 12]), 16)
    np.testing.assert_array_equal(noise_at(light, 1.0, sensor(**keys, **extra), *at),
                                  noise_at(light, 1.0, sensor(**keys, overlay={}), *at))  # fmt: skip


# Graphics -------------------------------------------------------------------------------------------------------------


def test_overlay_blanks_paints_and_writes():
    frame = np.full((100, 200, 3), 0.4, np.float32)
    seen = np.ones((100, 200), bool)
    seen[:, :50] = False
    box = Box(x=0.5, y=0.1, width=0.25, height=0.2, colour=(0.0, 0.0, 1.0))
    text = Caption(text="15/03/2012", x=0.3, y=0.9, height_px=14, colour=(1.0, 1.0, 0.0))
    found = camera_chain.draw(frame, Overlay(boxes=(box,), captions=(text,)), seen)
    assert (found[:, :50] == 0).all()
    np.testing.assert_array_equal(found[10:30, 100:150], np.broadcast_to([0.0, 0.0, 1.0], (20, 50, 3)))
    rows, columns = np.nonzero((found[..., 0] > 0.9) & (found[..., 2] < 0.1))
    assert 12 <= np.ptp(rows) <= 20
    assert rows.max() == pytest.approx(90, abs=4)
    assert columns.min() == pytest.approx(60, abs=3)
    # Everything else stays, and the given picture too.
    untouched = np.ones_like(seen)
    untouched[:, :50] = untouched[10:30, 100:150] = False
    untouched[70:95, 55:] = False
    assert (found[untouched] == np.float32(0.4)).all()
    assert (frame == np.float32(0.4)).all()


@pytest.mark.parametrize("height", [8.0, 40.0])
def test_captions_have_the_asked_height(height):
    overlay = Overlay(captions=(Caption(text="H", x=0.1, y=0.8, height_px=height),))
    found = camera_chain.draw(np.zeros((100, 100), np.float32), overlay, None)
    rows = np.nonzero(found.max(axis=1) > 0.5)[0]
    assert np.ptp(rows) + 1 == pytest.approx(height, abs=1)


OVERLAY = {
    "boxes": [{"x": 0.5, "y": 0.1, "width": 0.25, "height": 0.2, "colour": [0.0, 0.0, 0.3]},
              {"x": 0, "y": 0.8, "width": 0.3, "height": 0.4}],
    "insets": [{"x": 0.7, "y": 0.6, "width": 0.25, "height": 0.25}],
    "captions": [{"text": "15/03/2012", "x": 0.1, "y": 0.5, "height_px": 14, "colour": [1.0, 1.0, 0.2]}],
}  # fmt: skip


def test_the_mask_of_an_overlay_is_every_pixel_that_it_changes():
    """Two pictures that differ everywhere: what is drawn is alike on both but for the inset, whose place is known."""
    overlay = Overlay.model_validate(OVERLAY)
    dark, light = np.zeros((100, 200, 3), np.float32), np.full((100, 200, 3), 0.6, np.float32)
    changed = (camera_chain.draw(dark, overlay, None) != dark) | (camera_chain.draw(light, overlay, None) != light)
    changed = changed.any(axis=2)
    # A picture of one colour is its own inset.
    changed[60:85, 140:190] = True
    np.testing.assert_array_equal(camera_chain.overlaid(overlay, (100, 200)), changed)
    assert 0.1 < changed.mean() < 0.4


def test_an_inset_is_the_mirrored_picture_without_what_is_drawn():
    frame = picture((80, 120, 3), smooth=6.0)
    insets = {"insets": [{"x": 0.5, "y": 0.5, "width": 0.25, "height": 0.25}], "captions": []}
    overlay = Overlay.model_validate(OVERLAY | insets)
    found = camera_chain.draw(frame, overlay, None)[40:60, 60:90]
    expected = frame[:, ::-1].reshape(20, 4, 30, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    # One that has no pixel, or ends beyond the frame, is drawn as far as it can be.
    for own in ({"x": 1, "y": 1, "width": 0.2, "height": 0.2}, {"x": 0.9, "y": 0.5, "width": 0.5, "height": 0.001}):
        camera_chain.draw(frame, Overlay.model_validate({"insets": [own]}), None)


def test_overlay_of_a_grey_picture_takes_the_lumas():
    frame = np.full((40, 40), 0.4, np.float32)
    found = camera_chain.draw(frame, Overlay(boxes=(Box(x=0, y=0, width=0.5, height=1, colour=(0, 1, 0)),)), None)
    assert found[0, 0] == pytest.approx(0.587)
    assert found[0, -1] == np.float32(0.4)


# Coding ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("quality", [50, 75, 90])
def test_jpeg_quality_shows_in_the_blocks(quality):
    """The mean of a coded 8 x 8 block is a multiple of the table's first entry over 8; of another's it is not."""
    values = (255 * picture((64, 64), seed=2)).astype(np.uint8)
    coded = camera_chain.code(values, JpegCoding(quality=quality)).astype(float)
    means = coded.reshape(8, 8, 8, 8).mean(axis=(1, 3)) - 128

    def residue(step):
        return np.abs(means * 8 / step - np.rint(means * 8 / step)).mean()

    scale = 5000 / quality if quality < 50 else 200 - 2 * quality
    table = max(1, int((16 * scale + 50) / 100))
    assert residue(table) < 0.08
    assert residue(table * 1.37) > 0.15


def test_jpeg_of_colours_blurs_chroma_at_420_only():
    frame = np.zeros((32, 32, 3), np.uint8)
    frame[:, 15:, 0] = 255
    sharp = camera_chain.code(frame, JpegCoding(quality=98, chroma="4:4:4")).astype(int)
    soft = camera_chain.code(frame, JpegCoding(quality=98, chroma="4:2:0")).astype(int)
    assert np.abs(sharp - frame).max() < 20
    assert np.abs(soft - frame)[:, 13:17].max() > 40


def test_every_generation_loses():
    frame = (255 * picture(seed=4, smooth=0.7)).astype(np.uint8)
    once, often = (camera_chain.code(frame, JpegCoding(quality=60, generations=n)).astype(float) for n in (1, 8))
    assert np.square(often - frame).mean() >= np.square(once - frame).mean() > 1


def test_a_missing_codec_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(InputError, match=r"needs the package av; install simtest\[video\]"):
        camera_chain.code(np.zeros((8, 8), np.uint8), H264Coding())
    # Before anything is rendered: there is no session to render with.
    told = {"surface": {"type": "plane"}, "sensor": {"bits": 8, "coding": {"type": "h264"}}}
    monkeypatch.setattr("simtest.simulation.frame.Session", None)
    with pytest.raises(InputError, match="needs the package av"):
        make_frame(scene_from_dict(told))


# Exposure and the whole -----------------------------------------------------------------------------------------------

CURVES = [Response("srgb"), Response("gamma", 2.2), Response("table", light=(0, 0.2, 1), value=(0, 0.5, 1)), Response()]


@pytest.mark.parametrize("curve", CURVES, ids=lambda curve: curve.kind)
def test_the_fast_curve_is_the_curve(curve):
    light = np.random.default_rng(0).uniform(0, 1, (5, 6, 3)).astype(np.float32)
    light.ravel()[:4] = 0.0, 1.0, 0.0031308, 1e-6
    found = curve.encode_picture(light)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, curve.encode(light), atol=3e-7)


@given(st.floats(0.1, 0.7), st.sampled_from(["linear", "srgb"]), st.floats(1e-6, 1e6))
@settings(max_examples=30, deadline=None)
def test_automatic_exposure_reaches_its_mean(average, response, unit):
    light = unit * picture((60, 80), seed=5)
    light[10:14, 10:14] *= 100
    told = sensor(saturation=True, response={"type": response})
    scale = camera_chain.full_scale_of_average(light, average, told)
    frame = camera_chain.capture(light, scale, told, None)
    assert frame.mean() == pytest.approx(average, abs=1e-3)
    assert (frame[10:14, 10:14] == 1).all()


def test_a_centre_weighted_meter_burns_out_the_walls_around_a_dark_lumen():
    """About the centre of the view, which the mask moves; with wide weights it is the mean."""
    light = np.full((120, 160), 1.0, dtype=np.float32)
    light[40:100, 40:100] = 0.05
    seen = np.zeros(light.shape, dtype=bool)
    seen[10:, :140] = True  # its centre is that of the dark square

    def burnt(**exposure):
        told = sensor(saturation=True, response={"type": "srgb"}, exposure={"average": 0.4, **exposure})
        scene = load_scene("plane").model_copy(update={"sensor": told})
        frame = camera_chain.capture(light, _metered(scene, light, seen), told, None)
        return frame[:40].mean(), frame[40:100, 40:100].mean(), frame[seen].mean()

    near, _, mean = burnt()
    assert near < 0.6
    assert mean == pytest.approx(0.4, abs=1e-3)
    np.testing.assert_allclose(burnt(centre=10), burnt(), rtol=2e-3)
    near, lumen, _ = burnt(centre=0.1)
    assert near == 1
    assert lumen == pytest.approx(0.4, abs=0.01)


def test_weights_of_no_mean_are_refused():
    with pytest.raises(ValueError, match=r"centre = 0\.3: weighs"):
        sensor(exposure={"percentile": 99, "centre": 0.3})


@given(st.floats(-9, 9), st.floats(0.2, 5.0))
@settings(max_examples=40, deadline=None)
def test_a_zero_is_found_in_few_steps(zero, power):
    asked = []

    def falling(x):
        asked.append(x)
        return float(np.exp(-power * x) - np.exp(-power * zero)) if power > 1 else -np.arctan(power * (x - zero))

    assert camera_chain._zero_of(falling, -10.0, 10.0) == pytest.approx(zero, abs=2e-7)
    assert len(asked) < 60
    assert camera_chain._zero_of(lambda x: 1.0 - x, 2.0, 3.0) == 2.0
    assert camera_chain._zero_of(lambda x: 9.0 - x, 2.0, 3.0) == 3.0


@pytest.mark.parametrize("shape", [(60, 80), (60, 80, 3)])
def test_where_no_surface_is_seen_does_not_count(shape):
    """A liver before an empty background is exposed as it is where it fills the picture."""
    light = 0.2 + 0.1 * picture(shape)
    told = sensor(response={"type": "srgb"})
    surrounded = np.zeros((180, 160, *shape[2:]), dtype=light.dtype)
    surrounded[20:80, 30:110] = light
    own, within = (camera_chain.full_scale_of_average(v, 0.4, told) for v in (light, surrounded))
    assert within == pytest.approx(own, rel=1e-6)


def test_stages_come_in_physical_order():
    """The whole chain equals its stages called one by one, in the order of the sensor's docstring."""
    told = sensor(mosaic={}, colour=WARM, full_well=4000, read_noise=3.0, noise_sigma=0.005, response={"type": "srgb"},
                  sharpening={}, scaling={"factor": 0.7}, overlay={"captions": [{"text": "A"}]}, bits=8,
                  coding={"type": "jpeg", "quality": 80}, fringe={}, denoising={},
                  interlacing={"shift_px": [3, 0]})  # fmt: skip
    light = (4 * picture((64, 96, 3))).astype(np.float32)
    found = camera_chain.capture(light, 2.0, told, np.random.default_rng(7))
    # One by one.
    rng = np.random.default_rng(7)
    moved = camera_chain.capture(light, 1.0, Sensor(fringe=told.fringe), None)
    own = camera_chain.as_seen_by_sensor(moved / np.float32(2), told.colour)
    plane = camera_chain.behind_filters(own, told.mosaic)
    share = camera_chain.poisson(plane * np.float32(4000), rng) * np.float32(1 / 4000)
    plane = share + np.float32(3.0 / 4000) * rng.standard_normal(plane.shape, dtype=np.float32)
    plane = plane + np.float32(0.005) * rng.standard_normal(plane.shape, dtype=np.float32)
    linear = camera_chain.develop(camera_chain.demosaic(plane, told.mosaic), told.colour, True)
    values = told.response.model().encode_picture(np.clip(linear, 0, 1))
    values = camera_chain.denoise(values, told.denoising)
    values = np.clip(camera_chain.sharpen(values, told.sharpening), 0, 1)
    values = np.clip(camera_chain.rescale(values, told.scaling, told.interlacing), 0, 1)
    values = camera_chain.draw(values, told.overlay, None)
    expected = camera_chain.code(np.rint(values * 255).astype(np.uint8), told.coding)
    np.testing.assert_array_equal(np.rint(found * 255).astype(np.uint8), expected)
    assert found.dtype == np.float32


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"colour": {"matrix": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}}, "must be invertible"),
        ({"colour": {"matrix": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}}, "white stays white"),
        ({"coding": {"type": "jpeg"}}, "sensor: bits = None: must be 8 where coding is given"),
    ],
)
def test_stages_that_do_not_fit_are_named(keys, words):
    refused(lambda: scene_from_dict({"surface": {"type": "plane"}, "sensor": keys}), words)


# The noise behind the whole chain, at highlights' peaks ---------------------------------------------------------------


SCENE = {
    "camera.width": 120, "camera.height": 90, "camera.fx": 110.0, "camera.fy": 110.0, "surface.radius_mm": 40.0,
    "reflectance.exponent": 60.0, "reflectance.diffuse": 0.4,
}  # fmt: skip


@pytest.fixture(scope="module")
def session():
    return Session(load_scene("sphere", SCENE), "llvm_ad_rgb")


def drawn_sigma(view, row, column, draws=150):
    """The deviation of the channels' mean over draws of the whole frame, mean of the variances of 3 x 3 pixels."""
    decode = view.scene.sensor.response.model().decode
    around = np.s_[row - 1 : row + 2, column - 1 : column + 2]
    values = np.stack([decode(view.frame(seed))[around] for seed in range(draws)])
    values = values if values.ndim == 3 else values.mean(axis=3)
    return np.sqrt(values.var(axis=0, ddof=1).mean()) * view.full_scale


COLOURS = ((0.9, 0.4, 0.3), (1.0, 1.0, 1.0))
SENSORS = {name: {"preset": name} for name in PRESETS} | {
    "plain": {"full_well": 4000.0, "read_noise": 5.0},
    "mosaic": {"full_well": 4000.0, "mosaic": {}, "colour": {"white_balance": [1.8, 1.0, 2.2]}},
}


@pytest.mark.render
@pytest.mark.parametrize(("name", "colour"), zip(SENSORS, itertools.cycle(COLOURS)))
def test_the_noise_at_a_peak_is_that_of_frames_drawn_again(name, colour, session):
    sensor = {**SENSORS[name], "exposure": {"percentile": 100.0, "gain": 0.5}}
    scene = load_scene("sphere", {**SCENE, "reflectance.colour": list(colour), "sensor": sensor})
    view = render_view(session, scene)
    light = view.light.mean(axis=2)
    row, column = np.unravel_index(light.argmax(), light.shape)
    found = noise_at(view.light, view.full_scale, scene.sensor, np.array([row]), np.array([column]), 64)
    assert found[0] == pytest.approx(drawn_sigma(view, row, column), rel=0.15)
    [highlight] = view.highlights
    [examined] = examine(view.highlights, light)
    assert highlight.peak_snr == pytest.approx(examined.height / found[0], rel=0.2)


def test_without_light_there_is_no_noise():
    sensor = Sensor(preset="old_sd")
    assert noise_at(np.zeros((40, 40)), 0.0, sensor, np.array([3]), np.array([3]), 4) == [0.0]
    assert noise_at(np.ones((40, 40)), 1.0, sensor, np.array([], int), np.array([], int), 4).shape == (0,)
    # At the border, and in more pictures than one.
    border = np.zeros(300, dtype=int), np.full(300, 39)
    assert (noise_at(np.full((40, 40), 0.3, np.float32), 1.0, sensor, *border, 8) > 0).all()


def test_a_chain_that_draws_no_noise_has_that_of_its_steps():
    sensor = Sensor(bits=8, scaling={"factor": 0.6}, sharpening={"amount": 1.0})
    light = np.linspace(0.1, 0.9, 1600, dtype=np.float32).reshape(40, 40)
    found = noise_at(light, 1.0, sensor, np.array([20]), np.array([20]), 8)
    assert found == pytest.approx(1 / 255 / np.sqrt(12), rel=1e-3)


@pytest.mark.parametrize(
    ("factor", "coding"), [(0.45, None), (0.6, {"type": "jpeg", "quality": 85}), (1.5, {"type": "jpeg", "quality": 85})]
)
def test_scaling_a_small_highlight_is_no_noise(factor, coding):
    # Each draw falls otherwise between the recorded pixels of a row of cells that were scaled as one picture.
    sensor = Sensor(full_well=5000, scaling={"factor": factor}, coding=coding, bits=8 if coding else None)
    at, (y, x) = np.arange(24, 200, 24), np.mgrid[:216, :216]
    spots = sum(np.exp(-((x - i) ** 2 + (y - j) ** 2) / 3) for i in at for j in at)
    light = (0.2 + 0.6 * spots).astype(np.float32)
    rows, columns = (each.ravel() for each in np.meshgrid(at, at))
    found = noise_at(light, 1.0, sensor, rows, columns, 32)
    rng = np.random.default_rng(0)
    variance = np.var([capture(light, 1.0, sensor, rng) for _ in range(40)], axis=0, ddof=1)
    around = [
        variance[row - 1 : row + 2, column - 1 : column + 2].mean() for row, column in zip(rows, columns, strict=True)
    ]
    assert np.median(found / np.sqrt(around)) == pytest.approx(1, abs=0.15)


def test_a_clipped_channel_has_the_noise_below_the_clip():
    light = np.full((40, 40, 3), [1.3, 0.5, 0.4], dtype=np.float32)
    sensor = Sensor(full_well=5000, saturation=True, colour={})
    found = noise_at(light, 1.0, sensor, np.array([20]), np.array([20]), 200)
    assert found == pytest.approx(np.sqrt((1 + 0.5 + 0.4) / 5000) / 3, rel=0.15)
