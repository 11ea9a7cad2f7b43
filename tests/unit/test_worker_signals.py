"""How workers are started: their signals and threads."""

import os
import subprocess
import sys
from pathlib import Path

from simtest.runtime.processes import make_engine
from tests.unit.engine_tasks import threads

ROOT = Path(__file__).resolve().parents[2]

SCRIPT = """
import signal
from simtest.runtime.processes import make_engine
from tests.unit.engine_tasks import blocked_signals

if __name__ == "__main__":
    made = dict(make_engine(workers=2).run(blocked_signals, [0, 1], lambda: None))
    print(all({signal.SIGINT, signal.SIGTERM} <= set(each) for each in made.values()), signal.SIGINT in
          signal.pthread_sigmask(signal.SIG_BLOCK, []))
"""


def test_no_worker_is_broken_into_while_it_starts(tmp_path):
    """In a process of its own: the first worker of a process starts multiprocessing's tracker, which lifts masks."""
    script = tmp_path / "script.py"
    script.write_text(f"import sys\nsys.path.insert(0, {str(ROOT)!r})\n{SCRIPT}")
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=120, check=True)
    # Blocked in the workers, and no longer here.
    assert done.stdout.split() == ["True", "False"], done.stderr


def test_each_worker_has_its_share_of_the_cores(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    ((_, told),) = make_engine(workers=2).run(threads, [0], lambda: None)
    # A single task has all of them.
    assert told == ("6", "6", 6)
    shares = dict(make_engine(workers=2).run(threads, [0, 1], lambda: None))
    assert set(shares.values()) == {("3", "3", 3)}
