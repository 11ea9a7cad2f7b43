"""Sources of finite size: highlight widths against numerical convolution, frames against Mitsuba's own area light.

A plane is seen straight on, the disc lies about the camera. The half-angle of a pixel, between the normal and the
bisector of the directions to camera and disc's centre, is then the sightline's angle from the optical axis. The
half-width is where the lobe's radiance falls to half of that on the axis. The expectation is integrated here over the
disc by Gauss's rule from the formulas of the reflectances alone.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

import simtest
from simtest.rendering import Session, plugins
from simtest.spec import Scene, scene_from_dict

pytestmark = [pytest.mark.render, pytest.mark.slow]

Floats = npt.NDArray[np.float64]

BOUND = 0.03

IOR = 1.49 / 1.000277
"""Mitsuba's rough plastic: polypropylene in air."""

REACH = 4.4
"""Half of the frame's width over the expected half-width."""

PIXELS = 241
TOP = 0.35
"""The value on the axis is that of a parabola in the angle through this share of the expected half-width."""

ROOT_2LN2 = math.sqrt(2 * math.log(2))
"""Half-width at half height of a Gaussian over its standard deviation."""


@dataclass(frozen=True)
class Case:
    """A lobe, Phong's by its exponent or GGX's by alpha, under a disc, lengths in mm."""

    lobe: str
    value: float
    distance: float
    radius: float

    @property
    def law_rad(self) -> float:
        """Standard deviation per axis, rad, that the disc adds to the half-angle: r/(4 d) (theory, 7.6)."""
        return self.radius / (4 * self.distance)


CASES = [
    Case("phong", 200.0, 20.0, 1.5),
    Case("phong", 800.0, 10.0, 3.0),
    Case("ggx", 0.1, 10.0, 3.0),
    Case("ggx", 0.05, 20.0, 3.0),
]


def disc_points(radius: float) -> tuple[Floats, Floats]:
    """Return points on a disc, shape (N, 3), and their weights, sum 1: Gauss's rule in r^2, even steps of the angle."""
    if radius == 0:
        return np.zeros((1, 3)), np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(64)
    rho, angle = radius * np.sqrt((nodes + 1) / 2), 2 * np.pi * np.arange(160) / 160
    x, y = np.outer(rho, np.cos(angle)), np.outer(rho, np.sin(angle))
    return np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3), np.repeat(weights / 2 / len(angle), len(angle))


def lobe_radiance(case: Case, radius: float, theta: Floats) -> Floats:
    """Integrate the lobe's radiance over a disc of a radius, mm, at sightlines `theta`, rad, from the axis."""
    lights, weights = disc_points(radius)
    normal, result = np.array([0.0, 0.0, -1.0]), np.empty(len(theta))
    for i, angle in enumerate(theta):
        place = case.distance * np.array([math.tan(angle), 0.0, 1.0])
        view = -place / np.linalg.norm(place)
        towards = lights - place
        squared = np.sum(towards**2, axis=1)
        light = towards / np.sqrt(squared)[:, None]
        cos_i, cos_o = light @ normal, float(view @ normal)
        if case.lobe == "phong":
            mirrored = 2 * cos_i[:, None] * normal - light
            reflected = np.maximum(mirrored @ view, 0) ** case.value
        else:
            half = light + view
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            reflected = ggx(case.value, half @ normal, cos_i, cos_o, np.sum(light * half, axis=1))
        result[i] = weights @ (reflected / squared)
    return result


def ggx(alpha: float, cos_h: Floats, cos_i: Floats, cos_o: float, cos_d: Floats) -> Floats:
    """Compute f cos(theta_i) of a rough dielectric's reflection: F D G / (4 cos(theta_o)), Smith's G in two factors."""
    density = alpha**2 / (np.pi * (cos_h**2 * (alpha**2 - 1) + 1) ** 2)

    def masking(cosine: Floats | float) -> Floats:
        return np.asarray(2 / (1 + np.sqrt(1 + alpha**2 * (1 / np.square(cosine) - 1))))

    inside = np.sqrt(1 - (1 - cos_d**2) / IOR**2)
    across = (cos_d - IOR * inside) / (cos_d + IOR * inside)
    along = (IOR * cos_d - inside) / (IOR * cos_d + inside)
    fresnel = (across**2 + along**2) / 2
    return np.asarray(fresnel * density * masking(cos_i) * masking(cos_o) / (4 * cos_o))


def half_width(theta: Floats, radiance: Floats) -> float:
    """Return where a falling profile that begins on the axis reaches half of its first value, rad; NaN if nowhere."""
    below = np.flatnonzero(radiance < radiance[0] / 2)
    if not len(below):
        return math.nan
    last = below[0]
    inner, outer = radiance[last - 1], radiance[last]
    share = (inner - radiance[0] / 2) / (inner - outer)
    return float(theta[last - 1] + share * (theta[last] - theta[last - 1]))


def expected_half_width(case: Case, radius: float) -> float:
    """Return the half-width, rad, that numerical convolution with a disc of a radius, mm, gives."""
    start = lobe_scale(case) + 1.2 * radius / (2 * case.distance)
    theta = np.linspace(0, min(4 * start, 1.4), 160)
    rough = half_width(theta, lobe_radiance(case, radius, theta))
    # Once more, with the axis and the neighbourhood of the crossing alone.
    fine = np.concatenate([[0.0], np.linspace(0.95 * rough, 1.05 * rough, 41)])
    return half_width(fine, lobe_radiance(case, radius, fine))


def lobe_scale(case: Case) -> float:
    """Return the lobe's half-width roughly, rad."""
    return ROOT_2LN2 / (2 * math.sqrt(case.value)) if case.lobe == "phong" else 0.7 * case.value


def scene(case: Case, radius: float, samples: int, reach: float) -> Scene:
    """Describe a strip of the plane up to the sightline `reach`, rad, lit by a disc, or by a point of radius 0."""
    focal = PIXELS / 2 / math.tan(reach)
    reflectance = {"type": "phong", "exponent": case.value}
    if case.lobe == "ggx":
        reflectance = {"type": "rough_plastic", "alpha": case.value}
    light = {"source": {"type": "disc", "radius_mm": radius}} if radius else {}
    return scene_from_dict(
        {
            "surface": {"type": "plane", "distance_mm": case.distance},
            "reflectance": reflectance,
            "rig": {"lights": [light]},
            "camera": {"width": PIXELS, "height": PIXELS, "fx": focal, "fy": focal},
            "render": {"samples_per_pixel": samples},
        }
    )


@dataclass(frozen=True)
class Rendered:
    """What a frame shows, rad."""

    half_width: float
    deviation: float
    """Standard deviation per axis of the half-angle, of the lobe's light that reaches the frame."""


def rendered(session: Session, case: Case, radius: float, samples: int, reach: float) -> Rendered:
    """Render a case and measure the highlight in the mean over rings of one pixel's width about the axis."""
    described = scene(case, radius, samples, reach)
    session.update(described)
    lobe = session.radiance().specular.astype(float)
    lobe = lobe if lobe.ndim == 2 else lobe.mean(axis=-1)
    y, x = np.mgrid[:PIXELS, :PIXELS] - (PIXELS - 1) / 2
    radii = np.hypot(x, y)
    rings = np.rint(radii).astype(int)
    inside = rings <= PIXELS // 2
    count = np.bincount(rings[inside])
    means = np.bincount(rings[inside], lobe[inside]) / count
    theta = np.arctan(np.bincount(rings[inside], radii[inside]) / count / described.camera.fx)
    # A single pixel on the axis would carry its noise into every width.
    top = theta < TOP * reach / REACH
    curve = np.polynomial.Polynomial.fit(theta[top] ** 2, means[top], 1, w=np.sqrt(count[top]))
    means[0] = curve(0.0)
    weights = means * np.gradient(theta) * theta
    return Rendered(half_width(theta, means), math.sqrt(float(weights @ theta**2 / weights.sum() / 2)))


@dataclass(frozen=True)
class Row:
    """Half-widths of a case, rad, and the variance that the disc adds over that of the law."""

    case: Case
    expected: float
    point: float
    fixed: float
    drawn: float
    added: float


def measure(session: Session, case: Case) -> Row:
    """Measure a case: with one sample a pixel (fixed points) and with 16 (drawn ones)."""
    expected = expected_half_width(case, case.radius)
    reach = min(REACH * expected, 1.2)
    fixed = rendered(session, case, case.radius, 1, reach)
    drawn = rendered(session, case, case.radius, 16, reach)
    point = rendered(session, case, 0.0, 1, min(REACH * expected_half_width(case, 0.0), 1.2))
    # Of the same part of the lobe.
    wide = rendered(session, case, 0.0, 1, reach)
    added = (fixed.deviation**2 - wide.deviation**2) / case.law_rad**2
    return Row(case, expected, point.half_width, fixed.half_width, drawn.half_width, added)


@pytest.fixture(scope="module")
def session():
    return Session(scene(CASES[0], CASES[0].radius, 1, 0.5))


@pytest.mark.parametrize("case", CASES, ids=str)
def test_widths_are_those_of_numerical_convolution(session, case):
    """Within 3 %, from fixed points and from drawn ones; a point light's width is refuted."""
    row = measure(session, case)
    assert abs(row.fixed / row.expected - 1) < BOUND
    assert abs(row.drawn / row.expected - 1) < BOUND
    assert abs(row.point / row.expected - 1) > BOUND
    if case.lobe == "phong":
        # The disc adds (r / 4 d)^2 to the variance of the half-angle; the rest is the cut at the frame's rim.
        assert row.added == pytest.approx(1, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("lobe", ["phong", "rough plastic"])
def test_frames_are_those_of_mitsubas_area_light(session, tmp_path, lobe):
    """Blocks of 6 x 6 pixels by z-scores from independent seeds, and the same frames of a disc 10 % smaller refuted."""
    reflectances = {
        "phong": {"type": "phong", "exponent": 60.0, "diffuse": 0.3},
        "rough plastic": {"type": "rough_plastic", "alpha": 0.15},
    }
    seeds, block = 10, 6

    def described(radius, seed=0):
        light = {
            "position_mm": [1.5, -1.0, -0.8], "direction": [-0.15, 0.1, 1.0], "power": 2.0,
            "profile": {"type": "cosine", "power": 1.0}, "source": {"type": "disc", "radius_mm": radius},
        }  # fmt: skip
        return scene_from_dict(
            {
                "surface": {"type": "sphere", "radius_mm": 9.0, "tilt_deg": 10.0}, "reflectance": reflectances[lobe],
                "rig": {"lights": [light]}, "camera": {"width": 72, "height": 60, "fx": 60.0, "fy": 60.0},
                "render": {"samples_per_pixel": 64, "seed": seed},
            }
        )  # fmt: skip

    def blocks(image):
        image = image if image.ndim == 2 else image.mean(axis=-1)
        height, width = image.shape
        return image.astype(float).reshape(height // block, block, width // block, block).mean(axis=(1, 3)).ravel()

    def ours(radius):
        frames = []
        for seed in range(seeds):
            session.update(described(radius, seed))
            frames.append(blocks(session.radiance().total))
        return np.array(frames)

    def scores(frames):
        error = np.sqrt((frames.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / seeds)
        lit = theirs.mean(axis=0) > 1e-3 * theirs.mean()
        return ((frames.mean(axis=0) - theirs.mean(axis=0))[lit]) / error[lit]

    plugins.register()
    file = simtest.export(described(3.0), tmp_path)[0]
    loaded = session.mi.load_file(str(file))
    theirs = np.array([blocks(np.array(session.mi.render(loaded, spp=512, seed=100 + seed))) for seed in range(seeds)])
    right, wrong = scores(ours(3.0)), scores(ours(2.7))
    # The largest of all blocks by Bonferroni, Student's t of both samples.
    limit = stats.t.ppf(1 - 0.005 / len(right), 2 * seeds - 2)
    assert len(right) > 50
    assert np.abs(right).max() < limit
    assert np.abs(right.mean()) < 4 / np.sqrt(len(right))
    assert np.abs(wrong).max() > limit
