"""Run the bad inputs; exit 1 if any is not refused as it should be."""

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measuring import Figure, print_figures
from studies.bad_inputs import files
from studies.bad_inputs.cases import cases as every_case
from studies.bad_inputs.run import LIMIT_MIB, LIMIT_S, Case, Outcome, executed, forked, preload, run_all

KINDS = ("hang", "slow", "memory", "crash", "internal error", "traceback", "accepted")


def all_cases() -> list[Case]:
    """Return all cases, in a fixed order; no two have one name."""
    made = list(every_case())
    twice = [name for name, count in Counter(case.name for case in made).items() if count > 1]
    if twice:
        raise AssertionError(f"two cases are called {twice[0]!r}")
    return made


def figures(outcomes: list[Outcome]) -> Iterator[Figure]:
    """Return how many cases have each kind of fault, and the most that one took."""
    about = f"{len(outcomes)} cases"
    for kind in KINDS:
        count = sum(kind in outcome.faults for outcome in outcomes)
        yield Figure(kind, count, 0, unit="", about=about)
    others = sum(bool(set(outcome.faults) - set(KINDS)) for outcome in outcomes)
    yield Figure("unclear, or something left behind", others, 0, unit="", about=about)
    slowest = max(outcomes, key=lambda outcome: outcome.processor_s)
    largest = max(outcomes, key=lambda outcome: outcome.peak_mib)
    yield Figure("processor time of the slowest", slowest.processor_s, LIMIT_S, unit="s", about=slowest.case.name)
    yield Figure("memory of the largest", largest.peak_mib, LIMIT_MIB, unit="MiB", about=largest.case.name)


def main() -> int:
    """Run the cases, those with faults again as commands of their own, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="cases whose name holds this text")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--draw", type=int, default=0, help="which random damage; nothing was mended after draw 1")
    parser.add_argument("--commands", action="store_true", help="start each as a command of its own")
    parser.add_argument("--show", action="store_true", help="print every case's line")
    parser.add_argument("--log", type=Path, help="file to write each case with a fault to, at once")
    given = parser.parse_args()
    files.Draw.number = given.draw
    cases = [case for case in all_cases() if given.only in case.name]
    preload()
    outcomes: list[Outcome] = []
    for number, outcome in enumerate(run_all(cases, given.workers, executed if given.commands else forked), 1):
        outcomes.append(outcome)
        if outcome.faults or given.show:
            _print(outcome, given.log)
        if number % 100 == 0:
            print(f"{number} of {len(cases)}", file=sys.stderr, flush=True)
    # A fault of the process that forks is none of the command's.
    if not given.commands and (wrong := [outcome.case for outcome in outcomes if outcome.faults]):
        again = {outcome.case.name: outcome for outcome in run_all(wrong, given.workers, executed)}
        outcomes = [again.get(outcome.case.name, outcome) for outcome in outcomes]
    for outcome in outcomes:
        if outcome.faults:
            _print(outcome, None)
    return print_figures(list(figures(outcomes)))


def _print(outcome: Outcome, log: Path | None) -> None:
    text = (
        f"{outcome.case.name}: {'; '.join(outcome.faults) or 'sound'} "
        f"[exit {outcome.code}, {outcome.processor_s:.1f} s, {outcome.peak_mib:.0f} MiB]\n"
        f"    {outcome.stderr.strip()[-400:]}"
    )
    print(text, flush=True)
    if log:
        with log.open("a") as file:
            file.write(text + "\n")


if __name__ == "__main__":
    sys.exit(main())
