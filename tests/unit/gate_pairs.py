"""Sixty pairs of made-up nightly runs, and what the gate says of each: `python tests/unit/gate_pairs.py` stores it.

The pairs are the edits of `studies.gate.edits`, each against the run as it was, at other seeds, by other versions, and
with the two runs exchanged. What is stored is the verdict of the code at the time: run it only where the gate's rules
were changed on purpose.
"""

import json
from collections import Counter
from pathlib import Path

import numpy as np
from gate_nights import RUN, night, whole

from simtest.nightly.compare import compare
from studies.gate.edits import EDITS

FILE = Path(__file__).with_suffix(".json")
LEFT_OUT = "normals replaced by the truth"
"""No quantity is made of the normals: its verdicts are those of the run as it was."""

NAMES = [name for name in EDITS if name != LEFT_OUT]
OTHER_VERSIONS = {"versions": {**RUN["versions"], "numpy": "3.0"}}


def verdicts(name):
    """Return the four verdicts on an edit, by condition."""
    table, other = whole(), whole(seed=1)
    changed = EDITS[name](table, np.random.default_rng(0))
    tonight, base = night(changed), night(table)
    return {
        "same seeds": compare(tonight, base),
        "other seeds": compare(tonight, night(other)),
        "other versions": compare(night(changed, **OTHER_VERSIONS), base),
        "exchanged": compare(base, tonight),
    }


def summary(verdict):
    """Return what is stored of a verdict: state, outcomes by quantity, the surest test, notes and causes."""
    rows = verdict.comparisons.select("outcome", "quantity", "method").rows()
    outcomes = Counter(" ".join(row) for row in rows)
    p = verdict.comparisons["p_holm"].drop_nulls()
    return {
        "state": verdict.state,
        "bit_equal": verdict.bit_equal,
        "outcomes": dict(sorted(outcomes.items())),
        "p_holm": [float(f"{value:.6g}") for value in (p.min(), p.sum())] if len(p) else [],
        "notes": len(verdict.notes),
        "causes": len(verdict.causes),
    }


if __name__ == "__main__":
    stored = {name: {key: summary(one) for key, one in verdicts(name).items()} for name in NAMES}
    FILE.write_text(json.dumps(stored, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
