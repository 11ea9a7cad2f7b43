"""The gate says of sixty pairs of made-up nightly runs what it said when they were stored."""

import json

import pytest
from gate_pairs import FILE, NAMES, summary, verdicts

STORED = json.loads(FILE.read_text(encoding="utf-8"))


def test_there_are_sixty_pairs_of_every_outcome():
    pairs = [one for conditions in STORED.values() for one in conditions.values()]
    assert len(pairs) == 60
    assert {one["state"] for one in pairs} == {"fine", "changed", "regression"}
    outcomes = {text.split()[0] for one in pairs for text in one["outcomes"]}
    assert outcomes >= {"same", "equivalent", "undecided", "better", "changed", "worse", "new"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.ci) if i % 3 else name for i, name in enumerate(NAMES)]
)
def test_outcomes_of_pairs_stay(name):
    for condition, verdict in verdicts(name).items():
        said, stored = summary(verdict), STORED[name][condition]
        assert said.pop("p_holm") == pytest.approx(stored.pop("p_holm"), rel=1e-5), condition
        assert said == stored, condition
