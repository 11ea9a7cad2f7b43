"""Tables of answers: every row is checked, and mistakes of a whole table are told."""

import json

import numpy as np
import polars as pl
import pytest

from simtest.dataset.scoring.answers import Answer, read_answers, reversed_axes, stray_rows, wide_regions
from simtest.dataset.scoring.frames import ExportedFrame, Record, read_record
from simtest.dataset.scoring.score import score_table
from simtest.errors import Failure, InputError, Reason
from simtest.geometry import Camera
from simtest.spec import camera_table

pytestmark = pytest.mark.filterwarnings("ignore:.*no row:UserWarning")
FRAME = "f0123456789abcdef"
GOOD = {"frame": FRAME, "x_px": "50", "y_px": "40", "normal_x": "0", "normal_y": "0.6", "normal_z": "-0.8"}


@pytest.fixture
def record():
    """The record of an export with two frames of known names, and a camera in front."""
    camera = camera_table(Camera(96, 80, 96.0, 96.0, 48.0, 40.0))
    frame = ExportedFrame(sha256="", camera="c.toml", peaks=((47.5, 39.5),), boxes=((33, 25, 29, 29),))
    return Record(
        kind="run", version="", fingerprint="", definition="", variant="", experiment={}, uses=(),
        cameras={"c.toml": json.loads(json.dumps(camera))}, frames={FRAME: frame, "f" + "1" * 16: frame},
    )  # fmt: skip


def write(path, *rows):
    """Write rows as CSV; the first names the columns."""
    columns = list(rows[0])
    path.write_text("\n".join([",".join(columns), *(",".join(row.get(c, "") for c in columns) for row in rows)]) + "\n")
    return path


WRONG_ROWS = {
    "not a number": ({"normal_x": "left"}, "row 1: normal_x = left: must be a finite number or empty"),
    "NaN": ({"normal_x": "NaN"}, "row 1: normal_x = NaN: must be a finite number or empty"),
    "capitals": ({"status": "OK"}, "row 1: status = OK: must be ok or empty where a normal is given"),
    "left of the frame": (
        {"x_px": "-500"},
        r"row 1: look_px: looks at the pixel \(-500, 40\); must lie in the frame of 96 x 80 px",
    ),
    "elsewhere": (
        {"specularity": "0", "x_px": "95", "y_px": "1"},
        "row 1: x_px = 95, y_px = 1: must lie at detection 0, whose box is 29 x 29 px at .33, 25. .highlights.csv",
    ),
    "negative ratio": ({"axis_ratio": "-7"}, "row 1: axis_ratio: -7; must be in .0, 1."),
    "no variance": (
        {"cov_11": "0", "cov_12": "0", "cov_22": "0"},
        "row 1: covariance: singular; must have a variance",
    ),
    "no normal": ({"normal_y": ""}, "row 1: normal_y is empty; must be a number, or status must name why"),
    "no pixel": ({"x_px": ""}, "row 1: x_px or y_px is empty; both must be given, or none and specularity"),
    "unknown frame": ({"frame": "f1"}, "row 1: frame = f1: must be among the 2 names of frames.csv"),
    "long": ({"normal_z": "-0.9"}, "row 1: normal of length 1.08167: must be a unit vector"),
    "away": ({"normal_z": "0.8"}, r"row 1: the normal faces away from the camera: \(0 0.6 0.8\); z points forward"),
    "target": ({"target": "rough"}, "row 1: target = rough: must be fine, base or empty"),
    "number": ({"specularity": "1"}, "row 1: specularity = 1: must be a whole number from 0 to 0"),
    "half a number": ({"specularity": "0.5"}, "row 1: specularity = 0.5: must be a whole number"),
    "half a covariance": (
        {"cov_11": "1e-4", "cov_12": "0", "cov_22": ""},
        "row 1: cov_11, cov_12, cov_22: some are empty; all three must be given, or none",
    ),
    "degrees": (
        {"cov_11": "25", "cov_12": "0", "cov_22": "25"},
        r"row 1: covariance: holds 25; must be at most 9.87 rad\^2 \(deg\^2 times",
    ),
    "too large a covariance": (
        {"cov_11": "1e-4", "cov_12": "2e-4", "cov_22": "1e-4"},
        r"row 1: covariance \[\[0.0001, 0.0002\], .*\]\]: must be symmetric and have no negative eigenvalue",
    ),
    "asymmetric": (
        {"cov_11": "1e-4", "cov_12": "1e-5", "cov_22": "1e-4", "cov_21": "-1e-5"},
        r"row 1: covariance \[\[0.0001, 1e-05\], \[-1e-05, 0.0001\]\]: must be symmetric",
    ),
    "second": (
        {"second_x": "0", "second_y": "0", "second_z": "-2"},
        "row 1: candidate of length 2: must be a unit vector",
    ),
}


@pytest.mark.parametrize("wrong", WRONG_ROWS)
def test_a_wrong_row_is_named(record, tmp_path, wrong):
    change, message = WRONG_ROWS[wrong]
    table = write(tmp_path / "t.csv", {**GOOD, **change})
    with pytest.raises(InputError, match=message) as error:
        read_answers(table, record, "mine")
    assert str(table) in str(error.value)
    assert "\n" not in str(error.value)


def test_the_row_is_the_one_that_is_wrong(record, tmp_path):
    other = {**GOOD, "frame": "f" + "1" * 16, "normal_z": "-0.9"}
    with pytest.raises(InputError, match="row 2: normal of length"):
        read_answers(write(tmp_path / "t.csv", GOOD, other), record, "mine")


@pytest.mark.parametrize("change", [{}, {"x_px": "50.0"}])
def test_a_highlight_is_answered_once(record, tmp_path, change):
    with pytest.raises(InputError, match=f"row 2: frame {FRAME}: answers the same highlight as row 1; must be one row"):
        read_answers(write(tmp_path / "t.csv", GOOD, {**GOOD, **change}), record, "mine")


@pytest.mark.parametrize("missing", ["frame", "normal_y", "x_px"])
def test_a_missing_column_is_named(record, tmp_path, missing):
    row = {key: value for key, value in GOOD.items() if key != missing}
    with pytest.raises(InputError, match=f"column {missing} is missing; must have frame, x_px and y_px or specularity"):
        read_answers(write(tmp_path / "t.csv", row), record, "mine")


def test_a_column_that_is_given_twice_is_refused(record, tmp_path):
    file = tmp_path / "t.csv"
    file.write_text(",".join([*GOOD, "normal_x"]) + "\n" + ",".join([*GOOD.values(), "0"]) + "\n")
    with pytest.raises(InputError, match="column normal_x is given twice; must be one column"):
        read_answers(file, record, "mine")


def test_a_record_that_lacks_a_camera_is_none(record, tmp_path):
    (tmp_path / "export.json").write_text(json.dumps({**record.model_dump(mode="json"), "cameras": {}}))
    with pytest.raises(InputError, match=r"no record of an export \(whole: Value error, has no camera c.toml\)"):
        read_record(tmp_path)


def test_a_header_with_blanks_is_read_and_one_with_semicolons_is_shown(record, tmp_path):
    file = tmp_path / "t.csv"
    file.write_text(", ".join(GOOD) + "\n" + ", ".join(GOOD.values()) + "\n")
    assert set(read_answers(file, record, "mine")["mine"]) == {FRAME}
    file.write_text(file.read_text().replace(", ", ";"))
    with pytest.raises(InputError, match=r"column frame is missing; .*; has frame;x_px;y_px;normal_x;normal_y"):
        read_answers(file, record, "mine")


def test_unknown_columns_are_told(record, tmp_path):
    with pytest.warns(UserWarning, match=r"columns that are not read: normal_xx \(is normal_x meant\?\)"):
        read_answers(write(tmp_path / "t.csv", {**GOOD, "normal_xx": "1"}), record, "mine")


NO_TABLE = {
    "empty.csv": (b"", "no CSV table"),
    "binary.csv": (b"\x00\xff\xfe\n\x80", "is missing|no CSV table"),
    "utf16.csv": (",".join(GOOD).encode("utf-16"), "is UTF-16; must be a CSV table in UTF-8"),
    "broken.parquet": (b"PAR1 and no more", r"broken.parquet: no Parquet table"),
    "missing.csv": (None, "; must be a CSV or Parquet table"),
    "missed.csv": (
        (",".join([*GOOD, "status"]) + "\n" + ",".join([*GOOD.values(), "missed"])).encode(),
        "holds no answer; must have a row for each normal",
    ),
}


@pytest.mark.parametrize("name", NO_TABLE)
def test_what_is_no_table_is_refused(record, tmp_path, name):
    content, what = NO_TABLE[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=what) as error:
        read_answers(tmp_path / name, record, "mine")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("column", "values"),
    [("normal_x", [[0.0]]), ("frame", [[FRAME]]), ("normal_x", [b"0"])],
)
def test_columns_of_another_type_are_refused(record, tmp_path, column, values):
    columns = {key: [value if key == "frame" else float(value)] for key, value in GOOD.items()}
    pl.DataFrame({**columns, column: values}).write_parquet(tmp_path / "t.parquet")
    with pytest.raises(InputError, match=f"column {column} is .*; must hold (numbers|text)|row 1: {column}") as error:
        read_answers(tmp_path / "t.parquet", record, "mine")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", [" ", "..", "a/b", "x" * 81, "two\nlines"])
def test_a_name_that_cannot_stand_in_results_is_refused(tmp_path, name):
    with pytest.raises(InputError, match=r"--name = .*: must be 1 to 80 printable characters without /"):
        score_table(tmp_path / "t.csv", tmp_path, tmp_path / "out", name)


def test_an_estimator_of_a_row_is_checked_too(record, tmp_path):
    with pytest.raises(InputError, match="row 1: estimator = a/b: must be 1 to 80 printable characters"):
        read_answers(write(tmp_path / "t.csv", {**GOOD, "estimator": "a/b"}), record, "mine")


def test_a_method_that_missed_all_highlights_is_scored_beside_others(record, tmp_path):
    rows = ({**GOOD, "estimator": "a", "status": ""}, {**GOOD, "estimator": "b", "status": "missed"})
    answers = read_answers(write(tmp_path / "t.csv", *rows), record, "mine")
    assert {name: sum(map(len, frames.values())) for name, frames in answers.items()} == {"a": 1, "b": 0}


def test_rounded_normals_are_scaled_and_exact_ones_stay(record, tmp_path):
    rounded = write(tmp_path / "r.csv", {**GOOD, "normal_y": "0.5999", "normal_z": "-0.8001"})
    answer = read_answers(rounded, record, "mine")["mine"][FRAME][0]
    assert np.linalg.norm(answer.result.normal) == pytest.approx(1, abs=1e-15)
    exact = read_answers(write(tmp_path / "e.csv", GOOD), record, "mine")["mine"][FRAME][0].result.normal
    assert exact.tolist() == [0.0, 0.6, -0.8]


def test_a_detection_lends_its_pixel(record, tmp_path):
    row = {**GOOD, "x_px": "", "y_px": "", "specularity": "0"}
    answer = read_answers(write(tmp_path / "t.csv", row), record, "mine")["mine"][FRAME][0]
    assert tuple(answer.point_px) == record.frames[FRAME].peaks[0]


def test_a_reason_that_we_know_is_kept(record, tmp_path):
    row = {**GOOD, "normal_x": "", "normal_y": "", "normal_z": "", "status": "not_converged", "reason": "20 steps"}
    result = read_answers(write(tmp_path / "t.csv", row), record, "mine")["mine"][FRAME][0].result
    assert (result.reason, result.detail) == (Reason.NOT_CONVERGED, "20 steps")


BOXES = ((100, 40, 20, 20), (10, 60, 30, 25))
NOTHING = Failure(Reason.NO_ESTIMATE, "")


def two_regions():
    frame = ExportedFrame(sha256="", camera="c.toml", peaks=((110, 50), (25, 70)), boxes=BOXES)
    return Record(
        kind="run", version="", fingerprint="", definition="", variant="", experiment={}, uses=(),
        cameras={"c.toml": {}}, frames={"f": frame},
    )  # fmt: skip


def answers(points):
    return {"mine": {"f": [Answer(NOTHING, np.array(point, dtype=float)) for point in points]}}


def results(error_deg, signs=(1, 1, 1), count=40, seed=0):
    """Rows of normals that are off by a Gaussian error, with some axes reversed."""
    rng = np.random.default_rng(seed)
    truths = rng.normal([0, 0, -3], 1.0, (count, 3))
    truths /= np.linalg.norm(truths, axis=1)[:, None]
    normals = truths + rng.normal(0, np.radians(error_deg), truths.shape)
    normals = normals / np.linalg.norm(normals, axis=1)[:, None] * signs
    axes = ("x", "y", "z")
    values = {f"normal_{axis}": normals[:, i] for i, axis in enumerate(axes)}
    values |= {f"truth_{axis}": truths[:, i] for i, axis in enumerate(axes)}
    return pl.DataFrame({"estimator": ["mine"] * count, "status": ["ok"] * count, **values})


def test_pixels_in_another_frame_are_told():
    around = np.array([[110.0, 50.0], [105.0, 45.0], [20.0, 65.0], [30.0, 80.0], [118.0, 58.0], [25.0, 70.0]])
    assert stray_rows(answers(around), two_regions()) is None
    of_regions = around - np.array([[100, 40], [100, 40], [10, 60], [10, 60], [100, 40], [10, 60]])
    assert "6 of 6 rows lie in no detection's region" in stray_rows(answers(of_regions), two_regions())
    swapped = stray_rows(answers(around[:, ::-1]), two_regions())
    assert "6 of 6" in swapped
    assert "\n" not in swapped


def test_a_few_rows_elsewhere_are_no_mistake():
    inside = [[110.0, 50.0]] * 20
    assert stray_rows(answers(inside + [[1.0, 1.0]] * 8), two_regions()) is None
    assert stray_rows(answers([[1.0, 1.0]] * 4), two_regions()) is None


@pytest.mark.parametrize(("signs", "axis"), [((1, -1, 1), "y"), ((-1, 1, 1), "x"), ((-1, -1, 1), "x and y")])
def test_reversed_axes_are_told(signs, axis):
    (said,) = reversed_axes(results(0.5, signs))
    assert said.startswith(f"mine: with {axis} of the normals reversed the median error is 0.")


@pytest.mark.parametrize("error_deg", [0.01, 1.0, 10.0, 60.0])
def test_errors_alone_are_no_reversal(error_deg):
    for seed in range(8):
        assert reversed_axes(results(error_deg, seed=seed)) == []
        assert reversed_axes(results(error_deg, signs=(1, -1, 1), count=4, seed=seed)) == []


def stated(error_deg, sd_rad, count=40):
    errors = np.abs(np.random.default_rng(0).normal(0, error_deg, count))
    rows = {"estimator": ["mine"] * count, "status": ["ok"] * count, "error_deg": errors}
    return pl.DataFrame(rows | {name: np.full(count, sd_rad**2) for name in ("cov_11", "cov_22")})


def test_covariances_in_square_degrees_are_told():
    (said,) = wide_regions(stated(1.0, 1.0))
    assert said.startswith("mine: the covariances state a standard deviation of 57.3 deg in the median, and the median")
    assert "must be in rad^2" in said
    assert "\n" not in said


@pytest.mark.parametrize("sd_deg", [0.2, 1.0, 10.0])
def test_wide_covariances_alone_are_no_mistake(sd_deg):
    assert wide_regions(stated(1.0, np.radians(sd_deg))) == []
    # what a method states of frames without noise
    assert wide_regions(stated(0.001, np.radians(0.2))) == []
    assert wide_regions(stated(1.0, 1.0, count=4)) == []


def test_answers_without_covariances_are_no_mistake():
    assert wide_regions(stated(1.0, 1.0).with_columns(cov_11=pl.lit(None, pl.Float64))) == []
