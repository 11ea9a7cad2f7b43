"""Run the nightly on unchanged code again and again, with and without other work on the machine: no run may alarm.

python -m studies.nightly_alarms [--profile quick] [--runs 3] [--load 0 12] [--reports DIR]

The first run is accepted where DIR has no baseline of the profile. Of each of the others the exit code and the verdict
are printed; exits 1 where one is not fine. On the baseline's machine all runs are bit-equal, however busy it is.
"""

import argparse
import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measuring import Figure, print_figures

_MAIN = "from simtest.cli.main import main; main()"
_BUSY = "while True: pass"


@contextlib.contextmanager
def busy(count: int) -> Iterator[None]:
    """Keep so many processes at work."""
    others = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def nightly(*arguments: str) -> tuple[int, str]:
    """Run `simtest nightly` in a process; return its exit code and what it printed."""
    done = subprocess.run(
        [sys.executable, "-c", _MAIN, "nightly", *arguments], capture_output=True, text=True, check=False
    )
    return done.returncode, done.stdout if done.returncode in (0, 1) else done.stderr


def main(words: list[str]) -> int:
    """Run, and print how many runs were not fine at each load."""
    parser = argparse.ArgumentParser(description="Alarms of the nightly on unchanged code.")
    parser.add_argument("--profile", default="quick")
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--load", type=int, nargs="+", default=[0, 12], help="processes that keep the machine busy")
    parser.add_argument("--reports", type=Path, default=Path("out") / "nightly_alarms")
    told = parser.parse_args(words)
    common = ("--profile", told.profile, "--reports", str(told.reports))
    if not (told.reports / "baseline" / Path(told.profile).stem).is_dir():
        code, text = nightly(*common)
        code, text = nightly("accept", *common, "--reason", "first run of this code") if code == 0 else (code, text)
        if code:
            print(text, file=sys.stderr)
            return 2
    figures = []
    for load in told.load:
        alarms = 0
        for number in range(told.runs):
            started = time.monotonic()
            with busy(load):
                code, text = nightly(*common, "--json")
            stopped = {"headline": text.strip(), "causes": [], "bit_equal": None}
            verdict = json.loads(text) if code in (0, 1) else stopped
            alarms += code != 0
            equal = ", not bit-equal" if verdict["bit_equal"] is False else ""
            took = f"{time.monotonic() - started:.0f} s"
            print(f"load {load}, run {number + 1}: exit {code}, {verdict['headline']}{equal}; {took}", flush=True)
            print(*(f"  {cause}" for cause in verdict["causes"]), sep="\n", end="\n" * bool(verdict["causes"]))
        figures.append(Figure(f"alarms of {told.runs} runs at load {load}", alarms, 0, unit=""))
    return print_figures(figures)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
