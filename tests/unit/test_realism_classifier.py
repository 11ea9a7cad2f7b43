"""The classifier of studies/realism_classifier.py: areas by counting, and what it tells of sets that are known."""

import cv2
import numpy as np
import pytest

from studies.realism_classifier import COLOURS, CROP_PX, auc, control, crops, features, fitted, same_way, separation


def test_area_is_the_share_of_ordered_pairs():
    rng = np.random.default_rng(0)
    low, high = rng.integers(0, 9, 40), rng.integers(2, 12, 25)
    wins = [(h > v) + 0.5 * (h == v) for v in low for h in high]
    assert auc(low.astype(float), high.astype(float)) == pytest.approx(np.mean(wins))


def test_regression_is_at_the_minimum_of_its_loss():
    rng = np.random.default_rng(1)
    rows, labels, weights = rng.standard_normal((60, 3)), rng.integers(0, 2, 60), rng.random(60) + 0.5
    slope = fitted(rows, labels, weights)

    def loss(slope, constant):
        chance = 1 / (1 + np.exp(-(rows @ slope + constant)))
        likelihood = np.where(labels == 1, chance, 1 - chance)
        return -(weights * np.log(likelihood)).sum() + 0.5 * (slope**2).sum()

    grid = np.linspace(-3, 3, 6001)
    best = min(loss(slope, c) for c in grid)
    for step in 0.02 * rng.standard_normal((20, 3)):
        assert min(loss(slope + step, c) for c in grid[::10]) > best - 1e-6


def scenes(count, shift, seed):
    rng = np.random.default_rng(seed)
    return {f"{i}": shift + 0.5 * rng.standard_normal(4) + rng.standard_normal((8, 4)) for i in range(count)}


def test_different_sets_are_told_apart_and_halves_of_one_are_not():
    value, low, high = separation(scenes(4, 0.0, 1), scenes(4, 3.0, 2))
    assert value > 0.95
    assert low <= value <= high
    middle, least, greatest = control(scenes(6, 0.0, 4))
    assert middle == pytest.approx(0.5, abs=0.2)
    assert least <= middle <= greatest < 0.9


def test_crops_hold_a_highlight_each_and_colour_stands_first():
    rng = np.random.default_rng(0)
    frame = np.clip(np.float32([0.62, 0.34, 0.28]) + 0.01 * rng.standard_normal((240, 320, 3)), 0, 1).astype(np.float32)
    for x, y in ((100, 90), (200, 150), (310, 230)):
        cv2.circle(frame, (x, y), 4, (1.0, 1.0, 1.0), -1)
    coded = same_way(frame, 200)
    assert coded.shape == (200, 267, 3)
    cut = crops(coded, 0)
    # The third lies too near to the border.
    assert len(cut) == 2
    assert all(crop.shape == (CROP_PX, CROP_PX, 3) and crop.max() > 240 for crop in cut)
    grey = np.repeat(cv2.cvtColor(cut[0], cv2.COLOR_RGB2GRAY)[..., None], 3, axis=2)
    first, second = features(cut[0]), features(grey)
    assert np.isfinite(first).all()
    assert np.abs(first[1:3] - second[1:3]).min() > 5
    assert first[COLOURS:] == pytest.approx(second[COLOURS:], abs=0.2)
