"""A picture gives the same normals as a file and as an array: one rule says how its values are taken."""

import pickle
from pathlib import Path

import cv2
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image as PillowImage
from test_colour_detection import HEIGHT, WIDTH, lobe, picture

import simtest
from simtest.calibration import Calibration, Frame, NoiseModel, Priors, Response, exactly, srgb_encode
from simtest.calibration.priors import NO_FLOORS
from simtest.detection.colour import ColourDetector
from simtest.errors import Failure, InputError
from simtest.geometry import Camera
from simtest.reconstruction.images import read_picture
from simtest.reconstruction.options import DEFAULT_ESTIMATORS, Options, calibration_for, complete
from simtest.reconstruction.outputs import write_outputs
from simtest.reconstruction.pipeline import reconstruct, reconstruct_values

CAMERA = Camera.from_fov(60.0, WIDTH, HEIGHT)
FRAMES = Path(__file__).resolve().parents[3] / "shared" / "data" / "frames"
REAL = sorted(path.name for path in FRAMES.iterdir() if path.is_file()) if FRAMES.is_dir() else []


def tissue():
    """RGB values of 8 bits, with two highlights."""
    spots = sum(lobe(x, y, width, peak=0.5) for x, y, width in ((90, 70, 5.0), (230, 160, 6.0)))
    return np.rint(255 * picture(spots)).astype(np.uint8)


def by_file(path, tmp_path, camera, **options):
    """Reconstruct a file as the command does, without writing what it writes."""
    simtest.save_camera(camera, tmp_path / "camera.toml")
    told, values = Options(tmp_path / "camera.toml", **options), read_picture(path)
    return reconstruct_values(str(path), values, calibration_for(told, values)[0], told)


def same(found, record):
    """Check that an array's specularities are those of a file, to the last bit."""
    assert len(found) == len(record)
    for spot, told in zip(found, record, strict=True):
        assert spot.region.box == told.region.box
        assert list(spot.estimates) == list(told.estimates)
        for name, estimate in spot.estimates.items():
            other = told.estimates[name]
            if isinstance(estimate, Failure):
                assert estimate == other
                continue
            np.testing.assert_array_equal(estimate.candidates, other.candidates)
            np.testing.assert_array_equal(estimate.look_px, other.look_px)
            np.testing.assert_array_equal(estimate.covariance, other.covariance)
            assert estimate.flags == other.flags
    for name in ("encoding", "detector", "smoothing_px", "inferred", "assumed"):
        assert getattr(found.choices, name) == getattr(record.choices, name), name


def stored(values, path):
    """Write RGB or grey values as PNG; return what OpenCV reads, in RGB."""
    cv2.imwrite(str(path), values if values.ndim == 2 else values[:, :, ::-1])
    read = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return read if read.ndim == 2 else read[:, :, ::-1]


@pytest.mark.skipif(not REAL, reason="no real frames in ../shared/data/frames")
@pytest.mark.parametrize("name", REAL)
def test_real_frames_as_file_and_as_array(name, tmp_path):
    with PillowImage.open(FRAMES / name) as opened:
        values = np.asarray(opened.convert("RGB"))
    top, left = (size // 2 - 90 for size in values.shape[:2])
    values = values[top : top + 180, left : left + 180]
    camera = Camera.from_fov(70.0, values.shape[1], values.shape[0])
    # As PNG: decoders of JPEG differ in the last bit.
    np.testing.assert_array_equal(stored(values, tmp_path / "frame.png"), values)
    record = by_file(tmp_path / "frame.png", tmp_path, camera)
    found = reconstruct(values, camera)
    same(found, record)
    assert found.choices.detector == "colour"


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", ["colour", "alpha", "grey", "one channel", "three alike"])
def test_depths_and_channels(kind, shape, tmp_path):
    colours = tissue().astype(kind) * (257 if kind is np.uint16 else 1)
    grey = colours[:, :, 0]
    values = {
        "colour": colours, "grey": grey, "one channel": grey[:, :, None], "three alike": np.dstack([grey] * 3),
        "alpha": np.dstack([colours, np.full_like(grey, np.iinfo(kind).max)]),
    }[shape]  # fmt: skip
    written = (
        values[:, :, [2, 1, 0, *range(3, values.shape[2])]] if values.ndim == 3 and shape != "one channel" else values
    )
    cv2.imwrite(str(tmp_path / "frame.png"), written)
    found = reconstruct(values, CAMERA)
    same(found, by_file(tmp_path / "frame.png", tmp_path, CAMERA))
    assert found.choices.detector == ("colour" if shape in ("colour", "alpha") else "peaks")
    assert len(found) == 2


@pytest.mark.parametrize(
    "told",
    [
        {"encoding": "linear"}, {"detector": "peaks"}, {"detector": "simtest:colour"}, {"smoothing_px": 1.5},
        {"roi": (60, 40, 60, 60)}, {"target": "base"}, {"estimators": ("curved", "cone_axis")}, {"isolated": False},
    ],
    ids=str,
)  # fmt: skip
def test_what_is_told_is_told_alike(told, tmp_path):
    values = tissue()
    stored(values, tmp_path / "frame.png")
    found = reconstruct(values, CAMERA, **told)
    options = {"every": True} if "isolated" in told else told
    same(found, by_file(tmp_path / "frame.png", tmp_path, CAMERA, **options))
    assert not set(told) & set(found.choices.inferred)


def test_a_field_of_view_is_told_alike(tmp_path):
    """Focal length, centre and lens are guesses in both, and no exact camera in one of them."""
    values = tissue()
    stored(values, tmp_path / "frame.png")
    told = Options(fov_deg=60.0)
    picture_values = read_picture(tmp_path / "frame.png")
    record = reconstruct_values("frame.png", picture_values, calibration_for(told, picture_values)[0], told)
    found = reconstruct(values, 60.0)
    same(found, record)
    assert "focal length" in [each.what for each in found.choices.assumed]
    assert "focal length" not in [each.what for each in reconstruct(values, CAMERA).choices.assumed]


def test_the_calibration_states_what_is_not_inferred():
    calibration = Calibration(
        CAMERA, Response("gamma", 2.0), saturation_level=0.9,
        priors=Priors(((4.0, 0.0, 0.0),), exactly(40.0), floors=NO_FLOORS),
    )  # fmt: skip
    choices = reconstruct(tissue(), calibration).choices
    assert (choices.encoding, choices.saturation_level) == ("gamma", 0.9)
    assert choices.inferred == ("detector", "smoothing_px", "estimators")
    assert choices.priors == calibration.priors
    assert [each.what for each in choices.assumed] == [
        "falloff towards the border",
        "slope of the relief",
        "highlights",
    ]
    # An array gets the same default estimators as a file: lights and a distance are enough for one more.
    assert choices.estimators[-2:] == ("bisector", "cloud")


def test_the_choices_say_what_was_inferred():
    choices = reconstruct(tissue(), CAMERA).choices
    assert choices.inferred == ("encoding", "saturation_level", "detector", "smoothing_px", "estimators")
    assert str(choices) == (
        "encoding srgb (inferred), clipped at 1 (inferred), detector colour (inferred), smoothing 1 px (inferred), "
        f"estimators {' '.join(DEFAULT_ESTIMATORS)} cloud (inferred)"
    )


def test_real_numbers_stay_light_of_any_scale():
    """The call that simulations make: nothing is decoded, nothing clipped, peaks of the channels' mean at 2 px."""
    light = (tissue() / 255.0) ** 2.2
    found = reconstruct(light, CAMERA)
    choices = found.choices
    assert (choices.encoding, choices.saturation_level, choices.detector) == ("linear", None, "peaks")
    assert "response" not in [each.what for each in choices.assumed]
    assert choices.smoothing_px == 2.0
    (scaled,) = {len(reconstruct(1000 * light, CAMERA)), len(found)}
    assert scaled == 2
    explicit = reconstruct(light.mean(axis=2), CAMERA, ["cone_axis"], smoothing_px=2.0, detector="peaks")
    for one, other in zip(found, explicit, strict=True):
        np.testing.assert_allclose(one.estimates["cone_axis"].normal, other.estimates["cone_axis"].normal, atol=1e-6)


@pytest.mark.parametrize(
    "change", [lambda v: v / 255.0, lambda v: v / np.float32(255), lambda v: v.astype(np.uint16) * 257]
)
def test_a_picture_of_another_depth_is_the_same_picture(change):
    """Real numbers too, where it is said that they are encoded."""
    values = tissue()
    made = [reconstruct(v, CAMERA, detector="colour", encoding="srgb") for v in (values, change(values))]
    assert [spot.region.box for spot in made[0]] == [spot.region.box for spot in made[1]]
    assert made[0].choices == made[1].choices
    assert len(made[0]) == 2
    assert not {"encoding", "detector"} & set(made[0].choices.inferred)


def test_the_detector_that_is_given_decides_the_smoothing():
    for detector, smoothing_px in (("colour", 1.0), (ColourDetector(isolated=False), 1.0), ("peaks", 2.0)):
        assert reconstruct(tissue(), CAMERA, {}, detector=detector).choices.smoothing_px == smoothing_px


def test_the_result_is_a_list_that_travels():
    found = reconstruct(tissue(), CAMERA, ["brightest_point"])
    assert isinstance(found, list)
    again = pickle.loads(pickle.dumps(found))
    assert len(again) == len(found) == 2
    assert again.choices == found.choices
    assert found.detection.view.seen is None


@settings(max_examples=10, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([np.uint8, np.uint16]),
    st.booleans(),
    st.sampled_from([None, "srgb", "linear"]),
)
def test_any_picture_is_the_same_as_file_and_as_array(tmp_path_factory, seed, kind, coloured, encoding):
    rng, folder = np.random.default_rng(seed), tmp_path_factory.mktemp("frame")
    y, x = np.mgrid[:48, :64]
    light = np.zeros((48, 64)) + 0.05
    for cx, cy, width in zip(rng.uniform(8, 56, 3), rng.uniform(8, 40, 3), rng.uniform(1.5, 4, 3), strict=True):
        light += rng.uniform(0.3, 1.2) * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2) / width**2)
    light = light[:, :, None] * rng.uniform(0.6, 1, 3) if coloured else light
    largest = np.iinfo(kind).max
    values = np.rint(largest * srgb_encode(np.clip(light + rng.normal(0, 0.003, light.shape), 0, 1))).astype(kind)
    read = stored(values, folder / "frame.png")
    camera = Camera.from_fov(60.0, 64, 48)
    found = reconstruct(read, camera, encoding=encoding)
    same(found, by_file(folder / "frame.png", folder, camera, encoding=encoding))


# What a calibration does not know -------------------------------------------------------------------------------------


SMALL = Camera.from_fov(60.0, 160, 120)


def bright():
    """Return a colour frame of linear light beyond 1, with two highlights."""
    y, x = np.mgrid[:120, :160] + 0.5
    lobes = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 60) for a, b in ((50, 40), (110, 80)))
    noise = np.random.default_rng(0).normal(0, 0.004, (120, 160, 3))
    return (0.35 * np.array([1.0, 0.55, 0.45]) + 1.2 * lobes[..., None] + noise).astype(np.float32)


@pytest.mark.parametrize("values", [bright(), bright()[..., 0]], ids=["colour", "grey"])
def test_a_frame_without_a_response_is_linear_light_for_every_step(values):
    frame = Frame(values, Calibration(SMALL), 1.0)
    assert (frame.channels == values).all()
    assert not frame.clipped.any()
    same = Frame(values, Calibration(SMALL, Response("linear")), 1.0)
    assert (frame.corrected.intensity == same.corrected.intensity).all()
    assert frame.noise == same.noise


def test_light_by_colour_is_that_of_a_stated_linear_response():
    found, stated = (reconstruct(bright(), Calibration(SMALL, r), detector="colour") for r in (None, Response()))
    assert len(found) == len(stated) == 2
    for first, second in zip(found, stated, strict=True):
        assert first.region == second.region
        for name, estimate in first.estimates.items():
            assert np.array_equal(estimate.normal, second.estimates[name].normal)


@pytest.mark.parametrize("encoding", [None, "srgb", "linear"])
def test_the_noise_of_a_picture_has_the_steps_of_its_encoding(encoding):
    known = complete(Calibration(SMALL, noise=NoiseModel(bits=8)), encoding)
    assert known.noise.response == known.response == Response(encoding or "srgb")


def test_a_path_is_read_as_the_command_reads_it(tmp_path):
    """Text and path alike; the frame of the same pixels gives the same normals."""
    file = tmp_path / "shot.png"
    cv2.imwrite(str(file), tissue()[:, :, ::-1])
    by_array = reconstruct(tissue(), CAMERA)
    for named in (file, str(file)):
        by_path = reconstruct(named, CAMERA)
        assert by_path.image == str(file)
        assert str(by_path.choices) == str(by_array.choices)
        assert by_path.to_polars().equals(by_array.to_polars())
    with pytest.raises(InputError, match=r"none\.png: no such file"):
        reconstruct(tmp_path / "none.png", CAMERA)
    with pytest.raises(InputError, match="camera"):
        reconstruct(file, Camera.from_fov(60.0, 64, 48))


def test_the_table_of_a_result_is_that_of_its_file(tmp_path):
    spots = reconstruct(tissue(), CAMERA)
    table = spots.to_polars()
    write_outputs(tmp_path, spots, tissue() / 255)
    read = pl.read_csv(tmp_path / "normals.csv", infer_schema_length=None)
    assert table.columns == read.columns
    assert table.height == read.height > 0
    for column in ("specularity", "best", "estimator", "status"):
        assert table[column].to_list() == read[column].to_list()
    np.testing.assert_allclose(table["normal_z"].drop_nulls(), read["normal_z"].drop_nulls(), rtol=1e-12)


@pytest.mark.parametrize(("fov_deg", "asked"), [(1.7, True), (9.9, True), (10.0, False), (170.0, False), (171.0, True)])
def test_a_field_of_view_that_no_endoscope_has_is_asked_about(fov_deg, asked):
    """1.7 may be meant in radians."""
    question = f"field of view of {fov_deg:g} deg: is it in degrees? Endoscopes see 10 to 170 deg"
    assert (question in reconstruct(tissue(), fov_deg).warnings) == asked
    assert (question in calibration_for(Options(fov_deg=fov_deg), tissue() / 255)[1]) == asked
