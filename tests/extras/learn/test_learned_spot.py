"""A network as an estimator: equal in PyTorch and ONNX Runtime, calibrated, and silent outside its training."""

import json
import subprocess
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from simtest.calibration import Calibration, Priors
from simtest.errors import Failure, InputError
from simtest.estimators import Estimate
from simtest.estimators.learned import METADATA, CovarianceScale, TrainingRange, inflation
from simtest.estimators.learned_spot import EXTRAS, LearnedSpot, log_deviation, spot_inputs
from simtest.geometry import BrownConrady, Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from studies.networks.fitted import fitted_scale
from studies.networks.spots import SpotNormals, squared_distance

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]


SIZE = 96
LIGHTS = ((3.0, 1.0, 0.0), (-3.0, 1.0, 0.0))


def picture(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    light = 0.1 + 0.002 * rng.normal(size=(SIZE, SIZE))
    for column, row in rng.uniform(25, SIZE - 25, (3, 2)):
        light += 0.6 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / rng.uniform(15, 40))
    return np.clip(light, 0, 1).astype(np.float32)


def calibration(focal=90.0, lights=LIGHTS, **camera):
    return Calibration(Camera(SIZE, SIZE, focal, focal, SIZE / 2, SIZE / 2, **camera), priors=Priors(lights_mm=lights))


def examples(seeds):
    """Return inputs at the spots of frames, with rotations that the network cannot predict exactly."""
    from simtest.calibration import Frame

    rng = np.random.default_rng(seeds[0])
    crops, extras = [], []
    for seed in seeds:
        frame = Frame(picture(seed), calibration(), 1.0)
        made = spot_inputs(frame, rng.uniform(20, SIZE - 20, (6, 2)))
        crops.append(made[0])
        extras.append(made[1])
    batch = {"crops": np.concatenate(crops), "extras": np.concatenate(extras)}
    count = len(batch["crops"])
    for name in ("base", "fine"):
        batch[name] = rng.normal(0, 0.1, (count, 2)).astype(np.float32)
        batch[f"{name}_ratio"] = rng.uniform(0.2, 1, count).astype(np.float32)
    return {name: torch.from_numpy(values) for name, values in batch.items()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    taught, judged = examples(range(30)), examples(range(100, 120))
    task = SpotNormals()
    torch.manual_seed(3)
    network = task.network(taught, 1.0).eval()
    path = tmp_path_factory.mktemp("spot") / "model.onnx"
    return network, taught, judged, task.export(network, taught, judged, path, {"dataset": "drawn"})


def test_onnx_gives_what_pytorch_gives(made):
    network, _, judged, path = made
    session = onnxruntime.InferenceSession(path.read_bytes())
    inputs = {name: judged[name].numpy() for name in ("crops", "extras")}
    with torch.no_grad():
        wanted = [each.numpy() for each in network(judged["crops"], judged["extras"])]
    for one, other in zip(session.run(None, inputs), wanted, strict=True):
        assert one.shape == other.shape
        assert np.abs(one - other).max() < 1e-5


def test_covariances_are_scaled_to_cover_95_percent_of_the_validation_split(made):
    network, _, judged, path = made
    content = json.loads(onnxruntime.InferenceSession(path.read_bytes()).get_modelmeta().custom_metadata_map[METADATA])
    with torch.no_grad():
        outputs, features = network(judged["crops"], judged["extras"])
    inflated = inflation(TrainingRange.read(content, EXTRAS).distances(features.numpy()), content["feature_usual"])
    assert (inflated == 1).mean() == pytest.approx(0.5, abs=0.02)
    for number, surface in enumerate(("base", "fine")):
        scale = CovarianceScale(**{key: tuple(values) for key, values in content["scales"][surface].items()})
        factors = scale.at(log_deviation(outputs[:, number].numpy())) * inflated
        distances = squared_distance(outputs[:, number], judged[surface]).numpy() / factors
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

    assert "learned_spot" not in default_estimators(calibration())
    made = load_estimators(["learned_spot"])["learned_spot"]
    # Its frames have 480 px; the features of a smaller one's highlights are another matter.
    results = reconstruct(picture(7), calibration(), {"one": made}, smoothing_px=2.0)
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


def test_the_pipeline_runs_it_beside_the_others(made):
    network, path = made[0], made[3]
    frame = picture(7)
    learned = LearnedSpot(path)
    found = reconstruct(frame, calibration(), {"learned_spot": learned}, smoothing_px=2.0)
    results = [each.estimates["learned_spot"] for each in found]
    assert results
    assert all(isinstance(result, Estimate) for result in results), results
    peaks = np.array([result.look_px for result in results])
    crops, extras = spot_inputs(found.detection.frame, peaks)
    with torch.no_grad():
        outputs = network(torch.from_numpy(crops), torch.from_numpy(extras))[0].numpy()[:, 0]
    inflated = learned._network.run(crops, extras)[1]
    rays = calibration().camera.unproject(peaks)
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


def test_it_refuses_what_it_was_not_taught(made):
    path = made[3]
    refused = {
        "another focal length": (calibration(focal=200.0), "focal length"),
        "other lights": (calibration(lights=((40.0, 0.0, 0.0),)), "light"),
        "a lens with distortion": (calibration(distortion=BrownConrady(k1=-0.05)), "a lens with distortion"),
        "no lights": (Calibration(calibration().camera), "needs the lights"),
    }
    for name, (calibrated, said) in refused.items():
        results = told(path, calibrated)
        assert results, name
        for result in results:
            assert isinstance(result, Failure), name
            assert said in result.detail, name


def test_it_refuses_highlights_unlike_those_of_its_training(made):
    # Spots of another form: wide stripes, whose crops no frame of the train split holds.
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    stripes = (0.02 + 0.9 * np.exp(-((x - 48) ** 2) / 8 - ((y - 48) ** 2) / 900)).astype(np.float32) ** 2
    found = reconstruct(stripes, calibration(), {"one": LearnedSpot(made[3])}, (20, 20, 56, 56), smoothing_px=2.0)
    (result,) = [each.estimates["one"] for each in found]
    assert isinstance(result, Failure)
    assert "unlike the network's training" in result.detail


def without_metadata(model):
    del model.metadata_props[:]


def changed(**values):
    def change(model):
        content = json.loads(model.metadata_props[0].value)
        content.update(values)
        model.metadata_props[0].value = json.dumps(content)

    return change


def scales(deviations, factors):
    return {name: {"log_deviation": deviations, "factor": factors} for name in ("base", "fine")}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without_metadata, "is no network for learned_spot"),
        (changed(format="mine"), "format 'mine'"),
        (changed(scales={"fine": 1.0}), "KeyError"),
        (changed(scales={"base": 1.0, "fine": 1.0}), "TypeError"),
        (changed(scales=scales((0.0,), (0.0,))), "above 0"),
        (changed(scales=scales((0.0,), (1.0, 2.0))), "as many factors as deviations"),
        (changed(scales=scales((1.0, 0.0), (1.0, 2.0))), "must ascend"),
        (changed(feature_mean=[0.0]), "does not fit"),
        (changed(low=3), "is no network for learned_spot"),
        (changed(feature_usual=0.0), "feature_usual = 0.0: must be above 0"),
    ],
    ids=["no metadata", "another format", "a scale missing", "a scale of an older form", "a scale of 0",
         "too few scales", "scales in disorder", "other features", "no ranges", "a usual distance of 0"],
)  # fmt: skip
def test_another_model_is_refused_in_one_line(made, tmp_path, change, said):
    model = onnx.load(made[3])
    change(model)
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=said) as raised:
        LearnedSpot(tmp_path / "other.onnx").check()
    assert "\n" not in str(raised.value)
    assert "other.onnx" in str(raised.value)


def test_a_network_of_other_inputs_is_refused_in_one_line(made, tmp_path):
    model = onnx.load(made[3])
    for node in model.graph.node:
        node.input[:] = ["pictures" if name == "crops" else name for name in node.input]
    model.graph.input[0].name = "pictures"
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"other.onnx: cannot be run \(.*crops") as raised:
        told(tmp_path / "other.onnx", calibration())
    assert "\n" not in str(raised.value)


def test_what_is_no_model_is_refused_in_one_line(tmp_path):
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match=r"text.onnx: is no ONNX model"):
        LearnedSpot(tmp_path / "text.onnx").check()
    with pytest.raises(InputError, match=r"none.onnx: no such file"):
        LearnedSpot(tmp_path / "none.onnx").check()
    with pytest.raises(InputError, match="target = both: must be base or fine"):
        LearnedSpot(tmp_path / "none.onnx", "both")


def test_it_needs_no_pytorch(made):
    code = (
        "import sys; sys.modules['torch'] = None; "
        "from simtest.estimators.learned_spot import LearnedSpot; "
        f"LearnedSpot({str(made[3])!r}).check()"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert child.returncode == 0, child.stderr
