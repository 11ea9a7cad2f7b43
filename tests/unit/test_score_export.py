"""Frames without their truth: exact, complete, the same whatever the workers, and nothing in them tells the truth."""

import csv
import json
import re
import struct
import zlib

import numpy as np
import polars as pl
import pytest

import simtest
from simtest.dataset.export import export_run
from simtest.dataset.scoring.frames import image_hash, scored_frames
from simtest.errors import InputError
from simtest.reconstruction.images import read_picture
from simtest.runtime.processes import make_engine
from simtest.spec import load_experiment

SMALL = '"camera.width" = 96, "camera.height" = 80, "camera.fx" = 90.0, "camera.fy" = 90.0'
EXPERIMENT = f"""
realisations = 2
seed = 987654321
estimators = ["cone_axis", "circle_pose"]

[[groups]]
scene = "cylinder"
label = "steep tube"
set = {{ {SMALL}, "surface.radius_mm" = 7.3219, "sensor.noise_sigma" = 0.004 }}
random = {{ "surface.tilt_deg" = {{ low = 3.0, high = 9.0 }}, "surface.spin_deg" = {{ low = 0.0, high = 180.0 }} }}

[[groups]]
scene = "sphere"
label = "eight bits"
set = {{ {SMALL}, "surface.radius_mm" = 11.731, "sensor.bits" = 8, "sensor.saturation" = true, "sensor.response" = {{ type = "srgb" }}, "sensor.full_well" = 8000.0 }}
random = {{ "surface.tilt_deg" = {{ low = 3.0, high = 9.0 }} }}

[[groups]]
scene = "sphere"
label = "no noise"
set = {{ {SMALL}, "surface.radius_mm" = 11.731, "surface.tilt_deg" = 5.4321, "sensor.noise_sigma" = 0.0 }}
"""  # noqa: E501

NAMES = (
    "trial_of_mine",
    "steep tube",
    "eight bits",
    "no noise",
    "cylinder",
    "sphere",
    "987654321",
    "world_from",
    "from_camera",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run and its export: folder of the run, folder of the frames."""
    base = tmp_path_factory.mktemp("export")
    file = base / "trial_of_mine.toml"
    file.write_text(EXPERIMENT)
    simtest.validate(file, base / "run", export=base / "frames")
    return base / "run", base / "frames"


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def values(folder, row):
    """Return a frame as a stranger reads it."""
    path = folder / row["file"]
    return np.load(path) if path.suffix == ".npy" else read_picture(path)


def test_every_frame_has_its_files(made):
    _, frames = made
    listed = rows(frames / "frames.csv")
    # Two realisations without noise look the same: one frame stands for both.
    assert len(listed) == 5
    for row in listed:
        assert values(frames, row).shape == (int(row["height"]), int(row["width"]))
        assert read_picture(frames / row["preview"]).shape == (80, 96, 3)
        assert simtest.load_calibration(frames / row["camera"]).camera.width == 96
    assert {row["file"].rpartition(".")[2] for row in listed} == {"npy", "png"}
    assert {path.name for path in frames.iterdir()} == {
        "README.md", "cameras", "frames", "frames.csv", "highlights.csv", "previews",
    }  # fmt: skip


def test_frames_hold_what_the_estimators_saw(made):
    run, frames = made
    listed = {row["frame"]: row for row in rows(frames / "frames.csv")}
    scored = list(scored_frames(run))
    assert len(scored) == 6
    for frame in scored:
        seen = values(frames, listed[frame.name])
        assert image_hash(seen) == image_hash(frame.view.frame(frame.seed))
        assert seen.dtype == np.float32
        assert (frame.image == seen).all()


def test_calibrations_read_back_as_they_were_told(made):
    run, frames = made
    listed = {row["frame"]: row for row in rows(frames / "frames.csv")}
    for frame in scored_frames(run):
        told, read = frame.view.calibration, simtest.load_calibration(frames / listed[frame.name]["camera"])
        assert read.camera == told.camera
        assert read.priors == told.priors
        assert (read.response, read.saturation_level) == (told.response, told.saturation_level)


def test_highlights_are_the_detections_of_the_run(made):
    run, frames = made
    uses = pl.DataFrame(json.loads((run / "export.json").read_text())["uses"])
    results = pl.read_parquet(run / "results.parquet").filter(estimator="cone_axis").join(
        uses.select("frame", "setting", "realisation"), on=["setting", "realisation"]
    )  # fmt: skip
    found = {(row["frame"], int(row["specularity"])): row for row in rows(frames / "highlights.csv")}
    assert found
    for row in results.filter(pl.col("specularity").is_not_null()).to_dicts():
        peak = found[row["frame"], row["specularity"]]
        assert (float(peak["peak_x_px"]), float(peak["peak_y_px"])) == (row["bp_x_px"], row["bp_y_px"])


def told_values(run):
    """Return what nobody may tell, as numbers: true normals, points, curvatures, distances, radii, seeds."""
    results = pl.read_parquet(run / "results.parquet")
    columns = ["truth_x", "truth_y", "truth_z", "bp_true_x_px", "bp_true_y_px", "kd_min", "kd_max", "distance_mm",
               "surface.tilt_deg", "surface.spin_deg"]  # fmt: skip
    numbers = {v for name in columns for v in results[name].drop_nulls().to_list()}
    # Round numbers are everywhere.
    numbers = {v for v in numbers if len(f"{abs(v):.8g}".strip("0.").replace(".", "")) >= 6}
    assert len(numbers) > 20
    return numbers | {7.3219, 11.731, 5.4321}, set(results["seed"].to_list())


def contents(folder):
    """Yield the name and content of each file; of pictures the pixels too."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            data = path.read_bytes()
            yield path.relative_to(folder).as_posix(), data
            if path.suffix == ".png":
                chunks = list(png_chunks(data))
                # Neither text nor time.
                assert [kind for kind, _ in chunks if kind != b"IDAT"] == [b"IHDR", b"IEND"]
                yield path.name, zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT"))


def png_chunks(data):
    at = 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += 12 + length


def test_nothing_tells_the_truth(made):
    run, frames = made
    numbers, seeds = told_values(run)
    patterns = [word.encode() for word in NAMES] + [str(seed).encode() for seed in seeds]
    patterns += [struct.pack(order + "q", seed) for seed in seeds for order in "<>"]
    for value in numbers:
        patterns += [struct.pack(order + kind, value) for kind in "df" for order in "<>"]
        patterns += [f"{abs(value):.{digits}g}".encode() for digits in (6, 8, 17)]
    for name, data in contents(frames):
        for pattern in patterns:
            assert pattern not in data, (name, pattern)
            assert pattern.decode("latin-1") not in name


def test_the_search_finds_what_is_there(made, tmp_path):
    run, _ = made
    numbers, _ = told_values(run)
    value = max(numbers)
    (tmp_path / "leak.npy").write_bytes(b"1234" + struct.pack("<f", value))
    assert any(struct.pack("<f", value) in data for _, data in contents(tmp_path))


def test_names_tell_nothing_but_the_content(made):
    run, frames = made
    record = json.loads((run / "export.json").read_text())
    assert all(re.fullmatch("f[0-9a-f]{16}", name) for name in record["frames"])
    # In the order of the names, not of the settings.
    assert [row["frame"] for row in rows(frames / "frames.csv")] == sorted(record["frames"])


class Stopping:
    """Stops after some tasks, as a kill does."""

    def __init__(self, most):
        self.most, self.done = most, 0

    def run(self, task, arguments, on_step):
        for number, argument in enumerate(arguments):
            if self.done == self.most:
                raise KeyboardInterrupt
            self.done += 1
            yield number, task(argument, on_step)


def test_the_times_of_files_tell_no_order(made):
    assert len({path.stat().st_mtime_ns for path in made[1].rglob("*") if path.is_file()}) == 1


def test_a_stopped_export_goes_on(made, tmp_path):
    run, frames = made
    record = (run / "export.json").read_bytes()
    experiment = load_experiment(run.parent / "trial_of_mine.toml")
    out = tmp_path / "frames"
    with pytest.raises(KeyboardInterrupt):
        export_run(run, experiment, out, Stopping(2))
    assert not (out / "frames.csv").exists()
    engine = Stopping(10)
    steps = []
    export_run(run, experiment, out, engine, lambda *step: steps.append(step))
    assert engine.done == 1
    assert steps == [(5, 6, "exporting frames"), (6, 6, "exporting frames")]
    assert dict(contents(out)) == dict(contents(frames))
    assert (run / "export.json").read_bytes() == record
    assert not (run / "exporting").exists()


@pytest.mark.slow
def test_the_same_bytes_whatever_the_workers(made, tmp_path):
    run, frames = made
    experiment = load_experiment(run.parent / "trial_of_mine.toml")
    export_run(run, experiment, tmp_path / "frames", make_engine(workers=2))
    assert dict(contents(tmp_path / "frames")) == dict(contents(frames))


def test_frames_of_an_earlier_export_go(made, tmp_path):
    run, frames = made
    experiment = load_experiment(run.parent / "trial_of_mine.toml")
    out = tmp_path / "frames"
    export_run(run, experiment, out, make_engine())
    (out / "frames" / "f0000000000000000.npy").write_bytes(b"old")
    export_run(run, experiment, out, make_engine())
    assert dict(contents(out)) == dict(contents(frames))


def test_a_folder_of_something_else_is_refused(made, tmp_path):
    run, _ = made
    experiment = load_experiment(run.parent / "trial_of_mine.toml")
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match=r"--export .*: holds frames, which is no part of an export"):
        export_run(run, experiment, tmp_path, make_engine())
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"holds notes.txt, which is no part of an export; must be empty"):
        export_run(run, experiment, tmp_path, make_engine())
    assert (tmp_path / "frames" / "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("out", ["run", "run/frames", "."])
def test_an_export_lies_apart_from_its_run(made, tmp_path, out):
    # Before anything is rendered: a run that holds frames could not go on, nor be replaced.
    with pytest.raises(InputError, match=r"--export .*: must be neither .*run nor inside or around it"):
        simtest.validate(made[0].parent / "trial_of_mine.toml", tmp_path / "run", export=tmp_path / out)
    assert list(tmp_path.glob("run/*")) == []
    with pytest.raises(InputError, match="must be neither"):
        export_run(made[0], load_experiment(made[0].parent / "trial_of_mine.toml"), made[0] / "frames", make_engine())


def test_a_folder_for_the_export_is_checked_before_the_run(made, tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"--export .*: holds notes.txt, which is no part of an export"):
        simtest.validate(made[0].parent / "trial_of_mine.toml", tmp_path / "run", export=tmp_path / "frames")
    assert list(tmp_path.glob("run/*")) == []


def test_the_published_protocol_renders_nothing_to_export(tmp_path):
    with pytest.raises(InputError, match="paper: follows the published protocol, which renders no frames"):
        simtest.validate("paper", tmp_path / "run", realisations=1, export=tmp_path / "frames")
    assert not (tmp_path / "run").exists()


def test_the_readme_names_every_column(made):
    _, frames = made
    text = (frames / "README.md").read_text()
    for name in ("frames.csv", "highlights.csv"):
        with (frames / name).open() as file:
            for column in file.readline().strip().split(","):
                assert column in text or column.startswith("box"), column
    from simtest.dataset.scoring.answers import COLUMNS

    assert all(f"`{column}`" in text for column in COLUMNS if column != "cov_21")
