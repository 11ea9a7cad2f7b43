"""A network as a detector: labels, instances from its maps, equal in PyTorch and ONNX Runtime, refusals, bad files."""

import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from simtest.calibration import Calibration, Frame, Response, srgb_encode
from simtest.dataset.learn.detector_export import best_threshold, usual_limit
from simtest.dataset.learn.detector_frames import HIGHLIGHT, TISSUE, UNJUDGED, bumps, needs_be_found
from simtest.dataset.learn.detector_moves import moved_crops
from simtest.dataset.learn.detector_task import HighlightInstances
from simtest.dataset.learn.engine import train
from simtest.dataset.learn.training import load_training
from simtest.detection import load_detector
from simtest.detection.highlight_inputs import frame_statistics, highlight_inputs
from simtest.detection.learned_detector import LearnedDetector, basins_of
from simtest.detection.light_split import SplitLight
from simtest.errors import InputError, Reason
from simtest.geometry import Camera
from simtest.runtime.onnx_model import METADATA

pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.usefixtures("one_torch_thread")]

SIDE = 160


def drawn(seed, count=14):
    """Return picture, state, bump and region of reddish tissue with grey highlights."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5
    linear = (0.2 + 0.04 * np.sin(x / 30 + seed) * np.cos(y / 25))[..., None] * [1.0, 0.45, 0.35]
    region = np.zeros((SIDE, SIDE), dtype=np.int64)
    for number, (column, row) in enumerate(rng.uniform(12, SIDE - 12, (count, 2)), start=1):
        width = rng.uniform(1.5, 4)
        lobe = np.exp(-((x - column) ** 2 + (y - row) ** 2) / width**2)
        linear += rng.uniform(0.3, 0.7) * lobe[..., None]
        region[(lobe >= 0.5) & (region == 0)] = number
    picture = np.rint(255 * srgb_encode(np.clip(linear + 0.002 * rng.standard_normal(linear.shape), 0, 1)))
    state = np.where(region > 0, HIGHLIGHT, TISSUE).astype(np.uint8)
    return picture.astype(np.uint8), state, bumps(region), region.astype(np.int16)


def batch(seeds):
    parts = zip(*(drawn(seed) for seed in seeds), strict=True)
    names = ("picture", "state", "bump", "region")
    return {name: torch.from_numpy(np.stack(part)) for name, part in zip(names, parts, strict=True)}


def frame_of(picture, camera=None):
    height, width = picture.shape[:2]
    calibration = Calibration(
        camera or Camera.from_fov(60.0, width, height), response=Response("srgb"), saturation_level=1.0
    )
    return Frame(picture.astype(np.float32) / np.float32(255), calibration, 1.0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A network trained for a few seconds, and its file."""
    out = tmp_path_factory.mktemp("detector")
    taught, judged = batch(range(6)), batch(range(100, 104))
    training = load_training("highlight_instances", {"epochs": 8, "learning_rate": 0.01})
    made = train(training, HighlightInstances(), taught, judged, out)
    [path] = HighlightInstances().finish(made.network, taught, judged, out, {"dataset": "drawn"})
    return made, path


def changed(path, out, **change):
    """Write a network's file with other metadata; return its path."""
    model = onnx.load(path)
    content = json.loads({prop.key: prop.value for prop in model.metadata_props}[METADATA])
    onnx.helper.set_model_props(model, {METADATA: json.dumps({**content, **change})})
    onnx.save(model, out / "model.onnx")
    return out / "model.onnx"


def test_a_short_training_finds_most_highlights_of_a_fresh_frame(trained, tmp_path):
    made, path = trained
    history = made.state.history
    overlap = [next(iter(epoch.metrics.values())) for epoch in history]
    assert overlap[-1] > 0.5 > overlap[0]
    picture, _, _, region = drawn(200)
    # Four frames are too few for the range of the features.
    detector = LearnedDetector(changed(path, tmp_path, feature_limit=1e9), isolated=False)
    found = detector.detect(frame_of(picture), None)
    assert found.refusal is None
    hit = {int(region[y, x]) for each in found.highlights for x, y in each.peaks} - {0}
    assert len(hit) >= 0.7 * len(np.unique(region[region > 0]))
    # Not by marking everything.
    assert len(detector.detect(frame_of(drawn(201, count=0)[0]), None).highlights) <= 1


def test_onnx_gives_what_pytorch_gives_at_every_size(trained):
    made, path = trained
    session = onnxruntime.InferenceSession(path.read_bytes())
    network = made.network.cpu().eval()
    for height, width in ((64, 64), (104, 160)):
        inputs = np.random.default_rng(height).normal(size=(1, 5, height, width)).astype(np.float32)
        with torch.no_grad():
            wanted = [each.numpy() for each in network(torch.from_numpy(inputs))]
        for one, other in zip(session.run(None, {"inputs": inputs}), wanted, strict=True):
            assert one.shape == other.shape
            assert np.abs(one - other).max() < 1e-5


def test_what_lies_outside_the_training_is_refused(trained):
    detector = LearnedDetector(trained[1])
    picture = drawn(300)[0]
    grey = Frame(picture[..., 0].astype(np.float32) / 255, frame_of(picture).calibration, 1.0)
    small, dark = picture[:64, :64], (picture * 0.05).astype(np.uint8)
    noise = np.random.default_rng(0).integers(0, 255, picture.shape, dtype=np.uint8)
    for frame, said in (
        (grey, "three channels"), (frame_of(small), "longer side"), (frame_of(dark), "median light"),
        (frame_of(noise), "network's training"),
    ):  # fmt: skip
        found = detector.detect(frame, None)
        assert not found.regions
        assert found.refusal.reason is Reason.NO_ESTIMATE
        assert said in found.refusal.detail
        assert "\n" not in found.refusal.detail
    assert detector.detect(frame_of(picture), None).refusal is None


def test_a_large_frame_is_seen_reduced(trained, tmp_path):
    plain, _, _, region = drawn(200)
    detector = LearnedDetector(changed(trained[1], tmp_path, feature_limit=1e9), isolated=False)
    counts = []
    for times in (1, 3):
        found = detector.detect(frame_of(np.kron(plain, np.ones((times, times, 1), dtype=np.uint8))), None)
        assert found.refusal is None
        counts.append(len({int(region[y // times, x // times]) for h in found.highlights for x, y in h.peaks} - {0}))
    assert counts[1] >= 0.8 * counts[0] > 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"format": "other"}, "format"), ({"least_top": 2}, "least_top"), ({"least_top": "x"}, "least_top|could not"),
        ({"low": {}}, "longer side"),
        ({"high": {"longer side, px": 2, "logarithm of the median light": 0}}, "must be 8"),
        ({"feature_precision": [1.0]}, "feature_precision"),
        ({"feature_mean": [0.0], "feature_precision": [1.0]}, "features"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_told_in_one_line(trained, tmp_path, change, said):
    path = changed(trained[1], tmp_path, **change)
    with pytest.raises(InputError, match=said) as error:
        LearnedDetector().with_model(path).detect(frame_of(drawn(1)[0]), None)
    assert "\n" not in str(error.value)
    assert "model.onnx" in str(error.value)


@pytest.mark.parametrize(
    ("content", "said"), [(b"", "no ONNX model"), (b"text", "no ONNX model"), (None, "no such file")]
)
def test_a_file_that_is_no_network_is_told_in_one_line(tmp_path, content, said):
    path = tmp_path / "model.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        LearnedDetector().with_model(path)


def test_the_shipped_network_finds_highlights_by_its_name():
    from simtest.reconstruction.pipeline import run_picture

    rng = np.random.default_rng(5)
    y, x = np.mgrid[:360, :480] + 0.5
    linear = (0.16 + 0.04 * np.sin(x / 60) * np.cos(y / 50))[..., None] * [1.0, 0.45, 0.33]
    for column, row in rng.uniform(60, 300, (12, 2)):
        linear += 0.6 * np.exp(-((x - column) ** 2 + (y - row) ** 2) / 3.0**2)[..., None]
    picture = srgb_encode(np.clip(linear + 0.002 * rng.standard_normal(linear.shape), 0, 1)).astype(np.float32)
    detector = load_detector("learned_detector")
    assert isinstance(detector, LearnedDetector)
    detector.check()
    made, choices = run_picture(picture, Calibration(Camera.from_fov(60.0, 480, 360)), None, "learned_detector")
    assert choices.detector == "learned_detector"
    assert choices.smoothing_px == 1.0
    assert made.detection.refusal is not None or made.specularities


def test_the_shipped_network_refuses_noise_and_marks_nothing_on_a_broad_dull_lobe():
    rng = np.random.default_rng(0)
    detector = load_detector("learned_detector")
    for noise in (rng.integers(0, 255, (360, 480, 3)), np.repeat(rng.integers(0, 255, (360, 480, 1)), 3, axis=2)):
        found = detector.detect(frame_of(noise.astype(np.uint8)), None)
        assert not found.regions
        assert "unlike the network's training" in found.refusal.detail
    y, x = np.mgrid[:360, :480] + 0.5
    tissue = (0.16 + 0.04 * np.sin(x / 60) * np.cos(y / 50))[..., None] * [1.0, 0.45, 0.33]
    for height, width in ((0.15, 120), (0.4, 120), (0.3, 60)):
        lobe = height * np.exp(-((x - 240) ** 2 + (y - 180) ** 2) / width**2)
        linear = tissue + lobe[..., None] + 0.002 * rng.standard_normal(tissue.shape)
        dull = detector.detect(frame_of(np.rint(255 * srgb_encode(np.clip(linear, 0, 1))).astype(np.uint8)), None)
        assert not dull.highlights
        assert not dull.others


# Labels, moves and instances


def test_a_black_background_sets_no_scale():
    linear = np.random.default_rng(0).uniform(0.1, 0.3, (48, 64, 3)).astype(np.float32)
    clipped, light = np.zeros((48, 64), dtype=bool), SplitLight(linear[..., 0] * 0.1, linear[..., 1], 0.001)
    wide = np.zeros((48, 256, 3), dtype=np.float32)
    wide[:, :64] = linear
    padded = SplitLight(*(np.pad(part, ((0, 0), (0, 192))) for part in (light.specular, light.tissue)), 0.001)
    plain = highlight_inputs(linear, clipped, light)
    found = highlight_inputs(wide, np.pad(clipped, ((0, 0), (0, 192))), padded)
    np.testing.assert_allclose(found[..., :64], plain, rtol=1e-6)
    assert frame_statistics(wide, None, 256)[1] == pytest.approx(frame_statistics(linear, None, 64)[1])
    # A frame without light has none.
    assert frame_statistics(0 * wide, None, 256)[1] == pytest.approx(np.log(1e-6))


def test_which_highlights_must_be_found():
    sound = {"whole": True, "peak_snr": 30.0, "area_px": 9, "instrument": None}
    others = ({"whole": False}, {"peak_snr": 9.0}, {"area_px": 3}, {"instrument": 0}, {"peak_snr": None})
    assert needs_be_found([sound, *({**sound, **other} for other in others)]).tolist() == [True, *[False] * 4, True]


def test_bumps_stand_in_the_middle_of_their_pixels():
    region = np.zeros((20, 30), dtype=np.int64)
    region[3:8, 4:9], region[12, 10:21] = 1, 2
    made = bumps(region)
    assert made[5, 6] == made[12, 15] == 255
    assert (made[region == 0] == 0).all()
    # Two standard deviations away along the long highlight, whose second moment is 10 + 0.25.
    assert made[12, 20] == np.rint(255 * np.exp(-25 / (2 * 10.25)))


def test_saddles_of_the_light_tell_highlights_apart_and_faint_bumps_are_told():
    y, x = np.mgrid[:40, :60] + 0.5
    each = [np.exp(-((x - c) ** 2 + (y - 20) ** 2) / 18) for c in (20, 31, 50)]
    specular = sum(each).astype(np.float32)
    light = SplitLight(specular, np.full_like(specular, 0.1), 0.001)
    pixels = (specular > 0.1).astype(np.float32)
    bumps = np.maximum.reduce([each[0], 0.8 * each[1], 0.2 * each[2]]).astype(np.float32)
    basins, tops = basins_of(pixels, bumps, light, np.zeros(x.shape, dtype=bool), None)
    found = {int(column): float(top) for column, top in zip(basins.columns, tops, strict=True)}
    assert sorted(found) == pytest.approx([20, 31, 50], abs=1)
    assert [found[column] for column in sorted(found)] == pytest.approx([1, 0.8, 0.2], abs=0.05)
    # A shallow saddle separates nothing, and without pixels there is nothing.
    light = SplitLight(np.exp(-((x - 30) ** 2) / 60).astype(np.float32), np.ones_like(specular), 0.001)
    assert len(basins_of(pixels * 0 + 1, bumps, light, np.zeros(x.shape, dtype=bool), None)[1]) == 1
    assert len(basins_of(0 * pixels, bumps, light, np.zeros(x.shape, dtype=bool), None)[1]) == 0


def test_moved_crops_hang_on_their_generator_alone():
    examples = batch(range(2))
    one, same, other = (moved_crops(examples, torch.Generator().manual_seed(seed), 64) for seed in (1, 1, 2))
    assert all(torch.equal(one[name], same[name]) for name in one)
    assert not torch.equal(one["inputs"], other["inputs"])
    assert one["inputs"].shape == (6, 5, 64, 64)
    assert one["inputs"].isfinite().all()
    # What shines stays where its label is.
    inside, outside = one["state"] == HIGHLIGHT, one["state"] == TISSUE
    assert one["inputs"][:, 3][inside].median() > one["inputs"][:, 3][outside].median() + 1


def test_pixels_that_are_not_judged_do_not_change_the_loss():
    torch.manual_seed(0)
    task, examples = HighlightInstances(), batch([1])
    network = task.network(examples, load_training("highlight_instances")).eval()
    crops = moved_crops(examples, torch.Generator().manual_seed(1), 64)
    with torch.no_grad():
        before = task.loss(network, crops)
        crops["state"][:, :32] = UNJUDGED
        masked = task.loss(network, crops)
        crops["bump"][:, :32] = 255
        assert task.loss(network, crops) == masked
        assert masked != before


def test_the_threshold_with_the_best_f1_is_taken():
    heights, right = np.array([0.9, 0.8, 0.6, 0.4, 0.2]), np.array([True, True, False, True, False])
    one, needed = np.zeros(5, dtype=int), np.array([3])
    assert best_threshold(heights, right, one, needed) == pytest.approx(0.3)
    assert best_threshold(heights, np.array([True, True, False, False, False]), one, needed) == pytest.approx(0.7)
    assert best_threshold(heights, np.zeros(5, dtype=bool), one, needed) == 0.5


def test_the_limit_of_the_features_is_exceeded_by_few_new_frames():
    rng = np.random.default_rng(7)
    # 14 anatomies of 4 frames: the largest of 56 is exceeded far more often than by 0.5 %.
    limits = [usual_limit(np.exp(rng.normal(1.2, 0.75, 56))) for _ in range(200)]
    assert np.median(limits) == pytest.approx(np.exp(1.2 + 2.576 * 0.75), rel=0.1)


def test_each_class_counts_alike_for_the_threshold_unless_it_has_few_highlights():
    # 100 small ones, of which those below 0.5 are half false; 30 large ones, all of them between 0.2 and 0.4.
    small, large = np.linspace(0.99, 0.1, 120), np.linspace(0.4, 0.2, 30)
    heights, classes = np.append(small, large), np.repeat([0, 1], [120, 30])
    right = np.append((small > 0.5) | (np.arange(120) % 2 == 0), np.ones(30, dtype=bool))
    assert best_threshold(heights, right, classes, np.array([93, 30])) < 0.21
    strict = np.append(small > 0.5, np.ones(30, dtype=bool))
    assert best_threshold(heights, strict, classes, np.array([66, 10])) == pytest.approx(0.5, abs=0.01)
