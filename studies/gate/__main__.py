"""Print the tables of docs/gallery/gate_measured.md: `python -m studies.gate [SECTION]...`, all sections by default."""

import sys
from collections.abc import Callable

from benchmarks.measuring import print_figures
from simtest.nightly.gate.judged import COLUMNS, SUMMARY, Judged, NotJudged
from studies.gate import figures, proof
from studies.gate.bank import frames_of, load_bank
from studies.gate.edits import night_folder, of_last_night, of_the_bank, said, told


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
    rows = [(paired.name, _percent(paired), _percent(fresh), paired.about) for paired, fresh, _ in found]
    return _table(("estimator", "seen, same seeds", "seen, fresh seeds", "10 % is beyond the margin in"), rows)


def faults() -> str:
    """Return the table of planted faults."""
    rows = []
    for caught in proof.faults():
        canaries = ", ".join(caught.canaries[:3]) + (
            f" and {len(caught.canaries) - 3} more" * (len(caught.canaries) > 3)
        )
        stops = "; the night stops" if caught.stops else ""
        rows.append((caught.name + stops, canaries or "none", _percent(caught.paired), _percent(caught.fresh)))
    return _table(("planted fault", "canaries that fail", "gate, same seeds", "gate, fresh seeds"), rows)


def noise() -> str:
    """Return the table of the canaries that hold noise."""
    sound, reused = proof.noise_canaries()
    return _table(("canaries of noise", "fail"), [("code as it is", _percent(sound)), (reused.name, _percent(reused))])


def edits() -> str:
    """Return the table of results that were edited without touching the code."""
    night, drawn = of_last_night(night_folder()), of_the_bank(load_bank(proof.bank_folder()), proof.N)
    rows = [
        (one.name, said(one, one.same), said(other, other.same), said(other, other.fresh), told(one.same))
        for one, other in zip(night, drawn, strict=True)
    ]
    fine = [row[0] for row in rows[1:] if row[1] in ("fine", "-")]
    lines = (
        f"{len(rows) - 1 - len(fine)} of {len(rows) - 1} edits of the night are not called fine, of the same seeds.\n"
    )
    head = ("edit", "quick night, same seeds", "drawn night, same seeds", "drawn night, other seeds", "first cause")
    return lines + "\n" + _table(head, rows)


def judged() -> str:
    """Return the tables of what is judged, and of what is not and why."""
    made = []
    for title, table in {"results.parquet": COLUMNS, "summary.json": SUMMARY}.items():
        own = [(name, entry) for name, entry in table.items() if isinstance(entry, Judged)]
        rest = [(name, entry) for name, entry in table.items() if isinstance(entry, NotJudged)]
        made.append(f"{len(own)} of {len(table)} of {title} are judged, {len(rest)} are not.\n")
        made.append(_table((title, "judged by", "limit"), [(f"`{name}`", e.quantity, e.limit) for name, e in own]))
        by_reason: dict[str, list[str]] = {}
        for name, entry in rest:
            by_reason.setdefault(entry.reason, []).append(f"`{name}`")
        made.append(_table((title, "not judged, for"), [(", ".join(n), reason) for reason, n in by_reason.items()]))
    return "\n".join(made)


SECTIONS: dict[str, Callable[[], str]] = {
    "alarms": alarms, "harmless": harmless, "rises": rises, "faults": faults, "noise": noise,
    "edits": edits, "judged": judged,
}  # fmt: skip


def main(names: list[str]) -> int:
    """Print some sections, all by default."""
    if names == ["figures"]:
        return print_figures(figures())
    if unknown := next((name for name in names if name not in SECTIONS), None):
        print(f"section {unknown!r}: unknown; must be one of {', '.join(SECTIONS)}", file=sys.stderr)
        return 2
    for name in names or SECTIONS:
        print(SECTIONS[name](), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
