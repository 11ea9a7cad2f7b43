"""The page of the process protocol names every key that is sent or read, and its examples are sound messages."""

import json
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from simtest.errors import Reason
from simtest.estimators.process.check import core_cases
from simtest.estimators.process.core import PASSED, THREADS, CoreTable, Hello, hello_of
from simtest.estimators.process.messages import FRAME_ARRAYS, PATCH_ARRAYS, estimate_of, frame_request, patch_request
from simtest.estimators.process.pipe import DTYPES, PROTOCOL, Message
from simtest.estimators.protocol import Estimate

PAGE = (Path(__file__).resolve().parents[2] / "docs/reference/cores.md").read_text(encoding="utf-8")


def keys_of(value):
    """Yield the keys of a JSON value, at every depth."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield key
            yield from keys_of(each)
    elif isinstance(value, list):
        for each in value:
            yield from keys_of(each)


def unnamed(names):
    """Return the names that do not stand on the page as words of code."""
    fenced = re.findall(r"```(?:json|toml)\n.*?```", PAGE, re.DOTALL)
    inline = re.findall(r"`[^`\n]+`", re.sub(r"```.*?```", "", PAGE, flags=re.DOTALL))
    code = " ".join([*fenced, *inline])
    return sorted(name for name in names if not re.search(rf"(?<![\w<|]){re.escape(name)}(?!\w)", code))


def lens_keys(case):
    """The coefficients k2 to k6 are named by their first and last ones."""
    return {"k1", "k2", "k3", "k4", "k5"} if case.name == "lens with distortion" else {"k2", "k3"}


CAMERAS = ("lens with distortion", "fisheye with a round view")


@pytest.mark.parametrize("name", CAMERAS)
def test_every_key_and_array_of_a_request_is_named(name):
    wanted = (*PATCH_ARRAYS, "isophote_0.5", "isophote_rays_0.5")
    (case,) = (case for case in core_cases("patch") if case.name == name)
    hello = Hello("a", "1", "patch", arrays=wanted, isophotes=(0.5,))
    of_patch = patch_request(case.frame.patch(case.box), case.frame.camera, case.priors, hello)
    (case,) = (case for case in core_cases("frame") if case.name == name)
    of_frame = frame_request(case.frame, case.frame.camera, case.priors, Hello("a", "1", "frame", arrays=FRAME_ARRAYS))
    for header, arrays in (of_patch, of_frame):
        missing = set(header.pop("missing"))
        assert unnamed({*keys_of(header), *arrays, *missing} - lens_keys(case)) == []


def test_every_key_of_a_greeting_and_of_a_core_file_is_named():
    assert unnamed({field.name for field in fields(Hello)} | set(CoreTable.model_fields)) == []
    assert unnamed({*PASSED, *THREADS, "TMPDIR"}) == []
    assert unnamed(reason for reason in Reason if reason.startswith("core_")) == []


def test_every_field_of_an_answer_is_named():
    own = {"isophotes", "region", "cloud", "calibrated"}  # these are not read from a core's answer
    read = {field.name for field in fields(Estimate)} - own
    assert unnamed({*read, "look_ray", "basis", "reason", "detail", "estimates", "directions", "hypotheses"}) == []


def test_every_type_of_element_is_listed():
    assert re.findall(r"`\\?([<|]\w\d)`", PAGE.replace("\\|", "|")) == [*DTYPES[:2], *[DTYPES[i] for i in (4, 2, 3, 5)]]


def test_the_examples_of_messages_are_sound():
    blocks = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    asked, greeting, request, answer, refusal, files = (json.loads(block) for block in blocks)
    assert asked["protocol"] == PROTOCOL
    hello = hello_of(greeting)
    assert [entry["name"] for entry in request["arrays"]] == list(hello.arrays)
    camera = core_cases("patch")[0].frame.camera
    estimate = estimate_of(Message(answer), camera, hello)
    assert isinstance(estimate, Estimate)
    np.testing.assert_allclose(estimate.look_px, answer["look_px"])
    assert estimate_of(Message(refusal), camera, hello).reason == refusal["reason"]
    assert {request["id"], answer["id"], refusal["id"], files["id"]} == {7}
