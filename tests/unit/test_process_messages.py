"""Messages: framing byte by byte, what a request tells, and answers field by field."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from simtest.calibration import NO_PRIORS, Calibration, Frame, Priors
from simtest.calibration.priors import LogUniform, Normal, exactly
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.estimators.process.core import Hello, hello_of
from simtest.estimators.process.messages import (
    camera_message,
    estimate_of,
    estimates_of,
    frame_request,
    patch_request,
    priors_message,
)
from simtest.estimators.process.pipe import CoreFault, Message, MessageReader, encode, to_line
from simtest.geometry import Camera, ViewMask
from simtest.geometry.lenses import BrownConrady, KannalaBrandt
from simtest.geometry.vectors import basis_across
from tests.unit.core_helpers import CAMERA, PATCH

HELLO = Hello("a core", "1", "patch")

ARRAYS = {
    "doubles": np.array([[1.5, np.nan], [-np.inf, 1e-320]]),
    "floats": np.arange(6, dtype=np.float32).reshape(1, 2, 3),
    "steps": np.array([0, 65535], dtype=np.uint16),
    "bytes": np.array([[255]], dtype=np.uint8),
    "whole": np.array([-(2**31), 7], dtype=np.int32),
    "mask": np.array([True, False]),
    "nothing": np.empty((0, 2)),
}


# Framing --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("piece", [1, 7, 10**6])
def test_a_message_comes_back_whatever_pieces_it_comes_in(piece):
    content = b"".join(encode({"type": "x", "text": "zwölf\nlines"}, ARRAYS))
    reader, message = MessageReader(), None
    for start in range(0, len(content), piece):
        assert message is None
        message = reader.feed(content[start : start + piece])
    assert message.header == {"type": "x", "text": "zwölf\nlines"}
    for name, array in ARRAYS.items():
        assert message.arrays[name].dtype == array.dtype
        np.testing.assert_array_equal(message.arrays[name], array)


def test_arrays_that_are_no_plain_little_endian_ones_are_sent_as_such():
    strided, big, whole = np.arange(10.0)[::2], np.array([1.0, 2.0], dtype=">f4"), np.array([2**40])
    content = b"".join(encode({}, {"strided": strided, "big": big, "whole": whole}))
    listed = json.loads(content.split(b"\n")[0])["arrays"]
    assert [entry["dtype"] for entry in listed] == ["<f8", "<f4", "<f8"]
    arrays = MessageReader().feed(content).arrays
    assert arrays["strided"].tolist() == strided.tolist()
    assert arrays["big"].tolist() == [1, 2]
    assert arrays["whole"].tolist() == [2**40]


def test_a_line_is_one_line_of_json_without_nan():
    line = to_line({"a": float("nan"), "b": [np.float64(2.5), np.inf], "c": np.arange(2), "d": "a\nb"})
    assert line.count(b"\n") == 1
    assert json.loads(line) == {"a": None, "b": [2.5, None], "c": [0, 1], "d": "a\nb"}


BAD_LISTS = [
    3, {}, [3], [{}], [{"name": 3}], [{"name": "a", "dtype": "<f8"}], [{"name": "a", "shape": [1]}],
    [{"name": "a", "dtype": "<f8", "shape": [True]}], [{"name": "a", "dtype": "<f8", "shape": [1.0]}],
    [{"name": "a", "dtype": "<f8", "shape": [1] * 5}], [{"name": "a", "dtype": ["<f8"], "shape": [1]}],
    [{"name": "a", "dtype": "<f8", "shape": [0, 10**30]}], [{"name": "a", "dtype": "<f8", "shape": [1]}] * 2,
    [{"name": str(i), "dtype": "<f8", "shape": [0]} for i in range(100)],
]  # fmt: skip


def test_malformed_lists_of_arrays_break_the_protocol():
    for arrays in BAD_LISTS:
        with pytest.raises(CoreFault, match="array"):
            MessageReader().feed(json.dumps({"type": "estimate", "arrays": arrays}).encode() + b"\n")


# Greetings ------------------------------------------------------------------------------------------------------------


def greeting(**more):
    return {"type": "hello", "protocol": 1, "name": "a core", "version": "1", "kind": "patch"} | more


def test_a_greeting_has_defaults():
    assert hello_of(greeting()) == replace(HELLO, arrays=("values",))
    assert hello_of(greeting(kind="frame")).arrays == ("intensity",)
    assert hello_of(greeting(version=2, unknown=[1])).version == "2"
    # An isovalue of which no array is named gets both.
    both = hello_of(greeting(isophotes=[0.5, 0.25], arrays=["isophote_rays_0.5"]))
    assert both.arrays == ("isophote_rays_0.5", "isophote_0.25", "isophote_rays_0.25")


def test_isovalues_whose_arrays_would_have_one_name_are_refused():
    with pytest.raises(CoreFault, match="must differ in their first six digits"):
        hello_of(greeting(isophotes=[0.1234567, 0.12345671]))
    assert hello_of(greeting(isophotes=[0.5, 0.5, 1e-7])).arrays[-1] == "isophote_rays_1e-07"


# Requests -------------------------------------------------------------------------------------------------------------


def test_a_request_about_a_highlight_tells_all_of_it():
    wanted = ("values", "raw", "noise", "saturated", "seen", "rays", "isophote_0.5", "isophote_rays_0.5")
    hello = replace(HELLO, arrays=(*wanted, "isophote_0.001"), isophotes=(0.5, 0.001))
    header, arrays = patch_request(PATCH, CAMERA, NO_PRIORS, hello)
    assert set(arrays) == set(wanted) - {"saturated"}
    assert set(header["missing"]) == {"saturated", "isophote_0.001"}
    assert header["missing"]["isophote_0.001"].startswith("no_closed_isophote: ")
    np.testing.assert_array_equal(arrays["isophote_0.5"], PATCH.isophote(0.5))
    np.testing.assert_array_equal(arrays["isophote_rays_0.5"], CAMERA.unproject(PATCH.isophote(0.5)))
    row, column = 11, 7
    pixel = np.add(PATCH.origin_px, (column + 0.5, row + 0.5))
    np.testing.assert_allclose(arrays["rays"][row, column], CAMERA.unproject(pixel))
    assert arrays["noise"].shape == PATCH.values.shape
    about = json.loads(to_line(header))["patch"]
    assert about["noise"] == 0.01
    assert about["peak_px"] == PATCH.peak_px.tolist()
    assert arrays["values"][about["peak_pixel"][1], about["peak_pixel"][0]] == about["peak_value"]


def test_a_region_that_leaves_the_image_has_rays_too():
    moved = replace(PATCH, origin_px=(-5, 470))
    _, arrays = patch_request(moved, CAMERA, NO_PRIORS, replace(HELLO, arrays=("rays",)))
    np.testing.assert_allclose(arrays["rays"][3, 2], CAMERA.unproject([-2.5, 473.5]))


@pytest.mark.parametrize("lens", [BrownConrady(k1=-0.1, p2=1e-3), KannalaBrandt(k1=0.01), None])
def test_a_camera_is_told_with_its_lens_and_view(lens):
    camera = Camera(640, 480, 500.0, 501.0, 320.0, 241.0, 0.5, lens, ViewMask(320.0, 240.0, 200.0))
    told = json.loads(to_line(camera_message(camera)))
    assert told["K"] == [[500, 0.5, 320], [0, 501, 241], [0, 0, 1]]
    assert told["view_mask"]["radius"] == 200
    if lens is None:
        assert told["distortion"] is None
    else:
        model = told["distortion"].pop("model")
        assert {"brown_conrady": BrownConrady, "kannala_brandt": KannalaBrandt}[model](**told["distortion"]) == lens


def test_priors_name_their_distributions_and_whether_they_were_told():
    priors = Priors(((1.0, 2.0, 3.0),), Normal(12.0, 2.0), exactly(400.0), LogUniform(1.0, 4.0), falloff_power=None)
    told = json.loads(to_line(priors_message(priors)))
    assert told["lights_mm"] == [[1, 2, 3]]
    assert told["distance_mm"] == {
        "distribution": "normal", "parameters": {"mean": 12, "sd": 2}, "mean": 12, "sd": 2, "told": True,
    }  # fmt: skip
    assert told["lobe_curvature"]["distribution"] == "exact"
    assert told["lobe_curvature"]["parameters"] == {"value": 400}
    assert told["light_offset_mm"]["parameters"] == {"low": 1, "high": 4}
    assert told["falloff_power"] is None
    untold = priors_message(NO_PRIORS)
    assert untold["distance_mm"] == {
        "distribution": "uniform", "parameters": {"low": 5, "high": 80}, "mean": 42.5, "sd": 75 / np.sqrt(12),
        "told": False,
    }  # fmt: skip
    assert untold["lobe_curvature"] is None
    assert not untold["relief_slope"]["told"]


def test_a_request_about_a_frame_tells_all_of_it():
    picture = np.random.default_rng(3).uniform(0.1, 1.0, (480, 640, 3)).astype(np.float32)
    frame = Frame(picture, Calibration(CAMERA, saturation_level=0.99), 1.5)
    names = ("encoded", "channels", "intensity", "smoothed", "noise", "clipped", "seen", "rays")
    header, arrays = frame_request(frame, CAMERA, NO_PRIORS, Hello("a core", "1", "frame", arrays=names))
    assert set(arrays) == set(names)
    assert header["missing"] == {}
    np.testing.assert_array_equal(arrays["encoded"], picture)
    np.testing.assert_array_equal(arrays["smoothed"], frame.smoothed)
    assert arrays["rays"].shape == (480, 640, 3)
    assert arrays["seen"].all()
    assert header["frame"]["channels"] == 3
    assert header["frame"]["saturation_level"] == 0.99


# Answers --------------------------------------------------------------------------------------------------------------

NORMAL = np.array([0.6, 0.0, -0.8])


def answered(**fields):
    header = {"type": "estimate", "id": 1, "normal": NORMAL.tolist(), "look_px": [10, 20.5]} | fields
    return estimate_of(Message(header), CAMERA, HELLO)


def test_an_answer_is_an_estimate():
    found = answered(
        candidates=[NORMAL.tolist(), [0, 0, -1]], axis_ratio=0.5,
        axis_ratio_deviation=0.1, choice_margin=3, flags=["small"], target="base",
        curvature={"directions": [[1, 0, 0], [0, 1, 0]], "axis_ratio": 0.25, "hypotheses": [[1.5, 1.0]]},
    )  # fmt: skip
    assert isinstance(found, Estimate)
    assert found.normal.tolist() == NORMAL.tolist()
    assert found.candidates.tolist() == [NORMAL.tolist(), [0, 0, -1]]
    assert found.look_px.tolist() == [10, 20.5]
    assert (found.axis_ratio, found.axis_ratio_deviation, found.choice_margin) == (0.5, 0.1, 3)
    assert (found.flags, found.target) == (("small",), "base")
    assert found.curvature.gains.tolist() == [1.5, 1]
    assert found.covariance is None


def test_the_target_of_the_greeting_holds_where_an_estimate_tells_none():
    header = {"type": "estimate", "normal": [0, 0, -1], "look_px": [1, 1]}
    assert estimate_of(Message(header), CAMERA, replace(HELLO, target="base")).target == "base"


def test_an_estimate_may_look_along_a_ray():
    ray = CAMERA.unproject(np.array([100.0, 50.0]))
    assert answered(look_px=None, look_ray=ray.tolist()).look_px == pytest.approx([100, 50])
    for lens in (BrownConrady(k1=-0.1, p1=1e-3), KannalaBrandt(k1=-0.02)):
        camera = replace(CAMERA, distortion=lens)
        ray = 3.0 * camera.unproject(np.array([100.0, 50.0]))
        header = {"type": "estimate", "normal": NORMAL.tolist(), "look_ray": ray.tolist()}
        assert estimate_of(Message(header), camera, HELLO).look_px == pytest.approx([100, 50], abs=1e-6)
    behind = answered(look_px=None, look_ray=[0, 0, -1])
    assert isinstance(behind, Failure)
    assert "images no such direction" in behind.detail


@pytest.mark.parametrize("hand", [1, -1], ids=["right-handed", "left-handed"])
def test_a_covariance_in_another_basis_is_turned_into_ours(hand):
    first, second = basis_across(NORMAL)
    turned = np.array([np.cos(0.7) * first + np.sin(0.7) * second, -np.sin(0.7) * first + np.cos(0.7) * second])
    turned = turned[::hand]
    given = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    found = answered(covariance=given.tolist(), basis=turned.tolist()).covariance
    # The same covariance in space.
    ours = basis_across(NORMAL)
    np.testing.assert_allclose(ours.T @ found @ ours, turned.T @ given @ turned, atol=1e-15)
    np.testing.assert_allclose(answered(covariance=given.tolist()).covariance, given)


def test_a_budget_is_kept_part_by_part():
    found = answered(budget={"noise": [[1e-4, 0], [0, 1e-4]], "shape": [[2e-4, 0], [0, 0]]})
    assert set(found.budget) == {"noise", "shape"}
    np.testing.assert_allclose(found.covariance, [[3e-4, 0], [0, 1e-4]])


BAD_FIELDS = [
    {"normal": None}, {"normal": [True, 0, -1]}, {"normal": [[0, 0, -1]]}, {"normal": [0, 0, [-1]]},
    {"normal": {"x": 0}}, {"normal": [0, 0, 10**400]}, {"candidates": []}, {"candidates": [[0, 0, -1]] * 65},
    {"axis_ratio_deviation": 0}, {"axis_ratio": "0.5"},
    {"axis_ratio": [0.5]}, {"target": ["fine"]}, {"flags": "small"}, {"flags": [3]},
    {"flags": ["x" * 61]}, {"flags": ["a"] * 17}, {"curvature": 3}, {"curvature": {"axis_ratio": 0.5}},
    {"curvature": {"directions": [[1, 0, 0], [0, 1, 0]], "axis_ratio": 2}}, {"budget": []}, {"budget": {}},
    {"budget": {"a b": [[1, 0], [0, 1]]}}, {"budget": {"noise": [1, 2]}}, {"covariance": [[1, 2], [0, 1]]},
    {"axis_ratio": -5}, {"axis_ratio": 1e308}, {"look_px": [-500, 20]}, {"look_px": [1e300, 20]},
    {"look_px": None, "look_ray": [5, 0, 1e-3]}, {"covariance": [[1e308, 0], [0, 1]]},
    {"covariance": [[25.0, 0], [0, 25.0]]}, {"covariance": np.eye(2, dtype=bool)},
    {"isophotes": 3}, {"isophotes": [{"isovalue": 2, "cone": [[1, 0, 0], [0, 1, 0], [0, 0, -1]],
                                      "sightline": [0, 0, 1]}]},
    {"isophotes": [{"isovalue": 0.5, "cone": [[0, 0, 0]] * 3, "sightline": [0, 0, 1]}]},
    {"budget": {"noise": [[1e-4, 0], [0, 1e-4]], "shape": [1, 2]}},
]  # fmt: skip


def test_a_malformed_field_refuses_the_estimate():
    for fields in BAD_FIELDS:
        found = answered(**fields)
        assert isinstance(found, Failure), fields
        assert found.reason == Reason.ESTIMATOR_ERROR, fields
        assert "\n" not in found.detail
        assert len(found.detail) < 300, fields


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("look_px", [np.nan, 1.0]),
        ("axis_ratio", np.inf),
        ("choice_margin", np.inf),
        ("budget", {"noise": [[1e-4, 0], [0, 1e-4]], "shape": [[1, 0], [0, np.nan]]}),
    ],
)
def test_numbers_that_are_not_finite_refuse_the_estimate(name, value):
    found = answered(**{name: value})
    told = "shape" if name == "budget" else name
    assert (found.reason, found.detail) == (Reason.NOT_FINITE, f"{told} holds NaN or infinity")


OWN_FAILURES = [
    ({"reason": "streak", "detail": "of 30 px"}, "streak", "of 30 px"),
    ({"reason": "no_closed_isophote"}, "no_closed_isophote", ""),
    ({"reason": "too dark", "detail": "0.01"}, "no_estimate", "too dark: 0.01"),
    ({}, "no_estimate", ""),
    ({"reason": "core_died"}, "no_estimate", "core_died"),
    ({"reason": "estimator_error", "detail": "x"}, "no_estimate", "estimator_error: x"),
    ({"reason": 3}, "estimator_error", "failure: reason and detail must be text"),
    ({"reason": "streak", "detail": "a\nb\x1b[31m"}, "streak", "a b [31m"),
]


def test_a_core_may_fail_for_a_reason():
    for header, reason, detail in OWN_FAILURES:
        found = estimate_of(Message({"type": "failure", "id": 1} | header), CAMERA, HELLO)
        assert (found.reason, found.detail) == (reason, detail), header


def test_fields_may_be_arrays():
    arrays = {"normal": np.array([[0, 0, -1], [0.6, 0, -0.8]]), "look_px": np.array([[1, 2], [3, 4]], dtype="<i4")}
    answer = Message({"type": "estimates", "id": 1, "estimates": [{"flags": ["a"]}, {}]}, arrays)
    one, other = estimates_of(answer, CAMERA, HELLO)
    assert (one.flags, one.look_px.tolist()) == (("a",), [1, 2])
    assert other.normal.tolist() == [0.6, 0, -0.8]
    assert len(estimates_of(Message({"type": "estimates", "id": 1}, arrays), CAMERA, HELLO)) == 2
    wrong = estimates_of(Message({"type": "estimates", "id": 1, "estimates": [{}]}, arrays), CAMERA, HELLO)
    assert isinstance(wrong, Failure)
    assert "lengths [2] for 1 estimates" in wrong.detail
    single = estimate_of(
        Message({"type": "estimate"}, {"normal": arrays["normal"][0], "look_px": np.ones(2)}), CAMERA, HELLO
    )
    assert isinstance(single, Estimate)


def test_arrays_of_very_many_estimates_are_refused_before_a_list_is_made_of_them():
    tracemalloc.start()
    found = estimates_of(Message({"type": "estimates"}, {"normal": np.empty((60_000_000, 0))}), CAMERA, HELLO)
    assert "60000000 estimates of a frame; at most 10000" in found.detail
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


def test_one_malformed_estimate_leaves_the_others_of_a_frame():
    listed = [{"normal": [0, 0, -1], "look_px": [1, 1]}, {"normal": [0, 0, -3], "look_px": [1, 1]}]
    sound, refused = estimates_of(Message({"type": "estimates", "estimates": listed}), CAMERA, HELLO)
    assert isinstance(sound, Estimate)
    assert refused == Failure(Reason.ESTIMATOR_ERROR, "normal of length 3: must be a unit vector")
