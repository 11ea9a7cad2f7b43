"""The faults of the gate's study apply to the source as it is."""

import pytest

from studies.gate.faults import FAULTS, HARMLESS


@pytest.mark.parametrize("name", [*FAULTS, *HARMLESS])
def test_every_planted_change_applies(name):
    for mutation in {**FAULTS, **HARMLESS}[name]:
        assert mutation.code() != mutation.function.__code__
