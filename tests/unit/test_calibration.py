"""Calibrations: files, what they undo, and what they leave flagged."""

import dataclasses

import numpy as np
import pytest

import simtest
from simtest.calibration import Calibration, NoiseModel, Priors, Response, Uniform
from simtest.calibration.calibration import MIN_FALLOFF
from simtest.calibration.photometry import AngularProfile
from simtest.detection import Region, detect, estimate_noise
from simtest.detection.detector import Detection
from simtest.errors import Failure, InputError, Reason
from simtest.estimators import Estimate
from simtest.estimators.budget import plateau_area_px
from simtest.estimators.cone_axis import cone_axis
from simtest.geometry import Camera, KannalaBrandt, Patch, ViewMask, smooth
from simtest.reconstruction.pipeline import reconstruct
from simtest.simulation.sensor import capture, collect
from simtest.spec import load_calibration, load_camera, save_calibration
from simtest.spec.sensor import Sensor

CAMERA = Camera(160, 120, 90.0, 90.0, 80.0, 60.0)
CAMERA_TABLE = "[camera]\nwidth = 160\nheight = 120\nfx = 90.0\nfy = 90.0\n"
WHOLE = """
[response]
type = "gamma"
gamma = 2.0

[vignetting]
type = "cosine"
power = 4.0

[emission]
type = "table"
angle_deg = [0.0, 60.0]
value = [1.0, 0.5]

[sensor]
full_well = 5000.0
read_noise = 4.0
bits = 10
saturation_level = 0.98
"""


def spot(x=80.3, y=60.6, width=9.0, height=1.0):
    centres = CAMERA.pixel_centres()
    squared = (centres[..., 0] - x) ** 2 + (centres[..., 1] - y) ** 2
    return (height * np.exp(-squared / (2 * width**2))).astype(np.float32)


def write(tmp_path, text, name="calibration.toml"):
    path = tmp_path / name
    path.write_text(text)
    return path


# Files ---------------------------------------------------------------------------------------------------------------


FLAT = CAMERA_TABLE.removeprefix("[camera]\n")


@pytest.mark.parametrize(("name", "camera"), [("c.toml", CAMERA_TABLE), ("calib.cfg", CAMERA_TABLE), ("c.toml", FLAT)])
def test_a_whole_file_is_read(tmp_path, name, camera):
    read = load_calibration(write(tmp_path, camera + WHOLE, name))
    response = Response("gamma", 2.0)
    assert read == Calibration(
        CAMERA,
        response,
        AngularProfile(4.0),
        AngularProfile(angles=(0.0, np.radians(60.0)), values=(1.0, 0.5)),
        NoiseModel(0.0, 5000.0, 4.0, 10, response),
        0.98,
        Priors(falloff_power=None),
    )


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 0.6, 0.8)])
def test_an_emission_axis_may_be_a_list(axis):
    one, other = (Calibration(CAMERA, emission=AngularProfile(2.0), emission_axis=kind(axis)) for kind in (tuple, list))
    np.testing.assert_array_equal(one.falloff, other.falloff)


@pytest.mark.parametrize("text", [CAMERA_TABLE, FLAT])
def test_a_camera_file_is_a_calibration_of_nothing_else(tmp_path, text):
    read = load_calibration(write(tmp_path, text))
    assert read == Calibration(CAMERA)
    assert (read.response, read.falloff, read.saturation_level) == (None, None, None)


def test_lens_and_view_mask_are_read_beside_the_other_tables(tmp_path):
    table = CAMERA_TABLE + 'distortion = { type = "kannala_brandt", k1 = 0.01 }\nview_mask = { radius = 50.0 }\n'
    camera = dataclasses.replace(CAMERA, distortion=KannalaBrandt(0.01), view_mask=ViewMask(80.0, 60.0, 50.0))
    nested, flat = (load_calibration(write(tmp_path, text + WHOLE)) for text in (table, table.partition("\n")[2]))
    assert nested.camera == camera
    assert nested == flat
    assert load_camera(write(tmp_path, table + WHOLE)) == camera
    # The profile counts over the sightline's own angle: 0.6 rad from the axis lie about 90 tan or 90 theta px off.
    share = nested.falloff / AngularProfile(angles=(0.0, np.radians(60.0)), values=(1.0, 0.5)).at(
        camera.unproject(camera.pixel_centres())[..., 2]
    )
    theta = np.arccos(share**0.25)
    radius = np.hypot(*(camera.pixel_centres() - [80.0, 60.0]).transpose(2, 0, 1))
    inner = radius < 50
    np.testing.assert_allclose(radius[inner], (90 * (theta + 0.01 * theta**3))[inner], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (WHOLE, "width: missing"),
        (FLAT + "[lens]\nk1 = 0.1", "lens = .*unknown key"),
        (CAMERA_TABLE + "[lens]\nk1 = 0.1", "lens = .*unknown key"),
        (CAMERA_TABLE + '[response]\ntype = "table"\nlight = [0.0, 1.0]\nvalue = [1.0, 0.0]', "response.*rise from 0"),
        (CAMERA_TABLE + "[sensor]\nread_noise = 5", "sensor: read_noise = 5 electrons: needs full_well"),
        (CAMERA_TABLE + "[sensor]\nbits = 20", "sensor.bits = 20"),
    ],
)
def test_malformed_files_name_the_key(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        load_calibration(write(tmp_path, text))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Calibration("camera"), r"must be a simtest\.Camera"),
        (lambda: reconstruct(spot(), "camera.toml"), r"must be a simtest\.Camera or simtest\.Calibration"),
        (lambda: Calibration(CAMERA, response="srgb"), "calibration response is a str: must be a simtest Response"),
        (lambda: Calibration(CAMERA, vignetting=4.0), "calibration vignetting is a float: must be a simtest Angular"),
        (lambda: Calibration(CAMERA, emission=None), "calibration emission is a NoneType"),
        (lambda: Calibration(CAMERA, noise=0.05), "calibration noise is a float"),
        (lambda: Calibration(CAMERA, saturation_level="x"), "saturation_level = 'x': must be a finite number > 0"),
        (lambda: Response("film"), "response kind = 'film'"),
        (lambda: Response("gamma", "x"), "response gamma = 'x': must be a finite number > 0"),
        (lambda: Response("gamma", 10**400), "response gamma = 1000"),
        (lambda: Response("table", light=5, value=6), "light = 5: must be a sequence of finite numbers"),
        (lambda: AngularProfile(power="a"), "profile power = 'a': must be a finite number >= 0"),
        (lambda: AngularProfile(angles=0.5, values=(1, 1)), "profile angles = 0.5: must be a sequence"),
        (lambda: AngularProfile(angles=(0, 1), values=(1, np.nan)), "profile values = "),
        (lambda: NoiseModel(full_well=0), "noise full_well = 0: must be a finite number > 0"),
        (lambda: NoiseModel(-1), "noise sigma = -1"),
        (lambda: NoiseModel(0.0, 100.0, -1.0), "noise read_noise = -1.0"),
        (lambda: NoiseModel(read_noise=5.0), "noise read_noise = 5 electrons: needs full_well"),
        (lambda: NoiseModel(bits=8.5), "noise bits = 8.5: must be an integer from 1 to 32"),
        (lambda: NoiseModel(response="srgb"), "noise response is a str"),
    ],
)  # fmt: skip
def test_malformed_parts_of_a_calibration_are_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as error:
        make()
    assert str(error.value).isprintable()


def test_numpys_numbers_are_numbers():
    assert NoiseModel(np.float32(0.5), np.int64(100), np.float64(2), np.int16(8)).at(0.0) > 0
    assert AngularProfile(np.float32(2)).at(0.5) == 0.25


# What is undone ------------------------------------------------------------------------------------------------------


def test_correction_is_the_inverse_of_the_sensor():
    """Channels are made linear before they are averaged."""
    vignetting = {"type": "cosine", "power": 4.0}
    response = {"type": "gamma", "gamma": 2.2}
    sensor = Sensor.model_validate({"vignetting": vignetting, "response": response, "bits": 16})
    scene = spot(20, 30, height=0.9)
    radiance = scene[..., None] * np.array([0.9, 0.6, 0.3], np.float32)
    frame = capture(collect(radiance, sensor, CAMERA), 1.0, sensor, None)
    known = Calibration(CAMERA, Response("gamma", 2.2), AngularProfile(4.0))
    expected = 0.6 * scene
    np.testing.assert_allclose(known.correct(frame).intensity, expected, atol=1e-4)
    # Each part that is missing shows.
    for unknown in (Calibration(CAMERA, Response("gamma", 2.2)), Calibration(CAMERA, vignetting=AngularProfile(4.0))):
        assert np.abs(unknown.correct(frame).intensity - expected).max() > 0.1


def test_emission_counts_like_vignetting():
    lens, light = Calibration(CAMERA, vignetting=AngularProfile(3.0)), Calibration(CAMERA, emission=AngularProfile(3.0))
    np.testing.assert_array_equal(lens.falloff, light.falloff)
    both = Calibration(CAMERA, vignetting=AngularProfile(1.0), emission=AngularProfile(2.0))
    np.testing.assert_allclose(both.falloff, lens.falloff)


def test_a_prior_on_the_falloff_is_left_alone_and_must_hold_what_is_not_undone():
    power, profile = Uniform(0.0, 3.0), AngularProfile(2.0)
    for parts in ({"vignetting": profile}, {"emission": profile}, {"vignetting": profile, "emission": profile}):
        assert Calibration(CAMERA, **parts, priors=Priors(falloff_power=power)).priors.falloff_power == power
    beside = Priors(((5.0, 0.0, 0.0),), falloff_power=power)
    assert Calibration(CAMERA, emission=profile, priors=beside).falloff is None
    lens = Calibration(CAMERA, vignetting=profile)
    both = Calibration(CAMERA, vignetting=profile, emission=profile, priors=beside)
    np.testing.assert_array_equal(both.falloff, lens.falloff)
    with pytest.raises(InputError, match="emission: cannot be undone for lights_mm beside the camera"):
        Calibration(CAMERA, emission=profile, priors=dataclasses.replace(beside, falloff_power=None))


@pytest.mark.parametrize("lights_mm", [(), ((5.0, 0.0, 0.0),)])
def test_a_known_falloff_beside_one_that_nobody_gave_is_written(lights_mm, tmp_path):
    profile = AngularProfile(2.0)
    known = Calibration(CAMERA, vignetting=profile, emission=profile, priors=Priors(lights_mm))
    save_calibration(known, tmp_path / "written.toml")
    read = load_calibration(tmp_path / "written.toml")
    power = read.priors.falloff_power
    assert (power.low, power.high) == (0.0, 4.0)
    # Where both are undone the file has to state it.
    assert (read == known) == bool(lights_mm)


def test_where_no_light_is_left_the_gain_is_limited_and_marked():
    table = AngularProfile(angles=(0.0, 0.3, 0.4), values=(1.0, 1.0, 0.0))
    corrected = Calibration(CAMERA, vignetting=table).correct(np.full((120, 160), 0.1, np.float32))
    assert np.isfinite(corrected.intensity).all()
    assert corrected.gain.max() == pytest.approx(1 / MIN_FALLOFF)
    assert corrected.limited.any()
    assert not corrected.limited[60, 80]
    dark = Calibration(CAMERA, vignetting=AngularProfile(angles=(0.0, 1e-3), values=(1.0, 0.0)))
    corrected = dark.correct(np.zeros((120, 160), np.float32))
    np.testing.assert_array_equal(corrected.intensity, 0)
    assert corrected.limited.all()


def test_a_spot_that_reaches_into_the_limited_part_is_flagged():
    table = AngularProfile(angles=(0.0, 0.3, 0.4), values=(1.0, 1.0, 0.0))
    frame = spot(80 + 90 * np.tan(0.36), 60, 5.0)
    (found,) = reconstruct(frame, Calibration(CAMERA, vignetting=table))
    assert "vignetted" in found.estimates["cone_axis"].flags
    (found,) = reconstruct(spot(), Calibration(CAMERA, vignetting=table))
    assert found.estimates["cone_axis"].flags == ()


def test_noise_is_carried_through_the_gain():
    """Far out the correction multiplies the noise by up to 20: it must not be taken for highlights."""
    camera = Camera(240, 240, 90.0, 90.0, 120.0, 120.0)
    sensor = Sensor.model_validate({"vignetting": {"type": "cosine", "power": 8.0}, "noise_sigma": 0.05})
    x, y = np.moveaxis(camera.pixel_centres(), -1, 0)
    light = collect(np.exp(-((x - 125) ** 2 + (y - 118) ** 2) / 160).astype(np.float32), sensor, camera)
    known = Calibration(camera, vignetting=AngularProfile(8.0))
    naive = 0
    for seed in range(4):
        frame = capture(light, 1.0, sensor, np.random.default_rng(seed))
        assert len(reconstruct(frame, known, smoothing_px=1.0)) == 1
        smoothed = smooth(known.correct(frame).intensity, 1.0)
        naive += len(detect(smoothed, estimate_noise(frame))) - 1
    assert naive > 100


def test_known_shot_noise_raises_the_threshold_where_it_is_bright():
    """On a bright ground the shot noise is above what the dark frame around it shows."""
    ground = np.where(CAMERA.pixel_centres()[..., 0] < 60, 1.0, 0.0).astype(np.float32)
    sensor = Sensor.model_validate({"full_well": 50.0, "bits": 12, "exposure": {"gain": 1.0}})
    frame = capture(0.5 * ground, 1.0, sensor, np.random.default_rng(0))
    noise = NoiseModel(0.0, 50.0, 0.0, 12)
    assert noise.at(0.5) == pytest.approx(0.1, rel=1e-3)
    assert estimate_noise(frame) < 0.01
    found = [len(reconstruct(frame, c)) for c in (Calibration(CAMERA, noise=noise), Calibration(CAMERA))]
    assert found[0] == 0 <= found[1]


# Saturation ----------------------------------------------------------------------------------------------------------


def patch_of(frame, level=1.0):
    smoothed = smooth(frame, 2.0)
    return Patch.cut(smoothed, (0, 0, 160, 120), saturated=frame >= level)


def test_a_clipped_peak_lies_at_the_plateaus_centroid():
    place = (71.9, 44.2)
    frame = np.minimum(spot(*place, height=2.5), 1.0)
    clipped, blind = patch_of(frame), Patch.cut(smooth(frame, 2.0), (0, 0, 160, 120))
    # The plateau is made of whole pixels.
    np.testing.assert_allclose(clipped.peak_px, place, atol=0.2)
    assert np.hypot(*(blind.peak_px - place)) > 2
    assert clipped.peak_value == pytest.approx(1.0, abs=1e-3)
    # A Gaussian clipped at 1/g: share log(g) / log(2 g) of the isophote at half of it.
    assert clipped.saturated_share(0.5) == pytest.approx(np.log(2.5) / np.log(5), abs=0.01)


def test_the_peak_of_a_plateau_does_not_lie_in_its_hole():
    """A dark hole of one pixel, closed, at the centroid."""
    frame = np.zeros((21, 21), np.float32)
    frame[7:14, 7:14] = 1.0
    frame[10, 10] = -1.0
    patch = Patch.cut(frame, (0, 0, 21, 21), saturated=frame >= 1)
    assert patch.peak_value == 1.0
    column, row = patch.peak_pixel
    assert frame[row, column] == 1.0
    np.testing.assert_allclose(patch.peak_px, [10.5, 10.5])
    assert len(patch.crossings(0.5)) == 28
    # All of the plateau dark, as after a falsely stated level: no peak.
    dark = np.where(frame == 0, 0.5, 0).astype(np.float32)
    dark[3, 10] = 1.0
    result = Patch.cut(dark, (0, 0, 21, 21), (7, 7), saturated=frame >= 1)
    assert isinstance(result, Failure)
    assert result.reason is Reason.NO_PEAK


def test_two_highlights_on_one_clipped_plateau_keep_their_own_peaks():
    """Pale tissue clips one channel from one to the next; the light of both falls to nothing between them."""
    y, x = np.mgrid[:40, :40] + 0.5
    lobes = [np.exp(-((x - cx) ** 2 + (y - 20.0) ** 2) / 8) for cx in (15.2, 24.8)]
    frame = (lobes[0] + 0.8 * lobes[1]).astype(np.float32)
    clipped = np.zeros((40, 40), dtype=bool)
    clipped[17:24, 12:29] = True
    first, second = (
        Patch.cut(smooth(frame, 1.0), (2, 2, 36, 36), peak, saturated=clipped, raw=frame)
        for peak in ((14, 19), (24, 19))
    )
    assert first.peak_px == pytest.approx([15.2, 20.0], abs=0.6)
    assert second.peak_px == pytest.approx([24.8, 20.0], abs=0.6)
    # Where it is one highlight, the plateau's centroid is its peak as before.
    whole = Patch.cut(smooth(frame, 1.0), (2, 2, 36, 36), (14, 19), saturated=clipped, raw=np.maximum(frame, clipped))
    assert whole.peak_px == pytest.approx([20.5, 20.5])


@pytest.mark.parametrize("x", [4.3, 40.3])
def test_a_plateau_does_not_take_in_that_of_another_highlight(x):
    """At 4.3 px the region's border cuts the isophotes."""
    lights = (spot(x, height=2.5), spot(x, height=2.5) + spot(130.3, height=2.5))
    patches = [
        Patch.cut(smooth(frame, 1.0), (0, 0, 160, 120), (int(x), 60), saturated=frame >= 1)
        for frame in (np.minimum(light, 1.0) for light in lights)
    ]
    alone, both = (plateau_area_px(patch, 0.5) for patch in patches)
    assert alone == both > 50


def test_a_few_clipped_pixels_leave_the_parabola():
    frame = np.minimum(spot(height=1.01), 1.0)
    assert 0 < np.count_nonzero(frame >= 1.0) < 12
    np.testing.assert_array_equal(patch_of(frame).peak_px, Patch.cut(smooth(frame, 2.0), (0, 0, 160, 120)).peak_px)


def test_saturation_is_flagged_where_it_is_known():
    frame = np.minimum(spot(height=2.0), 1.0)
    for calibration, flags in (
        (Calibration(CAMERA, saturation_level=1.0), ("saturated",)),
        (Calibration(CAMERA), ()),
        (CAMERA, ()),
        (Calibration(CAMERA, saturation_level=1.1), ()),
    ):
        (found,) = reconstruct(frame, calibration)
        assert {name: e.flags for name, e in found.estimates.items()} == dict.fromkeys(found.estimates, flags)
    # A clipped corner elsewhere does not touch this spot.
    frame = spot()
    frame[:3, :3] = 5.0
    (found,) = reconstruct(frame, Calibration(CAMERA, saturation_level=2.0), roi=(30, 10, 100, 100))
    assert found.estimates["cone_axis"].flags == ()


def test_a_highlight_that_a_border_cuts_is_flagged_for_its_own_pixels_alone():
    frame = spot(80.0, 60.0)
    frame[50:70, 110:120] = 5.0  # clipped, in the region and no part of the highlight

    known = Calibration(CAMERA, saturation_level=2.0)
    region = Region((80, 10, 60, 100), (80, 60), 1.0)

    class Found:
        def detect(self, frame, camera, priors):
            return Detection((region,), frame)

    class Facing:
        def estimate(self, patch, camera, priors):
            return Estimate(-camera.unproject(patch.peak_px), -camera.unproject(patch.peak_px)[None], patch.peak_px)

    made = reconstruct(frame, known, {"facing": Facing()}, smoothing_px=1.0, detector=Found())
    (found,) = made
    assert isinstance(found.patch.isophote(0.5), Failure)
    assert found.estimates["facing"].flags == ()


def test_one_clipped_channel_is_enough():
    frame = np.minimum(spot(height=2.0)[..., None] * np.array([1.0, 0.4, 0.2], np.float32), 1.0)
    (found,) = reconstruct(frame, Calibration(CAMERA, saturation_level=1.0))
    assert found.patch.saturated_share(0.5) > 0.2


def test_a_large_plateau_does_not_hide_the_other_spots():
    """A plateau of more pixels than the peaks that are looked at."""
    camera = Camera(400, 300, 200.0, 200.0, 200.0, 150.0)
    x, y = np.moveaxis(camera.pixel_centres(), -1, 0)
    broad = np.exp(-((x - 120) ** 2 + (y - 150) ** 2) / (2 * 30**2))
    small = 0.5 * np.exp(-((x - 330) ** 2 + (y - 150) ** 2) / (2 * 8**2))
    frame = np.minimum(4 * broad, 1.0) + small
    assert np.count_nonzero(frame >= 1) > 2000
    found = reconstruct(frame, Calibration(camera, saturation_level=1.0))
    assert len(found) == 2
    np.testing.assert_allclose([s.patch.peak_px for s in found], [[120, 150], [330, 150]], atol=0.3)


def test_the_plateau_of_a_divided_frame_is_slanted_and_its_peak_is_not():
    vignetting = AngularProfile(6.0)
    sensor = Sensor.model_validate({"vignetting": {"type": "cosine", "power": 6.0}, "saturation": True})
    place = (115.0, 60.0)
    frame = capture(collect(spot(*place, height=2.5), sensor, CAMERA), 1.0, sensor, None)
    (found,) = reconstruct(frame, Calibration(CAMERA, vignetting=vignetting, saturation_level=1.0))
    (blind,) = reconstruct(frame, Calibration(CAMERA, vignetting=vignetting))
    assert np.hypot(*(found.patch.peak_px - place)) < 0.5 * np.hypot(*(blind.patch.peak_px - place))
    assert found.estimates["cone_axis"].flags == ("saturated",)


def test_an_estimator_of_elsewhere_with_odd_isovalues_is_flagged_all_the_same():
    frame = np.minimum(spot(height=2.0), 1.0)

    class Odd:
        def estimate(self, patch, camera, priors):
            made = cone_axis.estimate(patch, camera, priors)
            isophotes = tuple(dataclasses.replace(i, isovalue=2.0) for i in made.isophotes)
            return dataclasses.replace(made, isophotes=isophotes)

    (found,) = reconstruct(frame, Calibration(CAMERA, saturation_level=1.0), {"odd": Odd()})
    assert not isinstance(found.estimates["odd"], Failure)
    assert found.estimates["odd"].flags == ("saturated",)


def test_nothing_known_is_nothing_changed():
    frame = spot() + 0.01 * np.random.default_rng(0).standard_normal((120, 160)).astype(np.float32)
    (plain,), (told,) = reconstruct(frame, CAMERA), simtest.reconstruct(frame, simtest.Calibration(CAMERA))
    assert plain.region == told.region
    for name, estimate in plain.estimates.items():
        np.testing.assert_array_equal(estimate.normal, told.estimates[name].normal)
