"""Isophotes of analytic images: where they lie, to a hundredth of a pixel, and when there is none."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import binary_dilation, label
from skimage.measure import find_contours

from simtest.errors import Failure, InputError, Reason
from simtest.geometry import Patch, ellipse_of_conic, fit_ellipse, smooth
from simtest.geometry.patch import encloses

WIDTH, HEIGHT = 90, 70
CENTRE = np.array([41.3, 33.8])
SIGMA = 9.0


def centres():
    """Pixel centres: column i, row j lies at (i + 0.5, j + 0.5)."""
    return np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)


def spot(centre=CENTRE, sigma=SIGMA, stretch=1.0):
    x, y = centres()
    squared = ((x - centre[0]) / stretch) ** 2 + (y - centre[1]) ** 2
    return np.exp(-squared / (2 * sigma**2)).astype(np.float32)


def patch_of(image, box=None, peak=None):
    patch = Patch.cut(image, box or (0, 0, image.shape[1], image.shape[0]), peak)
    assert isinstance(patch, Patch)
    return patch


@pytest.mark.parametrize(("box", "t"), [(None, 0.3), ((5, 3, 80, 60), 0.5), ((11, 10, 60, 50), 0.7)])
def test_contour_of_a_radial_image_lies_where_the_formula_says(box, t):
    """A shift of half a pixel, or x and y exchanged, would be 20 times the tolerance or more."""
    image = spot()
    patch = patch_of(image, box)
    points = patch.isophote(t)
    radius = SIGMA * np.sqrt(-2 * np.log(t * patch.peak_value))
    distance = np.linalg.norm(points - CENTRE, axis=1)
    # Marching squares interpolates linearly: off by f''/(8 f') along the radius and by 1/(8 r) along the contour.
    assert np.abs(distance - radius).max() < (1 / radius + abs(radius / SIGMA**2 - 1 / radius)) / 8 < 0.025
    fitted = ellipse_of_conic(fit_ellipse(points[:-1]).image)
    np.testing.assert_allclose(fitted.centre, CENTRE, atol=1e-3)
    np.testing.assert_allclose([fitted.semi_major, fitted.semi_minor], radius, atol=0.015)
    np.testing.assert_array_equal(points[0], points[-1])


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.5, 0.9])
def test_peak_is_found_between_pixels(shift):
    centre = CENTRE + np.array([shift, -0.7 * shift])
    patch = patch_of(spot(centre))
    np.testing.assert_allclose(patch.peak_px, centre, atol=2e-3)
    assert patch.peak_value == spot(centre).max()
    moved = patch_of(spot(centre), (20, 10, 50, 50))
    np.testing.assert_allclose(moved.peak_px, patch.peak_px, atol=1e-12)


def test_peak_at_the_border_keeps_its_pixel():
    patch = patch_of(spot((0.5, 30.5)))
    np.testing.assert_allclose(patch.peak_px, [0.5, 30.5], atol=1e-3)
    assert patch_of(spot((-3, 30.5))).peak_px[0] == 0.5


def test_a_given_peak_and_the_brightest_pixel():
    image = spot((25, 35), 4) + 2 * spot((65, 35), 4)
    assert patch_of(image).peak_px[0] == pytest.approx(65, abs=0.01)
    dim = patch_of(image, (0, 0, WIDTH, HEIGHT), (25, 35))
    assert dim.peak_px[0] == pytest.approx(25, abs=0.01)
    assert dim.peak_value == pytest.approx(1, abs=0.02)
    points = dim.isophote(0.5)
    np.testing.assert_allclose(points.mean(axis=0), [25, 35], atol=0.2)


def test_the_isophote_is_the_outer_border_of_the_region_that_holds_the_peak():
    """A bump beside the peak has a border of its own."""
    image = spot((45, 35), 10) + 0.55 * spot((12, 12), 3)
    points = patch_of(image).isophote(0.5)
    assert encloses(points, np.array([45, 35.0]))
    np.testing.assert_allclose(points.mean(axis=0), [45, 35], atol=0.3)
    # Of a ring around the peak with a dark trench between them, the peak's own border is taken ...
    x, y = centres()
    radius = np.hypot(x - 45, y - 35)
    ring = (np.exp(-(radius**2) / 18) + 0.8 * np.exp(-((radius - 15) ** 2) / 8)).astype(np.float32)
    assert np.hypot(*(patch_of(ring, None, (44, 34)).isophote(0.5) - [45, 35]).T).max() < 6
    # ... and of a region with a dark hole the outer one.
    holed = spot((45, 35), 10)
    holed[36:39, 41:43] = 0
    np.testing.assert_array_equal(patch_of(holed).isophote(0.5), patch_of(spot((45, 35), 10)).isophote(0.5))


@given(number=st.integers(0, 2**32 - 1), t=st.floats(0.05, 0.95), width=st.floats(0.6, 3.0))
def test_crossings_are_the_points_of_marching_squares(number, t, width):
    """On noise alone, where regions have holes, corners that touch and neighbours of all kinds."""
    rng = np.random.default_rng(number)
    image = smooth(rng.standard_normal((40, 50)), width) + 0.2 * smooth(spot()[:40, :50], width)
    patch = patch_of(image, (0, 0, 50, 40))
    if isinstance(patch, Failure):
        return
    polygon, points = patch.isophote(t), patch.crossings(t)
    contours = [c[:, ::-1] + 0.5 for c in find_contours(patch.values.astype(float), t * patch.peak_value)]
    around = [c for c in contours if (c[0] == c[-1]).all() and encloses(c, np.array(patch.peak_pixel) + 0.5)]
    if isinstance(points, Failure):
        # The region reaches the border: no closed contour is its outer border.
        reached = level_reaches_border(patch.values > t * patch.peak_value, patch.peak_pixel)
        assert isinstance(polygon, Failure)
        assert reached
        return
    assert any(same_points(c[:-1], points) for c in around)
    assert same_points(polygon[:-1], points)
    assert (polygon[0] == polygon[-1]).all()


@given(number=st.integers(0, 2**32 - 1), steps=st.integers(2, 16), width=st.floats(0.0, 3.0), data=st.data())
def test_crossings_of_a_quantised_image_are_each_there_once(number, steps, width, data):
    """Where pixels have the level's own value many lines cross the border in one point."""
    rng = np.random.default_rng(number)
    image = smooth(rng.standard_normal((40, 50)), width) + 1.5 * spot((25, 20), 5.0)[:40, :50]
    image = (np.rint(image / image.max() * steps) / steps).astype(np.float32)
    t = data.draw(st.integers(1, steps - 1)) / steps
    patch = patch_of(image, (0, 0, 50, 40))
    points, polygon = patch.crossings(t), patch.isophote(t)
    if isinstance(points, Failure):
        assert isinstance(polygon, Failure)
        return
    assert len(np.unique(np.round(points, 9), axis=0)) == len(points)
    assert same_points(np.unique(polygon, axis=0), points)
    assert (polygon[0] == polygon[-1]).all()
    # In order: from one point to the next within a cell, and on.
    steps_taken = np.linalg.norm(np.diff(polygon, axis=0), axis=1)
    assert 0 < steps_taken.min() <= steps_taken.max() <= np.sqrt(2) + 1e-6
    region = patch.inside(t)
    assert (encloses_all(polygon, np.argwhere(region)[:, ::-1] + 0.5)).all()


def encloses_all(polygon, points):
    return np.array([encloses(polygon, point) for point in points])


@given(
    number=st.integers(0, 2**32 - 1), t=st.floats(0.2, 0.9), x=st.floats(5, 45), y=st.floats(5, 35),
    radius=st.floats(4, 40),
)  # fmt: skip
def test_a_region_that_meets_what_is_not_seen_is_not_closed(number, t, x, y, radius):
    """Those of marching squares over the cells whose four corners are seen."""
    rng = np.random.default_rng(number)
    image = smooth(rng.standard_normal((40, 50)), 1.5) + 0.4 * smooth(spot()[:40, :50], 1.5)
    columns, rows = np.meshgrid(np.arange(50) + 0.5, np.arange(40) + 0.5)
    seen = np.hypot(columns - x, rows - y) <= radius
    image[~seen] = 0 if number % 2 else 5  # whatever lies there
    row, column = np.unravel_index(np.where(seen, image, -np.inf).argmax(), image.shape)
    patch = Patch.cut(image, (0, 0, 50, 40), (column, row), seen=seen)
    if isinstance(patch, Failure):
        return
    contours = find_contours(patch.values.astype(float), t * patch.peak_value, mask=seen)
    centre = np.array(patch.peak_pixel, dtype=float)
    around = [c[:, ::-1] for c in contours if (c[0] == c[-1]).all() and encloses(c[:, ::-1], centre)]
    points = patch.crossings(t)
    if isinstance(points, Failure):
        above = (patch.values > t * patch.peak_value) & seen
        labels, _ = label(above)
        own = binary_dilation(labels == labels[row, column], np.ones((3, 3)))
        assert (own & ~seen).any() or level_reaches_border(above, patch.peak_pixel)
        assert np.array_equal(patch.inside(t), seen)
        return
    assert any(same_points(c[:-1] + 0.5, points) for c in around)
    assert seen[patch.inside(t)].all()


def same_points(first, second):
    if len(first) != len(second):
        return False
    order = [np.lexsort(np.round(p, 6).T) for p in (first, second)]
    return bool(np.allclose(first[order[0]], second[order[1]], atol=1e-9))


def level_reaches_border(above, pixel):
    labels, _ = label(above)
    own = labels == labels[pixel[1], pixel[0]]
    return bool(own[0].any() or own[-1].any() or own[:, 0].any() or own[:, -1].any())


def test_open_contours_fail():
    for centre in ((3, 35), (45, 68), (88, 2)):
        result = patch_of(spot(centre)).isophote(0.5)
        assert isinstance(result, Failure)
        assert result.reason is Reason.NO_CLOSED_ISOPHOTE
    # The same spot closes higher up.
    near_edge = patch_of(spot((8, 35)))
    assert isinstance(near_edge.isophote(0.5), Failure)
    assert not isinstance(near_edge.isophote(0.8), Failure)
    # Closed in the frame but cut by the region.
    assert isinstance(patch_of(spot(), (35, 28, 14, 12)).isophote(0.5), Failure)


def test_a_region_too_thin_for_a_contour_fails():
    assert isinstance(patch_of(spot(), (30, 33, 20, 2)).isophote(0.5), Failure)


def test_what_has_no_peak_fails():
    flat = np.full((HEIGHT, WIDTH), 0.3, np.float32)
    dark = np.zeros((HEIGHT, WIDTH), np.float32)
    for image, reason in ((flat, Reason.NO_PEAK), (dark, Reason.NO_PEAK), (-spot() - 1, Reason.NO_PEAK)):
        result = Patch.cut(image, (0, 0, WIDTH, HEIGHT))
        assert isinstance(result, Failure)
        assert result.reason is reason
    holed = spot()
    holed[40, 40] = np.nan
    result = Patch.cut(holed, (0, 0, WIDTH, HEIGHT))
    assert isinstance(result, Failure)
    assert result.reason is Reason.NOT_FINITE
    assert isinstance(Patch.cut(holed, (0, 0, 30, 30)), Patch)


@pytest.mark.parametrize("t", [0.0, 1.0, -0.1, 2.0, float("nan")])
def test_isovalues_outside_the_open_interval_are_refused(t):
    with pytest.raises(InputError, match="isovalue"):
        patch_of(spot()).isophote(t)


def test_even_odd_rule():
    square = np.array([[0.0, 0], [4, 0], [4, 3], [0, 3], [0, 0]]) + 5000
    assert encloses(square, np.array([5001.0, 5001]))
    assert not encloses(square, np.array([5005.0, 5001]))
    assert not encloses(square, np.array([4999.0, 5001]))
    # A U: the notch is outside.
    u = np.array([[0.0, 0], [5, 0], [5, 5], [4, 5], [4, 1], [1, 1], [1, 5], [0, 5], [0, 0]])
    assert not encloses(u, np.array([2.5, 3]))
    assert encloses(u, np.array([0.5, 3]))


def test_several_isophotes_at_once_are_those_of_each_alone():
    y, x = np.mgrid[:60, :80] + 0.5
    values = np.exp(-((x - 22.3) ** 2) / 300 - (y - 30.6) ** 2 / 200)
    # In steps, so that borders pass through pixels whose value is the level, two of them through the same ones.
    values = np.round(values * 40) / 40
    isovalues = (0.7, 0.1, 0.5, 0.5 + 1e-9, 0.3)
    found = Patch.cut(values, (0, 0, 80, 60)).crossings_of(isovalues)
    alone = [Patch.cut(values, (0, 0, 80, 60)).crossings(t) for t in isovalues]
    assert [isinstance(each, Failure) for each in found] == [False, True, False, False, False]
    for each, other in zip(found, alone, strict=True):
        if isinstance(other, Failure):
            assert each == other
        else:
            np.testing.assert_array_equal(each, other)
