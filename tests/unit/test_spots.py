"""Highlights told apart by saddles: dots, wide spots, clusters, melted clipped light; text and instruments left out."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.measure import label
from skimage.morphology import local_maxima, reconstruction
from skimage.segmentation import watershed

from simtest.calibration import srgb_encode
from simtest.detection.classify import border_of
from simtest.detection.detector import Kind
from simtest.detection.spots import find_basins
from simtest.detection.view import find_foreign, find_view
from simtest.errors import Failure, Reason
from simtest.geometry import Camera
from simtest.geometry.patch import connected
from simtest.reconstruction import detect_in_picture, reconstruct
from simtest.simulation.highlights import SADDLE
from simtest.simulation.highlights import find_spots as visible_spots

WIDTH, HEIGHT = 240, 180
TISSUE = np.array([0.40, 0.20, 0.16])


def lobe(x0, y0, width, peak=1.0, along=None):
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return peak * np.exp(-0.5 * (((x - x0) / width) ** 2 + ((y - y0) / (along or width)) ** 2))


def picture(specular, tissue=TISSUE, noise=0.002, shade=0.6):
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    linear = (shade + 0.1 * np.sin(x / 60) * np.cos(y / 45))[..., None] * tissue + np.asarray(specular)[..., None]
    linear = np.clip(linear + rng.normal(0, noise, linear.shape), 0, 1)
    return (np.rint(255 * srgb_encode(linear)) / 255).astype(np.float32)


def found_in(specular, **how):
    return detect_in_picture(picture(specular, **how)).detection.highlights


def nearest(highlights, x, y):
    return min(highlights, key=lambda h: float(np.hypot(h.region.peak[0] + 0.5 - x, h.region.peak[1] + 0.5 - y)))


# Summits and saddles --------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_summits_are_the_maxima_whose_saddle_is_low_enough(seed):
    """The same as of the truth's list of visible highlights, which shares no code with them."""
    rng = np.random.default_rng(seed)
    light = cv2.GaussianBlur(rng.random((40, 50)).astype(np.float32), (0, 0), 2.0)
    light = (light - light.min()) / (light.max() - light.min()) + 0.05
    basins = find_basins(light, np.ones(light.shape, dtype=bool), np.zeros_like(light), 0.8, 0.0)
    spots = visible_spots(light, light)
    assert sorted(zip(basins.rows, basins.columns, strict=True)) == sorted(zip(spots.rows, spots.columns, strict=True))
    # every pixel belongs to a summit that is at least as bright
    assert basins.labels.min() == 1
    assert (light <= light[basins.rows, basins.columns][basins.labels - 1]).all()
    # a saddle is no higher than either of the summits that it parts
    low = light[basins.saddles[:, 0], basins.saddles[:, 1]]
    assert (low <= light[basins.rows, basins.columns][basins.pairs].min(axis=1)).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), st.integers(3, 30))
def test_visible_spots_are_the_summits_that_morphological_reconstruction_leaves(seed, levels):
    rng = np.random.default_rng(seed)
    light = cv2.GaussianBlur(rng.random((30, 40)).astype(np.float32), (0, 0), 1.5)
    light = np.round(levels * (light - light.min()) / np.ptp(light)) + 1  # with plateaus
    log = np.log(light.astype(float))
    flooded = reconstruction(log + np.log(SADDLE), log, method="dilation")
    summits, count = label(local_maxima(flooded), connectivity=2, return_num=True)
    # of each the first of its brightest pixels
    first = [int(np.argmax(np.where(summits == n, light, 0))) for n in range(1, count + 1)]
    spots = visible_spots(light, light)
    assert sorted(first) == sorted((spots.rows * light.shape[1] + spots.columns).tolist())


@pytest.mark.parametrize("apart", [30.0, 14.0])
def test_pixels_of_peaks_that_stand_alone_are_those_of_the_watershed(apart):
    """The watershed is left out where each connected part holds one peak: 30 px apart, not 14."""
    specular = (lobe(80.5, 90.5, 5.0) + lobe(80.5 + apart, 94.5, 4.0, 0.9)).astype(np.float32)
    spots = visible_spots(specular, specular)
    markers = np.zeros(specular.shape, dtype=int)
    markers[spots.rows, spots.columns] = [1, 2]
    half = specular[spots.rows, spots.columns] / 2
    owners = watershed(-specular, markers, mask=specular >= half.min())
    owners[specular < np.array([np.inf, *half])[owners]] = 0
    assert np.array_equal(spots.regions, owners)
    assert (len(np.unique(connected(specular >= half.min()))) == 3) == (apart == 30.0)


def test_a_plateau_has_one_summit_and_an_empty_mask_none():
    flat = np.zeros((9, 12), dtype=np.float32)
    flat[2:7, 3:9] = 1.0
    flat[4, 5:7] = 0.9
    whole = find_basins(flat, flat > 0, np.zeros_like(flat), 0.8, 0.0)
    assert len(whole.rows) == 1
    none = find_basins(flat, flat > 2, np.zeros_like(flat), 0.8, 0.0)
    assert len(none.rows) == len(none.pairs) == 0
    assert not none.labels.any()


def test_bumps_of_the_noise_are_no_summits():
    light = np.full((9, 30), 0.1, dtype=np.float32)
    light[4, 5], light[4, 20], light[4, 6:20] = 0.30, 0.24, 0.18
    at = {noise: len(find_basins(light, light > 0.15, 0 * light, 0.8, noise).rows) for noise in (0.0, 0.1)}
    assert at == {0.0: 2, 0.1: 1}


# What is found --------------------------------------------------------------------------------------------------------


def test_dots_of_a_pixel_are_found_as_small():
    at = [(40.5, 40.5), (120.5, 60.5), (200.5, 140.5)]
    found = found_in(sum(lobe(x, y, 0.8, 0.5) for x, y in at))
    assert [h.kind for h in found] == [Kind.SMALL] * 3
    for x, y in at:
        assert nearest(found, x, y).region.peak == (int(x), int(y))


@pytest.mark.parametrize("width", [6.0, 9.0, 12.0])
def test_wide_spots_of_half_the_light_of_pale_tissue_are_found(width):
    """Half again as bright as the tissue: below what was searched for once."""
    tissue = np.array([0.55, 0.42, 0.36])
    (spot,) = found_in(lobe(120, 90, width, 0.5 * 0.6 * tissue.mean()), tissue=tissue)
    assert spot.kind is Kind.ISOLATED
    assert np.hypot(spot.region.peak[0] - 119.5, spot.region.peak[1] - 89.5) < 3


def test_paler_tissue_that_is_no_brighter_is_no_highlight():
    _y, _x = np.mgrid[:HEIGHT, :WIDTH]
    frame = np.broadcast_to(0.6 * TISSUE, (HEIGHT, WIDTH, 3)).copy()
    rng = np.random.default_rng(0)
    ragged = cv2.GaussianBlur(rng.normal(size=(HEIGHT, WIDTH)), (0, 0), 4.0) > 0.03
    grey = np.full(3, 0.6 * TISSUE.mean() * 1.1)
    frame[ragged] = 0.4 * frame[ragged] + 0.6 * grey
    encoded = srgb_encode(np.clip(frame + rng.normal(0, 0.002, frame.shape), 0, 1)).astype(np.float32)
    assert detect_in_picture(encoded).detection.highlights == []


# Touching highlights --------------------------------------------------------------------------------------------------


def test_touching_highlights_are_one_cluster_that_no_estimator_answers_for():
    specular = sum(lobe(x, 90, 3.0, 0.5) for x in (108, 118, 128)) + lobe(40, 40, 4.0, 0.5)
    made = reconstruct(picture(specular), Camera.from_fov(60.0, WIDTH, HEIGHT), detector="colour", encoding="srgb")
    kinds = {highlight.kind: highlight for highlight in made.detection.highlights}
    assert set(kinds) == {Kind.ISOLATED, Kind.CLUSTER}
    cluster = kinds[Kind.CLUSTER]
    assert sorted(x for x, _ in cluster.peaks) == pytest.approx([107.5, 117.5, 127.5], abs=1.5)
    assert cv2.pointPolygonTest(cluster.outline.astype(np.float32), (113.0, 90.0), False) > 0
    (spot,) = [each for each in made if isinstance(each.patch, Failure)]
    for estimate in spot.estimates.values():
        assert isinstance(estimate, Failure)
        assert estimate.reason is Reason.CLUSTER
        assert estimate.detail.startswith("3 highlights touch")


def test_a_shoulder_leaves_the_brighter_highlight_alone():
    found = found_in(lobe(100, 90, 4.0, 0.6) + lobe(113, 90, 3.0, 0.3))
    assert nearest(found, 100, 90).kind is Kind.ISOLATED
    assert nearest(found, 113, 90).region.peak != nearest(found, 100, 90).region.peak


def test_melted_clipped_highlights_are_told_apart_by_their_outline_and_one_ellipse_is_one():
    two = found_in(lobe(100, 90, 3.0, 6.0) + lobe(115, 90, 3.0, 6.0))
    (cluster,) = two
    assert cluster.kind is Kind.CLUSTER
    assert len(cluster.peaks) == 2
    (single,) = found_in(lobe(100, 90, 4.0, 6.0, along=7.0))
    assert single.kind is Kind.CLIPPED
    assert len(single.peaks) == 1
    assert single.clipped > 0.5


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 1000))
def test_every_highlight_has_an_outline_and_the_marked_pixels(seed):
    rng = np.random.default_rng(seed)
    specular = sum(
        lobe(*rng.uniform((0, 0), (WIDTH, HEIGHT)), rng.uniform(0.7, 6), rng.uniform(0.1, 3)) for _ in range(25)
    )
    detection = detect_in_picture(picture(specular)).detection
    assert detection.highlights
    for highlight in detection.highlights:
        assert len(highlight.outline) >= 4
        np.testing.assert_allclose(highlight.outline[0], highlight.outline[-1])
        assert len(highlight.peaks) == 1 or highlight.kind is Kind.CLUSTER
        x, y = highlight.region.peak
        assert detection.mask[y, x]
        assert cv2.pointPolygonTest(highlight.outline.astype(np.float32), (x + 0.5, y + 0.5), True) >= -0.75


def test_the_border_of_pixels_runs_along_their_edges():
    mask = np.zeros((4, 6), dtype=bool)
    mask[1:3, 2:5] = True
    border = border_of(mask)
    assert cv2.contourArea(border.astype(np.float32)) == pytest.approx(6)
    assert border.min(axis=0).tolist() == [2, 1]
    assert border.max(axis=0).tolist() == [5, 3]


# What is no tissue ----------------------------------------------------------------------------------------------------


def test_burnt_in_text_is_not_marked_and_a_highlight_beside_it_is():
    frame = picture(lobe(200, 150, 3.0, 0.6))
    plain = [h.region.peak for h in detect_in_picture(frame).detection.highlights]
    written = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    for i, text in enumerate(("14/11/2012", "00:42:11", "CVP:6")):
        cv2.putText(written, text, (8, 40 + 22 * i), cv2.FONT_HERSHEY_SIMPLEX, 0.5, 255, 1, cv2.LINE_AA)
    share = written[..., None] / np.float32(255)
    frame = (1 - share) * frame + share * np.float32(0.9)
    assert [h.region.peak for h in detect_in_picture(frame).detection.highlights] == plain


def test_a_long_straight_streak_and_what_shines_beside_it_are_an_instrument_s():
    bright = np.zeros((300, 400), dtype=np.uint8)
    cv2.line(bright, (100, 60), (180, 120), 1, 2)
    cv2.circle(bright, (150, 80), 2, 1, -1)
    cv2.circle(bright, (300, 250), 4, 1, -1)
    foreign = find_foreign(bright > 0)
    assert foreign[90, 140]
    assert foreign[80, 150]
    assert not foreign[250, 300]
    # blobs and bent streaks are none
    bent = np.zeros_like(bright)
    cv2.ellipse(bent, (200, 150), (60, 40), 0, 0, 180, 1, 3)
    cv2.ellipse(bent, (60, 60), (30, 12), 0, 0, 360, 1, -1)
    assert not find_foreign(bent > 0).any()
    assert not find_foreign(np.zeros((5, 5), dtype=bool)).any()


def test_a_black_box_in_a_corner_and_black_bars_are_no_part_of_the_view():
    frame = picture(np.zeros((HEIGHT, WIDTH))) + np.float32(0.1)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    cut = np.minimum(x, WIDTH - x) + np.minimum(y, HEIGHT - y) < 40
    frame[cut] = 0.01
    frame[120:, :80] = 0.0
    seen = find_view(frame).seen
    assert seen is not None
    assert not seen[119:, :81].any()
    assert seen[60:110, 20:220].mean() > 0.95
    assert seen[120:150, 100:200].all()
    round_view = np.where((np.hypot(x - 120, y - 90) < 95)[..., None], frame + np.float32(0.1), np.float32(0.01))
    round_view[165:] = 0.0
    seen = find_view(np.clip(round_view, 0, 1).astype(np.float32)).seen
    assert seen is not None
    assert not seen[164:].any()
