"""The published pipeline against a slow, plain one, and against the article's statements."""

import numpy as np
import pytest
import scipy.linalg
from scipy.ndimage import gaussian_filter
from skimage.measure import find_contours

from simtest.errors import Failure
from simtest.spec.recipes import PaperSetting
from simtest.validation.paper.protocol import Pipeline, draw_light, kernel_radius, region_of_interest


def generator(number):
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(number)))


def error_deg(setting, candidates):
    cosines = np.clip([c @ setting.normal for c in candidates], -1, 1)
    sines = [np.linalg.norm(np.cross(c, setting.normal)) for c in candidates]
    return np.degrees(np.arctan2(sines, cosines)).min()


def plain(setting, rng):
    """One realisation, step by step on the whole picture, from the article's text; the better candidate's error."""
    size, V = setting.size, np.array([0.0, 0.0, setting.height])
    L = draw_light(setting, rng) if setting.eps else V
    # Stage 1: the texture of the specular term.
    centre = V[:2] + (L[:2] - V[:2]) * V[2] / (V[2] + L[2])
    side = np.arange(size) + 0.5 - size / 2
    X, Y = np.meshgrid(side + centre[0], side + centre[1])
    P = np.stack([X, Y, 0 * X], axis=-1)
    view, light = V - P, L - P
    mirror = light * [-1, -1, 1]
    cosine = np.sum(mirror * view, axis=-1) / np.linalg.norm(mirror, axis=-1) / np.linalg.norm(view, axis=-1)
    texture = np.maximum(cosine, 0) ** setting.exponent
    # Stage 2: seen slanted; each pixel's ray is cut with the plane, the texture read bilinearly.
    theta = np.radians(setting.theta_deg)
    u, v = np.meshgrid(side / size, side / size)
    depth = setting.height * np.cos(theta) / (np.cos(theta) - v * np.sin(theta))
    x, y = u * depth, v * depth / np.cos(theta)
    column, row = x + size / 2 - 0.5, y + size / 2 - 0.5
    seen = (depth > 0) & (column >= 0) & (column <= size - 1) & (row >= 0) & (row <= size - 1)
    i, j = (np.clip(np.floor(a), 0, size - 2).astype(int) for a in (row, column))
    a, b = row - i, column - j
    frame = (1 - a) * ((1 - b) * texture[i, j] + b * texture[i, j + 1])
    frame += a * ((1 - b) * texture[i + 1, j] + b * texture[i + 1, j + 1])
    frame = np.where(seen, frame, 0.0)
    # Noise, drawn for the region of interest and the kernel's margin about it.
    x0, y0, width, height = region_of_interest(setting)
    margin = kernel_radius(setting)
    rows = slice(max(y0 - margin, 0), min(y0 + height + margin, size))
    columns = slice(max(x0 - margin, 0), min(x0 + width + margin, size))
    shape = (rows.stop - rows.start, columns.stop - columns.start)
    frame[rows, columns] += setting.sigma * rng.standard_normal(shape, dtype=np.float32)
    # Stage 3: smoothing, normalisation, isophote, ellipse, pose.
    frame = gaussian_filter(frame, setting.smoothing_px, mode="reflect", radius=margin)
    region = frame[y0 : y0 + height, x0 : x0 + width]
    region = region / region.max()
    best = None
    peak = np.array(np.unravel_index(region.argmax(), region.shape))
    for contour in find_contours(region, setting.isovalue):
        closed = (contour[0] == contour[-1]).all()
        if closed and _winds(contour - peak) and (best is None or _area(contour) > _area(best)):
            best = contour
    if best is None:
        return None
    points = best[:-1, ::-1] + 0.5 + [x0, y0]
    return error_deg(setting, _pose(_ellipse((points - size / 2) / size)))


def _winds(points):
    angle = np.unwrap(np.arctan2(points[:, 0], points[:, 1]))
    return abs(angle[-1] - angle[0]) > np.pi


def _area(points):
    p = points - points[0]
    return abs(np.sum(p[:-1, 1] * p[1:, 0] - p[1:, 1] * p[:-1, 0])) / 2


def _ellipse(w):
    """Fitzgibbon's generalised eigenproblem as published, on centred and scaled points; the cone C'."""
    centre, scale = w.mean(axis=0), w.std()
    x, y = ((w - centre) / scale).T
    D = np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1)
    constraint = np.zeros((6, 6))
    constraint[0, 2] = constraint[2, 0] = 2
    constraint[1, 1] = -1
    values, vectors = scipy.linalg.eig(np.linalg.solve(D.T @ D, constraint))
    a, b, c, d, e, f = np.real(vectors[:, np.argmax(np.real(values))])
    C = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])
    T = np.array([[1 / scale, 0, -centre[0] / scale], [0, 1 / scale, -centre[1] / scale], [0, 0, 1]])
    return T.T @ C @ T


def _pose(cone):
    values, vectors = np.linalg.eigh(cone if np.linalg.det(cone) < 0 else -cone)
    l3, l2, l1 = values
    e3, e1 = vectors[:, 0], vectors[:, 2]
    e3 = e3 if e3[2] > 0 else -e3
    g, h = np.sqrt((l1 - l2) / (l1 - l3)), np.sqrt((l2 - l3) / (l1 - l3))
    return [-(g * e1 + h * e3), -(-g * e1 + h * e3)]


def random_setting(number):
    rng = np.random.default_rng(number)
    return PaperSetting(
        eps=float(rng.choice([0.0, rng.uniform(0, 150)])),
        size=int(rng.integers(96, 200)),
        height=float(rng.uniform(300, 600)),
        exponent=float(rng.uniform(40, 120)),
        sigma=float(rng.uniform(0, 0.06)),
        isovalue=float(rng.uniform(0.1, 0.8)),
        theta_deg=float(rng.uniform(20, 70)),
        smoothing_px=float(rng.uniform(1.0, 3.0)),
    )


def test_pipeline_agrees_with_the_plain_one():
    answered = 0
    for number in range(200):
        setting = random_setting(number)
        expected = plain(setting, generator(number))
        result = Pipeline(setting).realise([generator(number)])["circle_pose"][0]
        if expected is None:
            assert isinstance(result, Failure), number
            continue
        assert not isinstance(result, Failure), (number, result)
        assert error_deg(setting, result.candidates) == pytest.approx(expected, abs=1e-6), number
        answered += 1
    assert answered > 120


def mean_error(count, **values):
    setting = PaperSetting(**values)
    pipeline = Pipeline(setting)
    results = pipeline.realise(generator(number) for number in range(count))["circle_pose"]
    return np.mean([error_deg(setting, r.candidates) for r in results if not isinstance(r, Failure)])


def test_error_grows_with_noise_and_stays_below_the_published_bound():
    errors = [mean_error(60, sigma=sigma) for sigma in (0.0, 0.05, 0.1)]
    assert errors == sorted(errors)
    assert errors[-1] < 1.25


def test_error_is_least_at_a_middle_isovalue():
    low, middle, high = (mean_error(60, isovalue=t) for t in (0.05, 0.45, 0.8))
    assert middle < low
    assert middle < high


def test_an_ill_posed_setting_gives_failures():
    pipeline = Pipeline(PaperSetting(theta_deg=89.0))
    assert isinstance(pipeline.realise([generator(0)])["circle_pose"][0], Failure)
