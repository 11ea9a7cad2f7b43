"""The progress bar: what it tells, step by step."""

import signal
from types import SimpleNamespace

import pytest
from rich import progress as rich

from simtest.cli import progress
from simtest.cli.progress import progress_bar
from simtest.validation.runner import _told as told


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
        move(3, 3, "done")
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


def test_the_bar_tells_where_an_anatomy_must_be_made_first():
    def case(setting, **surface):
        return SimpleNamespace(setting=setting, data={"surface": surface})

    colon, liver = {"type": "anatomy", "path": "colon"}, {"type": "anatomy", "path": "liver"}
    cases = [case("plane", type="plane"), case("a", **colon), case("b", viewpoint=1, **colon), case("c", **liver),
             case("d", **colon), case("e", seed=2, **colon), SimpleNamespace(setting="protocol", data={})]  # fmt: skip
    made = ": making the surface"
    assert told(cases) == ["plane", "a" + made, "b", "c" + made, "d", "e" + made, "protocol"]
