"""Print the tables of docs/measured/gate.md: `python -m studies.gate [SECTION]...`, all sections by default.

The bank of 20,400 realisations takes 10
minutes of processor time and is kept in the folder that GATE_BANK names (default: gate-bank in the system's folder for
temporary files).
"""

import sys
from collections.abc import Callable

from studies.gate import proof
from studies.gate.bank import frames_of, load_bank


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _percent(rate: proof.Rate) -> str:
    return f"{100 * rate.share:.1f} % ({rate.alarms} of {rate.nights})"


def alarms() -> str:
    """Return the table of false alarms on fresh seeds."""
    bank = load_bank(proof.bank_folder())
    rows = [(rate.name, _percent(rate), rate.about) for rate in proof.false_alarms(bank)]
    return f"{frames_of(bank)} realisations in the bank.\n\n" + _table(("fresh seeds", "false alarms", "tests"), rows)


def harmless() -> str:
    """Return the table of false alarms on changes that do no harm."""
    rates = proof.harmless()
    return _table(("change", "false alarms", "size"), [(rate.name, _percent(rate), rate.about) for rate in rates])


def rises() -> str:
    """Return the table of a rise of one estimator's errors."""
    found = proof.rises(load_bank(proof.bank_folder()))
    rows = [(paired.name, _percent(paired), _percent(fresh), paired.about) for paired, fresh in found]
    return _table(("estimator", "seen, same seeds", "seen, fresh seeds", "10 % is beyond the margin in"), rows)


def faults() -> str:
    """Return the table of planted faults."""
    rows = []
    for caught in proof.faults():
        laws = ", ".join(caught.laws[:3]) + f" and {len(caught.laws) - 3} more" * (len(caught.laws) > 3)
        stops = "; the night stops" if caught.stops else ""
        rows.append((caught.name + stops, laws or "none", _percent(caught.paired), _percent(caught.fresh)))
    return _table(("planted fault", "laws that do not hold", "gate, same seeds", "gate, fresh seeds"), rows)


SECTIONS: dict[str, Callable[[], str]] = {
    "alarms": alarms, "harmless": harmless, "rises": rises, "faults": faults,
}  # fmt: skip


def main(names: list[str]) -> int:
    """Print some sections, all by default."""
    if unknown := next((name for name in names if name not in SECTIONS), None):
        print(f"section {unknown!r}: unknown; must be one of {', '.join(SECTIONS)}", file=sys.stderr)
        return 2
    for name in names or SECTIONS:
        print(SECTIONS[name](), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
