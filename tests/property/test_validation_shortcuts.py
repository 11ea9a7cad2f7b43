"""What validation computes at once, or once, is what it would compute one by one."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.conventions import HIGHLIGHT_ISOVALUE
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.geometry import Camera
from simtest.geometry.patch import encloses
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.spec import scene_from_dict
from simtest.validation import laws
from simtest.validation.kept_frames import write_item
from simtest.validation.scoring import _look_normals, match, peak_px

CAMERA = Camera(120, 90, 100.0, 100.0, 60.0, 45.0)

shares = st.floats(0.0, 1.0, allow_subnormal=False)


def picture(centres):
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    spots = (a * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * s**2)) for u, v, a, s in centres)
    return sum(spots).astype(np.float32)


def matched_one_by_one(found, points):
    """Return what `match` does, by asking each detection about each point."""
    pairs = []
    for i, specularity in enumerate(found):
        contour = specularity.patch if isinstance(specularity.patch, Failure) else None
        contour = contour or specularity.patch.isophote(HIGHLIGHT_ISOVALUE)
        x, y, width, height = specularity.region.box
        for j, (u, v) in enumerate(points):
            boxed = x <= u <= x + width and y <= v <= y + height
            if boxed if isinstance(contour, Failure) else encloses(contour, np.array([u, v])):
                pairs.append((float(np.hypot(*(np.array([u, v]) - peak_px(specularity)))), i, j))
    matched = {}
    for _, i, j in sorted(pairs):
        if i not in matched and j not in matched.values():
            matched[i] = j
    return matched


@given(
    centres=st.lists(
        st.tuples(st.floats(5, 115), st.floats(5, 85), st.floats(0.3, 1.0), st.floats(2.0, 6.0)), min_size=1, max_size=5
    ),
    points=st.lists(st.tuples(st.floats(-5, 125), st.floats(-5, 95)), max_size=12),
    isolated=st.booleans(),
)
@settings(max_examples=40, deadline=None)
def test_detections_match_the_points_that_their_isophotes_enclose(centres, points, isolated):
    found = reconstruct(picture(centres), CAMERA, {}, isolated=isolated)
    # Points next to the peaks too, or hardly any would be enclosed.
    points = points + [(u + 0.7, v - 0.4) for u, v, _, _ in centres]
    assert match(found, [np.array(point) for point in points]) == matched_one_by_one(found, points)


def test_nothing_to_match():
    found = reconstruct(picture([(60.0, 45.0, 1.0, 4.0)]), CAMERA, {})
    assert match(found, []) == match([], [np.array([60.0, 45.0])]) == {}
    assert match(found, [np.array([np.nan, 45.0])]) == {}


@given(
    isovalues=st.lists(st.floats(0.2, 0.95), min_size=1, max_size=6),
    exponent=st.floats(5.0, 500.0),
    kd=st.tuples(st.floats(-0.9, 3.0), st.floats(-0.9, 3.0)),
    smoothing_px=st.sampled_from([0.0, 2.0]),
)
@settings(max_examples=60, deadline=None)
def test_the_axis_ratio_that_is_seen_is_that_of_each_section(isovalues, exponent, kd, smoothing_px):
    seen = laws.axis_ratio_seen(isovalues, exponent, *kd, smoothing_px, 1 / 400)
    for t, ratio in zip(isovalues, seen, strict=True):
        widths = [float(laws.isophote_half_width(t, exponent, one)) for one in kd]
        level = -2 * np.log(t)
        added = (level * smoothing_px**2 + (level - 1) / 6) / 400**2
        low, high = sorted(width**2 + added for width in widths)
        if np.isfinite(high):
            assert ratio == pytest.approx(np.sqrt(low / high), rel=1e-12)
        else:
            assert np.isnan(ratio)


@given(st.lists(st.tuples(*[shares] * 6), min_size=1, max_size=5), st.floats(0, 1e-3))
@settings(max_examples=60, deadline=None)
def test_angles_are_those_of_cross_and_dot_products(drawn, tilt):
    first, second = (np.array(drawn)[:, part] - [0.5, 0.5, -0.5] for part in (slice(3), slice(3, 6)))
    first, second = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (first, second))
    near = first + tilt * second
    for other in (second, near / np.linalg.norm(near, axis=1, keepdims=True), first):
        sine, cosine = np.linalg.norm(np.cross(first, other), axis=1), np.sum(first * other, axis=1)
        np.testing.assert_array_equal(angle_deg(first, other), np.degrees(np.arctan2(sine, cosine)))
        assert angle_deg(first[0], other[0]) == angle_deg(first, other)[0]
    assert angle_deg(first[0], second).shape == (len(drawn),)


def estimate(x, y):
    return Estimate(np.array([0.0, 0.0, -1.0]), np.array([[0.0, 0.0, -1.0]]), np.array([x, y]))


@pytest.mark.render
def test_all_looks_are_cast_at_once_and_each_finds_its_own_normal(monkeypatch):
    camera = {"width": 80, "height": 60, "fx": 60.0, "fy": 60.0}
    session = Session(scene_from_dict({"surface": {"type": "sphere", "radius_mm": 3.0}, "camera": camera}))
    looks = {"a": estimate(40.0, 30.0), "b": estimate(43.5, 27.25), "beside": estimate(1.0, 1.0),
             "none": estimate(np.nan, np.nan), "failed": Failure(Reason.NOT_AN_ELLIPSE)}  # fmt: skip
    specularities = [SimpleNamespace(estimates=looks), SimpleNamespace(estimates={"a": estimate(38.0, 31.0)})] * 2
    points_at, calls = session.exact_points, []
    monkeypatch.setattr(session, "exact_points", lambda points: calls.append(len(points)) or points_at(points))
    found = _look_normals(session, specularities, {0: 1, 1: 0, 3: 2})
    # A false detection has no look, nor has an estimate that failed.
    assert calls == [5]
    assert set(found) == {(0, "a"), (0, "b"), (1, "a"), (3, "a")}
    for (i, name), normal in found.items():
        alone = points_at(specularities[i].estimates[name].look_px[None]).normal[0]
        np.testing.assert_allclose(normal, alone, rtol=0, atol=1e-12)
    assert _look_normals(session, specularities, {}) == {}


def test_a_gallery_item_holds_what_was_written(tmp_path):
    rng = np.random.default_rng(0)
    frame, maps = rng.random((30, 40)), rng.random((6, 8, 3)).astype(np.float32)
    meta = {
        "surface": "plane", "setting": "s", "label": "l", "sigma": 0.01, "command": "simtest", "camera": CAMERA,
        "truth": [], "estimates": [], "lights": [[0.0, 0.0, 0.0]],
    }  # fmt: skip
    write_item(tmp_path / "one.npz", meta, frame, maps, maps / 2, curvature=maps[..., 0])
    with np.load(tmp_path / "one.npz", allow_pickle=False) as item:
        assert set(item.files) == {"frame", "position", "normal", "curvature", "meta"}
        np.testing.assert_array_equal(item["frame"], frame.astype(np.float16).astype(np.float32))
        np.testing.assert_array_equal(item["position"], maps)
        np.testing.assert_array_equal(item["curvature"], maps[..., 0].astype(np.float16))
        assert '"plane"' in str(item["meta"])
    # The same content is the same bytes, whenever it is written.
    write_item(tmp_path / "two.npz", meta, frame, maps, maps / 2, curvature=maps[..., 0])
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
