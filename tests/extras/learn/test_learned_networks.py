"""The networks as estimators: equal in PyTorch and ONNX Runtime, calibrated, and silent outside their training."""

import json
import subprocess
import sys
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from simtest.calibration import Calibration, Frame, Priors, Response
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate
from simtest.estimators import learned_dense as learned_dense_module
from simtest.estimators.learned import (
    METADATA,
    CovarianceScale,
    TrainingRange,
    inflation,
    log_deviation,
    normal_of,
    rotation_of,
)
from simtest.estimators.learned_dense import (
    CAMERA,
    CELLS,
    DISTANCE_MM,
    LearnedDense,
    camera_values,
    dense_inputs,
    output_centres,
)
from simtest.estimators.learned_spot import EXTRAS, LearnedSpot, spot_inputs
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
from studies.networks.fitted import fitted_scale, squared_distance
from studies.networks.spots import SpotNormals
from studies.networks.spots import squared_distance as spot_distance
from studies.networks.training import Recipe, train

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]

WIDTH, HEIGHT = 192, 144
SIZE = 96
LIGHTS = ((3.0, 1.0, 0.0), (-3.0, 1.0, 0.0))


class Made(NamedTuple):
    """A network for a test: trained or drawn, what it was taught and judged on, and its file."""

    estimator: type
    trained: Any
    taught: dict
    judged: dict
    path: Any
    inputs: tuple


def plane(seed):
    """Return a colour picture of a matt plane lit from the camera, its unit normal, and its distances, mm."""
    rng = np.random.default_rng(seed)
    normal = np.array([*rng.uniform(-0.6, 0.6, 2), -1.0])
    normal /= np.linalg.norm(normal)
    rays = dense_calibration().camera.unproject(dense_calibration().camera.pixel_centres())
    distance = rng.uniform(20, 45) * normal[2] / (rays @ normal)
    light = -(rays @ normal) / distance**2 * rng.uniform(150, 250)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for column, row in rng.uniform(40, 100, (2, 2)):
        light = light + 0.6 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 12)
    noisy = light[..., None] * [1.0, 0.6, 0.5] + 0.005 * rng.normal(size=(HEIGHT, WIDTH, 3))
    return np.clip(noisy, 0, 1).astype(np.float32), normal, distance


def dense_calibration(focal=130.0, lights=LIGHTS, width=WIDTH, height=HEIGHT, **camera):
    lens = Camera(width, height, focal, focal, width / 2, height / 2, **camera)
    return Calibration(lens, Response("srgb"), priors=Priors(lights_mm=lights))


def dense_examples(seeds):
    made = {"planes": [], "rotation": [], "distance": [], "camera": []}
    for seed in seeds:
        picture, normal, distance = plane(seed)
        frame = Frame(picture, dense_calibration(), 1.0)
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
def dense(tmp_path_factory):
    torch.set_num_threads(1)
    path = tmp_path_factory.mktemp("dense") / "model.onnx"
    taught, judged = dense_examples(range(24)), dense_examples(range(100, 116))
    task = DenseNormals()
    trained = train(task, SHORT, taught, judged)
    task.export(trained.network, taught, judged, path, {"dataset": "drawn"})
    return Made(LearnedDense, trained, taught, judged, path, ("planes",))


def picture(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    light = 0.1 + 0.002 * rng.normal(size=(SIZE, SIZE))
    for column, row in rng.uniform(25, SIZE - 25, (3, 2)):
        light += 0.6 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / rng.uniform(15, 40))
    return np.clip(light, 0, 1).astype(np.float32)


def spot_calibration(focal=90.0, lights=LIGHTS, **camera):
    return Calibration(Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, **camera), priors=Priors(lights_mm=lights))


def spot_examples(seeds):
    """Return inputs at the spots of frames, with rotations that the network cannot predict exactly."""
    rng = np.random.default_rng(seeds[0])
    crops, extras = [], []
    for seed in seeds:
        frame = Frame(picture(seed), spot_calibration(), 1.0)
        each = spot_inputs(frame, rng.uniform(20, SIZE - 20, (6, 2)))
        crops.append(each[0])
        extras.append(each[1])
    batch = {"crops": np.concatenate(crops), "extras": np.concatenate(extras)}
    count = len(batch["crops"])
    for name in ("base", "fine"):
        batch[name] = rng.normal(0, 0.1, (count, 2)).astype(np.float32)
        batch[f"{name}_ratio"] = rng.uniform(0.2, 1, count).astype(np.float32)
    return {name: torch.from_numpy(values) for name, values in batch.items()}


@pytest.fixture(scope="module")
def spot(tmp_path_factory):
    taught, judged = spot_examples(range(30)), spot_examples(range(100, 120))
    task = SpotNormals()
    torch.manual_seed(3)
    network = task.network(taught, 1.0).eval()
    path = tmp_path_factory.mktemp("spot") / "model.onnx"
    task.export(network, taught, judged, path, {"dataset": "drawn"})
    return Made(LearnedSpot, network, taught, judged, path, ("crops", "extras"))


# Of both --------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["dense", "spot"])
def made(request):
    return request.getfixturevalue(request.param)


def test_onnx_gives_what_pytorch_gives(made):
    inputs = {name: made.judged[name] for name in made.inputs}
    with torch.no_grad():
        wanted = [each.numpy() for each in getattr(made.trained, "network", made.trained)(*inputs.values())]
    session = onnxruntime.InferenceSession(made.path.read_bytes())
    found = session.run(None, {name: values.numpy() for name, values in inputs.items()})
    for one, other in zip(found, wanted, strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() < 1e-5 * max(1, np.abs(other).max())


def changed(**values):
    def change(model):
        content = json.loads(model.metadata_props[0].value)
        content.update(values)
        model.metadata_props[0].value = json.dumps(content)

    return change


def other_input(model):
    """Call a network's first input otherwise."""
    first = model.graph.input[0].name
    for node in model.graph.node:
        node.input[:] = ["pictures" if name == first else name for name in node.input]
    model.graph.input[0].name = "pictures"


def scales(deviations, factors):
    return {name: {"log_deviation": deviations, "factor": factors} for name in ("base", "fine", "distance")}


def rewritten(made, folder, change):
    """Return the estimator with a network whose file was changed."""
    model = onnx.load(made.path)
    change(model)
    onnx.save(model, folder / "other.onnx")
    return made.estimator(folder / "other.onnx")


OTHERS = {
    "another task": (changed(format="simtest lines, version 2"), "format 'simtest lines"),
    "a scale missing": (changed(scales={}), "KeyError"),
    "a scale of an older form": (changed(scales={"base": 1.0, "fine": 1.0, "distance": 1.0}), "TypeError"),
    "a scale below 0": (changed(scales=scales((0.0,), (-1.0,))), "above 0"),
    "too few scales": (changed(scales=scales((0.0,), (1.0, 2.0))), "as many factors as deviations"),
    "scales in disorder": (changed(scales=scales((1.0, 0.0), (1.0, 2.0))), "must ascend"),
    "no ranges": (changed(low={}), "KeyError"),
    "a range of another form": (changed(low=3), "is no network for learned_"),
    "other features": (changed(feature_mean=[0.0]), "does not fit"),
    "a usual distance of 0": (changed(feature_usual=0), "feature_usual = 0.0: must be above 0"),
}


@pytest.mark.parametrize("what", OTHERS)
def test_another_model_is_refused_in_one_line(dense, spot, tmp_path, what):
    change, said = OTHERS[what]
    for made in (dense, spot):
        with pytest.raises(InputError, match=rf"other.onnx: .*{said}") as raised:
            rewritten(made, tmp_path, change).check()
        assert "\n" not in str(raised.value)


def test_a_network_of_other_inputs_is_refused_in_one_line(made, tmp_path):
    learned, first = rewritten(made, tmp_path, other_input), made.inputs[0]
    frame, calibrated = (plane(1)[0], dense_calibration()) if first == "planes" else (picture(7), spot_calibration())
    with pytest.raises(InputError, match=rf"other.onnx: cannot be run \(.*{first}") as raised:
        reconstruct(frame, calibrated, {"one": learned}, smoothing_px=2.0, detector="peaks")
    assert "\n" not in str(raised.value)


def test_they_need_no_pytorch(dense, spot):
    code = (
        "import sys; sys.modules['torch'] = None; "
        "from simtest.estimators.learned_dense import LearnedDense; "
        "from simtest.estimators.learned_spot import LearnedSpot; "
        f"LearnedDense({str(dense.path)!r}).check(); LearnedSpot({str(spot.path)!r}).check()"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr


# Whole frames ---------------------------------------------------------------------------------------------------------


def test_a_small_training_learns_planes(dense):
    first, last = (dense.trained.history[epoch] for epoch in (0, -1))
    for name, share in (("normal, deg", 0.95), ("distance after a factor, %", 0.7)):
        assert last[f"median error of the {name}"] < share * first[f"median error of the {name}"]
    assert last["validation_loss"] < first["validation_loss"] - 0.3


def test_the_shipped_network_is_small():
    network = DenseNormals().network(dense_examples([0, 1]), DenseNormals.recipe.width)
    assert sum(values.numel() for values in network.parameters()) < 150_000


def test_eight_bits_change_the_outputs_little(dense, tmp_path):
    judged, path = dense.judged, dense.path
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


def test_scales_put_95_percent_of_the_validation_split_inside(dense):
    trained, judged, path = dense.trained, dense.judged, dense.path
    outputs, features = evaluated(trained.network, judged["planes"])
    content = json.loads(onnxruntime.InferenceSession(path.read_bytes()).get_modelmeta().custom_metadata_map[METADATA])
    distances = TrainingRange.read(content, CAMERA).distances(features.numpy())
    # Half of the validation split's frames are less sure than the network states.
    inflated = inflation(distances, content["feature_usual"])
    assert (inflated > 1).sum() == len(inflated) // 2
    base, distance = dense_scales(outputs, judged, inflated)
    assert content["scales"]["base"]["factor"] == pytest.approx(base.factor, rel=1e-5)
    assert content["about"] == {"dataset": "drawn"}
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


def test_maps_are_those_of_the_network(dense):
    trained, path = dense.trained, dense.path
    picture = plane(200)[0]
    maps = LearnedDense(path).maps(picture, dense_calibration())
    assert not isinstance(maps, Failure), maps
    assert maps.normal.shape == (HEIGHT, WIDTH, 3)
    assert maps.covariance.shape == (HEIGHT, WIDTH, 2, 2)
    assert np.allclose(np.linalg.norm(maps.normal, axis=-1), 1, atol=1e-5)
    with torch.no_grad():
        outputs = trained.network(torch.from_numpy(dense_inputs(Frame(picture, dense_calibration(), 1.0)))[None])[0][
            0
        ].numpy()
    # Each third pixel has its centre at that of a cell.
    assert np.allclose(maps.distance_mm[1::3, 1::3], DISTANCE_MM * np.exp(0.5 * outputs[5]), rtol=1e-4)
    rays = dense_calibration().camera.unproject(output_centres(dense_calibration().camera)).reshape(-1, 3)
    wanted = normal_of(rays, 0.5 * outputs[:2].reshape(2, -1).T)
    assert angle_deg(maps.normal[1::3, 1::3].reshape(-1, 3).astype(float), wanted).max() < 0.05
    assert (maps.deviation_mm > 0).all()


def test_the_pipeline_runs_it_beside_the_others(dense):
    picture, _, _ = plane(300)
    learned = LearnedDense(dense.path)
    found = reconstruct(picture, dense_calibration(), {"one": learned}, smoothing_px=1.0, detector="peaks")
    results = [each.estimates["one"] for each in found]
    assert results
    maps = learned.maps(picture, dense_calibration())
    for result in results:
        assert isinstance(result, Estimate), result
        assert result.target == "base"
        column, row = result.look_px.astype(int)
        assert angle_deg(result.normal[None], maps.normal[row, column].astype(float)[None])[0] < 3
        assert np.all(np.linalg.eigvalsh(result.covariance) > 0)
    with pytest.raises(InputError, match=r"other.onnx: (no such file|cannot be read)"):
        learned.with_model("other.onnx")


def test_a_factor_of_a_frame_is_no_error_of_its_shape(dense):
    cells = torch.tensor([3, 0, 2])
    left = without_factor(torch.tensor([1.0, 2.0, 3.0, 5.0, 9.0]), cells)
    assert left.tolist() == [-1.0, 0.0, 1.0, -2.0, 2.0]
    trained, judged = dense.trained, dense.judged
    task, part = DenseNormals(), {name: values[:4].clone() for name, values in judged.items()}
    with torch.no_grad():
        before = task.metrics(trained.network, part)
        part["distance"][1] *= 1.7
        after = task.metrics(trained.network, part)
    key = "median error of the distance after a factor, %"
    assert after[key] == pytest.approx(before[key], rel=1e-3)
    assert abs(after["median error of the distance, %"] - before["median error of the distance, %"]) > 1


def test_disturbed_frames_keep_truth_and_empty_cells(dense):
    taught = dense.taught
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


def test_far_features_make_maps_less_certain(dense, tmp_path):
    picture = plane(200)[0]
    plain = LearnedDense(dense.path)
    network = plain._network
    features = network._model.run(
        {"planes": dense_inputs(Frame(picture, dense_calibration(), 1.0))[None]},
        {"outputs": (1, 7, *CELLS), "features": (1, 12)},
    )[1]
    (distance,) = network._range.distances(features)
    near, far = (
        rewritten(dense, tmp_path, changed(feature_usual=usual)).maps(picture, dense_calibration())
        for usual in (2 * distance, distance / 9)
    )
    assert np.allclose(far.covariance, 9 * near.covariance, rtol=1e-3)
    assert np.allclose(far.deviation_mm, 3 * near.deviation_mm, rtol=1e-3)
    assert np.array_equal(far.normal, near.normal)
    assert np.array_equal(far.distance_mm, near.distance_mm)


def test_maps_are_of_the_view_alone(dense):
    picture = plane(200)[0]
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    inside = (x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2 < (0.48 * HEIGHT) ** 2
    bordered = np.where(inside[..., None], picture, 0).astype(np.float32)
    limitless = LearnedDense(dense.path)
    object.__setattr__(limitless._network._range, "limit", np.inf)
    found = learned_maps(bordered, dense_calibration(), limitless)
    known = np.isfinite(found.distance_mm)
    assert np.array_equal(known, np.isfinite(found.normal).all(axis=-1))
    assert not known[~inside].any()
    assert known.sum() > 0.85 * inside.sum()
    # A whole picture keeps all its pixels.
    assert np.isfinite(learned_maps(picture, dense_calibration(), limitless).distance_mm).all()


def test_maps_and_highlights_that_contradict_the_law_of_reflection_are_refused(dense, monkeypatch):
    picture = plane(300)[0]
    learned = LearnedDense(dense.path)
    points = np.random.default_rng(3).uniform(20, 120, (6, 2))
    assert not isinstance(learned.maps(picture, dense_calibration(), points), Failure)
    squared = learned.contradictions(Frame(picture, dense_calibration(), 1.0), points)
    assert squared.shape == (6,)
    monkeypatch.setattr(learned_dense_module, "REFLECTION_LIMIT", 0.99 * squared.mean() / 2)
    assert "contradicts the law of reflection at 6" in learned.maps(picture, dense_calibration(), points).detail
    assert not isinstance(learned.maps(picture, dense_calibration(), points[:3]), Failure)
    monkeypatch.setattr(learned_dense_module, "REFLECTION_LIMIT", 2.0)
    monkeypatch.setattr(learned_dense_module, "HIGHLIGHT_LIMIT", float(np.sort(squared)[2:4].mean()))
    answers = learned._at(Frame(picture, dense_calibration(), 1.0), list(points))
    refused = np.array([isinstance(answer, Failure) for answer in answers])
    assert np.array_equal(refused, squared > np.median(squared))
    assert all(
        "contradicts the law of reflection: squared" in each.detail for each in answers if each.__class__ is Failure
    )


def refusal(path, picture=None, **changes):
    picture = plane(1)[0] if picture is None else picture
    made = LearnedDense(path).maps(picture, dense_calibration(**changes))
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
def test_it_refuses_what_it_was_not_taught(dense, changes, size, said):
    assert said in refusal(dense.path, None if size is None else np.full(size, 0.5, np.float32), **changes)


def test_it_refuses_frames_unlike_those_of_its_training(dense):
    blocks = np.random.default_rng(0).integers(0, 2, (HEIGHT // 12, WIDTH // 12, 3)).astype(np.float32)
    assert "unlike the network's training" in refusal(dense.path, blocks.repeat(12, axis=0).repeat(12, axis=1))
    found = reconstruct(
        plane(1)[0], dense_calibration(lights=()), {"one": LearnedDense(dense.path)}, smoothing_px=1.0, detector="peaks"
    )
    assert all("needs the lights" in each.estimates["one"].detail for each in found)


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


# Single spots ---------------------------------------------------------------------------------------------------------


def test_covariances_are_scaled_to_cover_95_percent_of_the_validation_split(spot):
    network, judged, path = spot.trained, spot.judged, spot.path
    content = json.loads(onnxruntime.InferenceSession(path.read_bytes()).get_modelmeta().custom_metadata_map[METADATA])
    with torch.no_grad():
        outputs, features = network(judged["crops"], judged["extras"])
    inflated = inflation(TrainingRange.read(content, EXTRAS).distances(features.numpy()), content["feature_usual"])
    assert (inflated == 1).mean() == pytest.approx(0.5, abs=0.02)
    for number, surface in enumerate(("base", "fine")):
        scale = CovarianceScale(**{key: tuple(values) for key, values in content["scales"][surface].items()})
        factors = scale.at(log_deviation(outputs[:, number].numpy())) * inflated
        distances = spot_distance(outputs[:, number], judged[surface]).numpy() / factors
        assert 0.94 < (distances < 5.991).mean() < 0.98
        scale = CovarianceScale(**{key: tuple(values) for key, values in content["ratio_scales"][surface].items()})
        sure = outputs[:, number, 6]
        off = (judged[f"{surface}_ratio"] - torch.sigmoid(outputs[:, number, 5])) / torch.exp(sure)
        assert 0.94 < (off.numpy() ** 2 < 3.842 * inflated * scale.at(sure.numpy())).mean() < 0.98
    assert content["about"] == {"dataset": "drawn"}


def test_what_is_stated_too_surely_gets_a_larger_factor():
    # Deviations stated as exp(-1) are half of the true ones, those stated as exp(1) are true.
    rng = np.random.default_rng(4)
    deviations = np.repeat([-1.0, 1.0], 2000) + rng.uniform(0, 1e-3, 4000)
    distances = rng.chisquare(2, 4000) * np.repeat([4.0, 1.0], 2000)
    scale = fitted_scale(distances, deviations)
    inside = distances < 5.991 * scale.at(deviations)
    assert inside[:2000].mean() == pytest.approx(0.95, abs=0.02)
    one = np.quantile(distances, 0.95) / 5.991
    assert (distances[:2000] < 5.991 * one).mean() < 0.92
    # No group gains at another's cost.
    assert min(scale.factor) >= 0.99 * one
    assert fitted_scale(distances[:10], deviations[:10]) == CovarianceScale((0.0,), (1.0,))


def test_the_shipped_network_runs_by_its_name():
    from simtest.estimators import load_estimators
    from simtest.reconstruction.options import default_estimators

    assert "learned_spot" not in default_estimators(spot_calibration())
    made = load_estimators(["learned_spot"])["learned_spot"]
    # Its frames have 480 px; the features of a smaller one's highlights are another matter.
    results = reconstruct(picture(7), spot_calibration(), {"one": made}, smoothing_px=2.0)
    assert results
    assert all("outside the network's training: log of the focal length" in r.estimates["one"].detail for r in results)


def test_without_its_package_the_shipped_network_says_so_in_one_line(tmp_path):
    code = (
        "import sys; sys.modules['onnxruntime'] = None; import numpy as np; from simtest.calibration import *; "
        "from simtest.geometry import Camera; from simtest.errors import InputError; import simtest\n"
        "c = Calibration(Camera(96, 96, 90, 90, 48, 48), priors=Priors(lights_mm=((1., 0., 0.),)))\n"
        "y, x = np.mgrid[:96, :96]; p = (0.1 + 0.8 * np.exp(-((x - 40)**2 + (y - 50)**2) / 40)).astype('f4')\n"
        "try: simtest.reconstruct(p, c, ['learned_spot'])\n"
        "except InputError as error: print(error)"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.stdout == "learned_spot needs the package onnxruntime: install the extra onnx\n", child.stderr


def test_the_pipeline_runs_spots_beside_the_others(spot):
    network, path = spot.trained, spot.path
    frame = picture(7)
    learned = LearnedSpot(path)
    found = reconstruct(frame, spot_calibration(), {"learned_spot": learned}, smoothing_px=2.0)
    results = [each.estimates["learned_spot"] for each in found]
    assert results
    assert all(isinstance(result, Estimate) for result in results), results
    peaks = np.array([result.look_px for result in results])
    crops, extras = spot_inputs(found.detection.frame, peaks)
    with torch.no_grad():
        outputs = network(torch.from_numpy(crops), torch.from_numpy(extras))[0].numpy()[:, 0]
    inflated = learned._network.run(crops, extras)[1]
    rays = spot_calibration().camera.unproject(peaks)
    for result, ray, row, more in zip(results, rays, outputs, inflated, strict=True):
        assert result.target == "base"
        assert 0 < result.axis_ratio < 1
        wanted = np.exp(row[6]) * np.sqrt(learned._network.ratio_scales["base"].at(row[6]) * more)
        assert result.axis_ratio_deviation == pytest.approx(wanted, rel=1e-4)
        # The network's rotation is the angle between the normal and the direction to the camera.
        turned = 0.1 * np.hypot(*row[:2])
        assert angle_deg(result.normal[None], -ray[None])[0] == pytest.approx(np.degrees(turned), abs=1e-4)
        # The map from rotations to normals keeps areas but for the angle's sine, so determinants agree.
        factor = learned._network.scales["base"].at(log_deviation(row)) * more
        wanted = (0.1**2 * np.exp(row[2] + row[4])) ** 2 * factor**2
        assert np.linalg.det(result.covariance) == pytest.approx(wanted * np.sinc(turned / np.pi) ** 2, rel=1e-3)


def told(path, calibrated, seed=7):
    found = reconstruct(picture(seed), calibrated, {"learned_spot": LearnedSpot(path)}, smoothing_px=2.0)
    return [each.estimates["learned_spot"] for each in found]


def test_spots_are_refused_by_what_was_not_taught(spot):
    path = spot.path
    refused = {
        "another focal length": (spot_calibration(focal=200.0), "focal length"),
        "other lights": (spot_calibration(lights=((40.0, 0.0, 0.0),)), "light"),
        "a lens with distortion": (spot_calibration(distortion=BrownConrady(k1=-0.05)), "a lens with distortion"),
        "no lights": (Calibration(spot_calibration().camera), "needs the lights"),
    }
    for name, (calibrated, said) in refused.items():
        results = told(path, calibrated)
        assert results, name
        for result in results:
            assert isinstance(result, Failure), name
            assert said in result.detail, name


def test_it_refuses_highlights_unlike_those_of_its_training(spot):
    # Spots of another form: wide stripes, whose crops no frame of the train split holds.
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    stripes = (0.02 + 0.9 * np.exp(-((x - 48) ** 2) / 8 - ((y - 48) ** 2) / 900)).astype(np.float32) ** 2
    found = reconstruct(
        stripes, spot_calibration(), {"one": LearnedSpot(spot.path)}, (20, 20, 56, 56), smoothing_px=2.0
    )
    (result,) = [each.estimates["one"] for each in found]
    assert isinstance(result, Failure)
    assert "unlike the network's training" in result.detail


def test_a_target_that_is_none_is_refused():
    with pytest.raises(InputError, match="target = both: must be base or fine"):
        LearnedSpot("none.onnx", "both")
