"""Detection as the studies measure it: on rendered frames, and on real ones that were outlined by hand."""

from collections import defaultdict

import numpy as np
import pytest

from simtest.calibration import srgb_encode
from simtest.detection.detector import Highlight, Kind, Region
from simtest.reconstruction import reconstruct
from simtest.rendering import Session
from simtest.spec import load_scene
from studies.detection.__main__ import measured
from studies.detection.frames import SPLITS, study_frames
from studies.detection.overlays import OverlayCounts, overlay_counts
from studies.detection.real_frames import inside_outlines, outlined_frames, score_frame
from studies.detection.tissue import Counts, TissueFrame, detected_peaks
from studies.detection.tissue import score_frame as score_tissue
from studies.detection.truth import specular_truth


@pytest.mark.slow
@pytest.mark.render
def test_detection_keeps_its_promise():
    scores = measured(18)["all"]
    assert scores.f1 >= 0.90
    assert scores.dice >= 0.85


@pytest.mark.slow
@pytest.mark.render
def test_study_frames_are_the_same_again_and_their_anatomies_disjoint(tmp_path):
    first = [next(study_frames("tuning", 6, tmp_path / f"{k}")) for k in range(2)]
    np.testing.assert_array_equal(first[0].picture, first[1].picture)
    frame = first[0]
    assert frame.name == f"colon_{SPLITS['tuning']}-0"
    assert abs(SPLITS["figures"] - SPLITS["tuning"]) > 100
    truth = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen)
    wider = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen, peak_share=0.05)
    assert truth.count > 0
    # Less of the peak is asked for: the mask can only grow, by highlights too that were too small before.
    assert not (truth.mask & ~(wider.mask | wider.unclear)).any()


@pytest.mark.render
@pytest.mark.parametrize("radius", [4.0, 30.0])
def test_normals_through_a_clipped_8_bit_picture_of_a_tilted_sphere(radius):
    settings = {"surface.radius_mm": radius, "surface.tilt_deg": 15.0, "surface.azimuth_deg": 40.0,
                "reflectance.diffuse": 0.5}  # fmt: skip
    scene = load_scene("sphere", settings)
    session = Session(scene)
    radiance = session.radiance()
    (truth,) = [h for h in session.highlights(radiance) if h.lit]
    tissue = radiance.diffuse[:, :, None] * np.array([1.0, 0.5, 0.4], dtype=np.float32)
    linear = tissue / (2.5 * tissue.max()) + radiance.specular[:, :, None] / (0.7 * radiance.specular.max())
    linear += np.random.default_rng(0).normal(0, 0.004, linear.shape)
    picture = (np.rint(255 * srgb_encode(np.clip(linear, 0, 1))) / 255).astype(np.float32)
    made = reconstruct(picture, session.camera, detector="colour", encoding="srgb")
    (spot,) = made
    assert made.detection.highlights[0].kind is Kind.ISOLATED
    for name, most in (("cone_axis", 0.1), ("brightest_point", 0.5)):
        estimate = spot.estimates[name]
        assert np.degrees(np.arccos(min(1.0, estimate.normal @ truth.normal))) < most


# Frames that were outlined by hand ------------------------------------------------------------------------------------


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


def test_few_answers_stand_on_what_is_drawn_and_little_tissue_is_hidden(shared_data):
    """Frames that were developed on; the manual has the figures of the others."""
    counts = [made for _, developed_on, made in overlay_counts(shared_data / "frames" / "kvasir") if developed_on]
    if not counts:
        pytest.skip("no frames in ../shared/data/frames/kvasir")
    made = sum(counts, OverlayCounts())
    assert made.kept_on_overlays > 0.15 * made.kept
    assert made.on_overlays <= 0.01 * made.answered
    assert made.hidden <= 0.01 * made.tissue


def highlight(x, y, radius, *more):
    angle = np.linspace(0, 2 * np.pi, 25)
    outline = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], axis=1)
    peaks = np.array([(int(x), int(y)), *more])
    kind = Kind.CLUSTER if more else Kind.ISOLATED
    area = round(np.pi * radius**2)
    return Highlight(Region((0, 0, 9, 9), (int(x), int(y)), 1.0), kind, area, 1.0, 0.0, 0.0, 1.0, 0.0, outline, peaks)


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
        columns[4] > 0, regions,
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


def test_a_cluster_s_peaks_share_its_area():
    points, radii = detected_peaks([highlight(20, 20, 6.0, (28, 20))])
    assert points.tolist() == [[20.5, 20.5], [28.5, 20.5]]
    np.testing.assert_allclose(radii, 6.0 / np.sqrt(2), rtol=0.01)
