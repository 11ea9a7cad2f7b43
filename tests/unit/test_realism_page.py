"""The page of a comparison: what it says of sets that tell everything, little or nothing; and in a real browser."""

import dataclasses
import io
import json

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy import stats

from simtest.errors import InputError
from simtest.pages.charts import png
from simtest.realism.compare import Comparison, SetOfFrames, compare, distances, mean_distribution
from simtest.realism.frames import NamedFrame, _Film, open_frames
from simtest.realism.page import distance_chart, distribution_charts, write_comparison
from simtest.reconstruction.images import Source, open_source
from simtest.reconstruction.statistics import COLUMNS


def frame(seed, spots=4, size=(96, 128)):
    """Return a frame of tissue with white spots, sRGB values in [0, 1]."""
    rng = np.random.default_rng(seed)
    made = np.clip(np.float32([160, 90, 70]) + 6 * rng.standard_normal((*size, 3)), 0, 255).astype(np.uint8)
    for x, y in rng.integers(20, 76, size=(spots, 2)):
        cv2.circle(made, (int(x), int(y)), 3, (255, 255, 255), -1)
    return made.astype(np.float32) / 255


def frames(count, first=0, **more):
    return [NamedFrame(f"scene {i}", f"{i}.png", lambda i=i: frame(i, **more)) for i in range(first, first + count)]


def scenes(count, seed, shift=0.0):
    rng = np.random.default_rng(seed)
    return {f"{i}": {name: shift + 0.3 * rng.standard_normal() + rng.standard_normal(9) for name in COLUMNS}
            for i in range(count)}  # fmt: skip


def of_scenes(real, generated):
    """Return a comparison of measured values, without pictures."""
    sides = (SetOfFrames(side, len(side), 0, []) for side in (real, generated))
    return Comparison(*sides, distances(real, generated), [])


def test_what_is_drawn_is_what_the_distance_compares():
    real, generated = scenes(6, 1), scenes(8, 2, shift=1.0)
    chart = next(c for c in distribution_charts(of_scenes(real, generated)) if c.key == "column_radius")
    curves = {mark.name: mark for mark in chart.panels[0].marks}
    assert set(curves) == {"real", "generated"}
    assert curves["real"].line != curves["generated"].line
    # The area between both lines is the Wasserstein distance, each scene with the same weight.
    x = np.linspace(-8, 8, 20001)
    area = np.abs(mean_distribution(real, "radius", x) - mean_distribution(generated, "radius", x)).sum() * (
        x[1] - x[0]
    )
    pooled = [np.concatenate([s["radius"] for s in side.values()]) for side in (real, generated)]
    assert area == pytest.approx(stats.wasserstein_distance(*pooled), rel=2e-3)
    at = np.searchsorted(x, curves["real"].x)
    assert mean_distribution(real, "radius", x)[at] == pytest.approx(curves["real"].y, abs=0.02)


def test_quartiles_lie_on_the_curve_that_is_drawn_beside_them():
    """One frame of many small highlights among frames of few large ones: each scene has the same weight."""
    rng = np.random.default_rng(4)
    side = {str(i): {name: rng.lognormal(i / 4, 0.3, 20 if i else 400) for name in COLUMNS} for i in range(8)}
    found = SetOfFrames(side, len(side), 0, []).quartiles("radius")
    assert mean_distribution(side, "radius", np.array(found)) == pytest.approx([0.25, 0.5, 0.75], abs=0.01)
    nothing = {"0": {name: np.empty(0) for name in COLUMNS}}
    assert SetOfFrames(nothing, 1, 0, []).quartiles("radius") is None


def test_every_verdict_has_its_own_symbol_and_every_statistic_its_row():
    real, generated = scenes(8, 1), scenes(8, 2)
    for values in generated.values():
        values["radius"] = values["radius"] + 5
        values["noise"] = np.empty(0)
    chart = distance_chart(of_scenes(real, generated))
    assert [text for _, text in chart.panels[0].y.named][1] == "Radius of highlights"
    told = {mark.hover[0].splitlines()[0]: mark.symbol for mark in chart.panels[0].marks if mark.symbol}
    shown = {line.partition(": ")[2]: symbol for line, symbol in told.items()}
    assert {"near", "far"} <= set(shown)
    assert len(set(shown.values())) == len(shown)
    assert "too few scenes" in {key.name for key in chart.keys}
    with Image.open(io.BytesIO(png([chart]))) as picture:
        assert np.asarray(picture).std() > 5


def test_an_infinite_distance_is_drawn_at_the_end_and_written(tmp_path):
    real, generated = ({str(i): {name: np.full(3, value) for name in COLUMNS} for i in range(6)} for value in (1, 2))
    found = of_scenes(real, generated)
    marks = [mark for mark in distance_chart(found).panels[0].marks if mark.hover]
    assert len(marks) == 12
    assert all("far\ndistance ∞\n95 % interval ∞ to ∞" in mark.hover[0] for mark in marks)
    assert "12 are far" in found.verdict
    html = write_comparison(found, tmp_path, "plain").read_text()
    assert "∞ to ∞" in html
    assert {
        (row["distance"], row["verdict"]) for row in json.loads((tmp_path / "realism.json").read_text())["statistics"]
    } == {(None, "far")}


def test_page_holds_verdict_numbers_frames_and_reasons(tmp_path):
    def broken():
        raise InputError("x.png: no <picture>")

    real = [*frames(6), NamedFrame("x", "x.png", broken)]
    found = compare(real, frames(6, first=20, spots=0))
    assert found.generated.without_highlights == 6
    page = write_comparison(found, tmp_path / "out", "made/plain", "simtest realism ...")
    html = page.read_text(encoding="utf-8")
    assert found.verdict in html
    assert "real: 6 scenes, 6 frames;" in html.lower()
    assert "6 without a highlight" in html
    assert "no &lt;picture&gt;" in html
    # Each statistic that no frame tells is a stated gap.
    written = json.loads((tmp_path / "out" / "realism.json").read_text())
    rows = {row["statistic"]: row for row in written["statistics"]}
    assert rows["radius"]["verdict"] == "too few scenes"
    assert rows["radius"]["distance"] is None
    assert rows["colour"]["verdict"] == "near"
    assert rows["colour"]["median_inside_real_quartiles"].keys() == {
        "l_mean",
        "l_sd",
        "a_mean",
        "a_sd",
        "b_mean",
        "b_sd",
    }
    assert written["sets"]["generated"] == {"scenes": 6, "frames": 6, "without_highlights": 6}
    assert html.count("data:image/avif") == 12
    assert {file.name for file in (tmp_path / "out" / "figures").iterdir()} == {
        "strip.png", "distances.png", "distributions.png"
    }  # fmt: skip


def test_stopping_leaves_the_earlier_page(tmp_path):
    found = compare(frames(1), frames(1, first=5))
    write_comparison(found, tmp_path, "plain")
    before = (tmp_path / "index.html").read_bytes(), (tmp_path / "realism.json").read_bytes()

    def stop(done, total, what):
        if done == total - 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_comparison(dataclasses.replace(found, left_out=[]), tmp_path, "other", progress=stop)
    assert before == ((tmp_path / "index.html").read_bytes(), (tmp_path / "realism.json").read_bytes())
    assert not list(tmp_path.rglob("*.part*"))


def test_progress_tells_every_frame():
    told = []
    compare(frames(2), frames(3), lambda done, total, what: told.append((done, total)))
    # Five frames, and nothing else, are counted.
    assert told == [(i, 5) for i in range(6)]


def film(path, count, size=(128, 96)):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, size)
    for i in range(count):
        writer.write((frame(i) * 255).astype(np.uint8)[..., ::-1])
    writer.release()
    return path


def test_a_film_is_one_scene_of_twenty_frames(tmp_path):
    opened = open_frames([film(tmp_path / "one.avi", 45)])
    assert {f.scene for f in opened} == {str(tmp_path / "one.avi")}
    assert [int(f.name.partition("#")[2]) for f in opened] == [int(i) for i in np.linspace(0, 44, 20)]
    # Each is the frame that its name says, also when it is read again.
    for f in (opened[3], opened[10], opened[3]):
        wanted = frame(int(f.name.partition("#")[2]))
        assert np.abs(f.read() - wanted).mean() < 0.02


def test_a_film_that_ends_early_is_measured_as_far_as_it_goes(tmp_path):
    source = open_source(film(tmp_path / "one.avi", 8))
    longer = _Film(Source(source.path, 40))
    short = [NamedFrame("one", f"one.avi#{i}", lambda i=i: longer.read(i)) for i in (0, 5, 20, 39)]
    found = compare(short, frames(1))
    assert found.real.frames == 2
    assert [f.reason.partition(": ")[2] for f in found.left_out] == [
        "ends after 8 of the 40 frames that it announces"
    ] * 2
