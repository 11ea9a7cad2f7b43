"""What all learned cores share: a network as an ONNX file with metadata, and the range that it was taught."""

import json

import numpy as np
import onnx
import pytest
import torch

from simtest.errors import InputError, SimtestError
from simtest.estimators import learned
from simtest.estimators.learned import METADATA, OnnxModel, TrainingRange
from studies.networks import onnx_file
from studies.networks.fitted import fitted_range

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]

FORM = "simtest line, version 1"


class Line(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(40, 50)

    def forward(self, x):
        return self.layer(x)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    torch.manual_seed(0)
    network = Line()
    path = tmp_path_factory.mktemp("line") / "line.onnx"
    onnx_file.export(network, {"x": torch.zeros(2, 40)}, ["y"], {"format": FORM, "about": "drawn"}, path)
    return network, path


def test_a_written_network_gives_what_pytorch_gives_for_any_number_of_rows(line):
    network, path = line
    x = torch.randn(7, 40, generator=torch.Generator().manual_seed(1))
    model = OnnxModel(path, FORM, "line")
    (made,) = model.run({"x": x.numpy()}, {"y": (None, 50)})
    assert np.abs(made - network(x).detach().numpy()).max() < 1e-5
    assert model.content["about"] == "drawn"


def test_half_precision_moves_weights_by_a_part_in_2000(line, tmp_path):
    network, path = line
    onnx.save(onnx_file.stored(onnx.load(path), 16), tmp_path / "half.onnx")
    assert (tmp_path / "half.onnx").stat().st_size < 0.7 * path.stat().st_size
    x = np.eye(40, dtype=np.float32)
    rows = [OnnxModel(each, FORM, "line").run({"x": x}, {"y": (40, 50)})[0] for each in (path, tmp_path / "half.onnx")]
    bias = network.layer.bias.detach().numpy()
    assert np.abs(rows[1] - rows[0]).max() > 0
    assert (np.abs(rows[1] - rows[0]) <= 2**-11 * np.abs(rows[0] - bias) + 1e-6).all()


def test_a_layer_that_onnx_computes_otherwise_is_not_written(tmp_path):
    class Drawn(torch.nn.Module):
        def forward(self, x):
            return x + torch.randn(2, 40)

    with pytest.raises(SimtestError, match=r"bad.onnx: ONNX Runtime differs from PyTorch by"):
        onnx_file.export(Drawn(), {"x": torch.zeros(2, 40)}, ["y"], {"format": FORM}, tmp_path / "bad.onnx")
    assert not (tmp_path / "bad.onnx").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "JSONDecodeError"),
        ("{", "JSONDecodeError"),
        ("[]", "TypeError"),
        ("{}", r"KeyError: 'format'"),
        (json.dumps({"format": "simtest line, version 0"}), "ValueError: format 'simtest line, version 0'"),
    ],
    ids=["none", "cut", "a list", "no format", "another version"],
)
def test_other_metadata_are_refused_in_one_line(line, tmp_path, text, said):
    model = onnx.load(line[1])
    del model.metadata_props[:]
    if text is not None:
        onnx.helper.set_model_props(model, {METADATA: text})
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=rf"other.onnx: is no network for line \({said}") as raised:
        OnnxModel(tmp_path / "other.onnx", FORM, "line")
    assert str(raised.value).endswith("its metadata must hold 'simtest' of the form 'simtest line, version 1'")
    assert "\n" not in str(raised.value)


def test_outputs_that_are_no_floating_point_numbers_are_refused(line, tmp_path):
    helper, types = onnx.helper, onnx.TensorProto
    value = [helper.make_tensor_value_info(name, kind, [2]) for name, kind in (("x", types.FLOAT), ("y", types.BOOL))]
    graph = helper.make_graph([helper.make_node("Greater", ["x", "x"], ["y"])], "logical", value[:1], value[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", onnx_file.OPSET)], ir_version=8)
    helper.set_model_props(model, {METADATA: json.dumps({"format": FORM})})
    onnx.save(model, tmp_path / "logical.onnx")
    with pytest.raises(InputError, match=r"logical.onnx: cannot be run \(y holds bool; must be floating-point numbers"):
        OnnxModel(tmp_path / "logical.onnx", FORM, "line").run({"x": np.zeros(2, np.float32)}, {"y": (2,)})


def test_what_cannot_be_run_is_told_in_one_line(line, tmp_path):
    model = OnnxModel(line[1], FORM, "line")
    x = np.zeros((3, 40), np.float32)
    for inputs, shapes, said in (
        ({"x": x}, {"y": (None, 49)}, r"y has the shape \(3, 50\); must be \(any, 49\)"),
        ({"x": x}, {"y": (3,)}, r"y has the shape \(3, 50\); must be \(3\)"),
        ({"x": x}, {"z": (None, 50)}, "z"),
        ({"z": x}, {"y": (None, 50)}, "x"),
        ({"x": np.full_like(x, np.nan)}, {"y": (None, 50)}, "y holds values that are not finite"),
    ):
        with pytest.raises(InputError, match=rf"line.onnx: cannot be run \(.*{said}") as raised:
            model.run(inputs, shapes)
        assert "\n" not in str(raised.value)


def test_files_that_cannot_be_a_network_are_told_in_one_line(line, tmp_path, monkeypatch):
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "cut.onnx").write_bytes(line[1].read_bytes()[:500])
    (tmp_path / "folder.onnx").mkdir()
    for name, said in (("empty", "is no ONNX model"), ("cut", "is no ONNX model"), ("folder", "is a folder"),
                       ("none", "no such file")):  # fmt: skip
        with pytest.raises(InputError, match=rf"{name}.onnx: {said}") as raised:
            OnnxModel(tmp_path / f"{name}.onnx", FORM, "line")
        assert "\n" not in str(raised.value)
    monkeypatch.setattr(learned, "LARGEST_MODEL_BYTES", 1000)
    with pytest.raises(InputError, match=r"line.onnx: has \d+ bytes; may have 1000"):
        OnnxModel(line[1], FORM, "line")


def test_a_range_refuses_inputs_beyond_it_and_features_far_from_it():
    rng = np.random.default_rng(5)
    features, inputs = rng.normal(size=(4000, 6)), rng.uniform(1, 3, (4000, 1))
    made = fitted_range(["focal length"], inputs, features[:2000], features[2000:])
    again = TrainingRange.read(json.loads(json.dumps(made.written())), ["focal length"])
    assert np.allclose(again.precision, made.precision, rtol=1e-6)
    assert again.refusal({"focal length": 3.1}) is None
    told = again.refusal({"focal length": 3.3})
    assert told is not None
    assert told.detail == "outside the network's training: focal length is 3.3, was 1 to 3"
    assert again.refusal({"focal length": float("nan")}) is not None
    # Half of one per cent of features like the training's, and all that lie 8 deviations off.
    refused = sum(each is not None for each in again.refusals(rng.normal(size=(20000, 6))))
    assert 20 < refused < 300
    assert all(again.refusals(np.full((3, 6), 8.0)))
    assert all(again.refusals(np.full((1, 6), np.nan)))


@pytest.mark.parametrize(
    "change",
    [{"low": {}}, {"high": 3}, {"feature_mean": [0.0]}, {"feature_precision": [1.0]}, {"feature_limit": "far"},
     {"feature_limit": float("nan")}, {"feature_limit": 10**400}, {"feature_limit": []}, {"feature_limit": None},
     {"low": {"focal length": float("inf")}}],
)  # fmt: skip
def test_a_malformed_range_is_refused_in_one_line(line, change):
    features = np.random.default_rng(6).normal(size=(50, 2))
    content = fitted_range(["focal length"], features[:, :1], features, features).written()
    model = OnnxModel(line[1], FORM, "line")
    with pytest.raises(InputError, match=r"line.onnx: is no network for line \(") as raised, model.reading():
        TrainingRange.read({**content, **change}, ["focal length"])
    assert "\n" not in str(raised.value)
