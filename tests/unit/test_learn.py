"""Samples as tensors, crops, and a network that learns. Skipped where PyTorch is absent."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from simtest.dataset.learn import Samples, read_crops  # noqa: E402
from simtest.dataset.learn.network import propose, train  # noqa: E402
from simtest.dataset.shard_writer import write_dataset  # noqa: E402
from simtest.errors import InputError  # noqa: E402
from simtest.geometry.vectors import angle_deg  # noqa: E402
from simtest.runtime.engines import make_engine  # noqa: E402
from simtest.spec import load_dataset  # noqa: E402

pytestmark = [pytest.mark.extra, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Several threads take turns at so small a network, and wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learn") / "tiny"
    write_dataset(load_dataset("tiny", {"samples": 24}), folder, make_engine())
    return folder


def indices(items):
    return [item["meta"]["index"] for item in items]


@pytest.mark.slow
def test_workers_share_the_samples_out(made):
    alone = Samples(made, "train")
    loader = torch.utils.data.DataLoader(alone, batch_size=None, num_workers=2, multiprocessing_context="spawn")
    assert sorted(indices(loader)) == sorted(indices(alone))
    ranks = [indices(Samples(made, "train", rank=r, world=2)) for r in (0, 1)]
    assert sorted(ranks[0] + ranks[1]) == sorted(indices(alone))
    assert not set(ranks[0]) & set(ranks[1])


def test_shuffling_hangs_on_seed_and_epoch(made):
    first, again = Samples(made, "train", shuffle=5, seed=1), Samples(made, "train", shuffle=5, seed=1)
    order = indices(first)
    assert order == indices(again)
    again.set_epoch(1)
    assert order != indices(again)
    assert sorted(order) == sorted(indices(again))


def test_tensors_are_channels_first(made):
    item = next(iter(Samples(made, "train", fields=("image", "normal", "depth", "instance"))))
    assert item["image"].shape == (3, 48, 64)
    assert item["image"].dtype == torch.float32
    assert float(item["image"].max()) <= 1
    assert item["normal"].shape == (3, 48, 64)
    assert item["instance"].dtype == torch.uint8
    batch = Samples.collate([item, item])
    assert batch["depth"].shape == (2, 48, 64)
    with pytest.raises(InputError, match="field colour: unknown"):
        Samples(made, fields=("colour",))
    with pytest.raises(InputError, match="rank = 2"):
        Samples(made, rank=2, world=2)


def test_crops_hold_the_truth(made):
    crops = read_crops(made, "train")
    assert len(crops) >= 8
    assert np.allclose(np.linalg.norm(crops.normal, axis=1), 1)
    # Light and camera are at one place: the normal is close to the direction to the camera.
    assert angle_deg(crops.towards, crops.normal).max() < 3
    assert ((crops.axis_ratio > 0) & (crops.axis_ratio <= 1)).all()
    assert set(crops.classical) == {"circle_pose", "brightest_point", "cone_axis"}


def test_a_network_learns_the_truth(made):
    crops = read_crops(made, "train")
    untaught = np.abs(propose(train(crops, epochs=0), crops)[1] - crops.axis_ratio).mean()
    taught = train(crops, epochs=150)
    normal, ratio = propose(taught, crops)
    assert np.allclose(np.linalg.norm(normal, axis=1), 1)
    assert np.abs(ratio - crops.axis_ratio).mean() < 0.5 * untaught


def test_the_same_seed_gives_the_same_network(made):
    crops = read_crops(made, "train")
    assert np.array_equal(propose(train(crops, epochs=2), crops)[0], propose(train(crops, epochs=2), crops)[0])


def test_crops_are_linear_whatever_the_response(tmp_path):
    crops = []
    for name, response in (("srgb", {}), ("encoded", {"sensor.response": {"type": "gamma", "gamma": 1.2}})):
        values = {"samples": 6, "samples_per_anatomy": 1, "sensor.noise_sigma": 0.0, **response}
        write_dataset(load_dataset("tiny", values), tmp_path / name, make_engine())
        crops.append(read_crops(tmp_path / name, "train"))
    assert len(crops[0]) >= 2
    # A value's step is 1/255; taken for sRGB the second ones would differ by a third.
    assert np.abs(crops[0].images - crops[1].images).max() < 0.03
