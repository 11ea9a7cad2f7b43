"""Try the corners where features meet.

    python -m studies.corners [--scenes N] [--checks NAME ...] [--only K] [--draws N]

Prints the array's size and the pairs that the package refuses, the verdicts of each check, what the regions of the
estimators hold by feature, and each red line with the command that shows it again. Exit 1 where a check is red.
"""

import argparse
import sys
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Sequence

from simtest.errors import SimtestError
from studies.corners.case import Case
from studies.corners.checks import CHECKS, run
from studies.corners.coverage import Answer, answers_of, table
from studies.corners.scenes import MESH, refusals, rows

NAMES = (*CHECKS, "coverage")
VERDICTS = ("green", "refused", "not asked", "red")

MOST_LINES = 4
"""Faults of one check that are printed of one scene."""


class Tally:
    """Verdicts and processor time by check, the lines of what is not green, and the answers."""

    def __init__(self) -> None:
        self.counts = Counter[tuple[str, str]]()
        self.seconds: dict[str, float] = defaultdict(float)
        self.lines: list[str] = []
        self.answers: list[Answer] = []

    def add(self, check: str, verdict: str, scene: str, reasons: Sequence[str], seconds: float) -> None:
        """Count a verdict; print what is refused or red."""
        self.counts[check, verdict] += 1
        self.seconds[check] += seconds
        if verdict in ("refused", "red"):
            again = f" [python -m studies.corners --only {scene} --checks {check}]"
            self.lines += [f"{verdict}: scene {scene}, {check}: {reason}{again}" for reason in reasons[:MOST_LINES]]
            more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
            print(f"{verdict}: scene {scene}, {check}: {reasons[0]}{more}", flush=True)

    def table(self, checks: Sequence[str]) -> str:
        """Return the verdicts of checks as a table."""
        lines = [f"| check | {' | '.join(VERDICTS)} | s |", f"|{'---|' * (2 + len(VERDICTS))}"]
        for name in checks:
            counted = " | ".join(str(self.counts[name, verdict]) for verdict in VERDICTS)
            lines.append(f"| {name} | {counted} | {self.seconds[name]:.0f} |")
        return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.corners", description="Try the corners.")
    parser.add_argument("--scenes", type=int, help="rows of the array, from the first; default all")
    parser.add_argument("--checks", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--draws", type=int, default=4, help="scenes of each row whose answers are pooled; default 4")
    parser.add_argument("--only", type=int, metavar="K", help="row K of the array alone, from 0")
    given = parser.parse_args(arguments)
    array, tally = rows(), Tally()
    print(f"{len(array)} scenes hold all pairs of levels of {len(array[0])} features")
    print("pairs that are refused:")
    for (first, second), reason in refusals().items():
        print(f"  {first[0]} {first[1]}, {second[0]} {second[1]}: {reason}")
    for number in range(len(array))[: given.scenes] if given.only is None else [given.only]:
        if array[number]["surface"] == "mesh" and not MESH.is_file():
            print(f"scene {number} is left out: no ../shared/data/meshes/{MESH.name} beside the checkout")
            continue
        if given.only is not None:
            print(array[number])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _try(number, array[number], given.checks, given.draws, tally)
    print(f"\n{tally.table(given.checks)}")
    if tally.answers:
        tables, faults = table(tally.answers, array)
        print("\n" + "\n".join(tables))
        # One scene is no share.
        tally.lines += faults if given.only is None else []
    red = [line for line in tally.lines if line.startswith("red")]
    if red:
        print("\nreds, with the command that shows them again")
        print("\n".join(red))
    print(f"\n{sum(tally.seconds.values()):.0f} s of processor time")
    return 1 if red else 0


def _try(number: int, row: dict[str, str], checks: Sequence[str], draws: int, tally: Tally) -> None:
    """Run checks on a row's first scene, and collect the answers of its draws."""
    case = Case(number, row)
    for name in [each for each in checks if each in CHECKS]:
        begun = time.process_time()
        verdict, reasons = run(name, case)
        tally.add(name, verdict, str(number), reasons, time.process_time() - begun)
    case.close()
    for draw in range(draws) if "coverage" in checks else []:
        begun, verdict, reasons = time.process_time(), "green", [""]
        try:
            tally.answers += answers_of(case if draw == 0 else Case(number, row, draw))
        except SimtestError as error:
            verdict, reasons = "refused", [f"draw {draw}: {error}"]
        except Exception as error:
            verdict, reasons = "red", [f"draw {draw}: {type(error).__name__}: {error}"]
        tally.add("coverage", verdict, str(number), reasons, time.process_time() - begun)


if __name__ == "__main__":
    sys.exit(main())
