"""A small page of each kind that simtest writes, by name."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import pytest
import test_advice
import test_dataset_contents
import test_dense_command
import test_light_calibration
import test_twin
from made_nights import history_of, run_of, verdict_of
from test_nightly_page import rows_of
from test_realism_page import frames
from test_report import make_run

import simtest
from simtest.advice.advise import advise, write_advice
from simtest.advice.plan import Question
from simtest.advice.scope import read_scope
from simtest.advice.twin.bank import BankFrame
from simtest.advice.twin.run import TwinResult, match_spots, write_twins
from simtest.advice.twin.scenes import Look
from simtest.advice.twin.scoring import usable_spots
from simtest.api import reconstruct_picture
from simtest.bench.run import run_bench
from simtest.bench.table import read_entries, write_leaderboard
from simtest.calibration import Calibration, Response
from simtest.dataset.card import write_preview
from simtest.dataset.scoring.dense.score import score_maps
from simtest.dataset.shard_writer import write_dataset
from simtest.nightly.page import write_nightly_page
from simtest.nightly.records import JudgedRun
from simtest.realism.compare import compare
from simtest.realism.page import write_comparison
from simtest.reconstruction.light_calibration.page import write_calibration
from simtest.reconstruction.light_calibration.run import Ball, calibrate_lights
from simtest.reconstruction.options import Options
from simtest.reconstruction.pipeline import run
from simtest.reconstruction.sequence import reconstruct_sequence
from simtest.report import write_report
from simtest.report.scene3d import grid_triangles
from simtest.report.viewer import Content, write_scene_page
from simtest.runtime.processes import make_engine
from tests.bench_tiny import tiny_suite


def nightly_page(folder: Path) -> Path:
    """The page of a nightly run with findings and a history."""
    night = run_of(rows_of("overview", "noise"), datetime(2026, 3, 1, 2, 30, tzinfo=UTC))
    return write_nightly_page(folder, JudgedRun(night, verdict_of(night), history_of(night, 30)))


def view_page(folder: Path) -> Path:
    """The page in 3D of a dome with one true normal and those of two estimators."""
    x, y = np.meshgrid(np.linspace(-4, 4, 12), np.linspace(-4, 4, 12))
    vertices = np.stack([x, y, 12 + 0.05 * (x**2 + y**2)], axis=-1)
    at, tip = np.array([[0.0, 0.0, 12.0]]), np.array([[0.0, 0.0, 9.0]])
    names = ("camera", "true normal", "cone_axis", "another_package_with_a_long_name")
    points, none = vertices.reshape(-1, 3), np.empty((0, 3))
    content = Content(
        points, grid_triangles(vertices, 2.0), np.full(len(points), 0.1), none, none, np.full_like(points, 0.5),
        np.zeros((1, 3)), np.array(names), np.repeat(at, 4, axis=0), np.concatenate([tip, tip, tip, tip + 0.2]),
    )  # fmt: skip
    write_scene_page(content, folder / "view.html", "a_scene_with_a_long_name")
    return folder / "view.html"


def write_spots(path: Path) -> Path:
    """Write a picture with a dozen spots on tissue."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:240, :320]
    picture = 0.3 + 0.02 * rng.standard_normal((240, 320))
    for column, row in ((c, r) for c in range(40, 300, 70) for r in range(40, 220, 70)):
        picture += 0.6 * np.exp(-((x - column) ** 2 + 1.4 * (y - row) ** 2) / 60)
    cv2.imwrite(str(path), np.uint8(np.clip(255 * picture, 0, 254)))
    return path


def picture_page(folder: Path) -> Path:
    """The page of a picture."""
    with pytest.warns(UserWarning, match="no calibration"):
        _, files = reconstruct_picture(write_spots(folder / "spots.png"), folder / "out", Options(fov_deg=70.0))
    return next(file for file in files if file.name == "index.html")


def sequence_page(folder: Path) -> Path:
    """The page of a folder of pictures."""
    (folder / "pictures").mkdir()
    for name in ("a.png", "b.png"):
        write_spots(folder / "pictures" / name)
    with pytest.warns(UserWarning, match="no calibration"):
        reconstruct_sequence(folder / "pictures", folder / "out", Options(fov_deg=70.0))
    return folder / "out" / "index.html"


def advice_page(folder: Path) -> Path:
    """The page on what a small scope can reach on a plane."""
    scope = read_scope(test_advice.written(folder, test_advice.CAMERA + "[rig]\nlights_mm = [[2.0, 0.0, 0.0]]\n"))
    asked = Question(scope, "plane", (15.0, 30.0), frames=8)
    return write_advice(advise(asked, folder / "out"), folder / "out", "simtest advise")


def twin_page(folder: Path) -> Path:
    """The page of twins from a bank that is made up."""
    picture = np.float32(test_twin.picture_of_spots())[..., ::-1] / 255
    made, twins = (
        run(np.ascontiguousarray(picture), Calibration(test_twin.CAMERA), Options()),
        test_twin.made_bank(200, 2),
    )
    found = match_spots(usable_spots(made), twins, "frame.png", 2)
    bank = [BankFrame(np.uint8(255 * picture), [spot for frame, spot in twins if frame == i]) for i in range(2)]
    look, assumed = Look("tissue_colon", 0.4), list(made.choices.assumed)
    write_twins(TwinResult("frame.png", picture, found, bank, look, assumed, [], 1.0), folder, "simtest twin frame.png")
    return folder / "index.html"


def bench_page(folder: Path) -> Path:
    """The leaderboard of one core."""
    suite = tiny_suite(folder / "suite")
    run_bench(suite, "cone_axis", folder / "run")
    return write_leaderboard(suite, read_entries(folder / "run", suite), folder / "table")


def preview_page(folder: Path) -> Path:
    """The preview of a small dataset."""
    write_dataset(test_dataset_contents.recipe(), folder / "two", make_engine())
    return write_preview(folder / "two", folder / "preview.html")


def dense_page(folder: Path) -> Path:
    """The page of scored maps."""
    (folder / "small.toml").write_text(test_dense_command.EXPERIMENT)
    simtest.validate(folder / "small.toml", folder / "run", export=folder / "frames")
    score_maps("shading", folder / "run", folder / "scored")
    return folder / "scored" / "index.html"


def light_page(folder: Path) -> Path:
    """The page of calibrated lights."""
    calibration = Calibration(test_light_calibration.CAMERA, Response("gamma", 2.2))
    ball = Ball(test_light_calibration.RADIUS, 0.01)
    return write_calibration(calibrate_lights(test_light_calibration.pictures(), calibration, ball), folder)[-1]


KINDS: Mapping[str, Callable[[Path], Path]] = {
    "run": lambda folder: write_report(make_run(folder / "run", items=3)),
    "nightly": nightly_page,
    "realism": lambda folder: write_comparison(compare(frames(5), frames(5, first=9)), folder, "plain"),
    "picture": picture_page,
    "view": view_page,
    "sequence": sequence_page,
    "advice": advice_page,
    "twin": twin_page,
    "bench": bench_page,
    "preview": preview_page,
    "dense": dense_page,
    "light": light_page,
}
