"""The seed tree to the letter: stored runs and datasets are made again by it."""

import pytest

from simtest.runtime.seeds import Stage, from_integer, generator, integer, key
from simtest.spec.recipes import Distribution


def test_the_seed_tree_is_that_of_every_release():
    place = (7, "overview", "plane", 3, Stage.SENSOR)
    assert key("overview") == 11416273768129411606
    assert integer(*place) == 2421970951038761668
    assert generator(*place).integers(2**63, size=2).tolist() == [3954648001182531059, 2709375692794661143]
    assert from_integer(5).integers(2**63) == 6307306053231797772
    assert [stage.value for stage in Stage] == [0, 1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    ("form", "values"),
    [
        ({"low": 1, "high": 2}, [1.2515898007485415, 1.7324999133472123, 1.0566206926376902]),
        ({"low": 1, "high": 100, "log": True}, [3.185514611703684, 29.17425849799716, 1.297900456774583]),
        ({"low": 1, "high": 6, "integer": True}, [2, 2, 1]),
        ({"low": 1, "high": 1000, "integer": True, "log": True}, [5, 157, 1]),
        ({"choose": ("a", "b", "c"), "weights": (1, 2, 1)}, ["b", "b", "a"]),
    ],
)
def test_a_recipe_draws_what_every_release_draws(form, values):
    rng = from_integer(11)
    assert [Distribution(**form).draw(rng) for _ in range(3)] == values
