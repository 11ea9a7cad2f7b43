"""Negative controls on rendered frames: the smooth dataset is far from real frames, and not from itself."""

import numpy as np
import pytest

from simtest.dataset.shard_writer import write_dataset
from simtest.errors import InputError
from simtest.realism.compare import compare, distances
from simtest.realism.frames import open_frames, open_generated, rendered_frames, varied
from simtest.rendering.backend import colour_variant
from simtest.runtime.processes import make_engine
from simtest.runtime.resources import data_root
from simtest.simulation.frame import make_frame
from simtest.simulation.sensor import to_uint8
from simtest.spec import load_dataset, load_scene

COLONOSCOPY = (
    "fig5_a.bmp", "fig7_a.bmp", "hyperkvasir_0qkwl.jpg", "hyperkvasir_0qx73.jpg", "hyperkvasir_0rx1i.jpg",
)  # fmt: skip

SMOOTH = "smooth" if (data_root("scenes") / "datasets" / "smooth.toml").is_file() else "endoscopy"


@pytest.mark.parametrize(
    "exposure", [{}, {"sensor.exposure": {"percentile": 99.0}, "sensor.response": {"type": "srgb"}, "sensor.bits": 8}]
)
def test_a_picture_alone_is_that_of_the_labelled_frame(exposure):
    """`realism` renders scenes without their truth and in one session; the bytes must not tell."""
    size = {"camera.width": 96, "camera.height": 72, "camera.fx": 60, "camera.fy": 60}
    base = load_scene("sphere", {**size, "reflectance.colour": [0.9, 0.5, 0.4], **exposure})
    alone = [frame.read() for frame in rendered_frames(base, 3)]
    for number, picture in enumerate(alone):
        whole = make_frame(varied(base, number), colour_variant()).image
        # A sensor without a response gives linear light, which is shown as a screen needs it.
        expected = np.clip(whole, 0, 1) if base.sensor.encodes else to_uint8(whole).astype(np.float32) / 255
        assert np.array_equal(picture, expected)
    # Another seed of the noise each time.
    assert not np.array_equal(alone[0], alone[1])


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    """Folder of 24 samples of the smooth recipe, of 12 anatomies."""
    folder = tmp_path_factory.mktemp("smooth") / "data"
    write_dataset(load_dataset(SMOOTH, {"samples": 24, "samples_per_anatomy": 2}), folder, make_engine())
    return folder


@pytest.fixture(scope="module")
def against_real(smooth, shared_data):
    real = [shared_data / "frames" / name for name in COLONOSCOPY]
    if missing := [path.name for path in real if not path.is_file()]:
        pytest.skip(f"no real frames {', '.join(missing)} in ../shared/data/frames")
    return compare(open_frames(real), open_generated(str(smooth), 24))


@pytest.mark.slow
def test_the_smooth_dataset_is_told_from_real_frames(against_real):
    far = [d.statistic.name for d in against_real.distances if d.verdict == "far"]
    assert {"radius", "halo", "colour", "noise"} <= set(far)
    assert not against_real.is_inside("radius")
    assert not against_real.is_inside("clipped")


@pytest.mark.slow
def test_two_halves_of_the_smooth_dataset_are_told_apart_on_nothing(against_real):
    scenes = against_real.generated.scenes
    names = list(scenes)
    halves = [{name: scenes[name] for name in names[first::2]} for first in (0, 1)]
    assert min(map(len, halves)) >= 5
    assert [d.statistic.name for d in distances(*halves) if d.verdict == "far"] == []


@pytest.mark.slow
def test_samples_are_spread_over_the_anatomies(smooth):
    frames = open_generated(str(smooth), 12)
    assert len({frame.scene for frame in frames}) == 12
    liver = open_generated(str(smooth), 24, ["liver"])
    assert {frame.scene.split()[0] for frame in liver} == {"liver"}
    assert liver[0].read().shape == (480, 640, 3)
    with pytest.raises(InputError, match=r"--surface lung: .* has none; it has colon, liver"):
        open_generated(str(smooth), 24, ["lung"])
