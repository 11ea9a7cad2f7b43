"""The training engine: seed, checkpoints, resume, early stop, page, refusals. Skipped where PyTorch is absent."""

import json

import numpy as np
import pytest
import torch

from simtest.dataset.learn.checkpoint import BEST, LAST, read_state
from simtest.dataset.learn.engine import train
from simtest.dataset.learn.page import write_page
from simtest.dataset.learn.runs import run_training
from simtest.dataset.learn.tasks import load_task
from simtest.dataset.learn.training import Training, load_training
from simtest.errors import InputError

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]


SHORT = {"name": "line", "task": "line", "epochs": 4, "batch": 16, "learning_rate": 0.03, "patience": 0}


class Line:
    """A line through points, with dropout and noise on its inputs: everything random that a task may use."""

    name = "line"
    evaluated_at_once = 16

    def augmented(self, batch, generator):
        return {**batch, "x": batch["x"] + 0.01 * torch.randn(batch["x"].shape, generator=generator)}

    def network(self, examples, training):
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


def run(out, progress=None, **values):
    return train(Training(**{**SHORT, **values}), Line(), TAUGHT, JUDGED, out, progress)


@pytest.mark.parametrize("step", [1, 6, 9, 16])
def test_a_resumed_training_ends_with_the_weights_of_an_undisturbed_one(tmp_path, step):
    whole = run(tmp_path / "whole")

    def stop(done, total, what):
        if done == step:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", stop)
    # What is there is a whole checkpoint of the last finished epoch: four steps each.
    there = tmp_path / "stopped" / LAST
    assert there.exists() == (step > 4)
    if there.exists():
        assert len(read_state(there).history) == (step - 1) // 4
    resumed = run(tmp_path / "stopped")
    assert torch.equal(weights(resumed), weights(whole))
    assert resumed.state == whole.state
    for name in (LAST, BEST):
        assert (tmp_path / "stopped" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert (tmp_path / "whole" / LAST).stat().st_mode & 0o777 == (tmp_path / "whole").stat().st_mode & 0o666
    # A finished training is not done again.
    assert run(tmp_path / "whole", stop).state == whole.state


def test_the_seed_decides_and_the_network_learns(tmp_path):
    first, other = run(tmp_path / "a", epochs=30), run(tmp_path / "b", epochs=30, seed=1)
    assert not torch.equal(weights(first), weights(other))
    losses = [epoch.validation_loss for epoch in first.state.history]
    assert losses[-1] < 0.1 * losses[0]
    assert losses[first.state.best] == min(losses)


def test_training_stops_when_nothing_is_gained(tmp_path):
    # So large a step gains nothing after the first epochs.
    trained = run(tmp_path, epochs=200, patience=3, learning_rate=0.3)
    assert len(trained.state.history) < 200
    assert trained.state.waited == 3
    assert trained.state.history[trained.state.best].validation_loss == min(
        epoch.validation_loss for epoch in trained.state.history
    )


def test_another_training_in_the_folder_is_refused(tmp_path):
    run(tmp_path, epochs=1)
    with pytest.raises(InputError, match=r"holds another training \(learning_rate = 0.03 there, 0.01 here\)"):
        run(tmp_path, epochs=1, learning_rate=0.01)
    with pytest.raises(InputError, match=r"holds another training \(data = "):
        train(Training(**{**SHORT, "epochs": 1}), Line(), points(64, 3), JUDGED, tmp_path)
    with pytest.raises(InputError, match="split validation: holds no example"):
        train(Training(**SHORT), Line(), TAUGHT, points(0, 0), tmp_path / "none")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda data: b"", "is no checkpoint"),
        (lambda data: data[:40], "is no checkpoint"),
        (lambda data: data.replace(b'\\"best\\"', b'\\"bost\\"'), "is no checkpoint"),
        (lambda data: data.replace(b"network.0.weight", b"network.9.weight"), "fits no network"),
    ],
    ids=["empty", "cut", "without its state", "of another network"],
)
def test_a_damaged_checkpoint_is_told_in_one_line(tmp_path, damage, said):
    run(tmp_path, epochs=1)
    (tmp_path / LAST).write_bytes(damage((tmp_path / LAST).read_bytes()))
    with pytest.raises(InputError, match=said) as raised:
        run(tmp_path, epochs=1)
    assert "\n" not in str(raised.value)
    assert LAST in str(raised.value)


def test_a_loss_that_is_not_finite_is_told(tmp_path):
    class Broken(Line):
        def loss(self, network, batch):
            return super().loss(network, batch) * float("nan")

    with pytest.raises(InputError, match=r"learning_rate = 0.03: the loss is nan at step 0"):
        train(Training(**SHORT), Broken(), TAUGHT, JUDGED, tmp_path)


def test_the_page_shows_the_curves(tmp_path):
    trained = run(tmp_path)
    page = write_page(Training(**SHORT), trained.state, tmp_path, "data/<line>")
    text = page.read_text()
    assert "largest error" in text
    assert "data/&lt;line&gt;" in text
    content = json.loads((tmp_path / "training.json").read_text())
    assert [row["epoch"] for row in content["epochs"]] == [1, 2, 3, 4]
    assert content["best_epoch"] == trained.state.best + 1
    assert np.isfinite([row["train_loss"] for row in content["epochs"]]).all()
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {"loss.png", "metric-1.png"}


def test_files_of_trainings_are_checked(tmp_path):
    assert load_training("spot_normals").task == "spot_normals"
    assert load_training("spot_normals", {"epochs": 3}).epochs == 3
    for text, said in (
        ('task = "spot_normals"\nepochs = 0', "epochs = 0"),
        ('task = "spot_normals"\nlearning_rate = "fast"', "learning_rate"),
        ('task = "spot_normals"\nrate = 1', "unknown key"),
        ("epochs = 3", "task"),
    ):
        (tmp_path / "own.toml").write_text(text)
        with pytest.raises(InputError, match=said) as raised:
            load_training(tmp_path / "own.toml")
        assert "\n" not in str(raised.value)
    with pytest.raises(InputError, match=r"task = spot_normal: unknown; allowed: .*spot_normals \(did you mean"):
        load_task("spot_normal")
    with pytest.raises(InputError, match="no dataset to read"):
        run_training(load_training("spot_normals"), tmp_path, tmp_path / "out")
