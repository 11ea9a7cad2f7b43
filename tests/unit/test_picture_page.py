"""The page and the overlay of a picture: the best normals by default, all rows, budgets and flags in words."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simtest.calibration import Calibration, Frame, Uniform
from simtest.cli.pictures import assumed_lines, count_lines, silent_lines
from simtest.detection import Detection, Region
from simtest.detection.detector import Highlight, Kind
from simtest.errors import Failure, Reason
from simtest.estimators.budget import PARTS
from simtest.estimators.cloud_shape import CloudShape, Slope
from simtest.estimators.protocol import Estimate
from simtest.geometry import Camera, Patch
from simtest.pages.html import environment
from simtest.reconstruction import explanations
from simtest.reconstruction.assumptions import LIGHT_AT_CAMERA, assumptions, calibration_of_view
from simtest.reconstruction.options import Choices
from simtest.reconstruction.overlay import ISOPHOTE, NUMBER, draw_overlay
from simtest.reconstruction.page import write_picture_page
from simtest.reconstruction.records import Drawing, Specularities, Specularity, cloud_members

WIDTH, HEIGHT = 320, 240
NORMAL = np.array([0.28, 0.0, -0.96])
RING = [[10.0, 10.0], [20.0, 10.0], [20.0, 20.0], [10.0, 10.0]]


def estimate(look, degrees=2.0, **more):
    part = np.eye(2) * np.radians(degrees) ** 2 / 2
    return Estimate(
        NORMAL, NORMAL[None], np.array(look, float), budget={"noise": part / 4, "camera": part * 3 / 4}, **more
    )


def highlight(kind, at):
    edge = np.array(RING) + at
    region = Region((at[0] - 5, at[1] - 5, 10, 10), np.array(at), 0.5)
    return Highlight(region, kind, 9, None, None, None, 1.0, 0.0, edge, np.array([at]), 0.0)


def spot(i, at, estimates, best, drawings=None):
    """Return a specularity whose best estimate and drawings are given, not computed."""
    corner = (int(at[0]) - 5, int(at[1]) - 5)
    patch = Patch(np.zeros((10, 10)), corner, np.array(at, float), 1.0, (5, 5))
    region = Region((*corner, 10, 10), (corner[0] + 5, corner[1] + 5), None)
    made = Specularity(region, patch, estimates, highlight(Kind.ISOLATED, at), id=i)
    return given(made, best, drawings or {name: Drawing([], []) for name in estimates})


def given(made, best, drawings):
    vars(made).update(_judged=(best, "smallest expected error"), drawings=drawings)
    return made


def cloud_spot(i, points, look):
    shape = CloudShape(
        np.array(points, float), np.diag([1e-3, 2e-3]), 4.0, 1.0, Uniform(0.0, 1e-3), Slope(0.05, 0.02, 0.08, False)
    )
    made = spot(i, look, {"cloud": estimate(look, target="base", cloud=shape, flags=("cut",))}, "cloud")
    alone = replace(made, patch=Failure(Reason.NO_PEAK, "a cloud"), highlight=None)
    return given(alone, "cloud", {"cloud": Drawing([], [RING])})


def record_of(spots, others=(), assumed=()):
    calibration = Calibration(Camera.from_fov(60.0, WIDTH, HEIGHT))
    frame = Frame(np.zeros((HEIGHT, WIDTH), np.float32), calibration, 1.0)
    choices = Choices(calibration, "colour", 1.0, (), (), assumed)
    return Specularities(spots, Detection((), frame, others=others), choices, "a/frame.png", ["no calibration"])


def page_of(spots, tmp_path):
    write_picture_page(tmp_path / "index.html", record_of(spots), np.full((HEIGHT, WIDTH, 3), 0.3, np.float32))
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    return text, json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.S)[1])


def many(count):
    places = np.random.default_rng(3).uniform(20, 220, (count, 2))
    return [spot(i, at, {"cone_axis": estimate(at, flags=("saturated",)),
                         "circle_pose": Failure(Reason.STREAK, "long")}, "cone_axis")
            for i, at in enumerate(places.round(1).tolist())]  # fmt: skip


def test_budget_tilt_and_flags_stand_in_the_data(tmp_path):
    text, data = page_of(many(3), tmp_path)
    row, failed = data["spots"][0]["rows"]
    assert row["deviation"] == pytest.approx(2.0)
    assert row["tilt"] == pytest.approx(np.degrees(np.arccos(0.96)), abs=0.01)
    assert row["parts"] == pytest.approx({"noise": 1.0, "camera": np.sqrt(3.0)}, abs=1e-3)
    assert failed == {"name": "circle_pose", "status": "streak", "detail": "long"}
    assert data["words"]["flags"][row["flags"][0]] == "the isophotes enclose clipped pixels"
    assert "3 of 3 highlights have a best normal" in text
    assert "± 2° (median), mostly of camera (1.7°) and noise (1°)" in text


def test_the_covariance_across_the_view_is_foreshortened(tmp_path):
    _, data = page_of(many(1), tmp_path)
    xx, xy, yy = data["spots"][0]["rows"][0]["across"]
    # The normal leans in x: its x moves by cos(tilt) per rad.
    assert yy == pytest.approx(np.radians(2.0) ** 2 / 2, rel=1e-3)
    assert xx == pytest.approx(yy * 0.96**2, rel=1e-3)
    assert xy == pytest.approx(0, abs=1e-9)


def test_an_empty_error_has_a_reason(tmp_path):
    silent = replace(estimate((15, 15)), budget=None, covariance=None)
    beside = replace(silent, flags=("unresolved", "light_offset"))
    four = {
        "brightest_point": silent, "cone_axis": beside, "circle_pose": silent, "mine": silent,
        "curved": estimate((1, 1)),
    }  # fmt: skip
    _, data = page_of([spot(0, (15, 15), four, "brightest_point")], tmp_path)
    told = {row["name"]: row["silent"] for row in data["spots"][0]["rows"]}
    words = explanations.UNTOLD_ERROR
    assert told == {
        "brightest_point": words["other"], "cone_axis": words["light_offset"],
        "circle_pose": words["circle_pose"], "mine": words["other"], "curved": "",
    }  # fmt: skip
    silent = silent_lines([spot(0, (15, 15), four, "brightest_point"), spot(1, (15, 15), four, "curved")])
    assert list(silent) == [f"no ± at 1 best normal: {words['other']}"]


def test_numbers_of_the_overlay_stand_on_a_dark_ground():
    white = np.ones((HEIGHT, WIDTH, 3), np.float32)
    made = draw_overlay(white, [spot(0, (150, 100), {"cone_axis": estimate((150, 100))}, "cone_axis")])
    scale = made.shape[1] // WIDTH
    x, y, w, h = spot(0, (150, 100), {}, None).region.box
    left, low = int((x + 0.75 * w) * scale), int((y + 0.25 * h) * scale)
    ground = made[low - 12 : low + 3, left : left + 9]
    yellow = (ground == NUMBER).all(axis=-1)
    assert yellow.any()
    # 64: a quarter of white; the letter's own dark edge alone would leave white between its strokes
    assert ground[~yellow].max(axis=-1).mean() < 100


def test_glints_belong_to_their_cloud(tmp_path):
    spots = [*many(2), cloud_spot(2, [many(2)[1].peak_px, (100, 100)], (120.0, 110.0))]
    assert cloud_members(spots) == {1: 2}
    text, data = page_of(spots, tmp_path)
    assert [s["cloud"] for s in data["spots"]] == [None, 2, None]
    cloud = data["spots"][2]["rows"][0]["cloud"]
    assert len(cloud["points"]) == 2
    assert cloud["slope"] == pytest.approx(np.degrees([0.05, 0.02, 0.08]), abs=0.01)
    assert explanations.TERMS["cloud"].split(".")[0] in text


def test_lines_that_estimators_share_are_kept_once(tmp_path):
    both = {name: estimate((15, 15)) for name in ("cone_axis", "curved")}
    drawings = {name: Drawing([(0.3, RING[::-1]), (0.6, RING)], [RING]) for name in both}
    _, data = page_of([spot(0, (15, 15), both, "curved", drawings)], tmp_path)
    first = data["spots"][0]
    assert len(first["lines"]) == 2
    # Nearest to half height first.
    assert [first["lines"][i] for i in first["rows"][0]["isophotes"]] == [RING, RING[::-1]]


def test_a_picture_without_highlights_has_a_page(tmp_path):
    text, data = page_of([], tmp_path)
    assert data["spots"] == []
    assert "No highlight was found" in text


def test_what_the_calibration_gives_stands_apart_from_what_is_assumed(tmp_path):
    first, *others = assumptions(calibration_of_view(70.0, WIDTH, HEIGHT), None)
    record = record_of(many(1), assumed=[first, *(replace(each, given=True) for each in others)])
    write_picture_page(tmp_path / "index.html", record, np.full((HEIGHT, WIDTH, 3), 0.3, np.float32))
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "Given by the calibration, not exactly: distance of the tissue, focal length" in page
    assert "Assumed, because nobody gave it: light</summary>" in page
    _, *lines = assumed_lines(record.choices.assumed)
    assert [line.split(": ")[:2] for line in (lines[0], lines[-1])] == [
        ["given", "distance of the tissue"], ["assumed", "light"]
    ]  # fmt: skip


def test_counts_and_the_light_are_told_alike_on_page_and_terminal(tmp_path):
    others = [highlight(Kind.SMALL, (40, 40)), highlight(Kind.BORDER, (80, 40)), highlight(Kind.BORDER, (90, 60))]
    spots = [*many(2), spot(2, (50, 90), {"cone_axis": Failure(Reason.CLUSTER, "two")}, None)]
    assumed = assumptions(calibration_of_view(70.0, WIDTH, HEIGHT), None)
    record = record_of(spots, others, assumed)
    write_picture_page(tmp_path / "index.html", record, np.full((HEIGHT, WIDTH, 3), 0.3, np.float32))
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "2 of 3 highlights have a best normal" in page
    assert "3 more were found and left out" in page
    assert "(2 border, 1 few pixels)" in page
    assert LIGHT_AT_CAMERA in page
    lines = [*assumed_lines(record.choices.assumed), *count_lines(record, Path("frame.png"))]
    said = "\n".join(lines)
    assert lines[0] == f"note: {LIGHT_AT_CAMERA}"
    assert "3 specularities found in frame.png, 2 with a best normal" in lines
    assert "3 more highlights found and left out" in said
    assert "2 border, 1 few pixels" in said
    # Where the light is told, or all have a normal, there is nothing to say.
    lines = [*assumed_lines(assumed[1:]), *count_lines(record_of(many(2)), Path("frame.png"))]
    assert LIGHT_AT_CAMERA not in "\n".join(lines)
    assert "2 specularities found in frame.png" in lines


def test_a_kind_that_is_named_as_a_flag_has_another_name_for_people(tmp_path):
    _, data = page_of([replace(each, highlight=highlight(Kind.SMALL, (40, 40))) for each in many(1)], tmp_path)
    name = data["spots"][0]["kind"]
    assert name == "few pixels"
    assert data["words"]["kinds"][name] == explanations.KINDS["small"]
    shown = {explanations.kind_name(str(kind)) for kind in Kind}
    assert not shown & set(explanations.FLAGS)
    assert len(shown) == len(Kind)
    assert set(explanations.KIND_NAMES) <= set(explanations.KINDS)
    assert explanations.kind_name(None) == ""


def test_the_overlay_draws_the_best_estimate_alone():
    both = {"cone_axis": estimate((60, 60)), "circle_pose": estimate((200, 120))}
    drawings = {
        "cone_axis": Drawing([(0.5, RING)], [RING]),
        "circle_pose": Drawing([(0.1, [[200, 200], [230, 200]])], []),
    }
    blank = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    drawn = draw_overlay(blank, [spot(0, (60, 60), both, "cone_axis", drawings)])
    scale = drawn.shape[1] // WIDTH
    frame = drawn[: HEIGHT * scale]
    assert frame[10 * scale : 20 * scale, 10 * scale : 20 * scale].any()
    assert not frame[100 * scale :, 150 * scale :].any()
    assert (drawn == ISOPHOTE).all(axis=-1).any()


def test_the_overlay_draws_a_cloud_as_a_cloud():
    spots = [cloud_spot(0, [(200, 60), (250, 180), (150, 200)], (210.0, 150.0))]
    drawn = draw_overlay(np.zeros((HEIGHT, WIDTH), np.float32), spots)
    scale = drawn.shape[1] // WIDTH
    for x, y in spots[0].estimates["cloud"].cloud.points_px.astype(int):
        assert drawn[y * scale - 2 : y * scale + 2, x * scale - 2 : x * scale + 2].any()
        # half-way along the ray
        x, y = (x + 210) // 2, (y + 150) // 2
        assert drawn[y * scale - 4 : y * scale + 4, x * scale - 4 : x * scale + 4].any()


# Words ------------------------------------------------------------------------------------------------------------


def test_every_kind_reason_and_part_is_explained():
    assert set(explanations.KINDS) == {str(kind) for kind in Kind}
    assert set(explanations.REASONS) == {str(reason) for reason in Reason}
    assert set(explanations.PARTS) >= set(PARTS)


def test_templates_are_compiled_once_and_again_where_nothing_can_be_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))
    environment().get_template("picture.html.j2")
    assert list((tmp_path / "kept").glob("__jinja2_*.cache"))
    monkeypatch.setattr("jinja2.environment.Environment.compile", None)
    environment().get_template("picture.html.j2")
    monkeypatch.undo()
    (tmp_path / "file").touch()
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "file"))
    assert environment().get_template("picture.html.j2")
