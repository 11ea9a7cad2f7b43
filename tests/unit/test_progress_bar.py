"""The progress bar: what it tells, step by step."""

import signal
import time
from types import SimpleNamespace

import pytest
from rich import progress as rich

from simtest.cli import progress
from simtest.cli.progress import LEAST_STEPS, Remaining, progress_bar
from simtest.validation.case_work import names_of as told


@pytest.fixture
def bars(monkeypatch):
    """The bars that were made, without their drawing."""
    made = []

    class Recorded(rich.Progress):
        def __init__(self, *columns, **options):
            super().__init__(*columns, **options, disable=False, auto_refresh=False)
            made.append(self)

    monkeypatch.setattr(rich, "Progress", Recorded)
    monkeypatch.setattr(progress, "at_terminal", lambda: True)
    return made


def shown(bar):
    return [(task.completed, task.total, task.description) for task in bar.tasks]


def test_a_page_has_a_bar_of_its_own_below_that_of_the_work(bars):
    with progress_bar("writing the report") as move:
        assert bars == []
        move(0, 3, "starting with plane")
        (bar,) = bars
        assert shown(bar) == [(0, 3, "starting with plane")]
        move(2, 3, "sphere")
        move(3, 3, "unwritten")
        assert shown(bar) == [(3, 3, "writing the report")]
        move(0, 1, "reading the results")
        move(1, 5, "drawing frame 1")
        assert shown(bar) == [(3, 3, "done"), (1, 5, "drawing frame 1")]
        # More turns up on the way.
        move(4, 8, "drawing axis_ratio")
        move(8, 8, "page written")
    assert shown(bar) == [(3, 3, "done"), (8, 8, "page written")]


def test_a_finished_run_shows_the_bar_of_its_page_alone(bars):
    with progress_bar() as move:
        move(0, 1, "reading the results")
        move(1, 2, "writing the page")
        move(2, 2, "page written")
    assert shown(bars[0]) == [(2, 2, "page written")]


def test_a_single_step_shows_no_bar(bars):
    with progress_bar() as move:
        move(1, 1, "frame")
    assert bars == []


@pytest.fixture
def interruptible():
    """Have Ctrl-C raise `KeyboardInterrupt`: a run in the background of a shell ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_a_stop_waits_for_the_next_step(bars):
    def stopped_between_steps():
        with progress_bar() as move:
            move(0, 2, "one")
            signal.raise_signal(signal.SIGINT)
            move(1, 2, "two")

    with pytest.raises(KeyboardInterrupt):
        stopped_between_steps()
    assert not bars[0].live.is_started
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def times_left(ends, total, start=0):
    """What is said at the end of each step by a clock that shows the given times."""
    remaining = Remaining()
    assert remaining.seconds(start, total, 0.0) is None
    return [remaining.seconds(done, total, now) for done, now in enumerate(ends, start + 1)]


def test_the_first_step_is_no_measure_of_the_others():
    # 40 s to compile, then 0.5 s a frame: extrapolated, 100 frames would take over an hour.
    ends = [40 + 0.5 * i for i in range(100)]
    said = times_left(ends, 100)
    assert said[:LEAST_STEPS] == [None] * LEAST_STEPS
    told = [(i, left) for i, left in enumerate(said) if left is not None]
    assert told[0][0] <= 6
    for i, left in told:
        assert left == pytest.approx(ends[-1] - ends[i], abs=0.51)


def test_a_run_that_goes_on_measures_its_own_frames_alone():
    said = times_left([30 + float(i) for i in range(20)], 320, start=300)
    assert said[-1] == 0
    assert said[9] == pytest.approx(10)


def test_there_is_no_estimate_while_the_pace_changes():
    # Frames of 0.1 s, then of 2 s: told again once most measured steps are of the new kind.
    ends = [0.5 * i for i in range(20)] + [9.5 + 3.0 * (i + 1) for i in range(60)]
    said = times_left(ends, 80)
    assert said[15] is not None
    assert said[30] is None
    later = [(i, left) for i, left in enumerate(said[45:-1], 45) if left is not None]
    assert later
    for i, left in later:
        assert left == pytest.approx(ends[-1] - ends[i], rel=0.35)


def test_a_stretch_of_work_is_measured_by_itself():
    remaining = Remaining()
    first = [remaining.seconds(done, 6, float(done)) for done in range(7)]
    assert first[5] == pytest.approx(1.0)
    second = [remaining.seconds(done, 8, 100.0 + 10 * done) for done in range(9)]
    assert second[:3] == [None] * 3
    assert second[3] == pytest.approx(50.0)
    assert second[6] == pytest.approx(20.0)


def test_bar_and_lines_tell_the_time_left_once_it_is_known(bars, monkeypatch, capsys):
    seconds = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: seconds[0]))

    def fields():
        said = []
        with progress_bar() as move:
            for done in range(21):
                # The first step takes 60 s, the others 5 s.
                seconds[0] = 0.0 if done == 0 else 55.0 + 5.0 * done
                move(done, 20, "plane")
                said.append(bars[-1].tasks[0].fields["left"] if bars else "")
        return said

    said = fields()
    assert set(said[:3]) == {""}
    assert said[3] == "about 0:01:25 left"
    assert said[6] == "about 0:01:10 left"
    assert said[20] == ""
    bars.clear()
    capsys.readouterr()
    monkeypatch.setattr(progress, "at_terminal", lambda: False)
    seconds[0] = 0.0
    fields()
    lines = capsys.readouterr().err.splitlines()
    assert lines[:3] == [
        "simtest: 1/20 plane (60 s)",
        "simtest: 3/20 plane (70 s, about 85 s left)",
        "simtest: 5/20 plane (80 s, about 75 s left)",
    ]


def test_long_work_without_steps_shows_a_bar(bars, monkeypatch):
    monkeypatch.setattr(progress, "LEAST_S", 0.01)
    with progress_bar() as move:
        until = time.monotonic() + 10.0
        while not bars and time.monotonic() < until:
            time.sleep(0.01)
        (bar,) = bars
        move(1, 1, "frame")
    assert shown(bar) == [(1, 1, "writing the report")]
    assert not bar.live.is_started


def test_the_bar_tells_where_an_anatomy_must_be_made_first():
    def case(setting, **surface):
        return SimpleNamespace(setting=setting, data={"surface": surface})

    colon, liver = {"type": "anatomy", "path": "colon"}, {"type": "anatomy", "path": "liver"}
    cases = [case("plane", type="plane"), case("a", **colon), case("b", viewpoint=1, **colon), case("c", **liver),
             case("d", **colon), case("e", seed=2, **colon), SimpleNamespace(setting="protocol", data={})]  # fmt: skip
    made = ": making the surface"
    assert told(cases) == ["plane", "a" + made, "b", "c" + made, "d", "e" + made, "protocol"]
