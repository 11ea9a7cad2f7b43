"""Detectors: what the pipelines find by them, the frame they hand on, faults of others' detectors, and names."""

from dataclasses import replace

import numpy as np
import pytest

from simtest.calibration import NO_PRIORS, Calibration, Frame, NoiseModel, Response, srgb_encode
from simtest.calibration.photometry import AngularProfile
from simtest.detection import Detection, Detector, Region, load_detector, peak_shape
from simtest.detection.colour import ColourDetector, colour
from simtest.detection.detector import DETECTORS, run_detector
from simtest.detection.peaks import PeakDetector, peaks
from simtest.errors import Failure, InputError
from simtest.estimators.names import ESTIMATORS
from simtest.geometry import Camera, Patch, ViewMask
from simtest.reconstruction.options import complete
from simtest.reconstruction.pipeline import reconstruct
from simtest.runtime.resources import parse_model

CAMERA = Camera(200, 160, 200.0, 200.0, 100.0, 80.0)
CALIBRATIONS = {
    "camera alone": Calibration(CAMERA),
    "falloff, noise and clipping": Calibration(
        CAMERA, Response("gamma", 2.2), AngularProfile(3.0), noise=NoiseModel(full_well=8000.0, bits=8),
        saturation_level=0.9,
    ),
    "view mask": Calibration(Camera(200, 160, 200.0, 200.0, 100.0, 80.0, view_mask=ViewMask(100, 80, 70))),
}  # fmt: skip


def lobes(seed=0):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:160, :200] + 0.5
    values = 0.01 * rng.standard_normal(x.shape)
    for cx, cy, a, b in ((60.2, 70.7, 8, 10), (140.9, 80.1, 6, 9), (102.0, 120.0, 5, 5), (4.0, 20.0, 9, 9)):
        values = values + 0.9 * np.exp(-(((x - cx) / a) ** 2) - ((y - cy) / b) ** 2)
    return np.clip(values, 0, 1).astype(np.float32)


def tissue():
    """Reddish tissue with grey highlights, as encoded."""
    y, x = np.mgrid[:160, :200] + 0.5
    shade = 0.25 + 0.05 * np.sin(x / 40) * np.cos(y / 30)
    spots = sum(0.6 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / s**2) for cx, cy, s in ((60, 60, 6), (140, 100, 5)))
    linear = shade[..., None] * [1.0, 0.45, 0.35] + spots[..., None]
    return srgb_encode(np.clip(linear, 0, 1)).astype(np.float32)


def same_patches(detection, made):
    for region, spot in zip(detection.regions, made, strict=True):
        assert region == spot.region
        cut = detection.frame.patch(region.box, region.peak)
        for field in ("values", "raw", "saturated", "seen", "noise", "peak_px"):
            np.testing.assert_array_equal(getattr(cut, field), getattr(spot.patch, field))
        assert (cut.peak_value, cut.peak_pixel, cut.smoothing_px) == (
            spot.patch.peak_value, spot.patch.peak_pixel, spot.patch.smoothing_px,
        )  # fmt: skip


@pytest.mark.parametrize("name", list(CALIBRATIONS))
@pytest.mark.parametrize(("isolated", "smoothing_px"), [(True, 2.0), (False, 0.0)])
def test_peaks_are_those_of_the_pipeline(name, isolated, smoothing_px):
    calibration = CALIBRATIONS[name]
    frame = Frame(lobes(), calibration, smoothing_px)
    found = PeakDetector(isolated).detect(frame, calibration.camera)
    assert found.frame is frame
    made = reconstruct(lobes(), calibration, {}, smoothing_px=smoothing_px, isolated=isolated)
    assert len(made) >= 2
    same_patches(found, made)


@pytest.mark.parametrize(("name", "isolated"), [("camera alone", True), ("view mask", False)])
def test_colour_is_that_of_the_pipeline(name, isolated):
    calibration = CALIBRATIONS[name]
    found = ColourDetector(isolated).detect(Frame(tissue(), complete(calibration, None), 1.0), calibration.camera)
    made = reconstruct(tissue(), calibration, {}, isolated=isolated, detector="colour", encoding="srgb")
    assert len(made) == 2
    same_patches(found, made)
    there = made.detection
    assert [h.kind for h in found.highlights] == [h.kind for h in there.highlights]
    assert len(found.others) == len(there.others)
    assert found.view.seen is there.view.seen is None or (found.view.seen == there.view.seen).all()


def test_the_same_box_gives_the_same_patch_again():
    frame = Frame(lobes(), Calibration(CAMERA), 2.0)
    (first, *_) = peaks.detect(frame, CAMERA, NO_PRIORS).regions
    patch = frame.patch(first.box, first.peak)
    assert isinstance(patch, Patch)
    assert frame.patch(first.box, first.peak) is patch


def test_detectors_are_found_by_name_or_given():
    assert isinstance(peaks, Detector)
    assert load_detector("peaks") is peaks
    assert load_detector("simtest:colour") is colour
    own = PeakDetector(isolated=False)
    assert load_detector(own) is own
    for given in (3, PeakDetector, lambda frame, camera, priors: None):
        with pytest.raises(InputError, match="no object with a method detect"):
            load_detector(given)


@pytest.mark.parametrize("corner", [None, 30.0])
@pytest.mark.parametrize("detector", [peaks, colour])
def test_the_view_that_the_camera_states_is_told(detector, corner):
    mask = ViewMask(CAMERA.width / 2, CAMERA.height / 2, 45.0, corner)
    camera = replace(CAMERA, view_mask=mask)
    light = lobes()
    frame = Frame(np.repeat(light[:, :, None] / light.max(), 3, axis=2), Calibration(camera), 1.0)
    view = detector.detect(frame, camera).view
    np.testing.assert_array_equal(view.seen, camera.seen)
    assert view.circle == (mask if corner is None else None)


def test_a_region_that_was_given_has_no_contrast_and_still_a_shape():
    frame = Frame(lobes(), Calibration(CAMERA), 2.0)
    detected = peaks.detect(frame, CAMERA).regions[0]
    given = Region(detected.box, detected.peak, None)
    patch = frame.patch(given.box, given.peak)
    assert peak_shape(patch, given, frame.noise).residual == peak_shape(patch, detected, frame.noise).residual
    (spot,) = reconstruct(lobes(), CAMERA, {}, roi=detected.box)
    assert spot.region.contrast is None
    assert isinstance(Detection((given,), frame).regions[0], Region)


# What a detector of another package may do wrong ----------------------------------------------------------------------


def found_by(detect, picture=None):
    finder = type("Finder", (), {"detect": lambda self, frame, camera, priors: detect(frame)})()
    return reconstruct(lobes() if picture is None else picture, CAMERA, {}, detector=finder)


def fails(frame):
    raise RuntimeError("no model")


@pytest.mark.parametrize(
    ("detect", "said"),
    [
        (lambda frame: None, "returned a NoneType; must be a Detection"),
        (lambda frame: Detection((Region((0.5, 0, 9, 9), (3, 3), 1.0),), frame), "must be 4 integers x, y, w, h"),
        (lambda frame: Detection((Region((0, 0, 9, 9), (3.5, 3), 1.0),), frame), "must be 2 integers column, row"),
        (lambda frame: Detection((Region((5, 5, 45, 45), (2, 2), 0.1),), frame), r"peak \(2, 2\): must lie in its box"),
        (lambda frame: Detection((Region((5, 5, 45, 45), (50, 9), 0.1),), frame), r"peak \(50, 9\): must lie in its"),
        (lambda frame: Detection((Region((CAMERA.width - 3, 0, 9, 9), (3, 3), 1.0),), frame), "leaves the frame"),
        (fails, "RuntimeError: no model"),
    ],
)
def test_a_detector_that_fails_is_named(detect, said):
    with pytest.raises(InputError, match=rf"detector Finder: .*{said}"):
        found_by(detect)


def test_integers_of_numpy_are_taken():
    box, peak = (tuple(np.array(numbers, dtype=np.int64)) for numbers in ((0, 0, CAMERA.width, CAMERA.height), (9, 8)))
    (spot,) = found_by(lambda frame: Detection((Region(np.array(box), peak, 1.0),), frame))
    assert spot.region == Region((0, 0, CAMERA.width, CAMERA.height), (9, 8), 1.0)
    assert all(type(number) is int for number in (*spot.region.box, *spot.region.peak))


def test_a_detector_may_hand_on_other_light_of_a_grey_frame():
    box = (0, 0, CAMERA.width, CAMERA.height)
    (spot,) = found_by(lambda f: Detection((Region(box, (3, 3), None),), replace(f, light=f.smoothed)))
    assert not isinstance(spot.patch, Failure)


@pytest.mark.parametrize("channels", [None, 2])
def test_colour_takes_three_channels(channels):
    shape = (CAMERA.height, CAMERA.width) if channels is None else (CAMERA.height, CAMERA.width, channels)
    with pytest.raises(InputError, match=r"takes \(H, W, 3\)"):
        run_detector(colour, Frame(np.full(shape, 0.5, dtype=np.float32), Calibration(CAMERA), 1.0))


# Names: what they mean, and which are refused -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "short"),
    [
        ("learned_spot:models/spots/model.onnx", "learned_spot_spots"),
        ("learned_spot:wide net.onnx", "learned_spot_wide_net"),
        ("learned_spot:C:\\nets\\a.onnx", "learned_spot_C_nets_a"),
        ("my_package.core:/a/b.onnx", "my_package.core_b"),
    ],
)
def test_a_network_is_named_by_what_runs_it_and_its_file(text, short):
    assert parse_model(text).short == short


@pytest.mark.parametrize("text", ["learned_spot", "package:learned_spot", "command: ./core a.onnx", "a.onnx",
                                  "command:core.onnx", "learned_spot: a.onnx", ":a.onnx", "a b:c.onnx"])  # fmt: skip
def test_other_names_are_no_networks(text):
    assert parse_model(text) is None


def test_a_detector_without_networks_refuses_a_file():
    assert "colour" in DETECTORS.names()
    with pytest.raises(InputError, match=r"detector 'colour:a.onnx': colour runs no network; must stand alone"):
        load_detector("colour:a.onnx")


# Names that several packages register ---------------------------------------------------------------------------------


POINTS = {
    "simtest.estimators": ("cone_axis", "json:loads"),
    "simtest.detectors": ("peaks", "json:loads"),
}


def install(folder, name, monkeypatch):
    """Make a package that registers names of simtest, in front of all others on the path."""
    info = folder / f"{name.replace('-', '_')}-9.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 9.0\n")
    text = "".join(f"[{group}]\n{point} = {value}\n" for group, (point, value) in POINTS.items())
    (info / "entry_points.txt").write_text(text)
    monkeypatch.syspath_prepend(str(folder))


@pytest.mark.parametrize(("group", "name"), [(ESTIMATORS, "cone_axis"), (DETECTORS, "peaks")])
def test_a_name_that_another_package_registers_too_is_refused(tmp_path, monkeypatch, group, name):
    own = group.load(name)
    install(tmp_path, "evil-core", monkeypatch)
    with pytest.raises(InputError, match=rf"registered by 2 packages; name one of them: evil-core:{name} or simtest:"):
        group.load(name)
    assert group.load(f"simtest:{name}") is own


@pytest.mark.parametrize("called", ["simtest", "SimTest"])
@pytest.mark.parametrize(("group", "name"), [(ESTIMATORS, "cone_axis"), (DETECTORS, "peaks")])
def test_a_package_of_our_name_is_refused(tmp_path, monkeypatch, group, name, called):
    install(tmp_path, called, monkeypatch)
    with pytest.raises(InputError, match="another package that is called simtest registers json:loads; remove it"):
        group.load(name)
