"""The arithmetic of studies.learned_transfer: errors and refusals, pairing, overlap of regions, scores, kept frames."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from simtest.detection.detector import Region
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.geometry import Patch
from simtest.reconstruction import Specularity
from studies.detection.real_frames import OutlinedFrame
from studies.hard.cases import scene_of
from studies.hard.scenes import KINDS
from studies.learned_transfer import answers as answering
from studies.learned_transfer import frames, kept, real, tables
from studies.learned_transfer.answers import OK, Answer
from studies.learned_transfer.frames import FIRST, GUIDES, LENS, ONE_LIGHT, ROWS, HardFrame, hard_frames

ALL = {"all": tuple(row.name for row in ROWS)}


def a_frame(**changes):
    """Return a frame of a wall across the view with one visible highlight, whose only glint is tilted by 0.1 rad."""
    height, width = 24, 32
    normal = np.zeros((height, width, 3), dtype=np.float16)
    normal[..., 2] = -1
    normal[:, :4] = np.nan
    made = HardFrame(
        FIRST, GUIDES[0], np.full((height, width, 3), 90, dtype=np.uint8), normal,
        np.full((height, width), 20, dtype=np.float32), np.array([[15.5, 10.5]]),
        np.array([[math.sin(0.1), 0.0, -math.cos(0.1)]]),
    )  # fmt: skip
    return replace(made, **changes)


def an_estimate(angle=0.0, sd=0.05, target="base", **more):
    normal = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    return Estimate(normal, normal[None], np.array([15.5, 10.5]), covariance=sd**2 * np.eye(2), target=target, **more)


def a_specularity(estimates, peak=(15, 10)):
    values = np.random.default_rng(0).random((9, 9)).astype(np.float32)
    values[4, 4] = 3.0
    patch = Patch.cut(values, (0, 0, 9, 9), raw=values, noise=0.01, smoothing_px=1.0)
    return Specularity(Region((11, 6, 9, 9), peak, 1.0), patch, estimates)


def answer(estimator, spot, base_deg, scene=1, status=OK, row=GUIDES[0].name, inside=math.nan):
    return Answer(row, "plane", scene, spot, estimator, status, base_deg, inside=inside)


def test_every_row_is_a_picture_that_tells_its_lights():
    for number, row in itertools.product(range(FIRST, FIRST + len(KINDS)), ROWS):
        scene = scene_of(number, row)[1]
        assert scene.sensor.bits == 8
        lights = scene.calibration().priors.lights_mm
        assert len(lights) == (1 if row in ONE_LIGHT else 2)
        assert (scene.camera.distortion is not None) == (row in LENS)


def test_an_answer_is_judged_against_the_surface_that_it_states(monkeypatch):
    frame = a_frame()
    results = {
        "base": an_estimate(0.02),
        "fine": an_estimate(0.1, 0.001, "fine"),
        "refuses": Failure(Reason.NO_ESTIMATE, "unlike the network's training: features at 90, limit 80"),
        "sure": an_estimate(0.02, 0.001),
    }
    found = [a_specularity(results), a_specularity(results, (2, 10))]
    monkeypatch.setattr(answering, "reconstruct", lambda *arguments, **options: found)
    made = {each.estimator: each for each in answering.answers(frame, {})}
    assert len(list(answering.answers(frame, {}))) == len(results)  # nothing is known off the surface
    assert made["base"].base_deg == pytest.approx(math.degrees(0.02), abs=1e-6)
    assert made["base"].fine_deg == pytest.approx(math.degrees(0.08), abs=1e-6)
    assert (made["base"].inside, made["sure"].inside, made["fine"].inside) == (1, 0, 1)
    assert made["fine"].base_deg == pytest.approx(math.degrees(0.1), abs=1e-6)
    # On one scale with the errors, which are angles.
    assert made["fine"].stated_deg == pytest.approx(math.degrees(0.001) * math.sqrt(2))
    assert made["refuses"].status == "unlike the network's training: features"
    assert math.isnan(made["refuses"].base_deg)


def test_a_glint_is_known_only_near_its_visible_highlight_and_alone():
    frame = a_frame()
    assert answering.fine_at(frame, np.array([16.5, 10.5])) is not None
    assert answering.fine_at(frame, np.array([18.5, 10.5])) is None
    assert answering.fine_at(replace(frame, fine=np.full((1, 3), np.nan)), np.array([15.5, 10.5])) is None
    assert answering.fine_at(replace(frame, peaks=np.empty((0, 2))), np.array([15.5, 10.5])) is None
    assert answering.base_at(frame, np.array([40.0, 3.0])) is None


def test_differences_are_paired_and_their_interval_is_over_scenes():
    tissue = [answer("t", k, 2.0 + scene, scene) for scene in range(6) for k in range(4)]
    smooth = [answer("s", k, 5.0 + scene, scene) for scene in range(6) for k in range(4)]
    alone = [answer("s", 9, 80.0), answer("t", 8, math.nan, status="refused")]
    made = tables.paired([*tissue, *smooth, *alone], "t", "s")
    assert (made.pairs, made.scenes, made.difference) == (24, 6, pytest.approx(-3.0))
    assert made.interval == pytest.approx((-3.0, -3.0))
    # Highlights of a scene err alike: that is no proof of a difference.
    rng = np.random.default_rng(1)
    offs = rng.normal(0, 3, 6)
    noisy = [answer("t", k, 9.0 + offs[scene], scene) for scene in range(6) for k in range(50)]
    level = [answer("s", k, 9.0, scene) for scene in range(6) for k in range(50)]
    low, high = tables.paired([*noisy, *level], "t", "s").interval
    assert low < 0 < high
    assert tables.paired(alone, "t", "s").pairs == 0
    assert tables.paired([answer("t", 0, 1.0), answer("s", 0, 2.0)], "t", "s").interval is None


def test_the_tables_count_answers_refusals_and_coverage():
    made = [answer("t", k, float(k), inside=float(k < 3)) for k in range(4)] + [answer("t", 4, math.nan, status="why")]
    lines = list(tables.summary(made, ALL, ["t", "absent"]))
    assert lines[2:] == ["| all | t | 5 | 4 | 1 why | 1.50 | 2.85 | none | 75.0 (4) |"]
    (pair,) = list(tables.pairs(made, ALL, [("t", "s")]))[2:]
    assert pair == "| all | t - s | 0 | 0 | none | none | none |"


def test_regions_overlap_as_a_search_over_their_points_says():
    rng = np.random.default_rng(3)
    angles = np.linspace(0, 2 * np.pi, 400)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    outcomes = []
    for _ in range(60):
        first, second = (a @ a.T + 0.02 * np.eye(2) for a in rng.normal(0, 0.5, (2, 2, 2)))
        off = rng.normal(0, 2.5, 2)
        if any(off @ np.linalg.solve(each, off) <= real.CHI2_95 for each in (first, second)):
            near = True  # a centre lies inside the other region
        else:
            rim = np.linalg.cholesky(first) @ circle * math.sqrt(real.CHI2_95)
            gaps = np.einsum("in,in->n", rim - off[:, None], np.linalg.solve(second, rim - off[:, None]))
            near = bool(gaps.min() <= real.CHI2_95)
        outcomes.append(near)
        assert real.regions_overlap(off, first, second) == near
    assert len(set(outcomes)) == 2


def test_agreement_turns_the_other_covariance_into_the_first_basis():
    one, other = an_estimate(0.0, 0.01), an_estimate(0.06, 0.01)
    made = real.compared("f", ("n", one), ("b", other))
    assert made.off_deg == pytest.approx(math.degrees(0.06), rel=1e-3)
    assert made.overlaps is False
    assert real.compared("f", ("n", one), ("b", an_estimate(0.02, 0.01))).overlaps is True
    assert real.compared("f", ("n", one), ("b", other.without_uncertainty())).overlaps is None
    found = [a_specularity({"n": one, "b": other}), a_specularity({"n": one, "b": Failure(Reason.NO_PEAK, "")})]
    assert len(list(real.agreements("f", found, ["n"], ["b"]))) == 1
    (line,) = list(tables.agreement([made], []))[2:]
    assert line == "| all | n - b | 1 | 3.44 | 3.44 | 0 of 1 |"
    assert real.refusals(found, "b") == {OK: 1, "no_peak": 1}


def test_answers_on_an_instrument_are_counted_in_the_frame_s_own_pixels():
    tool = np.zeros((480, 640), dtype=bool)
    tool[200:220, 300:320] = True
    nothing = np.zeros_like(tool)
    frame = OutlinedFrame("f", "figures", np.zeros((480, 640, 3), np.float32), nothing, nothing, {"instrument": tool})
    on, off = (replace(an_estimate(), look_px=np.array(at)) for at in ([155.0, 105.0], [162.0, 105.0]))
    found = [a_specularity({"n": each}) for each in (on, off, Failure(Reason.NO_PEAK, ""))]
    half = np.zeros((240, 320, 3), dtype=np.float32)
    assert real.misplaced(frame, found, "n", half) == "1, 0, 0, 0"
    assert real.misplaced(frame, found[2:], "n", half) == "0, 0, 0, 0"


def test_what_is_told_of_a_real_frame():
    picture = np.random.default_rng(0).random((300, 600, 3)).astype(np.float32)
    small = real.reduced(picture)
    assert small.shape == (240, 480, 3)
    assert small.mean() == pytest.approx(picture.mean(), abs=1e-3)
    assert real.reduced(small) is small
    assert not real.untold(small).priors.lights_mm
    assert len(real.told(small, "fig5_a.bmp").priors.lights_mm) == 2
    assert len(real.told(small, real.LAPAROSCOPY).priors.lights_mm) == 8
    assert real.told(small, "x").camera.fx == pytest.approx(240 / math.tan(math.radians(40)))


def test_frames_are_kept_and_those_that_a_scene_cannot_show_left_out(tmp_path, monkeypatch):
    made = a_frame()
    arrays = {name: getattr(made, name) for name in frames.ARRAYS}
    calls = []

    def rendered(renderer, row):
        calls.append(row.name)
        return arrays if row is GUIDES[0] else {"why_not": np.array("no room")}

    monkeypatch.setattr(frames, "_rendered", rendered)
    for _ in range(2):
        (read,) = hard_frames([FIRST], GUIDES[:2], tmp_path)
        np.testing.assert_array_equal(read.normal_base, made.normal_base)
        assert (read.scene, read.row, read.kind) == (FIRST, GUIDES[0], KINDS[FIRST % len(KINDS)])
    assert calls == [row.name for row in GUIDES[:2]]
    np.testing.assert_array_equal(read.peaks, made.peaks)
    assert read.frame().camera.width == 480


def test_answers_are_kept_by_the_hash_of_the_network(tmp_path, monkeypatch):
    frame, asked = a_frame(), []

    def made(frame, estimators):
        asked.append(sorted(estimators))
        return iter([answer(name, 0, 1.5, frame.scene) for name in estimators])

    class Network:
        def __init__(self, model):
            self.model = model

    monkeypatch.setattr(kept, "answers", made)
    for name, text in (("one", "a"), ("two", "b"), ("same", "a")):
        (tmp_path / name).write_text(text)
    folder = kept.Kept(tmp_path)
    networks = {"n, smooth": Network(tmp_path / "one"), "n, tissue": Network(tmp_path / "two"), "bisector": object()}
    first = folder.normals(frame, networks)
    assert [each.estimator for each in first] == list(networks)
    assert repr(folder.normals(frame, networks)) == repr(first)
    (read,) = folder.normals(frame, {"n, other": Network(tmp_path / "same")})
    assert (read.estimator, read.base_deg, math.isnan(read.stated_deg)) == ("n, other", 1.5, True)
    assert asked == [sorted(networks)]
