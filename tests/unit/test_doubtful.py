"""A highlight whose score is below the least one has no best normal, in no output; its estimates stay."""

import csv
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from simtest import reconstruct
from simtest.cli.common import PictureOptions
from simtest.cli.pictures import count_lines, record_tables
from simtest.detection.score import LEAST_SCORE
from simtest.errors import Failure, InputError
from simtest.geometry import Camera
from simtest.reconstruction import pipeline
from simtest.reconstruction.options import Options
from simtest.reconstruction.outputs import constraints_arrays, write_outputs
from simtest.reconstruction.sequence import reconstruct_sequence
from simtest.validation.references import compare

CAMERA = Camera.from_fov(60.0, 320, 240)
BELOW = "it may be no highlight, as its score 0.3 is below 0.4; --least-score 0 keeps it"
SENTENCE = "1 of 2 may be no highlights: their scores are below 0.4; --least-score 0 keeps them"


def picture(shift=0.0):
    """Return two white highlights, the second dimmer, on tissue; linear light."""
    y, x = np.mgrid[:240, :320] + 0.5
    spots = sum(
        level * np.exp(-((x - at - shift) ** 2 + (y - 110) ** 2) / 50) for at, level in ((90, 0.45), (230, 0.35))
    )
    return (np.array([0.35, 0.12, 0.1]) + np.asarray(spots)[..., None]).astype(np.float32)


@pytest.fixture(autouse=True)
def _scored(monkeypatch):
    """The dimmer highlight has a score of 0.3, the other one of 0.6."""

    def scores(patches, _):
        return [None if isinstance(patch, Failure) else 0.3 if patch.peak_px[0] > 160 else 0.6 for patch in patches]

    monkeypatch.setattr(pipeline, "highlight_scores", scores)


def found(least=0.4, **more):
    return reconstruct(picture(), CAMERA, least_score=least, **({"encoding": "srgb"} | more))


@pytest.mark.parametrize("detector", ["peaks", "colour"])
def test_it_has_no_best_normal_and_keeps_its_estimates(detector):
    bright, dim = found(detector=detector)
    assert (bright.score, dim.score, bright.is_doubtful, dim.is_doubtful) == (0.6, 0.3, False, True)
    assert (dim.best, dim.best_estimate, dim.best_because) == (None, None, BELOW)
    assert bright.best in bright.normals
    assert set(dim.normals) == set(bright.normals)
    # A score of the threshold itself suffices, and 0 keeps all.
    for least in (0.3, 0.0):
        assert all(spot.best for spot in found(least, detector=detector))


def test_the_threshold_is_the_fitted_one_unless_it_is_given(monkeypatch):
    monkeypatch.setattr(pipeline, "highlight_scores", lambda patches, _: [LEAST_SCORE - 1e-3] * len(patches))
    assert {spot.least_score for spot in found(None)} == {LEAST_SCORE}
    assert not any(spot.best for spot in found(None))


def test_what_has_no_score_is_not_doubtful():
    spot = found()[1]
    assert replace(spot, score=None).best
    nothing = reconstruct(np.full((240, 320), 0.1, np.float32), CAMERA, roi=(10, 10, 40, 40), least_score=1)
    assert nothing[0].score is None
    assert nothing[0].best_because == "no estimator answered"


def test_every_output_has_it_without_a_best(tmp_path):
    spots = found()
    files = {file.name: file for file in write_outputs(tmp_path, spots, picture())}
    first, second = json.loads(files["normals.json"].read_text())["specularities"]
    assert (second["best"], second["best_because"], second["score"]) == (None, BELOW, 0.3)
    assert second["estimates"]["cone_axis"]["normal"]
    assert (first["best"] is None, first["score"]) == (False, 0.6)
    rows = list(csv.DictReader(files["normals.csv"].read_text().splitlines()))
    assert {(row["specularity"], row["score"]) for row in rows} == {("0", "0.6"), ("1", "0.3")}
    assert {row["specularity"] for row in rows if row["best"] == "1"} == {"0"}
    assert any(row["specularity"] == "1" and row["status"] == "ok" for row in rows)
    assert constraints_arrays(spots)["id"].tolist() == [0]
    assert spots.stated.count == spots.stated_of_organ.count == 1
    assert "1 with a best normal" in repr(spots)
    page = files["index.html"].read_text()
    assert "1 of 2 highlights have a best normal" in page
    assert SENTENCE in page
    shown = json.loads(page.partition('type="application/json">')[2].partition("</script>")[0])["spots"][1]
    assert (shown["best"], shown["because"], shown["score"]) == (None, BELOW, 0.3)
    assert BELOW in spots._repr_html_()
    assert BELOW in spots[1]._repr_html_()


def test_the_terminal_counts_it(tmp_path):
    spots = found()
    lines = list(count_lines(spots, tmp_path / "a.png"))
    assert lines[0].endswith("2 specularities found in " + str(tmp_path / "a.png") + ", 1 with a best normal")
    assert f"note: {SENTENCE}" in lines
    (table,) = record_tables(spots)
    assert [(row[4], row[5] == "none") for row in table.rows] == [("0.60", False), ("0.30", True)]
    assert not found(0.0).doubts


class Facing:
    """A reference that faces the camera."""

    source, notes = "facing", ("a note",)

    def normals_at(self, pixels, camera):
        return np.tile([0.0, 0.0, -1.0], (len(pixels), 1))


def test_a_comparison_leaves_it_out():
    spots = found()
    compare(spots, Facing())
    made = spots.reference
    assert (made.compared, made.missed, made.problems) == (1, 0, ["a note", f"left out: {SENTENCE}"])
    assert {each.n for each in made.estimators.values()} == {1}
    # Its own errors stay beside its estimates.
    assert spots[1].reference.errors
    whole = found(0.0)
    compare(whole, Facing())
    assert (whole.reference.compared, whole.reference.problems) == (2, ["a note"])


@pytest.mark.parametrize(("factor", "share"), [(1e4, 0.0), (1.0, 1.0), (None, None)])
def test_a_comparison_counts_what_is_wrong_and_sure(factor, share):
    """Both normals are off by 90 deg or so, with an uncertainty that holds that, or does not, or is not reported."""

    class Across(Facing):
        def normals_at(self, pixels, camera):
            return np.tile([1.0, 0.0, 0.0], (len(pixels), 1))

    spots = found(0.0, estimators=["cone_axis"])
    made = spots[0].estimates["cone_axis"]
    budget = None if factor is None else {"noise": factor * made.covariance}
    spots[:] = [replace(each, estimates={"cone_axis": replace(made, covariance=None, budget=budget)}) for each in spots]
    compare(spots, Across())
    assert spots.reference.estimators["cone_axis"].wrong_and_sure == share
    assert spots.reference.rows["cone_axis"].n == 2


def test_tracks_of_a_film_have_no_normal_there(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    for i in range(2):
        encoded = np.clip(picture(2.0 * i), 0, 1)
        cv2.imwrite(str(folder / f"{i}.png"), np.rint(255 * encoded[..., ::-1]).astype(np.uint8))
    options = Options(fov_deg=60.0, estimators=("cone_axis",), least_score=0.4)
    with pytest.warns(UserWarning, match="angles depend"):
        reconstruct_sequence(folder, tmp_path / "out", options)
    tracks = json.loads((tmp_path / "out" / "tracks.json").read_text())
    kept = [[normal is not None for normal in track["normals"]] for track in tracks]
    assert sorted(kept) == [[False, False], [True, True]]


@pytest.mark.parametrize("value", [-0.1, 1.1, True, "0.4"])
def test_a_threshold_that_is_no_share_is_refused(value):
    with pytest.raises(InputError, match=r"least_score = .*: must be a number in \[0, 1\]"):
        found(value)


def test_the_command_s_options_carry_it():
    assert PictureOptions(fov_deg=60.0, least_score=0.25).checked().least_score == 0.25
    assert PictureOptions(fov_deg=60.0).checked().least_score is None
