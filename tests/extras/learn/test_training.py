"""The training loop of the shipped networks: seed, best epoch, early stop, refusals. Needs PyTorch."""

from dataclasses import replace

import pytest
import torch

from simtest.errors import InputError
from studies.networks.dense import DenseNormals
from studies.networks.training import Recipe, train

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]


SHORT = Recipe("A line", "line", seed=0, epochs=4, batch=16, learning_rate=0.03, weight_decay=1e-3, patience=0)


class Line:
    """A line through points, with dropout and noise on its inputs: everything random that a task may use."""

    evaluated_at_once = 16

    def augmented(self, batch, generator):
        return {**batch, "x": batch["x"] + 0.01 * torch.randn(batch["x"].shape, generator=generator)}

    def network(self, taught, width):
        return torch.nn.Sequential(torch.nn.Linear(2, 8), torch.nn.Dropout(0.2), torch.nn.Linear(8, 1))

    def loss(self, network, batch):
        return torch.nn.functional.mse_loss(network(batch["x"])[:, 0], batch["y"])

    def metrics(self, network, batch):
        return {"largest error": float((network(batch["x"])[:, 0] - batch["y"]).abs().max())}


def points(count, seed):
    x = torch.randn((count, 2), generator=torch.Generator().manual_seed(seed))
    return {"x": x, "y": x @ torch.tensor([1.0, -2.0]) + 0.5}


TAUGHT, JUDGED = points(64, 1), points(32, 2)


def weights(trained):
    return torch.cat([tensor.flatten() for tensor in trained.network.state_dict().values()])


def run(task=None, **values):
    return train(task or Line(), replace(SHORT, **values), TAUGHT, JUDGED)


def test_the_seed_decides_and_the_network_learns():
    first, again, other = run(epochs=30), run(epochs=30), run(epochs=30, seed=1)
    assert torch.equal(weights(first), weights(again))
    assert not torch.equal(weights(first), weights(other))
    losses = [epoch["validation_loss"] for epoch in first.history]
    assert losses[-1] < 0.1 * losses[0]
    assert losses[first.best] == min(losses)


def test_the_best_epoch_is_kept_and_training_stops_when_nothing_is_gained():
    # So large a step gains nothing after the first epochs.
    trained = run(epochs=200, patience=3, learning_rate=0.3)
    losses = [epoch["validation_loss"] for epoch in trained.history]
    assert len(losses) < 200
    assert len(losses) - 1 - trained.best == 3
    with torch.no_grad():
        assert float(Line().loss(trained.network, JUDGED)) == pytest.approx(min(losses), rel=1e-5)


def test_a_loss_that_is_not_finite_is_told():
    class Broken(Line):
        def loss(self, network, batch):
            return super().loss(network, batch) * float("nan")

    with pytest.raises(InputError, match=r"learning_rate = 0.03: the loss is nan at step 0"):
        run(Broken())


def test_a_folder_without_a_dataset_is_told(tmp_path):
    with pytest.raises(InputError, match="no dataset to read"):
        DenseNormals().examples(tmp_path, "train")
