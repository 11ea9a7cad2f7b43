"""Requests for the check of a core: highlights by formula, whose normals are known without a renderer."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, LogUniform, Normal, Priors
from simtest.geometry import Array, BrownConrady, Camera, KannalaBrandt, ViewMask
from simtest.geometry.vectors import basis_across
from simtest.runtime.seeds import from_integer

SMOOTHING_PX = 1.0
RADIUS_PX = 9.0
"""Of a highlight's isophote at half of its peak."""

REACH_PX = 36
"""Half of the width of a region of interest."""

TIGHT_PX = 5
"""The same where the isophote at half of the peak must not close."""

SEED = 20261123

PINHOLE = Camera.from_fov(70.0, 640, 480)
BARREL = Camera(640, 480, 460.0, 455.0, 322.0, 236.0, distortion=BrownConrady(k1=-0.1, p1=1e-3))
SMALL = Camera.from_fov(70.0, 160, 120)
FISHEYE = Camera(
    640, 480, 250.0, 250.0, 320.0, 240.0, distortion=KannalaBrandt(k1=-0.02), view_mask=ViewMask(320.0, 240.0, 230.0)
)

OTHER_PRIORS = Priors(
    ((3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)), Normal(30.0, 2.0), LogUniform(100.0, 1000.0), falloff_power=None
)
"""Two lights beside the camera, a told distance and a told lobe."""


@dataclass(frozen=True)
class CoreCase:
    """One request of the check.

    Parameters
    ----------
    name : str
        What is special about it.
    frame : Frame
        The picture.
    normals : ndarray, shape (N, 3)
        Of the highlights in it, unit, camera frame; the light is at the camera.
    priors : Priors
        What the core is told.
    reach_px : int
        Half of the width of the region of interest around the first highlight.
    is_accurate : bool
        Whether the normal of a simple method is expected to be near the true one.
    """

    name: str
    frame: Frame
    normals: Array
    priors: Priors = LIGHT_AT_CAMERA
    reach_px: int = REACH_PX
    is_accurate: bool = True

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The region of interest around the first highlight, cut at the border of the frame: column, row, w, h."""
        camera = self.frame.camera
        centre = np.floor(camera.project(-self.normals[0])).astype(int)
        low = np.maximum(centre - self.reach_px, 0)
        high = np.minimum(centre + self.reach_px + 1, [camera.width, camera.height])
        return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


@cache
def core_cases(kind: str) -> tuple[CoreCase, ...]:
    """Return the requests for a core of a kind, patch or frame; made once, since their frames take most of a check."""
    return tuple(_patch_cases() if kind == "patch" else _frame_cases())


def _patch_cases() -> Iterator[CoreCase]:
    first, second = _normals(PINHOLE, (220.2, 180.7), (460.4, 300.1))
    yield _case("plane", PINHOLE, [first])
    yield _case("another plane", PINHOLE, [second])
    yield _case("cylinder", PINHOLE, [second], gains=(1.0, 2.5))
    yield _case("lens with distortion", BARREL, _normals(BARREL, (500.3, 120.2)))
    yield _case("fisheye with a round view", FISHEYE, _normals(FISHEYE, (180.6, 260.3)))
    yield _case("noise", PINHOLE, [first], noise=0.01)
    yield _case("two lights, distance and lobe told", PINHOLE, [first], priors=OTHER_PRIORS, is_accurate=False)
    yield _case("clipped peak", PINHOLE, [first], clip=0.7, is_accurate=False)
    yield _case("isophote that does not close", PINHOLE, [first], reach_px=TIGHT_PX, is_accurate=False)
    yield _case("region at the frame's border", PINHOLE, _normals(PINHOLE, (3.0, 240.0)), is_accurate=False)
    yield _case("dark", PINHOLE, [first], peak=1e-5)
    yield _case("large region", PINHOLE, _normals(PINHOLE, (300.2, 250.9)), reach_px=200, radius_px=60.0)


def _frame_cases() -> Iterator[CoreCase]:
    first, second = _normals(PINHOLE, (220.2, 180.7), (460.4, 300.1))
    yield _case("one highlight", PINHOLE, [first])
    yield _case("two highlights", PINHOLE, [first, second])
    yield _case("lens with distortion", BARREL, _normals(BARREL, (500.3, 120.2)))
    yield _case("fisheye with a round view", FISHEYE, _normals(FISHEYE, (180.6, 260.3)))
    yield _case("noise", PINHOLE, [first, second], noise=0.01)
    yield _case("two lights, distance and lobe told", PINHOLE, [first], priors=OTHER_PRIORS, is_accurate=False)
    yield _case("colour", PINHOLE, [first], channels=3)
    yield _case("clipped peaks", PINHOLE, [first, second], clip=0.7, is_accurate=False)
    yield _case("no highlight", PINHOLE, [], noise=0.01)
    yield _case("dark", PINHOLE, [first], peak=1e-5)
    yield _case("small frame", SMALL, _normals(SMALL, (70.2, 60.9)))


def _case(
    name: str,
    camera: Camera,
    normals: list[Array] | Array,
    gains: tuple[float, float] = (1.0, 1.0),
    noise: float = 1e-3,
    clip: float | None = None,
    peak: float = 0.8,
    channels: int = 1,
    radius_px: float = RADIUS_PX,
    priors: Priors = LIGHT_AT_CAMERA,
    reach_px: int = REACH_PX,
    is_accurate: bool = True,
) -> CoreCase:
    """Return a request about highlights of equal shape; the noise is a share of the peak."""
    size = (camera.height, camera.width)
    light = np.full(size, 0.02) + sum((_lobe(camera, n, gains, radius_px) for n in normals), np.zeros(size))
    light = peak * np.maximum(light + noise * from_integer(SEED).standard_normal(size), 0.0)
    if camera.seen is not None:
        light[~camera.seen] = 0.0
    if clip is not None:
        light = np.minimum(light, clip)
    encoded = light.astype(np.float32)
    if channels > 1:
        encoded = np.repeat(encoded[:, :, None], channels, axis=2)
    calibration = Calibration(camera, priors=priors, saturation_level=clip)
    frame = Frame(encoded, calibration, SMOOTHING_PX)
    return CoreCase(name, frame, np.array(normals).reshape(-1, 3), priors, reach_px, is_accurate)


def _normals(camera: Camera, *pixels: tuple[float, float]) -> Array:
    """Return the normals that point back along the sightlines of pixels, shape (N, 3)."""
    return -camera.unproject(np.array(pixels))


@cache
def _rays(camera: Camera) -> Array:
    return camera.unproject(camera.pixel_centres())


def _lobe(camera: Camera, normal: Array, gains: tuple[float, float], radius_px: float) -> Array:
    """Return a highlight of peak 1, shape (H, W), with the light at the camera (theory.md section 3).

    Its isophotes are cones of sightlines about the normal, of half-angles that are smaller by 1 + d k along a principal
    direction of curvature k at the distance d.

    Parameters
    ----------
    gains : tuple of float
        1 + d k along both principal directions.
    """
    rays = _rays(camera)
    first, second = basis_across(normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(-(rays @ normal) > 0, -(rays @ normal), np.nan)
        reach = (gains[0] * (rays @ first) / depth) ** 2 + (gains[1] * (rays @ second) / depth) ** 2
    tangent = radius_px / camera.fx
    return np.nan_to_num(np.exp(-np.log(2.0) * reach / tangent**2), nan=0.0)
