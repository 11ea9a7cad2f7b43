"""The history of nights and the baseline: what is written stays, and what is damaged is named."""

import errno
import json
import os
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import polars as pl
import pytest
from polars.testing import assert_frame_equal

from simtest.errors import InputError
from simtest.nightly import store
from simtest.nightly.quantities import OLDEST_COLUMNS
from simtest.nightly.records import CELL
from simtest.nightly.run import judge
from simtest.nightly.store import (
    BASELINE_ROWS,
    HISTORY,
    LATEST_ROWS,
    TREND_COLUMNS,
    TRENDS,
    Reports,
    accept,
    append,
    clock_note,
    exclusive_replacement,
    history_rows,
    load_baseline,
    load_run,
    log_note,
    new_run_id,
    only_night,
    read_history,
    replace_folder,
    save_run,
)
from simtest.nightly.words import short_commit
from tests.unit.nightly_samples import STARTED, make_rows, make_run, no_baseline


def keep(folder, number, **more):
    """Append a night; gives its file."""
    started = STARTED + timedelta(days=number)
    record = {"id": f"{started:%Y%m%dT%H%M%SZ}-1-{number:08x}", "started": started.isoformat(), **more}
    scratch_folder = folder.with_name("work")
    scratch_folder.mkdir(exist_ok=True)
    return append(folder, history_rows(make_run(record), no_baseline()), scratch_folder)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "quick"


# History ---------------------------------------------------------------------------------------------------------


def test_a_night_reads_back_as_it_was_written(folder):
    file = keep(folder, 0)
    assert file == folder / "20260301T023000Z-1-00000000.parquet"
    written = history_rows(make_run({"id": file.stem}), no_baseline())
    assert_frame_equal(pl.read_parquet(folder / "*.parquet"), written)
    assert written.schema == pl.Schema(HISTORY)
    read, notes = read_history(folder)
    assert notes == []
    assert_frame_equal(read, written.filter(pl.col("quantity").is_in(TRENDS)).select(TREND_COLUMNS))
    assert 0 < read.height < written.height


def test_checks_of_older_versions_are_no_trend(folder):
    file = keep(folder, 0)
    rows = pl.read_parquet(file)
    check = rows.head(1).with_columns(
        experiment=pl.lit("costs"), estimator=pl.lit(""), quantity=pl.lit("unanswered"), value=pl.lit(0.0)
    )
    pl.concat([rows, check]).write_parquet(file)
    assert "costs" not in read_history(folder)[0]["experiment"]


def test_an_empty_history_has_the_columns(folder, tmp_path):
    for empty in (tmp_path, folder):
        read, notes = read_history(empty)
        assert (read.columns, read.height, notes) == (list(TREND_COLUMNS), 0, [])


def test_the_newest_runs_come_in_the_order_of_their_start(folder):
    for number in (2, 0, 1):
        keep(folder, number)
    names = ["20260301T023000Z-1-00000000", "20260302T023000Z-1-00000001", "20260303T023000Z-1-00000002"]
    assert read_history(folder)[0]["run_id"].unique(maintain_order=True).to_list() == names
    assert read_history(folder, newest=2)[0]["run_id"].unique(maintain_order=True).to_list() == names[1:]


def test_what_is_not_shown_is_not_read(folder, monkeypatch):
    """Neither the files of other profiles, nor older ones than the page shows."""
    files = [keep(folder, number) for number in range(3)]
    keep(folder.with_name("full"), 0)
    read, opened = pl.read_parquet, []
    monkeypatch.setattr(pl, "read_parquet", lambda file, **how: (opened.append((file, how)), read(file, **how))[1])
    read_history(folder, newest=2)
    assert [file for file, _ in opened] == files[1:]
    assert all(how["columns"] == list(TREND_COLUMNS) for _, how in opened)


@pytest.mark.parametrize(
    ("commit", "short"),
    [("0123456789abcdef", "0123456789ab"), ("0123456789abcdef+", "0123456789ab+"), (None, "unknown"),
     ("../../etc", "unknown"), ("0123456789ab/../x", "unknown")],
)  # fmt: skip
def test_a_commit_is_a_safe_name(commit, short):
    assert short_commit(commit) == short


def foreign(file):
    pl.DataFrame({"quantity": ["mean_deg"], "value": [1.0]}).write_parquet(file)


def wrong_types(file):
    pl.read_parquet(file).with_columns(pl.lit("yesterday").alias("started")).write_parquet(file)


def two_runs(file):
    rows = pl.read_parquet(file)
    pl.concat([rows, rows.with_columns(pl.lit("other").alias("run_id"))]).write_parquet(file)


def without_start(file):
    pl.read_parquet(file).with_columns(pl.lit(None, HISTORY["started"]).alias("started")).write_parquet(file)


DAMAGE = {
    "truncated": lambda file: os.truncate(file, file.stat().st_size // 2),
    "a few bytes": lambda file: os.truncate(file, 3),
    "empty": lambda file: os.truncate(file, 0),
    "no rows": lambda file: pl.read_parquet(file).head(0).write_parquet(file),
    "text": lambda file: file.write_text("not a table\n" * 50),
    "foreign": foreign,
    "wrong types": wrong_types,
    "two runs": two_runs,
    "no start": without_start,
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_file_is_named_and_skipped(folder, kind):
    bad = keep(folder, 1)
    keep(folder, 2)
    DAMAGE[kind](bad)
    before = bad.read_bytes()
    with pytest.warns(UserWarning, match=rf"{bad.name}: .*; skipped") as told:
        read, (note,) = read_history(folder)
    assert len(told) == 1
    assert read["run_id"].unique().to_list() == ["20260303T023000Z-1-00000002"]
    assert note.startswith("History: 1 file skipped: ")
    assert bad.relative_to(folder).as_posix() in note
    assert bad.read_bytes() == before


@pytest.mark.filterwarnings("ignore:.*; skipped")
def test_many_damaged_files_make_a_short_note(folder):
    for number in range(8):
        os.truncate(keep(folder, number), 9)
    read, (note,) = read_history(folder)
    assert read.height == 0
    assert note.startswith("History: 8 files skipped: ")
    assert note.endswith(" and 3 more.")


def test_a_copy_of_a_night_counts_once(folder):
    file = keep(folder, 0)
    (folder / "copy.parquet").write_bytes(file.read_bytes())
    once = keep(folder.with_name("other"), 0).parent
    with pytest.warns(UserWarning, match="another file holds already"):
        read, notes = read_history(folder)
    assert read.equals(read_history(once)[0])
    assert len(notes) == 1


@pytest.mark.parametrize("step", ["os.fsync", "os.replace"])
def test_whoever_reads_the_history_never_meets_half_of_a_night(folder, monkeypatch, step):
    """The process is killed in the middle: nothing tidies up, and the documented glob matches whole files alone."""
    keep(folder, 0)
    before = pl.read_parquet(folder / "*.parquet")
    killed = RuntimeError("killed")
    monkeypatch.setattr(f"simtest.runtime.files.{step}", lambda *_: (_ for _ in ()).throw(killed))
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
    with pytest.raises(RuntimeError):
        keep(folder, 1)
    monkeypatch.undo()
    assert pl.read_parquet(folder / "*.parquet").equals(before)
    assert pl.read_parquet(folder.parent / "quick" / "**" / "*.parquet").equals(before)


def test_other_files_are_no_nights(folder, recwarn):
    keep(folder, 0)
    (folder / "notes.txt").write_text("mine")
    assert read_history(folder)[1] == []
    assert not recwarn.list


def test_a_file_of_other_columns_is_read_in_what_is_shown(folder):
    """An older version's holds more kinds of figures, a later one's perhaps other columns."""
    file = keep(folder, 0)
    expected = read_history(folder)[0]
    older = pl.read_parquet(file).drop("digest", "source_hash").with_columns(kind=pl.lit("setting"))
    cost = older.head(1).with_columns(kind=pl.lit("cost"), quantity=pl.lit("run_time"))
    pl.concat([older, cost]).write_parquet(file)
    read, notes = read_history(folder)
    assert notes == []
    assert_frame_equal(read, expected)


def test_a_clock_that_went_back_is_told(folder):
    keep(folder, 3)
    read, _ = read_history(folder)
    note = clock_note(read, STARTED)
    assert note is not None
    assert "2026-03-01 02:30:00 UTC" in note
    assert "2026-03-04 02:30:00" in note
    assert clock_note(read, STARTED + timedelta(days=4)) is None
    assert clock_note(read.head(0), STARTED) is None
    # The night is kept all the same, in its place by the time it tells.
    keep(folder, 0)
    assert read_history(folder)[0]["started"].is_sorted()


def test_names_of_nights_differ_whatever_the_clock_says():
    now = datetime(2026, 1, 1, tzinfo=UTC)
    assert len({new_run_id(now) for _ in range(1000)}) == 1000


def test_a_full_disk_leaves_no_half_of_a_night(folder, monkeypatch):
    keep(folder, 0)
    before = contents(folder)

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("simtest.runtime.files.os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        keep(folder, 1)
    assert contents(folder) == before


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and not path.name.endswith("lock")
    }


# Baseline --------------------------------------------------------------------------------------------------------


@pytest.fixture
def reports(tmp_path):
    """Reports with a last night."""
    made = Reports(tmp_path / "reports")
    write_latest(made, make_run())
    return made


def write_latest(reports, run):
    folder = reports.latest(run.record.profile)
    folder.mkdir(parents=True, exist_ok=True)
    save_run(folder, run, LATEST_ROWS)


def test_a_baseline_is_the_last_night_with_a_reason(reports):
    assert load_baseline(reports, "quick") is None
    record = accept(reports, "quick", "  first\n night ")
    found, run = load_baseline(reports, "quick"), make_run()
    assert found.record == record
    assert found.record.reason == "first night"
    assert datetime.fromisoformat(record.accepted).tzinfo is not None
    assert_frame_equal(found.figures, run.figures)
    kept = run.rows.select(found.rows.columns)
    # What is compared with margins lies there in single precision.
    assert pl.read_parquet_schema(reports.baseline("quick") / BASELINE_ROWS)["peak_snr"] == pl.Float32()
    assert_frame_equal(found.rows, kept)
    assert {"error_deg", "seed", "true_id", "realisation"} <= set(kept.columns)
    assert list(reports.work.iterdir()) == []


def test_reading_a_baseline_writes_nothing(reports):
    accept(reports, "quick", "first")
    for path in reports.baseline("quick").parent.glob(".*"):
        path.unlink()
    load_baseline(reports, "quick")
    load_baseline(reports, "full")
    assert [path.name for path in reports.baseline("quick").parent.iterdir()] == ["quick"]


def test_a_baseline_of_an_older_version_has_figures_that_are_of_no_cell(reports):
    accept(reports, "quick", "first")
    held = load_baseline(reports, "quick")
    cost = held.figures.head(1).with_columns(
        experiment=pl.lit("cost"), quantity=pl.lit("run_time"), digest=pl.lit(None, pl.String)
    )
    older = pl.concat([held.figures, cost]).with_columns(kind=pl.lit("setting"), passed=None, about=pl.lit(""))
    save_run(reports.baseline("quick"), replace(held, figures=older), BASELINE_ROWS)
    found = load_baseline(reports, "quick")
    assert_frame_equal(found.figures, held.figures)
    assert judge(make_run(), found, reports).verdict.bit_equal


def test_all_acceptances_are_kept(reports):
    accept(reports, "quick", "first")
    write_latest(reports, make_run({"id": "20260302T023000Z-7-0"}, make_rows(error_deg=0.5)))
    accept(reports, "quick", "better ellipse fit")
    lines = [json.loads(line) for line in (reports.baseline("quick") / "log.jsonl").read_text().splitlines()]
    assert [line["reason"] for line in lines] == ["first", "better ellipse fit"]
    assert [line["replaces"] for line in lines] == [None, "20260301T023000Z-7-0123abcd"]
    assert load_baseline(reports, "quick").rows["error_deg"].min() == 0.5


def test_a_log_that_was_cut_off_is_told_and_what_is_left_is_kept(reports):
    assert log_note(reports, "quick") is None
    accept(reports, "quick", "first")
    accept(reports, "quick", "second")
    assert log_note(reports, "quick") is None
    log = reports.baseline("quick") / "log.jsonl"
    os.truncate(log, log.stat().st_size - 20)
    note = log_note(reports, "quick")
    assert "log.jsonl: damaged (line 2 of 2 is no entry; cut off?); the rest is kept" in note
    assert "\n" not in note
    # The next entry has a line of its own.
    accept(reports, "quick", "third")
    lines = log.read_text().splitlines()
    assert len(lines) == 3
    assert [json.loads(lines[i])["reason"] for i in (0, 2)] == ["first", "third"]
    assert "line 2 of 3" in log_note(reports, "quick")
    assert "log.jsonl: damaged" in judge(make_run(), load_baseline(reports, "quick"), reports).verdict.notes[-1]


def test_a_baseline_of_an_older_version_is_compared_in_what_it_holds(reports):
    accept(reports, "quick", "first")
    held = load_baseline(reports, "quick")
    old = replace(held, rows=held.rows.select(*CELL, "realisation", *OLDEST_COLUMNS))
    save_run(reports.baseline("quick"), old, BASELINE_ROWS)
    found = load_baseline(reports, "quick")
    assert "peak_snr" not in found.rows.columns
    tonight = make_run(rows=make_rows().with_columns(peak_snr=pl.lit(9.0), error_deg=pl.col("error_deg") * (1 + 1e-9)))
    verdict = judge(tonight, found, reports).verdict
    assert verdict.state == "fine"
    assert any("lacks" in note and "judged from the next accepted baseline on" in note for note in verdict.notes)


@pytest.mark.parametrize(("reason", "said"), [("", "0 characters"), (" \n", "0 characters"), ("x" * 1001, "1001")])
def test_a_baseline_needs_a_reason(reports, reason, said):
    with pytest.raises(InputError, match=f"--reason: {said} characters" if "c" not in said else f"--reason: {said}"):
        accept(reports, "quick", reason)
    assert load_baseline(reports, "quick") is None


def test_there_is_nothing_to_accept(reports):
    with pytest.raises(InputError, match="no night of the profile full; run simtest nightly first"):
        accept(reports, "full", "why not")


@pytest.mark.parametrize("name", ["run.json", "figures.parquet", BASELINE_ROWS])
@pytest.mark.parametrize("damage", ["missing", "truncated", "text", "another night's"])
def test_a_damaged_baseline_is_named(reports, name, damage):
    accept(reports, "quick", "first")
    file = reports.baseline("quick") / name
    if damage == "missing":
        file.unlink()
    elif damage == "truncated":
        os.truncate(file, file.stat().st_size // 2)
    elif damage == "text":
        file.write_text("no table")
    else:
        kept = file.read_bytes()
        write_latest(reports, make_run(rows=make_rows(error_deg=3.0)))
        accept(reports, "quick", "second")
        if file.read_bytes() == kept:
            pytest.skip("the same in both nights")
        file.write_bytes(kept)
    # A record of another night names the first table, whose hash it does not hold.
    named = BASELINE_ROWS if (name, damage) == ("run.json", "another night's") else name
    with pytest.raises(InputError, match=f"{named}: (damaged|no such file)"):
        load_baseline(reports, "quick")


def test_a_damaged_last_night_is_not_accepted(reports):
    accept(reports, "quick", "first")
    before = contents(reports.baseline("quick"))
    os.truncate(reports.latest("quick") / LATEST_ROWS, 100)
    with pytest.raises(InputError, match=rf"{LATEST_ROWS}: damaged"):
        accept(reports, "quick", "second")
    assert contents(reports.baseline("quick")) == before


@pytest.mark.parametrize("renames", [0, 1, 2])
def test_an_accept_that_is_killed_leaves_one_of_the_two(reports, monkeypatch, renames):
    """The renames are where the folder changes hands: a kill before, between and after them."""
    accept(reports, "quick", "first")
    write_latest(reports, make_run({"id": "20260302T023000Z-7-0"}))
    done, rename = [], Path.rename

    def killed(self, target):
        if len(done) == renames:
            raise KeyboardInterrupt
        done.append(target)
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", killed)
    if renames < 2:
        with pytest.raises(KeyboardInterrupt):
            accept(reports, "quick", "second")
    else:
        swapped = reports.baseline("quick").parent
        monkeypatch.setattr(
            store, "sync_folder", lambda made: (_ for _ in ()).throw(KeyboardInterrupt) if made == swapped else None
        )
        with pytest.raises(KeyboardInterrupt):
            accept(reports, "quick", "second")
    monkeypatch.undo()
    assert load_baseline(reports, "quick").record.reason == ("first" if renames < 2 else "second")
    accept(reports, "quick", "third")
    assert load_baseline(reports, "quick").record.reason == "third"
    assert {path.name for path in reports.baseline("quick").parent.iterdir()} == {"quick", ".quick.lock"}


# Scratch ---------------------------------------------------------------------------------------------------------


def test_what_a_killed_night_left_is_removed_and_other_profiles_are_left_alone(tmp_path):
    reports = Reports(tmp_path)
    dead, other = reports.work / "quick" / "rows", reports.work / "full" / "rows"
    for rows in (dead, other):
        rows.parent.mkdir(parents=True)
        rows.write_text("half")
    with only_night(reports, "quick") as folder:
        assert folder == dead.parent
        assert list(folder.iterdir()) == []
        with pytest.raises(InputError, match="is in use by process"), only_night(reports, "quick"):
            pass
        assert folder.is_dir()
    assert not folder.exists()
    assert other.exists()


def test_a_folder_is_replaced_whole(tmp_path):
    folder = tmp_path / "page"
    for text in ("first", "second"):
        new = tmp_path / "new"
        new.mkdir()
        (new / text).touch()
        with exclusive_replacement(folder):
            replace_folder(new, folder)
        assert [path.name for path in folder.iterdir()] == [text]


def test_reports_that_are_a_file_are_refused(tmp_path):
    (tmp_path / "reports").touch()
    with pytest.raises(InputError, match=r"--reports .*reports: is a file; must be a folder"):
        Reports(tmp_path / "reports").make()


def test_a_night_that_another_wrote_is_refused(tmp_path):
    save_run(tmp_path, make_run(), LATEST_ROWS)
    (tmp_path / "run.json").write_text('{"id": "x"}')
    with pytest.raises(InputError, match=r"run\.json: damaged"):
        load_run(tmp_path, LATEST_ROWS)
