"""Distance of two sets of frames: against scipy's Wasserstein distance, with negative controls."""

import json

import cv2
import numpy as np
import pytest
from scipy import stats

import simtest.rendering
from simtest.cli.data import realism
from simtest.errors import InputError
from simtest.realism.compare import compare, distances
from simtest.realism.fitting.bank import FrameMaker, one_family
from simtest.realism.frames import NamedFrame, open_frames, open_generated, varied
from simtest.realism.statistics import COLUMNS
from simtest.runtime.arrays import kept
from simtest.spec import load_scene
from simtest.spec.recipes import load_dataset

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


@pytest.mark.ci  # meanwhile: test_the_command_says_too_few_scenes
def test_few_scenes_carry_no_verdict():
    assert {d.verdict for d in distances(scenes(4), scenes(30, seed=1))} == {"too few scenes"}
    assert {d.verdict for d in distances(scenes(30), scenes(4, seed=1))} == {"too few scenes"}
    assert all(np.isfinite(d.distance) for d in distances(scenes(4), scenes(30, seed=1)))


@pytest.mark.parametrize("real", [2, 6])
def test_one_generated_scene_gives_a_distance_without_an_interval(real):
    for d in distances(scenes(real), scenes(1, seed=1)):
        assert np.isfinite(d.distance)
        assert np.isnan(d.interval).all()
        assert d.verdict == "too few scenes"


def test_what_no_frame_tells_is_a_stated_gap():
    real, generated = scenes(6), scenes(6, seed=1)
    for side in generated.values():
        side["radius"] = np.empty(0)
    found = {d.statistic.name: d for d in distances(real, generated)}
    assert np.isnan(found["radius"].distance)
    assert found["radius"].verdict == "too few scenes"
    assert np.isfinite(found["halo"].distance)


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
    ("frames", "against", "words"),
    [
        ("missing.png", "plane", "missing.png: no such file; must be a picture, a film or a folder"),
        ("real", "no_such_scene", "no_such_scene"),
        ("empty", "plane", "holds no pictures"),
    ],
)
def test_bad_input_is_one_line(tmp_path, frames, against, words):
    (tmp_path / "real").mkdir()
    (tmp_path / "empty").mkdir()
    picture(tmp_path / "real" / "0.png", 0)
    with pytest.raises(InputError, match=words) as raised:
        realism([tmp_path / frames], against=against, out=tmp_path / "out")
    assert "\n" not in str(raised.value)


def test_a_set_without_frames_to_measure_is_refused(tmp_path):
    def read():
        raise InputError("x.png: no picture")

    frames = [NamedFrame("a", "x.png", read)]
    with pytest.raises(InputError, match=r"no real frame can be measured \(x.png: no picture\)"):
        compare(frames, frames)


def test_an_empty_set_is_not_refused_for_a_frame_of_the_other_one():
    def read():
        raise InputError("x.png: no picture")

    sound = NamedFrame("b", "b.png", lambda: np.full((96, 128, 3), (0.6, 0.3, 0.2), np.float32))
    with pytest.raises(InputError, match=r"no generated frame can be measured \(the set is empty\)"):
        compare([sound, NamedFrame("a", "x.png", read)], [])


def test_scenes_vary_from_frame_to_frame():
    scene = load_scene("tissue_colon")
    assert varied(scene, 0) == scene
    other = varied(scene, 2)
    assert other.surface.viewpoint == scene.surface.viewpoint + 2
    assert other.surface.relief.seed == scene.surface.relief.seed + 2
    assert other.sensor.seed == scene.sensor.seed + 2
    assert other.reflectance.albedo.seed == scene.reflectance.albedo.seed + 2
    assert len(open_generated("tissue_colon", 7)) == 7
