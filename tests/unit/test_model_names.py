"""Networks of the user's own by name, NAME:FILE.onnx: names, hashes, refusals. Needs no network but the shipped one."""

import pytest

from simtest.detection.detector import DETECTORS, load_detector
from simtest.errors import InputError
from simtest.runtime.resources import parse_model


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("learned_spot:models/spots/model.onnx", "learned_spot_spots"),
        ("learned_spot:wide net.onnx", "learned_spot_wide_net"),
        ("learned_spot:C:\\nets\\a.onnx", "learned_spot_C_nets_a"),
        ("my_package.core:/a/b.onnx", "my_package.core_b"),
    ],
)
def test_a_network_is_named_by_what_runs_it_and_its_file(text, short):
    assert parse_model(text).short == short


@pytest.mark.parametrize("text", ["learned_spot", "package:learned_spot", "command: ./core a.onnx", "a.onnx",
                                  "command:core.onnx", "learned_spot: a.onnx", ":a.onnx", "a b:c.onnx"])  # fmt: skip
def test_other_names_are_no_networks(text):
    assert parse_model(text) is None


def test_a_detector_without_networks_refuses_a_file():
    assert "colour" in DETECTORS.names()
    with pytest.raises(InputError, match=r"detector 'colour:a.onnx': colour runs no network; must stand alone"):
        load_detector("colour:a.onnx")
