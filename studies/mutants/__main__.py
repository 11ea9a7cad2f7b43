"""Print the table of docs/gate.md: `python -m studies.mutants [--out FILE] [--only NAME...] [--workers N]`.

Canaries are asked first, and the gate about those faults alone that they do not name; with --canaries it is not asked.
What --out holds from an earlier call is not asked again.
"""

import argparse
import sys
import tempfile
from pathlib import Path

from studies.mutants.catalogue import BY_NAME, MUTANTS, UNCHANGED
from studies.mutants.further import FURTHER
from studies.mutants.judging import Judged, run


def table(found: list[Judged]) -> str:
    """Return the table of who names each mutant, and a last line that counts them."""
    lines = [("fault", "kind", "named by", "other canaries"), ("---",) * 4]
    planted = [each for each in found if each.mutant is not UNCHANGED]
    for each in planted:
        by = each.naming or [f"gate: {quantity}" for quantity in (each.worse or ())[:3]]
        others = ", ".join(each.others[:4]) + (f" and {len(each.others) - 4} more" * (len(each.others) > 4))
        lines.append((each.mutant.name, each.mutant.kind, ", ".join(by) or each.stopped or "nobody", others))
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    named, seen = sum(each.by_name for each in planted), sum(each.is_seen for each in planted)
    control = next((each for each in found if each.mutant is UNCHANGED), None)
    alarms = "not asked" if control is None else f"{len(control.naming + control.others)} canaries"
    return f"{text}\n\n{named} of {len(planted)} named, {seen} seen; alarms on unchanged code: {alarms}."


def main(arguments: list[str]) -> int:
    """Plant the mutants and print the table; 1 where one is named by nobody, or unchanged code raises an alarm."""
    parser = argparse.ArgumentParser(prog="python -m studies.mutants", description=__doc__)
    parser.add_argument("--out", type=Path, help="JSON lines, one an answer; default: in the folder of temporary files")
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
    file = options.out or Path(tempfile.gettempdir()) / "mutants.jsonl"
    profile = None if options.canaries else options.profile
    found = run(names, file, options.workers, lambda line: print(line, file=sys.stderr, flush=True), profile)
    print(table(found))
    return 0 if all(each.by_name != (each.mutant is UNCHANGED) for each in found) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
