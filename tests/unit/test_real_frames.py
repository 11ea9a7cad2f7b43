"""Detection on the real frames that were outlined by hand, and how the studies score it."""

from collections import defaultdict

import numpy as np
import pytest

from simtest.detection.detector import Highlight, Kind, Region
from studies.detection.real_frames import inside_outlines, outlined_frames, score_frame
from studies.detection.tissue import Counts, detected_peaks, size_class
from studies.detection.tissue import score_frame as score_tissue
from studies.detection.tissue_frames import TissueFrame


def test_outlined_frames_are_covered_and_nothing_else_is_marked(shared_data):
    from simtest.reconstruction import detect_in_picture

    scores = {
        frame.name: score_frame(frame, detect_in_picture(frame.picture))
        for frame in outlined_frames(shared_data / "frames")
    }
    assert len(scores) == 8
    for name, made in scores.items():
        assert made.marks.get("instrument", 0) == made.marks.get("text", 0) == made.marks["border"] == 0, name
        assert made.marks.get("vessel", 0) == made.empty == 0, name
    assert scores["no_highlight_simcol_0001.png"].count == 0
    assert np.nanmedian([made.covered for made in scores.values()]) >= 0.8
    assert np.nanmedian([made.iou for made in scores.values()]) >= 0.65
    assert np.nanmin([made.covered for made in scores.values()]) >= 0.55


def highlight(x, y, radius, *more):
    angle = np.linspace(0, 2 * np.pi, 25)
    outline = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    peaks = np.array([(int(x), int(y)), *more])
    kind = Kind.CLUSTER if more else Kind.ISOLATED
    area = round(np.pi * radius**2)
    return Highlight(
        Region((0, 0, 9, 9), (int(x), int(y)), 1.0), kind, 1.0, area, 1.0, 0.0, 0.0, 1.0, 0.0, outline, peaks
    )


def test_outlines_are_filled_where_they_are():
    inside = inside_outlines([highlight(20.0, 15.0, 5.0)], (30, 40))
    y, x = np.mgrid[:30, :40] + 0.5
    away = np.hypot(x - 20, y - 15)
    assert inside[away < 4.6].all()
    assert not inside[away > 5.4].any()


def tissue_frame(*spots):
    """A frame of round visible highlights: position, radius, clearness, whole."""
    y, x = np.mgrid[:60, :80] + 0.5
    regions = np.zeros(x.shape, dtype=np.int32)
    for i, (column, row, radius, *_) in enumerate(spots):
        regions[np.hypot(x - column, y - row) <= radius] = i + 1
    columns = [np.array([spot[i] for spot in spots], dtype=float) for i in range(5)]
    return TissueFrame(
        "colon 1", np.zeros((60, 80, 3), np.uint8), np.stack(columns[:2], axis=1), columns[2], columns[3],
        columns[4] > 0, np.zeros(len(spots)), regions,
    )  # fmt: skip


def test_peaks_are_matched_to_visible_highlights_once_each():
    frame = tissue_frame((20, 20, 3.0, 50, 1), (28, 20, 3.0, 50, 1), (60, 40, 5.0, 50, 1), (70, 10, 2.0, 3, 1))
    counts = defaultdict(Counts)
    # a cluster of both touching ones, one split in two, a false one, and one on what need not be found
    found = [highlight(20, 20, 6.0, (28, 20)), highlight(59, 40, 3.0), highlight(62, 41, 3.0), highlight(40, 50, 1.5)]
    score_tissue(frame, [*found, highlight(70, 10, 2.0)], counts)
    assert {k: (c.hits, c.false, c.missed) for k, c in counts.items()} == {1: (2, 1, 0), 2: (1, 0, 0), 0: (0, 1, 0)}
    missed = defaultdict(Counts)
    score_tissue(frame, [], missed)
    assert {k: c.missed for k, c in missed.items()} == {1: 2, 2: 1}
    assert np.isnan(Counts().f1)
    assert Counts(2, 1, 1).f1 == pytest.approx(4 / 6)


@pytest.mark.parametrize(("radius", "number"), [(0.9, -1), (1.0, 0), (3.9, 1), (4.0, 2), (20.0, 3)])
def test_classes_of_size(radius, number):
    assert size_class(radius) == number


def test_a_cluster_s_peaks_share_its_area():
    points, radii = detected_peaks([highlight(20, 20, 6.0, (28, 20))])
    assert points.tolist() == [[20.5, 20.5], [28.5, 20.5]]
    np.testing.assert_allclose(radii, 6.0 / np.sqrt(2), rtol=0.01)
