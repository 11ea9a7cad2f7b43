"""Presets of the sensor: filled in, replaced key by key, and the same after a round trip."""

import numpy as np
import pytest

from simtest.api import _scene
from simtest.errors import InputError
from simtest.runtime.files import write_json
from simtest.simulation.sensor import capture
from simtest.spec import load_scene
from simtest.spec.scene import scene_from_dict
from simtest.spec.sensor import PRESETS, Sensor
from tests.refusals import refused


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_gives_what_its_table_says(name):
    sensor = Sensor.model_validate({"preset": name})
    assert sensor.full_well == PRESETS[name]["full_well"]
    assert sensor.coding.quality == PRESETS[name]["coding"]["quality"]
    assert sensor.sharpening.amount == PRESETS[name]["sharpening"]["amount"]
    assert Sensor.model_validate(sensor.model_dump(mode="json")) == sensor
    assert Sensor.model_validate(sensor.model_dump(exclude_unset=True)) == sensor


def test_given_keys_replace_the_presets():
    sensor = Sensor.model_validate(
        {"preset": "colonoscope_hd", "sharpening": {"amount": 0.2}, "mosaic": None, "exposure": {"percentile": 99.0}}
    )
    assert sensor.sharpening.amount == 0.2
    assert sensor.sharpening.radius_px == PRESETS["colonoscope_hd"]["sharpening"]["radius_px"]
    assert sensor.mosaic is None
    assert sensor.exposure.percentile == 99.0
    assert sensor.exposure.average is None
    # Of another type: nothing of the preset's table stays.
    film = Sensor.model_validate({"preset": "colonoscope_hd", "coding": {"type": "h264", "crf": 30}})
    assert film.coding.crf == 30
    gain = Sensor.model_validate({"preset": "colonoscope_hd", "exposure": {"gain": 2.0}})
    assert (gain.exposure.gain, gain.exposure.average) == (2.0, PRESETS["colonoscope_hd"]["exposure"]["average"])


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ({"preset": "colonoscope"}, "sensor.preset = 'colonoscope'"),
        ({"sharpening": {"radius_px": 0}}, "sensor.sharpening.radius_px = 0"),
        ({"sharpening": {"amount": -1}}, "sensor.sharpening.amount = -1"),
        ({"mosaic": {"pattern": "rgbg"}}, "sensor.mosaic.pattern = 'rgbg'"),
        ({"mosaic": {"demosaicing": "magic"}}, "sensor.mosaic.demosaicing = 'magic'"),
        ({"scaling": {}}, "sensor.scaling.factor: missing"),
        ({"scaling": {"factor": 0}}, "sensor.scaling.factor = 0"),
        ({"overlay": {"captions": [{"text": ""}]}}, "text"),
        ({"overlay": {"boxes": [{"x": 2, "y": 0, "width": 1, "height": 1}]}}, "x = 2"),
        ({"bits": 8, "coding": {"type": "jpeg", "quality": 0}}, "quality = 0"),
        ({"bits": 8, "coding": {"type": "webp"}}, "webp"),
        ({"bits": 8, "coding": {"type": "h264", "crf": 99}}, "crf = 99"),
        ({"bits": 10, "coding": {"type": "jpeg"}}, "bits = 10: must be 8"),
        ({"exposure": {"average": 1.0}}, "average = 1"),
        ({"exposure": {"average": 0.4, "percentile": 99}}, "percentile and average exclude each other"),
    ],
)
def test_bad_sensors_are_named_in_one_line(sensor, words):
    with pytest.raises(InputError) as caught:
        scene_from_dict({"surface": {"type": "plane"}, "sensor": sensor})
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("new", PRESETS)
@pytest.mark.parametrize("kept", [False, True])
def test_another_preset_replaces_the_numbers_of_the_former(new, kept, tmp_path):
    """A scene as an object, and one in frame.json, kept the full well, sharpening and coding of the former preset."""
    own = {"sensor.full_well": 9000.0, "sensor.sharpening.amount": 0.3} if kept else {}
    expected = load_scene("cylinder", {**own, "sensor.preset": new}).sensor
    scene = load_scene("cylinder", {**own, "sensor.preset": "colonoscope_hd"})
    assert _scene(scene, {"sensor.preset": new}, {}).sensor == expected
    write_json(tmp_path / "frame.json", {"scene": scene.model_dump(mode="json")})
    assert load_scene(tmp_path / "frame.json", {"sensor.preset": new}).sensor == expected


def test_another_tissue_replaces_the_colour_of_the_former(tmp_path):
    preset = {"reflectance.albedo.preset": "liver_capsule"}
    expected = load_scene("tissue_colon", preset).reflectance.albedo
    assert expected.base == (0.2, 0.04, 0.033)
    write_json(tmp_path / "frame.json", {"scene": load_scene("tissue_colon").model_dump(mode="json")})
    for made in (_scene(load_scene("tissue_colon"), preset, {}), load_scene(tmp_path / "frame.json", preset)):
        assert made.reflectance.albedo == expected
    # Negative control: without a new preset a part of the former one can be set.
    assert _scene(load_scene("tissue_colon"), {"reflectance.albedo.base.1": 0.5}, {}).albedo.base == (0.66, 0.5, 0.19)


def test_what_a_preset_gives_can_be_switched_off():
    """TOML has no null."""
    stages = ("mosaic", "colour", "sharpening", "scaling", "overlay", "coding", "full_well", "bits")
    off = {f"sensor.{name}": False for name in stages} | {"sensor.read_noise": 0.0}
    sensor = load_scene("plane", {"sensor.preset": "old_sd", **off}).sensor
    assert [getattr(sensor, name) for name in stages] == [None] * len(stages)
    assert sensor.response.type == "srgb"
    refused(lambda: load_scene("plane", {"sensor.coding": True}), "sensor.coding = True: must be a table")
    refused(lambda: load_scene("plane", {"sensor.read_noise": False}), "sensor.read_noise = False: must be a number")


def test_presets_differ_in_what_they_do_to_an_edge():
    """The old processor blurs the edge most; all draw halos; without a preset there is none."""
    light = np.repeat(np.where(np.arange(64) < 32, 0.2, 0.6).astype(np.float32)[None, :, None], 48, axis=0)
    light = np.repeat(light, 3, axis=2)
    widths, depths = {}, {}
    for name in (*PRESETS, None):
        keys = {"preset": name} if name else {"response": {"type": "srgb"}}
        noiseless = {"full_well": None, "read_noise": 0.0, "exposure": {"full_scale": 1.0}}
        frame = capture(light, 1.0, Sensor.model_validate({**keys, **noiseless}), None)[8:-8].mean(axis=(0, 2))
        low, high = frame[4:20].mean(), frame[44:60].mean()
        widths[name] = int(((frame > low + 0.1 * (high - low)) & (frame < high - 0.1 * (high - low))).sum())
        depths[name] = low - frame[20:32].min()
    assert widths["old_sd"] == max(widths.values()) > widths[None]
    assert all(depths[name] > 0.02 for name in PRESETS)
    assert depths[None] < 1e-6
