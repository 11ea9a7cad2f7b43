"""Try the corners where features meet.

    python -m studies.corners [--scenes N] [--checks NAME ...] [--only K]

Prints the array's size and the pairs that the package refuses, the verdicts of each check, and each red line with the
command that shows it again. Exit 1 where a check is red.
"""

import argparse
import sys
import time
import warnings
from collections import Counter
from collections.abc import Sequence

from simtest.errors import SimtestError
from studies.corners.case import Case
from studies.corners.checks import CHECKS, run
from studies.corners.coverage import Answer, answers_of, table
from studies.corners.scenes import MESH, refusals, rows

NAMES = (*CHECKS, "coverage")
VERDICTS = ("green", "refused", "not asked", "red")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.corners", description="Try the corners.")
    parser.add_argument("--scenes", type=int, help="rows of the array, from the first; default all")
    parser.add_argument("--checks", nargs="+", choices=NAMES, default=NAMES, metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--draws", type=int, default=4, help="scenes of each row whose answers are pooled; default 4")
    parser.add_argument("--only", type=int, metavar="K", help="row K of the array alone, from 0")
    given = parser.parse_args(arguments)
    array = rows()
    print(f"{len(array)} scenes hold all pairs of {len(array[0])} features; pairs that are refused:")
    for (first, second), reason in refusals().items():
        print(f"  {first[0]} {first[1]}, {second[0]} {second[1]}: {reason}")
    chosen = [given.only] if given.only is not None else list(range(len(array)))[: given.scenes]
    started = time.process_time()
    counts, lines, answers = Counter[tuple[str, str]](), list[str](), list[Answer]()
    for number in chosen:
        row = array[number]
        if row["surface"] == "mesh" and not MESH.is_file():
            print(f"scene {number} is left out: there is no {MESH}")
            continue
        case = Case(number, row)
        if given.only is not None:
            print(row)
        for name in [each for each in given.checks if each in CHECKS]:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                verdict, reasons = run(name, case)
            counts[name, verdict] += 1
            if verdict in ("red", "refused"):
                lines += [f"{verdict}: scene {number}, {name}: {reason}" for reason in reasons[:4]]
                print(lines[-1], f"(and {len(reasons) - 1} more)" if len(reasons) > 1 else "", flush=True)
        case.close()
        if "coverage" in given.checks:
            for draw in range(given.draws):
                try:
                    with warnings.catch_warnings():
                        warnings.simplefilter("ignore")
                        answers += answers_of(case if draw == 0 else Case(number, row, draw))
                    counts["coverage", "green"] += 1
                except SimtestError as error:
                    counts["coverage", "refused"] += 1
                    lines.append(f"refused: scene {number}, coverage, draw {draw}: {error}")
                except Exception as error:  # noqa: BLE001 - one scene's failure is one red line
                    counts["coverage", "red"] += 1
                    lines.append(f"red: scene {number}, coverage, draw {draw}: {type(error).__name__}: {error}")
    print(f"\n| check | {' | '.join(VERDICTS)} |\n|{'---|' * (1 + len(VERDICTS))}")
    for name in given.checks:
        print(f"| {name} | {' | '.join(str(counts[name, verdict]) for verdict in VERDICTS)} |")
    if answers:
        tables, faults = table(answers, array)
        print("\n" + "\n".join(tables))
        lines += faults
    red = [line for line in lines if line.startswith("red")]
    if red:
        print("\nreds, each shown again by: python -m studies.corners --only SCENE --checks CHECK")
        print("\n".join(red))
    print(f"\n{time.process_time() - started:.0f} s of processor time")
    return 1 if red else 0


if __name__ == "__main__":
    sys.exit(main())
