"""The spread of diffuse light: its transfer function, its width on the surface, and what it keeps."""

import numpy as np
import pytest
from scipy.linalg import solve_banded

from simtest.errors import InputError
from simtest.geometry import Camera
from simtest.rendering.subsurface import once_scattered, pixels_per_mm, reflectance, spread, transfer
from simtest.spec.reflectance import Translucency
from simtest.spec.spec_model import validate

CAMERA = Camera(320, 240, 320, 320, 160, 120)
RAYS = CAMERA.unproject(CAMERA.pixel_centres())
TISSUE = Translucency()
NARROW = Translucency(absorption_per_mm=(0.8, 1.6, 1.6))


def plane(distance, tilt_deg=0.0):
    """Return depth along the rays and normals of a plane that meets the optical axis at a distance."""
    tilt = np.radians(tilt_deg)
    normal = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    depth = distance * normal[2] / (RAYS @ normal)
    return depth, np.broadcast_to(normal, RAYS.shape)


def point(row=120, column=160):
    image = np.zeros((240, 320, 3), dtype=np.float32)
    image[row, column] = 1
    return image


def deviations(image, pitch):
    """Return the standard deviation per axis of a point's image, a number for each channel, times a pixel's pitch."""
    y, x = np.mgrid[:240, :320]
    square = ((x - 160) ** 2 + (y - 120) ** 2)[:, :, None] * image
    return pitch * np.sqrt(square.sum((0, 1)) / image.sum((0, 1)) / 2)


@pytest.mark.parametrize(
    ("scattering", "absorption", "index"), [(1.46, 0.056, 1.0), (1.7, 0.8, 1.0), (1.46, 0.056, 1.37), (1.7, 0.8, 1.37)]
)
def test_transfer_function_solves_the_diffusion_equation(scattering, absorption, index):
    """Against finite differences in depth: -D phi'' + (mu_a + D k^2) phi = mu_s' exp(-mu_t z), phi' D = phi A at 0."""
    total = scattering + absorption
    diffusion = 1 / (3 * total)
    inside = 0.0 if index == 1 else 0.0636 * index + 0.668 + 0.710 / index - 1.440 / index**2
    leaving = (1 - inside) / (2 * (1 + inside))
    step, count = 0.002, 20_000
    z = step * np.arange(count)

    def solved(k):
        rows = np.zeros((3, count))
        rows[0, 1:] = rows[2, :-1] = -diffusion / step**2
        rows[1] = 2 * diffusion / step**2 + absorption + diffusion * k**2
        source = scattering * np.exp(-total * z)
        # Half a cell at the surface
        rows[1, 0] = diffusion / step**2 + (absorption + diffusion * k**2) / 2 + leaving / step
        source[0] /= 2
        return leaving * solve_banded((1, 1), rows, source)[0]

    waves = np.array([0.0, 0.1, 0.3, 1.0, 3.0, 10.0])
    expected = np.array([solved(k) for k in waves])
    assert np.allclose(reflectance(waves, scattering, absorption, index), expected, rtol=0.01)
    share = once_scattered(scattering, absorption, index)
    assert np.allclose(
        transfer(waves, scattering, absorption, index), share + (1 - share) * expected / expected[0], rtol=0.01
    )


def test_light_that_is_scattered_once():
    """1/H(1)^2 of isotropic scattering, with H from Chandrasekhar's integral equation by iteration."""
    mu, weight = np.polynomial.legendre.leggauss(64)
    mu, weight = (mu + 1) / 2, weight / 2
    for albedo in (0.5, 0.8, 0.96):
        H = np.ones_like(mu)
        for _ in range(300):
            kernel = mu[:, None] / (mu[:, None] + mu)
            H = 0.5 * (H + 1 / (1 - albedo / 2 * (kernel * H * weight).sum(axis=1)))
        last = 1 / (1 - albedo / 2 * (1 / (1 + mu) * H * weight).sum())
        assert once_scattered(albedo, 1 - albedo, 1.0) == pytest.approx(1 / last**2, rel=0.05)


def test_uniform_light_stays():
    for tilt in (0.0, 60.0):
        depth, normal = plane(20, tilt)
        image = np.full((240, 320, 3), 0.3, dtype=np.float32)
        assert np.abs(spread(image, depth, normal, CAMERA, TISSUE) - 0.3).max() < 1e-5


def test_energy_is_kept():
    """Of a point and of noise within the frame: the sum stays within 1 %."""
    depth, normal = plane(20)
    image = point()
    image[80:160, 120:200] += np.random.default_rng(0).uniform(0, 1, (80, 80, 3)).astype(np.float32)
    after = spread(image, depth, normal, CAMERA, NARROW)
    assert np.allclose(after.sum((0, 1)) / image.sum((0, 1)), 1, atol=0.01)
    assert (after >= 0).all()


@pytest.mark.parametrize("distance", [12.0, 20.0, 33.0])
def test_width_on_the_surface_is_that_of_the_transfer_function(distance):
    """-d2T/dk2 at 0 is the variance per axis; the same mm at all distances."""
    depth, normal = plane(distance)
    found = deviations(spread(point(), depth, normal, CAMERA, NARROW), distance / 320)
    k = 1e-3
    expected = [
        np.sqrt(2 * (1 - transfer(np.array([k]), s, a, NARROW.index)[0]) / k**2)
        for s, a in zip(NARROW.scattering_per_mm, NARROW.absorption_per_mm, strict=True)
    ]
    assert np.allclose(found, expected, rtol=0.06)


def test_aslant_patches_are_seen_smaller():
    depth, normal = plane(20)
    straight = pixels_per_mm(depth, normal, CAMERA)
    assert straight[120, 160] == pytest.approx(16, rel=1e-2)
    # Off axis the pixel sees the same area of a plane across the axis.
    assert np.allclose(straight, straight[120, 160], rtol=2e-2)
    aslant = pixels_per_mm(*plane(20, 60), CAMERA)
    assert aslant[120, 160] == pytest.approx(16 * np.cos(np.radians(60)) ** 0.5, rel=2e-2)


def test_light_does_not_cross_steps_of_the_depth():
    depth, normal = plane(10)
    depth = depth.copy()
    depth[:, 160:] *= 2.5
    image = np.zeros((240, 320, 3), dtype=np.float32)
    image[:, :160] = 1
    after = spread(image, depth, normal, CAMERA, TISSUE)
    # Two px beside the edge is what half-size levels blur.
    assert after[:, 164:].max() < 0.01
    assert after[:, :156].min() > 0.99
    # Without the step it does.
    flat = spread(image, *plane(10), CAMERA, TISSUE)
    assert flat[120, 170, 0] > 0.2


def test_light_does_not_leave_the_surface():
    depth, normal = plane(20)
    depth, normal = depth.copy(), normal.copy()
    depth[:, 200:], normal[:, 200:] = np.nan, np.nan
    image = np.random.default_rng(0).uniform(0.5, 1, (240, 320, 3)).astype(np.float32)
    image[:, 200:] = 7.0
    after = spread(image, depth, normal, CAMERA, TISSUE)
    assert np.array_equal(after[:, 200:], image[:, 200:])
    assert np.isfinite(after).all()
    assert after[:, :200].max() < 1
    nowhere = np.full_like(depth, np.nan)
    assert np.array_equal(spread(image, nowhere, normal, CAMERA, TISSUE), image)


def test_small_and_odd_frames():
    for height, width in ((1, 1), (2, 3), (17, 31)):
        camera = Camera(width, height, 30, 30, width / 2, height / 2)
        rays = camera.unproject(camera.pixel_centres())
        image, normal = np.ones((height, width, 3), dtype=np.float32), np.broadcast_to([0.0, 0.0, -1.0], rays.shape)
        assert np.allclose(spread(image, 20 / rays[..., 2], normal, camera, TISSUE), 1, atol=1e-5)


def test_red_spreads_most_and_one_channel_as_the_mean():
    depth, normal = plane(20)
    red, green, blue = deviations(spread(point(), depth, normal, CAMERA, TISSUE), 20 / 320)
    assert red > 2 * green
    assert red > 2 * blue
    after = spread(point()[:, :, 0], depth, normal, CAMERA, TISSUE)
    assert after.shape == (240, 320)
    assert green < deviations(after[:, :, None], 20 / 320)[0] < red


def test_malformed():
    with pytest.raises(InputError, match=r"scattering_per_mm\.2: missing") as error:
        validate(Translucency, {"scattering_per_mm": [1, 2]}, "my.toml")
    assert str(error.value).isprintable()
