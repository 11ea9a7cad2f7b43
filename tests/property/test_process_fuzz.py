"""Random bytes and JSON from a core: an estimate, a Failure, or a broken protocol, and never another exception."""

import contextlib

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.estimators.process.core import Hello, hello_of
from simtest.estimators.process.messages import estimate_of, estimates_of
from simtest.estimators.process.pipe import CoreFault, Message, MessageReader
from simtest.estimators.protocol import check
from simtest.geometry import Camera

CAMERA = Camera.from_fov(70.0, 640, 480)
HELLO = Hello("a core", "1", "patch")
GOOD = {"normal": [0, 0, -1], "look_px": [3, 4]}

TEXT = st.text("ab ,\n\x1bé", max_size=8)
JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=12,
)
FIELDS = (*GOOD, "candidates", "look_ray", "covariance", "basis", "budget", "axis_ratio", "choice_margin", "curvature",
          "isophotes", "target", "flags")  # fmt: skip
PIECES = st.binary(max_size=60) | st.sampled_from(
    [b"\n", b'{"type":"estimate"}', b'{"arrays":[', b'{"name":"a"}', b"]}"]
)

patient = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@patient
@given(st.lists(PIECES, max_size=20))
def test_no_bytes_do_more_than_break_the_protocol(pieces):
    reader, faults = MessageReader(), []
    try:
        for piece in pieces:
            reader.feed(piece)
    except CoreFault as fault:
        faults.append(fault)
    assert all(each.reason == Reason.CORE_PROTOCOL for each in faults)
    assert all("\n" not in each.detail and len(each.detail) < 400 for each in faults)


@patient
@given(st.dictionaries(st.sampled_from(FIELDS), JSON, max_size=3))
def test_no_answer_is_more_than_an_estimate_or_a_failure(fields):
    assert isinstance(estimate_of(Message({"type": "estimate", **GOOD, **fields}), CAMERA, HELLO), Estimate | Failure)
    frame = estimates_of(Message({"type": "estimates", "estimates": [GOOD | fields]}), CAMERA, HELLO)
    assert isinstance(frame, Failure) or all(isinstance(check(each, CAMERA), Estimate | Failure) for each in frame)


@patient
@given(JSON, JSON)
def test_no_list_of_estimates_and_no_failure_is_more_than_a_failure(given_list, reason):
    found = estimates_of(Message({"type": "estimates", "estimates": given_list}), CAMERA, HELLO)
    assert isinstance(found, list | Failure)
    assert isinstance(estimate_of(Message({"type": "failure", "reason": reason}), CAMERA, HELLO), Failure)


@patient
@given(
    st.dictionaries(st.sampled_from(["protocol", "name", "kind", "arrays", "isophotes", "transport", "target"]), JSON)
)
def test_no_greeting_is_more_than_one_or_a_fault(fields):
    told = {"type": "hello", "protocol": 1, "name": "a core", "kind": "patch"}
    with contextlib.suppress(CoreFault):
        assert isinstance(hello_of(told | fields), Hello)
