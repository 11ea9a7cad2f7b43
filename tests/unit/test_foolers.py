"""The study of foolers: its scenes, when a maximum counts as a highlight, and how it counts."""

import math
from pathlib import Path

import numpy as np
import pytest

from simtest.detection.score import LEAST_SCORE
from simtest.geometry import Patch, smooth
from simtest.spec import load_scene
from studies.foolers import SLOW, TESTED, TRAINED, Detected, auc, is_highlight, summary

SCENES = Path(__file__).parents[2] / "scenes" / "foolers"
Y, X = np.mgrid[:80, :80] + 0.5 - 40


def dome(width):
    return np.exp(-(X**2 + Y**2) / (2 * width**2)).astype(np.float32)


def test_each_kind_is_a_scene_and_no_kind_is_both_trained_and_tested():
    assert {path.stem for path in SCENES.glob("*.toml")} == {*TRAINED, *TESTED, *SLOW}
    assert not {*TRAINED} & {*TESTED}


@pytest.mark.parametrize("kind", [*TRAINED, *TESTED, *SLOW])
def test_a_scene_is_sound(kind):
    assert load_scene(SCENES / f"{kind}.toml").camera.width > 0


@pytest.mark.parametrize(
    ("lobe", "base", "counts"),
    [
        (dome(4), np.full_like(X, 0.3), True),
        (0.3 * dome(10), 0.7 * dome(10), False),
        (0.6 * dome(10), 0.4 * dome(10), True),
        (0 * dome(10), dome(10), False),
        # A broad base's rise is larger, but not from around the highlight.
        (0.5 * dome(2), 0.5 * dome(60), True),
    ],
)
def test_a_highlight_is_what_the_lobe_makes(lobe, base, counts):
    light = (lobe + base).astype(np.float32)
    patch = Patch.cut(smooth(light, 1.0), (5, 5, 70, 70), smoothing_px=1.0)
    assert is_highlight(patch, light, lobe.astype(np.float32)) is counts


def test_auc_is_the_chance_of_the_right_order():
    true = np.array([True, True, False, False])
    assert auc(np.array([0.9, 0.8, 0.2, 0.1]), true) == 1.0
    assert auc(np.array([0.5, 0.5, 0.5, 0.5]), true) == 0.5
    assert auc(np.array([0.9, 0.1, 0.8, 0.2]), true) == 0.5
    assert math.isnan(auc(np.ones(2), np.ones(2, dtype=bool)))


@pytest.mark.parametrize(
    ("error", "stated", "wrong"), [(20, 2, True), (20, 7, False), (4, 0.1, False), (math.nan,) * 2 + (False,)]
)
def test_wrong_and_sure(error, stated, wrong):
    assert Detected("convex", None, None, True, error, stated).is_wrong_and_sure is wrong


def test_the_table_counts_what_passes():
    low, high = LEAST_SCORE / 2, (1 + LEAST_SCORE) / 2
    cases = [(True, high, False), (True, low, False), (False, low, True), (False, high, True)]
    rows = [{"true": t, "score": s, "wrong_and_sure": w, "answered": True} for t, s, w in cases]
    line = summary("kind", rows)
    assert line[:3] == ["kind", "2", "2"]
    assert line[4:] == ["4", "2 (50.0 %)", "2", "1 (50.0 %)", "1 (50.0 %)", "1 (50.0 %)"]
