"""Answers made elsewhere: our own, scored again, give the rows of the run that made them."""

import json
import shutil

import numpy as np
import polars as pl
import pytest

import simtest
from simtest.dataset.scoring.score import score_table
from simtest.errors import InputError
from simtest.reconstruction.images import read_picture

LENS = """
realisations = 2
seed = 8
estimators = ["cone_axis", "bisector", "photometric", "circle_pose"]

[[groups]]
scene = "plane"
label = "lens"
sweep = [{ "surface.tilt_deg" = [0.5, 40.0, 88.0] }]

[groups.set]
"camera.width" = 160
"camera.height" = 160
"camera.fx" = 65.4
"camera.fy" = 65.4
"camera.view_mask.radius" = 80.0
"camera.distortion.type" = "kannala_brandt"
"surface.azimuth_deg" = 30.0
"sensor.noise_sigma" = 0.01
"rig.lights.0.offset_mm" = 1.0
"known.lights" = true
"""

SENSOR = """
realisations = 2
seed = 9
estimators = ["cone_axis", "curved"]

[[groups]]
scene = "sphere"
label = "8 bits"
set = { "sensor.bits" = 8, "sensor.saturation" = true, "sensor.response.type" = "srgb", "sensor.full_well" = 8000.0 }
sweep = [{ "sensor.exposure.gain" = [0.5, 2.0] }]

[[groups]]
scene = "sphere"
label = "noise-free"
set = { "sensor.noise_sigma" = 0.0 }
"""

TISSUE = """
realisations = 1
seed = 3
estimators = ["cone_axis", "brightest_point", "curved", "photometric", "circle_pose"]

[[groups]]
scene = "tissue_colon"
isolated = false
set = { "camera.width" = 240, "camera.height" = 200, "camera.fx" = 160.0, "camera.fy" = 160.0 }

[[groups]]
scene = "plane"
label = "relief"
sweep = [{ "surface.relief.bands.0.slope_deg" = [2.0, 6.0] }]

[groups.set]
"surface.tilt_deg" = 0.0
"surface.distance_mm" = 20.0
"surface.relief" = { bands = [{ slope_deg = 4.0, wavelength_mm = 2.0 }] }
"reflectance.exponent" = 400.0
"camera.width" = 200
"camera.height" = 200
"camera.fx" = 200.0
"camera.fy" = 200.0
"sensor.noise_sigma" = 0.005
"""

NOT_IN_A_TABLE = (
    "isovalue", "isovalues", "axis_ratio_seen_law", "error_law_deg", "error_look_law_deg",
    "gain_1", "gain_2", "gain_error", "gain_oracle_error",
    "direction_error_deg",
)  # fmt: skip
"""Columns of what a table does not state, beside the parts of the budget: isophotes and curvature."""

OF_CANDIDATES = ("error_oracle_deg", "n_candidates", "rank_correct")
"""Columns of estimators with two candidates, of which results.parquet holds the proposed one alone."""

ANSWER = (
    "frame", "estimator", "specularity", "x_px", "y_px", "normal_x", "normal_y", "normal_z", "cov_11", "cov_12",
    "cov_22", "target", "axis_ratio", "choice_margin", "flags", "status",
)  # fmt: skip

pytestmark = pytest.mark.filterwarnings("ignore:.*no row:UserWarning")


def run_of(base, name, text):
    """Run and export an experiment; return the folder of the run."""
    file = base / f"{name}.toml"
    file.write_text(text)
    small = {"camera.width": 96, "camera.height": 80, "camera.fx": 96.0, "camera.fy": 96.0} if name == "sensor" else {}
    simtest.validate(file, base / name, settings=small, export=base / f"{name}_frames")
    return base / name


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("score")


@pytest.fixture(scope="module")
def lens(base):
    return run_of(base, "lens", LENS)


@pytest.fixture(scope="module")
def sensor(base):
    return run_of(base, "sensor", SENSOR)


def own_answers(run):
    """Return a run's own estimates as a table of answers, as docs/howto/scoring.md does."""
    uses = pl.DataFrame(json.loads((run / "export.json").read_text())["uses"])
    rows = pl.read_parquet(run / "results.parquet").filter(pl.col("specularity").is_not_null())
    named = rows.join(uses.select("frame", "setting", "realisation"), on=["setting", "realisation"])
    own = named.rename({"look_x_px": "x_px", "look_y_px": "y_px"}).select(ANSWER)
    return own.unique(["frame", "estimator", "specularity"], maintain_order=True)


def assert_equal(run, scored):
    """Compare all columns of two runs that a table can state, bit by bit."""
    ours, again = (pl.read_parquet(folder / "results.parquet") for folder in (run, scored))
    assert ours.columns == again.columns
    assert ours.shape == again.shape
    for name in ours.columns:
        if name in NOT_IN_A_TABLE or name.startswith("budget_"):
            continue
        single = (
            (ours["n_candidates"].fill_null(1) == 1)
            if name in OF_CANDIDATES
            else pl.repeat(True, len(ours), eager=True)
        )
        assert ours[name].filter(single).equals(again[name].filter(single), null_equal=True), name


@pytest.mark.parametrize("kind", [pytest.param("csv", marks=pytest.mark.ci), "parquet"])
def test_own_estimates_with_a_lens(lens, base, kind):
    table = base / f"lens.{kind}"
    own = own_answers(lens)
    own.write_csv(table) if kind == "csv" else own.write_parquet(table)
    scored = score_table(table, lens, base / f"lens_{kind}")
    assert_equal(lens, scored.folder)
    statuses = scored.results["status"].value_counts()
    assert dict(statuses.rows())["ok"] >= 16


def test_own_estimates_through_a_sensor(sensor, base):
    own_answers(sensor).write_csv(base / "sensor.csv")
    assert_equal(sensor, score_table(base / "sensor.csv", sensor, base / "sensor_scored").folder)


@pytest.mark.slow
def test_own_estimates_of_coloured_tissue_and_reliefs(base):
    run = run_of(base, "tissue", TISSUE)
    own = own_answers(run)
    own.write_csv(base / "tissue.csv")
    assert_equal(run, score_table(base / "tissue.csv", run, base / "tissue_scored").folder)
    results = pl.read_parquet(run / "results.parquet")
    # Colour, many highlights, refusals for several reasons, and missed highlights.
    assert {"ok", "missed", "unresolved", "no_closed_isophote"} <= set(results["status"])
    assert results.filter(pl.col("status") == "missed").height > 100


def test_summary_and_page_are_those_of_the_run(sensor, base):
    from simtest.report import write_report

    own_answers(sensor).write_csv(base / "page.csv")
    scored = score_table(base / "page.csv", sensor, base / "page_scored").folder
    ours, again = (json.loads((folder / "summary.json").read_text())["experiments"] for folder in (sensor, scored))
    assert ours["sensor"]["settings"] == again["sensor"]["settings"]
    assert again["sensor"]["estimators"] == dict.fromkeys(
        ("cone_axis", "curved"), "Answers of page.csv, made elsewhere."
    )
    assert write_report(scored).name == "index.html"
    ours, again = (json.loads((folder / "guide.json").read_text()) for folder in (sensor, scored))
    # The table and the method's description differ, nothing else.
    for method in (*ours["methods"], *again["methods"]):
        del method["about"]
    assert ours == again
    assert sorted(path.name for path in (sensor / "gallery").iterdir()) == sorted(
        path.name for path in (scored / "gallery").iterdir()
    )


def as_a_stranger(frames, estimators):
    """Estimate from the exported folder alone; return a table with both candidates."""
    listed = pl.read_csv(frames / "frames.csv")
    rows = []
    for name, file, camera in listed.select("frame", "file", "camera").iter_rows():
        image = np.load(frames / file) if file.endswith(".npy") else read_picture(frames / file)
        known = simtest.load_calibration(frames / camera)
        for number, found in enumerate(simtest.reconstruct(image, known, estimators)):
            for estimator, result in found.estimates.items():
                row = {"frame": name, "estimator": estimator, "specularity": number}
                if isinstance(result, simtest.Failure):
                    rows.append({**row, "status": str(result.reason), "reason": result.detail})
                    continue
                row |= dict(zip(("x_px", "y_px"), result.look_px.tolist(), strict=True))
                row |= dict(zip(("normal_x", "normal_y", "normal_z"), result.normal.tolist(), strict=True))
                if len(result.candidates) > 1:
                    second = result.candidates[1].tolist()
                    row |= dict(zip(("second_x", "second_y", "second_z"), second, strict=True))
                if result.covariance is not None:
                    (a, b), (_, c) = result.covariance.tolist()
                    row |= {"cov_11": a, "cov_12": b, "cov_22": c}
                flags = ",".join(result.flags)
                rows.append(
                    {**row, "choice_margin": result.choice_margin, "axis_ratio": result.axis_ratio, "flags": flags}
                )
    return pl.DataFrame(rows, infer_schema_length=None)


def test_a_stranger_reaches_the_same_rows(lens, base):
    names = ["cone_axis", "bisector", "photometric", "circle_pose"]
    as_a_stranger(base / "lens_frames", names).write_csv(base / "stranger.csv")
    scored = score_table(base / "stranger.csv", lens, base / "stranger").folder
    assert_equal(lens, scored)
    ours, again = (pl.read_parquet(folder / "results.parquet") for folder in (lens, scored))
    assert ours["n_candidates"].max() == 2
    for name in ("error_oracle_deg", "n_candidates", "rank_correct"):
        assert ours[name].equals(again[name], null_equal=True)


def test_pixels_decide_where_no_detection_is_named(lens, base):
    own = own_answers(lens).filter(estimator="cone_axis").drop("specularity", "estimator")
    own.write_csv(base / "by_pixel.csv")
    scored = score_table(base / "by_pixel.csv", lens, base / "by_pixel", name="mine").results
    ours = pl.read_parquet(lens / "results.parquet").filter(estimator="cone_axis")
    assert scored["estimator"].unique().to_list() == ["mine"]
    assert scored["error_deg"].equals(ours["error_deg"], null_equal=True)
    assert scored["status"].equals(ours["status"])


def test_a_frame_without_answers_counts_as_missed(lens, base):
    own = own_answers(lens).filter(estimator="cone_axis").drop("estimator")
    left = own["frame"][0]
    own.filter(pl.col("frame") != left).write_csv(base / "fewer.csv")
    with pytest.warns(UserWarning, match="of 6 frames have no row; their highlights count as missed"):
        scored = score_table(base / "fewer.csv", lens, base / "fewer").results
    ours = pl.read_parquet(lens / "results.parquet").filter(estimator="cone_axis")
    assert scored.filter(status="ok").height == ours.filter(status="ok").height - own.filter(frame=left).height
    assert scored.filter(status="missed").height == ours.filter(status="missed").height + 1
    # Nobody is charged with false detections that are not his.
    assert scored["true_id"].null_count() == 0


def test_a_refusal_is_counted_under_its_reason(sensor, base):
    own = own_answers(sensor).filter(estimator="cone_axis").drop("estimator")
    told = own.with_columns(
        status=pl.Series(["streak", "too dark for me", *["ok"] * (len(own) - 2)]),
        reason=pl.Series(["", "mean 3 counts", *[""] * (len(own) - 2)]),
        normal_x=pl.Series([None, None, *own["normal_x"][2:]]),
    )
    told.write_csv(base / "refusals.csv")
    scored = score_table(base / "refusals.csv", sensor, base / "refusals").results
    assert sorted(set(scored["status"])) == ["no_estimate", "ok", "streak"]
    assert scored.filter(status="no_estimate")["flags"][0] == "too dark for me: mean 3 counts"


# Runs that cannot be scored on --------------------------------------------------------------------------------------


def edited(sensor, tmp_path, **changes):
    """Copy a run, with other values in its export.json."""
    run = tmp_path / "run"
    shutil.copytree(sensor, run)
    record = json.loads((run / "export.json").read_text())
    record.update(changes)
    (run / "export.json").write_text(json.dumps(record))
    return run


@pytest.fixture
def table(sensor, tmp_path):
    own_answers(sensor).write_csv(tmp_path / "own.csv")
    return tmp_path / "own.csv"


CHANGED = {
    "version": ("0.1.0", r"run: made by simtest 0.1.0, this is .*; score with that version, or run and"),
    "fingerprint": ("0" * 64, "the run was made anew since its frames were exported; export again"),
    "definition": ("0" * 64, "scenes or meshes have changed since its frames were exported; export again"),
}


@pytest.mark.parametrize("key", CHANGED)
def test_a_run_that_is_not_the_exported_one_is_refused(sensor, tmp_path, table, key):
    value, message = CHANGED[key]
    run = edited(sensor, tmp_path, **{key: value})
    with pytest.raises(InputError, match=message):
        score_table(table, run, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_frames_that_come_out_otherwise_are_refused(sensor, tmp_path, table):
    frames = json.loads((sensor / "export.json").read_text())["frames"]
    name = sorted(frames)[0]
    frames[name]["sha256"] = "0" * 64
    run = edited(sensor, tmp_path, frames=frames)
    with pytest.raises(InputError, match=f"frame {name} comes out otherwise than it was exported; score where it was"):
        score_table(table, run, tmp_path / "out")


def test_a_run_without_an_export_is_refused(sensor, tmp_path, table):
    with pytest.raises(InputError, match=r"export.json: .*nothing was exported: give the command again with --export"):
        score_table(table, tmp_path, tmp_path / "out")
    with pytest.raises(InputError, match=r"missing: no such folder; must be the folder of the run or dataset whose"):
        score_table(table, tmp_path / "missing", tmp_path / "out")
    with pytest.raises(InputError, match=r"\.csv: is a file; must be the folder of the run or dataset whose frames"):
        score_table(table, table, tmp_path / "out")
    (tmp_path / "frames" / "cameras").mkdir(parents=True)
    (tmp_path / "frames" / "frames.csv").write_text("")
    with pytest.raises(
        InputError, match=r"frames: holds the exported frames \(frames.csv\); must be the folder of the"
    ):
        score_table(table, tmp_path / "frames", tmp_path / "out")
    (tmp_path / "export.json").write_text('{"format": "mine"}')
    with pytest.raises(InputError, match=r"export.json: no record of an export"):
        score_table(table, tmp_path, tmp_path / "out")


def test_the_run_itself_is_not_replaced(sensor, table):
    for out in (sensor, sensor / "scored", sensor.parent):
        with pytest.raises(InputError, match="must be neither the run that is scored on nor inside or around it"):
            score_table(table, sensor, out)


def test_another_exported_run_is_not_replaced(sensor, table, tmp_path):
    shutil.copytree(sensor, tmp_path / "other")
    with pytest.raises(InputError, match="holds a run whose frames were exported; must be another folder"):
        score_table(table, sensor, tmp_path / "other")
    assert (tmp_path / "other" / "export.json").exists()


@pytest.mark.slow
def test_the_rows_do_not_depend_on_the_workers(sensor, base, table):
    from simtest.runtime.processes import make_engine

    one = score_table(table, sensor, base / "one").results
    two = score_table(table, sensor, base / "two", engine=make_engine(workers=2)).results
    assert one.equals(two, null_equal=True)


def test_the_command_prints_what_a_run_prints(sensor, here, table):
    code, output, errors = here("score", table, "--on", sensor, "--out", "scored")
    assert code == 0, errors
    assert output.splitlines()[-1] == "scored/index.html"
    code, output, errors = here("score", table, "--on", sensor / "gallery")
    assert code != 0
    assert "nothing was exported" in errors[-1]


def test_a_finished_run_still_counts_as_one(sensor, base):
    """A run's folder with an export is still taken for the run's folder."""
    from simtest.spec import load_experiment
    from simtest.validation.runner import run_experiment

    small = {"camera.width": 96, "camera.height": 80, "camera.fx": 96.0, "camera.fy": 96.0}
    again = run_experiment(load_experiment(base / "sensor.toml", small), sensor)
    assert again.resumed == 3
