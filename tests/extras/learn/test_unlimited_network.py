"""The networks of the study of transfer."""

import json

import onnx

from simtest.estimators.learned import WEIGHTS
from simtest.estimators.learned_spot import LearnedSpot
from simtest.runtime.resources import data_root
from studies.learned_transfer.unlimited import LIMIT, unlimited


def test_a_network_without_its_limit_keeps_everything_else():
    model = onnx.load(data_root("scenes").joinpath(*WEIGHTS, LearnedSpot.shipped))
    made = unlimited(model)
    before, after = ({prop.key: prop.value for prop in one.metadata_props} for one in (model, made))
    contents = [json.loads(props.pop("simtest")) for props in (before, after)]
    assert contents[0].pop("feature_limit") < contents[1].pop("feature_limit") == LIMIT
    assert contents[0] == contents[1]
    assert before == after
    assert made.graph == model.graph
