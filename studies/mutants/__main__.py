"""Print the table of faults in docs/gallery/gate_measured.md.

`python -m studies.mutants [--out FILE] [--only NAME...] [--workers N]`

Canaries are asked first, and the gate about those faults alone that they do not name; with --canaries it is not asked.
What --out holds from an earlier call on the same code and profile is not asked again.
"""

import argparse
import sys
from pathlib import Path

from studies.mutants.catalogue import BY_NAME, MUTANTS, UNCHANGED
from studies.mutants.further import FURTHER
from studies.mutants.judging import Judged, run

ANSWERS = Path("reports/studies/mutants.jsonl")
"""Answers of earlier calls, where --out names no other file."""


def table(found: list[Judged]) -> str:
    """Return the table of who names each mutant, and a last line that counts them."""
    lines = [("fault", "kind", "named by", "other alarms"), ("---",) * 4]
    planted = [each for each in found if each.mutant is not UNCHANGED]
    for each in planted:
        by = each.naming or [f"gate: {quantity}" for quantity in (each.worse or ())[:3]]
        all_others = each.others + [f"gate: {alarm}" for alarm in each.alarms if alarm not in (each.worse or ())]
        others = ", ".join(all_others[:4]) + (f" and {len(all_others) - 4} more" * (len(all_others) > 4))
        lines.append((each.mutant.name, each.mutant.kind, ", ".join(by) or each.stopped or "nobody", others))
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    named, seen = sum(each.by_name for each in planted), sum(each.is_seen for each in planted)
    control = next((each for each in found if each.mutant is UNCHANGED), None)
    return f"{text}\n\n{named} of {len(planted)} named, {seen} seen; alarms on unchanged code: {_alarms(control)}."


def _alarms(control: Judged | None) -> str:
    """Return the alarms that unchanged code raised, by name."""
    if control is None:
        return "not asked"
    canaries = control.naming + control.others
    told = [
        f"{len(canaries)} canaries",
        "the gate not asked" if control.worse is None else f"{len(control.alarms)} of the gate",
    ]
    names = canaries + control.alarms + [control.stopped] * bool(control.stopped)
    return ", ".join(told) + (f" ({', '.join(names)})" if names else "")


def main(arguments: list[str]) -> int:
    """Plant the mutants and print the table; 1 where one is named by nobody, or unchanged code raises an alarm."""
    parser = argparse.ArgumentParser(prog="python -m studies.mutants", description=__doc__)
    parser.add_argument("--out", type=Path, default=ANSWERS, help=f"JSON lines, one an answer; default: {ANSWERS}")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="of mutants, as the table has them")
    parser.add_argument("--workers", type=int, default=2, help="mutants at once (default 2)")
    parser.add_argument("--canaries", action="store_true", help="leave out the gate")
    parser.add_argument("--further", action="store_true", help="the ten faults that no canary was made for")
    parser.add_argument("--profile", default="quick", help="of the gate's nights, a name or a path (default quick)")
    options = parser.parse_args(arguments)
    names = options.only or [mutant.name for mutant in (FURTHER if options.further else MUTANTS)]
    if unknown := next((name for name in names if name not in BY_NAME), None):
        print(f"mutant {unknown!r}: unknown; must be a name of studies/mutants/catalogue.py", file=sys.stderr)
        return 2
    profile = None if options.canaries else options.profile
    found = run(names, options.out, options.workers, lambda line: print(line, file=sys.stderr, flush=True), profile)
    print(table(found))
    return 0 if all(each.as_wanted for each in found) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
