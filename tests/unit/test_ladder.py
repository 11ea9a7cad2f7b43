"""The error ladder: exact inputs are exact, and each rung really replaces its stage's input."""

import numpy as np
import pytest

from simtest.conventions import CONE_AXIS_ISOVALUES
from simtest.errors import Failure, Reason
from simtest.estimators import isophotes as base
from simtest.geometry import Patch
from simtest.validation import laws
from studies import error_ladder as ladder
from studies.error_ladder import CAMERA, DISTANCE_MM, EXPONENT, RUNGS, SCENES, ClosedScene, error_ladder

PLANE, TURNED, CYLINDER = SCENES
NAMES = list(RUNGS)


def means(scene, **how):
    return {(r.estimator, r.name): r.mean_deg for r in error_ladder([scene], **({"realisations": 2} | how))}


@pytest.fixture(scope="module")
def sound():
    return means(TURNED)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_the_exact_isophote_has_the_radiance_it_should(scene):
    peak = scene.radiance(scene.sightline)
    assert peak == pytest.approx(1 / DISTANCE_MM**2)
    for t in CONE_AXIS_ISOVALUES:
        points = scene.contour(t)
        np.testing.assert_allclose(scene.radiance(CAMERA.unproject(points)), t * peak, rtol=1e-9)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_the_closed_form_is_that_of_the_surface(scene):
    """Hit points lie on the surface, and its normal there makes the cosine."""
    points = scene.contour(0.5)
    sightlines = CAMERA.unproject(points)
    distance, cosine = scene._hit(sightlines)
    P = distance[:, None] * sightlines
    if scene.kd:
        radius = DISTANCE_MM / scene.kd
        out = P - (DISTANCE_MM + radius) * scene.sightline
        out[:, 1] = 0
        np.testing.assert_allclose(np.linalg.norm(out, axis=1), radius, rtol=1e-12)
        normals = out / radius
    else:
        np.testing.assert_allclose(P @ scene.sightline, DISTANCE_MM, rtol=1e-12)
        normals = np.broadcast_to(-scene.sightline, P.shape)
    np.testing.assert_allclose(-np.sum(normals * sightlines, axis=1), cosine, rtol=1e-9)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_the_exact_cone_meets_the_exact_isophote_in_the_principal_sections(scene):
    """A plane's isophote lies on the cone everywhere; a cylinder's does in both of its sections."""
    cone, sightlines = scene.cone(0.5), CAMERA.unproject(scene.contour(0.5))
    off = np.abs(np.einsum("ni,ij,nj->n", sightlines, cone, sightlines))
    if not scene.kd:
        assert off.max() < 1e-9
    y = np.array([0.0, 1.0, 0.0])
    for across, kd in ((np.cross(y, scene.sightline), scene.kd), (y, 0.0)):
        width = laws.isophote_half_width(0.5, EXPONENT, kd)
        edge = scene.sightline + width * across
        level = scene.radiance(edge / np.linalg.norm(edge)) / scene.radiance(scene.sightline)
        assert level == pytest.approx(0.5, rel=1e-9)
        assert edge @ cone @ edge == pytest.approx(0, abs=1e-9)


def test_errors_fall_from_rung_to_rung_to_rounding(sound):
    for name in ladder.ESTIMATORS:
        values = [sound[name, rung] for rung in NAMES]
        assert values[0] > values[1] > values[2] > values[3]
        assert values[-1] < 1e-9
    # Circle pose is at its branch point: of a relative rounding e of the axes it makes sqrt(2 e).
    assert sound["circle_pose", "exact contour"] < 1e-5
    assert sound["cone_axis", "exact contour"] < 1e-10


def test_what_no_exact_input_takes_away_is_the_models():
    found = means(CYLINDER, realisations=1)
    half = laws.isophote_half_width(0.5, EXPONENT, np.array([1.0, 0.0]))
    law = np.degrees(laws.circle_pose_error(half.max(), half.min()))
    assert found["circle_pose", "exact cone"] == pytest.approx(law, abs=1e-6)
    assert found["circle_pose", "exact pose"] < 1e-9
    assert found["cone_axis", "exact cone"] < 1e-9


def shifted_contours(monkeypatch):
    whole = Patch.crossings_of
    monkeypatch.setattr(Patch, "crossings_of", lambda patch, levels: [points + 0.5 for points in whole(patch, levels)])


def shrunken_fits(monkeypatch):
    # What the fit is given is squeezed towards the first point: another ellipse, off its place.
    whole = base.fit_ellipses
    monkeypatch.setattr(base, "fit_ellipses", lambda points: whole([p[0] + (p - p[0]) * [0.8, 1.0] for p in points]))


def turned_poses(monkeypatch):
    whole = ladder.pose_of_cone
    turn = np.array([[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
    monkeypatch.setattr(ladder, "pose_of_cone", lambda cone: whole(turn @ cone @ turn.T))


@pytest.mark.parametrize(
    ("fault", "seen_at"),
    [
        (shifted_contours, ["as it is", "no noise", "no smoothing"]),
        (shrunken_fits, ["as it is", "no noise", "no smoothing", "exact contour"]),
        (turned_poses, ["exact cone"]),
    ],
)
def test_a_fault_shows_where_its_stage_is_asked_and_nowhere_else(monkeypatch, sound, fault, seen_at):
    fault(monkeypatch)
    found = means(TURNED)
    for name in ladder.ESTIMATORS:
        # An estimator that notices gives no answer, which is a change too.
        values = [np.inf if found[name, rung] is None else found[name, rung] for rung in NAMES]
        changed = [rung for rung, value in zip(NAMES, values, strict=True) if abs(value - sound[name, rung]) > 1e-4]
        assert changed == seen_at, name


def test_noise_is_on_the_first_rung_alone_and_hangs_on_the_seed(sound):
    again, other = means(TURNED), means(TURNED, seed=1)
    assert again == sound
    for name in ladder.ESTIMATORS:
        changed = [rung for rung in NAMES if other[name, rung] != sound[name, rung]]
        assert changed == NAMES[:1]


def test_a_rung_without_an_answer_is_counted(monkeypatch):
    far = ClosedScene("a spot beyond the frame", 60.0)
    assert not (0 <= CAMERA.project(far.sightline)[0] <= CAMERA.width)
    rungs = {(r.estimator, r.name): r for r in error_ladder([far], realisations=1)}
    rung = rungs["cone_axis", "no noise"]
    assert rung.failures + len(rung.errors_deg) == 1
    assert rungs["cone_axis", "exact pose"].mean_deg < 1e-9


@pytest.mark.parametrize(
    ("holder", "name", "silent"), [(Patch, "cut", NAMES[:4]), (ladder, "pose_of_cone", ["exact cone"])]
)
def test_a_rung_whose_stage_fails_is_without_an_answer(monkeypatch, holder, name, silent):
    monkeypatch.setattr(holder, name, lambda *_, **__: Failure(Reason.NO_PEAK, "none"))
    found = means(PLANE, realisations=1)
    for estimator in ladder.ESTIMATORS:
        assert [rung for rung in NAMES if found[estimator, rung] is None] == silent


def test_the_first_rung_has_the_noise_that_it_says(monkeypatch):
    frames = []
    whole = ladder._whole
    monkeypatch.setattr(ladder, "_whole", lambda frame, smoothing: frames.append(frame) or whole(frame, smoothing))
    error_ladder([PLANE], realisations=2)
    noisy, clean = frames[:2], frames[-1]
    assert [np.std(frame - clean) for frame in noisy] == pytest.approx([ladder.NOISE] * 2, rel=0.02)
    assert "sigma 0.05" in RUNGS["as it is"]
