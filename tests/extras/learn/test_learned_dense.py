"""A dense network: trained, equal in PyTorch and ONNX Runtime, calibrated, and silent outside its training."""

import json
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from simtest.calibration import Calibration, Frame, Priors, Response
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate
from simtest.estimators import learned_dense as learned_dense_module
from simtest.estimators.learned import METADATA, TrainingRange, inflation, normal_of, rotation_of
from simtest.estimators.learned_dense import (
    CAMERA,
    CELLS,
    DISTANCE_MM,
    LearnedDense,
    camera_values,
    dense_inputs,
    log_deviation,
    output_centres,
)
from simtest.geometry import BrownConrady, Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.learned_maps import learned_maps
from simtest.reconstruction.pipeline import reconstruct
from studies.networks import onnx_file
from studies.networks.dense import (
    DenseNetwork,
    DenseNormals,
    cells_of,
    dense_scales,
    disturbed,
    evaluated,
    known_cells,
    without_factor,
)
from studies.networks.fitted import squared_distance
from studies.networks.training import Recipe, train

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]

WIDTH, HEIGHT = 192, 144
LIGHTS = ((3.0, 1.0, 0.0), (-3.0, 1.0, 0.0))


def plane(seed):
    """Return a colour picture of a matt plane lit from the camera, its unit normal, and its distances, mm."""
    rng = np.random.default_rng(seed)
    normal = np.array([*rng.uniform(-0.6, 0.6, 2), -1.0])
    normal /= np.linalg.norm(normal)
    rays = calibration().camera.unproject(calibration().camera.pixel_centres())
    distance = rng.uniform(20, 45) * normal[2] / (rays @ normal)
    light = -(rays @ normal) / distance**2 * rng.uniform(150, 250)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for column, row in rng.uniform(40, 100, (2, 2)):
        light = light + 0.6 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 12)
    noisy = light[..., None] * [1.0, 0.6, 0.5] + 0.005 * rng.normal(size=(HEIGHT, WIDTH, 3))
    return np.clip(noisy, 0, 1).astype(np.float32), normal, distance


def calibration(focal=130.0, lights=LIGHTS, width=WIDTH, height=HEIGHT, **camera):
    lens = Camera(width, height, focal, focal, width / 2, height / 2, **camera)
    return Calibration(lens, Response("srgb"), priors=Priors(lights_mm=lights))


def examples(seeds):
    made = {"planes": [], "rotation": [], "distance": [], "camera": []}
    for seed in seeds:
        picture, normal, distance = plane(seed)
        frame = Frame(picture, calibration(), 1.0)
        rays = frame.camera.unproject(output_centres(frame.camera)).reshape(-1, 3)
        rotation = rotation_of(rays, np.broadcast_to(normal, rays.shape))
        made["planes"].append(dense_inputs(frame))
        made["rotation"].append(rotation.T.reshape(2, *CELLS))
        made["distance"].append(distance[1::3, 1::3])
        made["camera"].append(camera_values(frame))
    return {name: torch.from_numpy(np.float32(values)) for name, values in made.items()}


SHORT = Recipe(
    "Planes", "dense_normals", 0, epochs=6, batch=4, learning_rate=0.01, weight_decay=1e-3, patience=0, width=0.25
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    torch.set_num_threads(1)
    path = tmp_path_factory.mktemp("dense") / "model.onnx"
    taught, judged = examples(range(24)), examples(range(100, 116))
    task = DenseNormals()
    trained = train(task, SHORT, taught, judged)
    return trained, taught, judged, task.export(trained.network, taught, judged, path, {"dataset": "planes"})


def test_a_small_training_learns_planes(made):
    first, last = (made[0].history[epoch] for epoch in (0, -1))
    for name, share in (("normal, deg", 0.95), ("distance after a factor, %", 0.7)):
        assert last[f"median error of the {name}"] < share * first[f"median error of the {name}"]
    assert last["validation_loss"] < first["validation_loss"] - 0.3


def test_the_shipped_network_is_small():
    network = DenseNormals().network(examples([0, 1]), DenseNormals.recipe.width)
    assert sum(values.numel() for values in network.parameters()) < 150_000


def test_onnx_gives_what_pytorch_gives(made):
    trained, _, judged, path = made
    session = onnxruntime.InferenceSession(path.read_bytes())
    with torch.no_grad():
        wanted = [each.numpy() for each in trained.network(judged["planes"])]
    for one, other in zip(session.run(None, {"planes": judged["planes"].numpy()}), wanted, strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() < 1e-5 * max(1, np.abs(other).max())


def test_eight_bits_change_the_outputs_little(made, tmp_path):
    _, _, judged, path = made
    # The tiny network's tensors are below the size from which weights are stored in fewer bits.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(onnx_file, "LEAST_STORED", 50)
        small = onnx_file.stored(onnx.load(path), 8)
    data = small.SerializeToString()
    assert len(data) < 0.8 * path.stat().st_size
    inputs = {"planes": judged["planes"].numpy()}
    one, other = (onnxruntime.InferenceSession(each).run(None, inputs)[0] for each in (path.read_bytes(), data))
    off = np.abs(one - other)
    assert off.max() > 0
    assert np.median(off) < 0.02 * one.std()


def test_scales_put_95_percent_of_the_validation_split_inside(made):
    trained, _, judged, path = made
    outputs, features = evaluated(trained.network, judged["planes"])
    content = json.loads(onnxruntime.InferenceSession(path.read_bytes()).get_modelmeta().custom_metadata_map[METADATA])
    distances = TrainingRange.read(content, CAMERA).distances(features.numpy())
    # Half of the validation split's frames are less sure than the network states.
    inflated = inflation(distances, content["feature_usual"])
    assert (inflated > 1).sum() == len(inflated) // 2
    base, distance = dense_scales(outputs, judged, inflated)
    assert content["scales"]["base"]["factor"] == pytest.approx(base.factor, rel=1e-5)
    assert content["about"] == {"dataset": "planes"}
    values, rotation, log_distance = known_cells(outputs, judged)
    stated = values.double().numpy()
    # 16 frames: the share that holds a seventeenth frame's at 95 % is larger.
    factors = np.repeat(inflated, cells_of(judged).numpy())
    inside = squared_distance(values, rotation).numpy() / base.at(log_deviation(stated)) / factors < 5.991
    assert 0.95 < inside.mean() <= 1
    logarithm = np.clip(stated[:, 6], -5, 2)
    off = (log_distance.numpy() - stated[:, 5]) / np.exp(logarithm)
    assert 0.95 < (off**2 / distance.at(logarithm) / factors < 3.8415).mean() <= 1
    # Without the factors it does not hold: the network was too sure.
    assert min(base.factor + distance.factor) != 1


def test_maps_are_those_of_the_network(made):
    trained, _, _, path = made
    picture = plane(200)[0]
    maps = LearnedDense(path).maps(picture, calibration())
    assert not isinstance(maps, Failure), maps
    assert maps.normal.shape == (HEIGHT, WIDTH, 3)
    assert maps.covariance.shape == (HEIGHT, WIDTH, 2, 2)
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
    with torch.no_grad():
        outputs = trained.network(torch.from_numpy(dense_inputs(Frame(picture, calibration(), 1.0)))[None])[0][
            0
        ].numpy()
    # Each third pixel has its centre at that of a cell.
    assert np.allclose(maps.distance_mm[1::3, 1::3], DISTANCE_MM * np.exp(0.5 * outputs[5]), rtol=1e-4)
    rays = calibration().camera.unproject(output_centres(calibration().camera)).reshape(-1, 3)
    wanted = normal_of(rays, 0.5 * outputs[:2].reshape(2, -1).T)
    assert angle_deg(maps.normal[1::3, 1::3].reshape(-1, 3).astype(float), wanted).max() < 0.05
    assert (maps.deviation_mm > 0).all()


def test_the_pipeline_runs_it_beside_the_others(made):
    picture, _, _ = plane(300)
    learned = LearnedDense(made[3])
    found = reconstruct(picture, calibration(), {"one": learned}, smoothing_px=1.0, detector="peaks")
    results = [each.estimates["one"] for each in found]
    assert results
    maps = learned.maps(picture, calibration())
    for result in results:
        assert isinstance(result, Estimate), result
        assert result.target == "base"
        column, row = result.look_px.astype(int)
        assert angle_deg(result.normal[None], maps.normal[row, column].astype(float)[None])[0] < 3
        assert np.all(np.linalg.eigvalsh(result.covariance) > 0)
    with pytest.raises(InputError, match=r"other.onnx: (no such file|cannot be read)"):
        learned.with_model("other.onnx")


def test_a_factor_of_a_frame_is_no_error_of_its_shape(made):
    cells = torch.tensor([3, 0, 2])
    left = without_factor(torch.tensor([1.0, 2.0, 3.0, 5.0, 9.0]), cells)
    assert left.tolist() == [-1.0, 0.0, 1.0, -2.0, 2.0]
    trained, _, judged, _ = made
    task, part = DenseNormals(), {name: values[:4].clone() for name, values in judged.items()}
    with torch.no_grad():
        before = task.metrics(trained.network, part)
        part["distance"][1] *= 1.7
        after = task.metrics(trained.network, part)
    key = "median error of the distance after a factor, %"
    assert after[key] == pytest.approx(before[key], rel=1e-3)
    assert abs(after["median error of the distance, %"] - before["median error of the distance, %"]) > 1


def test_disturbed_frames_keep_truth_and_empty_cells(made):
    taught = made[1]
    taught = {name: values[:12].clone() for name, values in taught.items()}
    taught["planes"][:, :5, :10] = 0
    changed = disturbed(taught, torch.Generator().manual_seed(0))
    assert torch.equal(changed["rotation"], taught["rotation"])
    assert (changed["planes"][:, :5, :10] == 0).all()
    assert torch.equal(changed["planes"][:, 5:], taught["planes"][:, 5:])
    assert not torch.allclose(changed["planes"][:, 0], taught["planes"][:, 0], atol=0.05)
    # Some views are cut, not all.
    lost = ((changed["planes"][:, 4] == 0) & (taught["planes"][:, 4] > 0)).flatten(1).any(dim=1)
    assert 0 < lost.sum() < len(lost)
    again = disturbed(taught, torch.Generator().manual_seed(0))
    assert torch.equal(again["planes"], changed["planes"])


def with_metadata(source, target, **values):
    model = onnx.load(source)
    changed(**values)(model)
    onnx.save(model, target)
    return LearnedDense(target)


def test_far_features_make_maps_less_certain(made, tmp_path):
    picture = plane(200)[0]
    plain = LearnedDense(made[3])
    network = plain._network
    features = network._model.run(
        {"planes": dense_inputs(Frame(picture, calibration(), 1.0))[None]},
        {"outputs": (1, 7, *CELLS), "features": (1, 12)},
    )[1]
    (distance,) = network._range.distances(features)
    near = with_metadata(made[3], tmp_path / "near.onnx", feature_usual=2 * distance).maps(picture, calibration())
    far = with_metadata(made[3], tmp_path / "far.onnx", feature_usual=distance / 9).maps(picture, calibration())
    assert np.allclose(far.covariance, 9 * near.covariance, rtol=1e-3)
    assert np.allclose(far.deviation_mm, 3 * near.deviation_mm, rtol=1e-3)
    assert np.array_equal(far.normal, near.normal)
    assert np.array_equal(far.distance_mm, near.distance_mm)


def test_maps_are_of_the_view_alone(made):
    picture = plane(200)[0]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    inside = (x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2 < (0.48 * HEIGHT) ** 2
    bordered = np.where(inside[..., None], picture, 0).astype(np.float32)
    limitless = LearnedDense(made[3])
    object.__setattr__(limitless._network._range, "limit", np.inf)
    found = learned_maps(bordered, calibration(), limitless)
    known = np.isfinite(found.distance_mm)
    assert np.array_equal(known, np.isfinite(found.normal).all(axis=-1))
    assert not known[~inside].any()
    assert known.sum() > 0.85 * inside.sum()
    # A whole picture keeps all its pixels.
    assert np.isfinite(learned_maps(picture, calibration(), limitless).distance_mm).all()


def test_maps_and_highlights_that_contradict_the_law_of_reflection_are_refused(made, monkeypatch):
    picture = plane(300)[0]
    learned = LearnedDense(made[3])
    points = np.random.default_rng(3).uniform(20, 120, (6, 2))
    assert not isinstance(learned.maps(picture, calibration(), points), Failure)
    squared = learned.contradictions(Frame(picture, calibration(), 1.0), points)
    assert squared.shape == (6,)
    monkeypatch.setattr(learned_dense_module, "REFLECTION_LIMIT", 0.99 * squared.mean() / 2)
    assert "contradicts the law of reflection at 6" in learned.maps(picture, calibration(), points).detail
    assert not isinstance(learned.maps(picture, calibration(), points[:3]), Failure)
    monkeypatch.setattr(learned_dense_module, "REFLECTION_LIMIT", 2.0)
    monkeypatch.setattr(learned_dense_module, "HIGHLIGHT_LIMIT", float(np.sort(squared)[2:4].mean()))
    answers = learned._at(Frame(picture, calibration(), 1.0), list(points))
    refused = np.array([isinstance(answer, Failure) for answer in answers])
    assert np.array_equal(refused, squared > np.median(squared))
    assert all(
        "contradicts the law of reflection: squared" in each.detail for each in answers if each.__class__ is Failure
    )


def refusal(path, picture=None, **changes):
    picture = plane(1)[0] if picture is None else picture
    made = LearnedDense(path).maps(picture, calibration(**changes))
    assert isinstance(made, Failure)
    return made.detail


@pytest.mark.parametrize(
    ("changes", "size", "said"),
    [
        ({"focal": 300.0}, None, "log of the focal length along x"),
        ({"lights": ((40.0, 0.0, 0.0),)}, None, "mean light, x"),
        ({"lights": ()}, None, "needs the lights"),
        ({"distortion": BrownConrady(k1=-0.05)}, None, "a lens with distortion"),
        ({"width": 300, "height": 144}, (144, 300, 3), "width over height is 2.08, may be 1 to 1.9"),
        ({"width": 144, "height": 192}, (192, 144, 3), "width over height is 0.75"),
        ({"width": 96, "height": 72}, (72, 96, 3), "a cell has 0.75 px, may have 1.5 to 20"),
        ({}, (144, 192), "a frame of one channel"),
    ],
    ids=["lens", "lights", "no lights", "distortion", "wide", "upright", "small", "grey"],
)
def test_it_refuses_what_it_was_not_taught(made, changes, size, said):
    assert said in refusal(made[3], None if size is None else np.full(size, 0.5, np.float32), **changes)


def test_it_refuses_frames_unlike_those_of_its_training(made):
    blocks = np.random.default_rng(0).integers(0, 2, (HEIGHT // 12, WIDTH // 12, 3)).astype(np.float32)
    assert "unlike the network's training" in refusal(made[3], blocks.repeat(12, axis=0).repeat(12, axis=1))
    found = reconstruct(
        plane(1)[0], calibration(lights=()), {"one": LearnedDense(made[3])}, smoothing_px=1.0, detector="peaks"
    )
    assert all("needs the lights" in each.estimates["one"].detail for each in found)


def changed(**values):
    def change(model):
        content = json.loads(model.metadata_props[0].value)
        content.update(values)
        model.metadata_props[0].value = json.dumps(content)

    return change


def other_input(model):
    for node in model.graph.node:
        node.input[:] = ["pictures" if name == "planes" else name for name in node.input]
    model.graph.input[0].name = "pictures"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda model: model.metadata_props.pop(), "is no network for learned_dense"),
        (changed(format="simtest spot_normals, version 2"), "format 'simtest spot_normals"),
        (changed(scales={"base": {"log_deviation": [0.0], "factor": [1.0]}}), "KeyError"),
        (
            changed(scales={name: {"log_deviation": [0.0], "factor": [-1.0]} for name in ("base", "distance")}),
            "above 0",
        ),
        (changed(low={}), "KeyError"),
        (changed(feature_usual=0), "feature_usual = 0.0: must be above 0"),
        (changed(feature_mean=[0.0]), "does not fit"),
        (other_input, r"cannot be run \(.*planes"),
    ],
    ids=[
        "no metadata",
        "another task",
        "a scale missing",
        "a scale below 0",
        "no ranges",
        "usual 0",
        "other features",
        "inputs",
    ],
)
def test_another_model_is_refused_in_one_line(made, tmp_path, change, said):
    model = onnx.load(made[3])
    change(model)
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=said) as raised:
        LearnedDense(tmp_path / "other.onnx").maps(plane(1)[0], calibration())
    assert "\n" not in str(raised.value)
    assert "other.onnx" in str(raised.value)


def test_what_is_no_model_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match=r"text.onnx: is no ONNX model"):
        LearnedDense(tmp_path / "text.onnx").check()
    with pytest.raises(InputError, match=r"none.onnx: no such file"):
        LearnedDense(tmp_path / "none.onnx").check()


def test_it_needs_no_pytorch(made):
    code = (
        "import sys; sys.modules['torch'] = None; "
        "from simtest.estimators.learned_dense import LearnedDense; "
        f"LearnedDense({str(made[3])!r}).check()"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr


def test_whole_frames_reach_the_deepest_cells():
    # A change in one corner moves what the network states in the other.
    torch.manual_seed(0)
    network = DenseNetwork(torch.zeros(10), torch.ones(10), 0.25).eval()
    planes = torch.zeros((2, 10, 96, 128))
    planes[1, :, :8, :8] = 50.0
    with torch.no_grad():
        outputs, features = network(planes)
    assert outputs.shape == (2, 7, *CELLS)
    assert not torch.equal(outputs[0, :, -1, -1], outputs[1, :, -1, -1])
    assert features.shape == (2, 12)
