"""A network is trained on a dataset, stored and described by one call; the shipped cards are those of their files."""

import hashlib
from dataclasses import replace

import numpy as np
import onnx
import pytest
from test_model_cards import HEADING, SHIPPED

from simtest.dataset.shard_writer import write_dataset
from simtest.estimators.learned_dense import LearnedDense
from simtest.runtime.processes import make_engine
from simtest.spec import load_dataset
from studies.networks.__main__ import made_network
from studies.networks.card import MEASURED, make_card, write_card
from studies.networks.dense import DenseNormals
from studies.networks.onnx_file import stored

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cards") / "tiny"
    values = {"samples": 12, "samples_per_anatomy": 2, "estimators": [], "title": "Small | frames"}
    write_dataset(load_dataset("tiny", values), folder, make_engine())
    return folder


def made(data, path):
    task = DenseNormals()
    return made_network(task, replace(task.recipe, epochs=2, title='A "line"'), data, path, bits=8)


@pytest.mark.render
def test_one_call_makes_a_network_that_runs_and_its_card(data, tmp_path):
    file = tmp_path / "own.onnx"
    trained = made(data, file)
    LearnedDense(file).check()
    card = file.with_suffix(".md").read_text()
    for said in (
        f"SHA-256 `{hashlib.sha256(file.read_bytes()).hexdigest()}`",
        f"`{hashlib.sha256((data / 'manifest.json').read_bytes()).hexdigest()}`",
        "| recipe | `tiny`, seed 1: Small \\| frames |",
        "| inputs | planes (n, 10, 96, 128) |",
        "are stored in 8 bits; computed in float32 |",
        "| learning_rate | 0.003 |",
        f"2 epochs were done. Epoch {trained.best + 1} has the smallest loss",
        f"| loss | {trained.history[trained.best]['validation_loss']:.4g} |",
    ):
        assert said in card, said
    assert card.rstrip().endswith("how often the test split was used.")
    # What people wrote is kept; made again of the same file it is the same.
    file.with_suffix(".md").write_text(card.partition(HEADING)[0] + f"{HEADING}\n\nOff by 3 deg.\n")
    again = write_card(file).read_text()
    assert again == card.partition(HEADING)[0] + f"{HEADING}\n\nOff by 3 deg.\n"


def test_weights_in_short_are_few_bytes_and_near():
    (file,) = (file for file in SHIPPED if file.stem == "learned_spot")
    model = onnx.load(file)
    assert stored(model, 32).SerializeToString() == model.SerializeToString()
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(40, 50)).astype(np.float32)
    node = onnx.helper.make_node("MatMul", ["x", "w"], ["y"])
    sizes = {"x": 40, "y": 50}
    sides = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["n", k]) for name, k in sizes.items()]
    graph = onnx.helper.make_graph([node], "g", sides[:1], sides[1:], [onnx.numpy_helper.from_array(weights, "w")])
    plain = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    lengths = [len(stored(plain, bits).SerializeToString()) for bits in (32, 16, 8)]
    assert lengths[0] > 1.8 * lengths[1] > 3 * lengths[2]


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_a_shipped_card_is_the_one_that_its_file_gives(file):
    assert MEASURED == HEADING
    card = file.with_suffix(".md").read_text(encoding="utf-8")
    assert card.startswith(make_card(file) + "\n\n")
