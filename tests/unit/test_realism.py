"""Realism: statistics on pictures that have a known value, distances against scipy, sets of frames."""

import json
from types import SimpleNamespace

import cv2
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import simtest.rendering
from simtest.cli.data import realism
from simtest.dataset.index import SAMPLES
from simtest.dataset.shard_writer import write_dataset
from simtest.errors import InputError
from simtest.realism import frames as realism_frames
from simtest.realism.compare import compare, distances
from simtest.realism.fitting.bank import FrameMaker, one_family
from simtest.realism.frames import NamedFrame, open_frames, open_generated, rendered_frames, varied
from simtest.reconstruction.statistics import COLUMNS, STATISTICS, measure
from simtest.rendering.backend import colour_variant
from simtest.runtime.arrays import kept
from simtest.runtime.processes import make_engine
from simtest.runtime.resources import data_root
from simtest.simulation.frame import make_frame
from simtest.simulation.sensor import to_uint8
from simtest.spec import load_dataset, load_scene

TISSUE = np.float32([0.62, 0.34, 0.28])
"""Encoded red, green and blue."""


def tissue(height=240, width=320, noise=0.0, seed=0):
    frame = np.broadcast_to(TISSUE, (height, width, 3)).copy()
    return (frame + noise * np.random.default_rng(seed).standard_normal(frame.shape)).astype(np.float32)


def with_spots(frame, spots, sigma=3.0, height=0.36):
    """Add grey Gaussians at (x, y)."""
    rows, columns = np.mgrid[: frame.shape[0], : frame.shape[1]] + 0.5
    made = frame.copy()
    for x, y in spots:
        made += (height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2)))[..., None].astype(
            np.float32
        )
    return np.clip(made, 0, 1)


GRID = [(x, y) for x in (60, 140, 220) for y in (60, 120, 180)]


def test_every_column_is_measured_and_named_once():
    assert len(STATISTICS) == 12
    assert len(set(COLUMNS)) == len(COLUMNS)
    found = measure(with_spots(tissue(noise=0.01), GRID))
    assert set(found) == set(COLUMNS)
    assert all(values.ndim == 1 and np.isfinite(values).all() for values in found.values())


def test_highlights_are_counted_and_sized():
    found = measure(with_spots(tissue(noise=0.004), GRID))
    assert found["per_frame"] == [9]
    assert found["per_megapixel"] == pytest.approx(9 / (240 * 320) * 1e6)
    assert found["axis_ratio"] == pytest.approx(1.0, abs=0.12)
    # Neighbours are 60 px apart along y.
    assert np.median(found["clustering"] * found["radius"] * 320) == pytest.approx(60, abs=1)
    small = measure(with_spots(tissue(noise=0.004), GRID, sigma=2.0))
    ratio = np.median(found["radius"]) / np.median(small["radius"])
    assert ratio == pytest.approx(1.5, rel=0.15)
    assert found["area"] == pytest.approx(9 * np.pi * np.median(found["radius"] * 320) ** 2 / (240 * 320), rel=0.2)


def test_clipping_is_seen_at_the_peaks():
    assert measure(with_spots(tissue(), GRID, height=0.30))["clipped"] == [0.0]
    assert measure(with_spots(tissue(), GRID, height=2.0))["clipped"] == [1.0]
    half = with_spots(with_spots(tissue(), GRID[:4], height=2.0), GRID[4:8], height=0.30)
    assert measure(half)["clipped"] == pytest.approx(0.5)


def test_sharpening_draws_halos_and_nothing_else_does():
    frame = with_spots(tissue(noise=0.002), GRID, height=2.0, sigma=2.0)
    plain = np.median(measure(frame)["halo"])
    sharp = np.clip(frame + 1.2 * (frame - cv2.GaussianBlur(frame, (0, 0), 2.0)), 0, 1)
    assert np.median(measure(sharp)["halo"]) > plain + 0.05
    assert plain < 0.02


def test_colour_has_its_moments():
    found = measure(tissue(noise=0.02))
    lab = cv2.cvtColor(tissue(4, 4), cv2.COLOR_RGB2Lab)[0, 0]
    for i, name in enumerate("lab"):
        assert found[f"{name}_mean"] == pytest.approx(lab[i], abs=0.7)
        assert 0.3 < found[f"{name}_sd"] < 6


@given(st.floats(-3, 1))
@settings(max_examples=10, deadline=None)
def test_falloff_is_the_slope_over_the_squared_radius(slope):
    rows, columns = np.mgrid[:240, :320] + 0.5
    squared = ((columns - 160) ** 2 + (rows - 120) ** 2) / (160**2 + 120**2)
    linear = (0.15 * TISSUE / TISSUE.max() * np.exp(slope * squared)[..., None]).astype(np.float32)
    frame = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055).astype(np.float32)
    assert measure(frame)["falloff"] == pytest.approx(slope, abs=0.08)


@pytest.mark.parametrize("slope", [-1.0, -2.0, -3.0])
def test_spectrum_of_a_power_law(slope):
    rng = np.random.default_rng(3)
    frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.rfftfreq(256)[None])
    frequency[0, 0] = 1
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((256, 256))) * frequency ** (slope / 2))
    frame = tissue(256, 256) + (0.03 * field / field.std())[..., None].astype(np.float32)
    assert measure(frame)["spectrum"] == pytest.approx(slope, abs=0.35)


def test_spectrum_of_a_wide_frame_is_that_of_all_of_it():
    """Fine detail on one side and coarse detail on the other: the mirrored frame is the same frame."""
    rng = np.random.default_rng(3)
    coarse = cv2.GaussianBlur(rng.standard_normal((256, 256)), (0, 0), 3)
    frame = tissue(256, 512)
    frame[:, :256] += (0.03 * rng.standard_normal((256, 256)))[..., None].astype(np.float32)
    frame[:, 256:] += (0.03 * coarse / coarse.std())[..., None].astype(np.float32)
    slopes = [measure(np.ascontiguousarray(each))["spectrum"][0] for each in (frame, frame[:, ::-1])]
    turned = measure(np.ascontiguousarray(frame.transpose(1, 0, 2)))["spectrum"][0]
    assert slopes[1] == pytest.approx(slopes[0], abs=0.05)
    assert turned == pytest.approx(slopes[0], abs=0.05)


@pytest.mark.parametrize("noise", [0.005, 0.02])
def test_noise_at_mid_grey(noise):
    """Luma of three channels of white noise."""
    expected = noise * np.linalg.norm([0.299, 0.587, 0.114])
    assert measure(tissue(480, 640, noise=noise))["noise"] == pytest.approx(expected, rel=0.03)
    # A slope of brightness is no noise.
    ramp = tissue(noise=noise) + np.linspace(-0.1, 0.1, 320, dtype=np.float32)[None, :, None]
    assert measure(ramp)["noise"] == pytest.approx(expected, rel=0.05)


def test_vessels_are_green_dark_lines():
    frame = tissue(noise=0.003)
    veined = frame.copy()
    veined[:, 20::40, 1] *= 0.75
    veined[:, 21::40, 1] *= 0.75
    shaded = frame.copy()
    shaded[:, 20::40] *= 0.9
    shaded[:, 21::40] *= 0.9
    plain, vessels, shade = (measure(f)["vessels"][0] for f in (frame, veined, shaded))
    assert vessels > 4 * plain
    assert shade < 2 * plain
    # Of lines that are greener than what lies around them the band leaves less than half.
    dark, pale = frame.copy(), frame.copy()
    for row in range(3):
        dark[:, 20 + row :: 30, 1] *= 0.75
        pale[:, 20 + row :: 30, 1] *= 1.25
    assert measure(pale)["vessels"][0] < 0.5 * measure(dark)["vessels"][0]


def test_a_black_mask_is_no_tissue():
    frame = with_spots(tissue(360, 480, noise=0.004), [(240, 180), (280, 150)])
    rows, columns = np.mgrid[:360, :480]
    masked = np.where(((columns - 240) ** 2 + (rows - 180) ** 2 < 170**2)[..., None], frame, 0).astype(np.float32)
    whole, round_ = measure(frame), measure(masked)
    for name in ("l_mean", "a_mean", "b_mean"):
        assert round_[name] == pytest.approx(whole[name], abs=1.0)
    assert round_["per_megapixel"] > whole["per_megapixel"] * 1.5


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((100, 100), np.float32), "takes colour frames"),
        (np.full((100, 100, 3), 0.5, np.float32), "has no colours"),
        (tissue(40, 100), "100 x 40 px: must be at least 64 px"),
    ],
)
def test_frames_that_cannot_be_measured_are_named(picture, words):
    with pytest.raises(InputError, match=words):
        measure(picture)


@pytest.mark.parametrize("colour", [(0.9, 0.2, 0.1), (0.02, 0.0, 0.0), (1.0, 1.0, 0.98)])
def test_an_even_frame_is_measured_without_a_traceback(colour):
    found = measure(np.broadcast_to(np.float32(colour), (128, 128, 3)).copy())
    assert all(np.isfinite(values).all() for values in found.values())


SPREAD = 0.3
"""Of the scenes' means, where a scene's own values spread by 1."""


def scenes(count, shift=0.0, seed=0, values=30):
    rng = np.random.default_rng(seed)
    return {
        f"{seed} {i}": {name: shift + SPREAD * rng.standard_normal() + rng.standard_normal(values) for name in COLUMNS}
        for i in range(count)
    }


def test_distance_is_the_wasserstein_distance_over_the_left_out_scenes():
    real, generated = scenes(6), scenes(4, shift=0.7, seed=1)
    found = {d.statistic.name: d for d in distances(real, generated)}
    own = [s["radius"] for s in real.values()]
    spread = np.mean([stats.wasserstein_distance(v, np.concatenate(own[:i] + own[i + 1 :])) for i, v in enumerate(own)])
    pooled = np.concatenate([s["radius"] for s in generated.values()])
    expected = stats.wasserstein_distance(np.concatenate(own), pooled) / spread
    assert found["radius"].distance == pytest.approx(expected, rel=1e-9)
    assert found["radius"].interval[0] < expected


@pytest.mark.ci  # meanwhile: test_realism_intervals
def test_two_halves_of_one_set_are_told_apart_on_nothing():
    """Negative control over 12 statistics and 10 seeds; a shift by two spreads is told on all."""
    for seed in range(10):
        real, same, other = (scenes(12, shift, seed + more, 12) for shift, more in ((0, 0), (0, 100), (2.5, 100)))
        near = distances(real, same)
        assert not [d for d in near if d.verdict == "far"]
        far = distances(real, other)
        assert all(d.verdict == "far" for d in far)


@pytest.mark.parametrize("real", [2, 6])
def test_one_generated_scene_gives_a_distance_without_an_interval(real):
    for d in distances(scenes(real), scenes(1, seed=1)):
        assert np.isfinite(d.distance)
        assert np.isnan(d.interval).all()
        assert d.verdict == "too few scenes"


def test_equal_real_scenes_have_no_spread():
    same = {str(i): {name: np.ones(3) for name in COLUMNS} for i in range(5)}
    other = {str(i): {name: np.full(3, 2.0) for name in COLUMNS} for i in range(5)}
    assert all((d.distance, d.verdict) == (0, "near") for d in distances(same, same))
    # Infinitely many spreads are the strongest difference, not too few scenes.
    assert all((d.distance, d.interval, d.verdict) == (np.inf, (np.inf, np.inf), "far") for d in distances(same, other))
    # One generated scene of five that differs may differ by chance.
    other = same | {"0": other["0"]}
    assert all((d.distance, d.interval, d.verdict) == (np.inf, (0, np.inf), "between") for d in distances(same, other))


def test_columns_that_vary_together_do_not_narrow_the_interval():
    """Six columns that hold the same numbers have the interval of one."""
    sides = scenes(8), scenes(8, shift=1.0, seed=1)
    for side in sides:
        for values in side.values():
            values |= {name: values["radius"] for name in COLUMNS}
    found = {d.statistic.name: d for d in distances(*sides)}
    assert found["colour"].interval == pytest.approx(found["radius"].interval)


def picture(path, seed, size=(96, 128)):
    rng = np.random.default_rng(seed)
    frame = np.clip(np.float32([70, 90, 160]) + 6 * rng.standard_normal((*size, 3)), 0, 255).astype(np.uint8)
    for x, y in rng.integers(20, 76, size=(4, 2)):
        cv2.circle(frame, (int(x), int(y)), 3, (255, 255, 255), -1)
    cv2.imwrite(str(path), frame)
    return path


def test_sets_of_files(tmp_path):
    folder = tmp_path / "real"
    folder.mkdir()
    files = [picture(folder / f"{i}.png", i) for i in range(6)]
    film = tmp_path / "one.film"
    film.mkdir()
    for i in range(30):
        picture(film / f"{i}.png", i)
    assert len({frame.scene for frame in open_frames([folder])}) == 6
    assert [frame.scene for frame in open_frames(files[:2])] == [str(file) for file in files[:2]]
    frames = open_frames([film])
    assert len({frame.scene for frame in frames}) == 1
    assert len(frames) == 20
    assert frames[0].read().shape == (96, 128, 3)


def test_of_a_folder_the_generated_frames_are_evenly_spread(tmp_path):
    """Frames of one film beside each other show one place."""
    for i in range(30):
        picture(tmp_path / f"{i:02d}.png", i)
    taken = [int(frame.name[:2]) for frame in open_generated(str(tmp_path), 5)]
    assert taken == [0, 7, 14, 21, 29]
    assert len(open_generated(str(tmp_path), 40)) == 30


class StoringSession:
    """Stands for a session: makes what a surface makes, an anatomy and a relief, and renders nothing."""

    def __init__(self, scene, variant):
        self.update(scene)

    def update(self, scene):
        for kind in ("colon", "relief"):
            kept(kind, scene.model_dump_json(), lambda: {"a": np.zeros(1)})

    def radiance(self):
        raise InputError("renders nothing")


def test_rendered_frames_keep_no_relief(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(simtest.rendering, "Session", StoringSession)
    for frame in open_generated("tissue_colon", 2):
        with pytest.raises(InputError, match="renders nothing"):
            frame.read()
    assert {path.name.split("-")[0] for path in (tmp_path / "kept").iterdir()} == {"colon"}


def test_a_bank_of_a_fit_keeps_neither_reliefs_nor_anatomies(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(simtest.rendering, "Session", StoringSession)
    maker = FrameMaker(one_family(load_dataset("endoscopy"), "tissue_colon"))
    with pytest.raises(InputError, match="renders nothing"):
        next(maker.frames(0, 1))
    assert not (tmp_path / "kept").exists()


def test_too_few_scenes_are_told_before_they_are_measured(tmp_path, monkeypatch):
    for name, count in (("real", 3), ("made", 6)):
        (tmp_path / name).mkdir()
        for i in range(count):
            picture(tmp_path / name / f"{i}.png", i)

    def measured(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("simtest.realism.compare.compare", measured)
    told = "3 real and 6 generated scenes: a verdict needs 5 of each"
    with pytest.warns(UserWarning, match=told), pytest.raises(KeyboardInterrupt):
        realism([tmp_path / "real"], against=str(tmp_path / "made"), out=tmp_path / "out")


def test_the_command_says_too_few_scenes(tmp_path, capsys):
    for name, count in (("real", 3), ("made", 6)):
        (tmp_path / name).mkdir()
        for i in range(count):
            picture(tmp_path / name / f"{i}.png", i + count)
    # Frames of another size, a grey one and one that is no picture are left out or measured, never a traceback.
    picture(tmp_path / "real" / "large.png", 1, (120, 160))
    cv2.imwrite(str(tmp_path / "real" / "grey.png"), np.full((96, 128), 100, np.uint8))
    (tmp_path / "real" / "no.png").write_bytes(b"no picture")
    out = tmp_path / "out"
    realism([tmp_path / "real"], against=str(tmp_path / "made"), out=out)
    printed = capsys.readouterr().out
    assert "too few scenes: 4 real and 6 generated" in printed
    assert "left out: grey.png" in printed
    assert "left out: no.png" in printed
    written = json.loads((out / "realism.json").read_text())
    assert {row["verdict"] for row in written["statistics"]} == {"too few scenes"}
    assert [(frame["side"], frame["frame"]) for frame in written["left_out"]] == [
        ("real", "grey.png"),
        ("real", "no.png"),
    ]
    assert "too few scenes: 4 real and 6 generated" in (out / "index.html").read_text()


@pytest.mark.parametrize(
    ("frames", "against", "more", "words"),
    [
        ("missing.png", "plane", {}, "missing.png: no such file; must be a picture, a film or a folder"),
        ("real", "no_such_scene", {}, "no_such_scene"),
        ("empty", "plane", {}, "holds no pictures"),
        ("real", "plane", {"surfaces": ["colon"]}, "--surface colon: only of a dataset, and plane is none"),
        ("real", "plane", {"count": 0}, "--count 0: must be 1 to 10000"),
    ],
)
def test_bad_input_is_one_line(tmp_path, frames, against, more, words):
    (tmp_path / "real").mkdir()
    (tmp_path / "empty").mkdir()
    picture(tmp_path / "real" / "0.png", 0)
    with pytest.raises(InputError, match=words) as raised:
        realism([tmp_path / frames], against=against, out=tmp_path / "out", **more)
    assert "\n" not in str(raised.value)


def test_a_surface_is_named_by_its_kind_or_by_its_scene(tmp_path, monkeypatch):
    """A stomach's surface is a colon of a wide lumen: it goes by its scene."""
    (tmp_path / "manifest.json").touch()
    pl.DataFrame({
        "surface": ["colon", "colon", "liver"], "family": [0, 1, 2], "anatomy": [0, 0, 0], "key": ["a", "b", "c"],
        "shard": ["s"] * 3, "index": [0, 1, 2],
    }).write_parquet(tmp_path / SAMPLES)  # fmt: skip
    families = [{"scene": name} for name in ("tissue_colon", "tissue_stomach", "tissue_liver")]
    monkeypatch.setattr(realism_frames, "shard_names", lambda _: ["s"])
    monkeypatch.setattr(realism_frames, "open_manifest", lambda _: SimpleNamespace(dataset={"families": families}))

    def names(*surfaces):
        return [frame.name for frame in open_generated(str(tmp_path), 9, surfaces)]

    assert names("stomach") == names("tissue_stomach") == ["b"]
    assert names("colon") == ["a", "b"]
    assert names("tissue_colon", "liver") == ["a", "c"]
    words = "--surface lung: .* has none; it has colon, liver, tissue_colon, tissue_stomach, tissue_liver$"
    with pytest.raises(InputError, match=words):
        names("lung")


def test_a_set_without_frames_to_measure_is_refused():
    def read():
        raise InputError("x.png: no picture")

    broken = NamedFrame("a", "x.png", read)
    sound = NamedFrame("b", "b.png", lambda: np.full((96, 128, 3), (0.6, 0.3, 0.2), np.float32))
    with pytest.raises(InputError, match=r"no real frame can be measured \(x.png: no picture\)"):
        compare([broken], [broken])
    # It is not refused for a frame of the other set.
    with pytest.raises(InputError, match=r"no generated frame can be measured \(the set is empty\)"):
        compare([sound, broken], [])


def test_scenes_vary_from_frame_to_frame():
    scene = load_scene("tissue_colon")
    assert varied(scene, 0) == scene
    other = varied(scene, 2)
    assert other.surface.viewpoint == scene.surface.viewpoint + 2
    assert other.surface.relief.seed == scene.surface.relief.seed + 2
    assert other.sensor.seed == scene.sensor.seed + 2
    assert other.reflectance.albedo.seed == scene.reflectance.albedo.seed + 2
    assert len(open_generated("tissue_colon", 7)) == 7


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
