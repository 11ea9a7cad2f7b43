"""The study of one light: its negative control is one."""

import pytest

from studies import one_light


def rows(before):
    row = {"kind": "glint", "held": 1.0, "held_before": 1.0, "stated": 2.0, "before": before, "error": 1.0, "frame": 0}
    return [{**row, "told": "range", "organ": "colon", "slope": 2, "clipped": "no", "crowd": "many", "radius": 2.0}]


def test_a_control_that_equals_what_it_controls_is_told():
    with pytest.raises(SystemExit, match="does not take the part for near misses away"):
        one_light.report(rows(2.0))
    assert one_light.report(rows(0.5)) in (0, 1)
