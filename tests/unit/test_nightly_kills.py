"""Nights in processes of their own: two at once, killed at any moment, and on a disk that fills up."""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import polars as pl
import pytest

from simtest.nightly.store import LATEST_ROWS, Reports, load_baseline, load_run, read_history

MAIN = "from simtest.cli.main import main; main()"
ROUNDS = 2

# The published protocol renders nothing: a night of a second.
TINY = """
[[experiments]]
experiment = "paper"
labels = ["noise"]
realisations = 2
"""

pytestmark = pytest.mark.slow


@pytest.fixture
def profile(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def start(*arguments):
    return subprocess.Popen(
        [sys.executable, "-c", MAIN, "nightly", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def night(profile, reports, *more):
    return start("--profile", profile, "--reports", reports.root, "--workers", "1", *more)


def finish(process, code=0):
    output, errors = process.communicate(timeout=300)
    assert process.returncode == code, (output, errors)
    return errors.decode()


def accept(profile, reports, reason):
    return start("accept", "--profile", profile, "--reports", reports.root, "--reason", reason)


def kept(reports):
    """Return the bytes of the history's files."""
    return {path: path.read_bytes() for path in reports.history("tiny").iterdir()}


def check_whole(reports):
    """All that is there can be read, and belongs together."""
    history, notes = read_history(reports.history("tiny"))
    assert notes == []
    assert history["run_id"].n_unique() == len(kept(reports))
    last = load_run(reports.latest("tiny"), LATEST_ROWS)
    assert last.record.id in set(history["run_id"])
    page = (reports.latest("tiny") / "index.html").read_text()
    assert page
    assert {"verdict.json", "summary.md"} <= {path.name for path in reports.latest("tiny").iterdir()}


def test_of_two_nights_at_once_the_second_is_refused(tmp_path, profile):
    reports = Reports(tmp_path / "reports")
    first = night(profile, reports)
    while not list(reports.root.glob("work/tiny")) and first.poll() is None:
        time.sleep(0.01)
    errors = finish(night(profile, reports), 2)
    assert errors.startswith(f"simtest: --reports {reports.root / 'tiny'}: is in use by process {first.pid} (")
    finish(first)
    finish(night(profile, reports))
    assert len(kept(reports)) == 2
    check_whole(reports)
    assert not [path for path in reports.work.iterdir() if path.is_dir()]
    # The same rows: neither has seen the other's work.
    history = pl.read_parquet(reports.history("tiny") / "*.parquet")
    digests = history.group_by("run_id", maintain_order=True).agg("digest", "value")
    assert digests.height == 2
    assert digests["digest"].n_unique() == digests["value"].n_unique() == 1


STAGES = ("work/*/paper/parts/case-*", "work/*/paper/results.parquet", "work/*/tonight", "work/*/tonight/index.html",
          "history/*/*", "nightly/.tiny.old")  # fmt: skip
"""What stands in the folder at moments of a night, in order; the last one stands for the swap of the page."""


def kill_at(process, reports, stage, extra_s):
    """Kill a process a moment after a new path of a pattern stands; gives whether it was still at work."""
    old = set(reports.root.glob(stage))
    while process.poll() is None and not set(reports.root.glob(stage)) - old:
        time.sleep(0.001)
    time.sleep(extra_s)
    process.kill()
    process.communicate()
    return process.returncode == -signal.SIGKILL


def test_a_night_killed_at_any_moment_loses_nothing(tmp_path, profile):
    """Kills at each stage of a night and a random moment later; acceptances are killed too."""
    reports, rng = Reports(tmp_path / "reports"), random.Random(1)
    finish(night(profile, reports))
    finish(accept(profile, reports, "first"))
    killed = 0
    for number, stage in enumerate([*STAGES, "work/.tiny.baseline"] * ROUNDS):
        before, accepted = kept(reports), load_baseline(reports, "tiny").record
        accepting = stage.endswith("baseline")
        process = accept(profile, reports, f"number {number}") if accepting else night(profile, reports)
        killed += kill_at(process, reports, stage, rng.uniform(0, 0.03))
        after = kept(reports)
        assert {path: after.get(path) for path in before} == before
        assert load_baseline(reports, "tiny").record.reason in (accepted.reason, f"number {number}")
    # The last stages are short: some nights end before the kill.
    assert killed >= 3 * ROUNDS
    finish(night(profile, reports))
    check_whole(reports)
    finish(accept(profile, reports, "last"))
    assert load_baseline(reports, "tiny").record.reason == "last"
    assert not [path for path in reports.work.iterdir() if path.is_dir()]
    assert not [path for path in reports.root.rglob("*.part*")]
    assert {path.name for path in reports.baseline("tiny").parent.iterdir()} == {"tiny", ".tiny.lock"}


@contextmanager
def small_disk(folder, size):
    """Mount a file system of so many bytes; skip where that is not allowed."""
    folder.mkdir()
    mount = shutil.which("mount")
    if mount is None or os.geteuid() != 0:
        pytest.skip("a small file system can be mounted by root alone")
    options = ["-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    if subprocess.run([mount, *options], capture_output=True, check=False).returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_is_told_and_the_next_night_works(tmp_path, profile):
    """The disk is filled so far that a night is stopped sooner or later in its work."""
    disk = tmp_path / "disk"
    with small_disk(disk, 64 << 20):
        reports = Reports(disk / "reports")
        finish(night(profile, reports))
        finish(accept(profile, reports, "first"))
        stopped = 0
        for left_kib in (4, 48, 160, 1000):
            before, accepted = kept(reports), load_baseline(reports, "tiny").record
            filler = disk / "filler"
            usage = shutil.disk_usage(disk)
            filler.write_bytes(bytes(max(0, usage.free - (left_kib << 10))))
            process = night(profile, reports)
            output, errors = process.communicate(timeout=300)
            if process.returncode:
                stopped += 1
                assert (process.returncode, output) == (2, b""), errors
                last = errors.decode().splitlines()[-1]
                assert last.startswith("simtest: --reports ")
                assert "No space left on device" in last
            after = kept(reports)
            assert {path: after.get(path) for path in before} == before
            assert load_baseline(reports, "tiny").record == accepted
            filler.unlink()
        assert stopped >= 2
        finish(night(profile, reports))
        check_whole(reports)
