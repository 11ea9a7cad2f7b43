"""Plant faults one at a time, and say which test catches each.

`python -m studies.mutants --tests [--only ROOM or NAME...] [--workers N]` runs for each row of studies/mutants/rows.py
the tests that could see it: first on sound code, where they must pass, then with the fault, where one must fail. Who
caught what is written to studies/mutants/caught.json. Without --tests that table is printed.
"""

import argparse
import sys

from studies.mutants.judging import GuardError, is_caught, judge, read_table, write_table
from studies.mutants.rows import BY_NAME, ROWS, Row


def chosen(names: list[str]) -> list[Row]:
    """Return the rows of some sections of the package, or of some names; all without a name."""
    rooms = {row.room for row in ROWS}
    if unknown := next((name for name in names if name not in BY_NAME and name not in rooms), None):
        raise LookupError(f"--only {unknown}: unknown; allowed: {', '.join(sorted(rooms))}, or the name of a fault")
    return [row for row in ROWS if not names or row.name in names or row.room in names]


def table(rows: list[Row], caught: dict[str, str]) -> str:
    """Return who caught each fault, and a last line that counts them."""
    lines = [("fault", "section", "kind", "caught by"), ("---",) * 4]
    lines += [(row.name, row.room, row.kind, caught.get(row.name, "not asked")) for row in rows]
    seen = sum(is_caught(caught.get(row.name)) for row in rows)
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + f"\n\n{seen} of {len(rows)} caught."


def main(arguments: list[str]) -> int:
    """Print the table; return 1 where nobody catches a fault, 2 where the tests or a fault cannot be run."""
    parser = argparse.ArgumentParser(prog="python -m studies.mutants", description=__doc__)
    parser.add_argument("--tests", action="store_true", help="run the tests, and renew studies/mutants/caught.json")
    parser.add_argument("--only", nargs="+", default=[], metavar="ROOM", help="sections of the package, or names")
    parser.add_argument("--workers", type=int, default=2, help="faults at once (default 2)")
    options = parser.parse_args(arguments)
    caught = read_table()
    try:
        rows = chosen(options.only)
        if options.tests:
            known = caught
            for row, who in judge(rows, options.workers):
                print(f"{row.room}: {row.name}: {who}", file=sys.stderr, flush=True)
                known = {**known, row.name: who}
                write_table(ROWS, known)
            caught = known
    except (LookupError, GuardError) as error:
        print(error, file=sys.stderr)
        return 2
    print(table(rows, caught))
    return int(not all(is_caught(caught.get(row.name)) for row in rows))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
