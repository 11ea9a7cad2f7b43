"""The seed tree to the letter: stored runs and datasets are made again by it."""

from simtest.runtime.seeds import Stage, from_integer, generator, integer, key


def test_the_seed_tree_is_that_of_every_release():
    place = (7, "overview", "plane", 3, Stage.SENSOR)
    assert key("overview") == 11416273768129411606
    assert integer(*place) == 2421970951038761668
    assert generator(*place).integers(2**63, size=2).tolist() == [3954648001182531059, 2709375692794661143]
    assert from_integer(5).integers(2**63) == 6307306053231797772
    assert [stage.value for stage in Stage] == [0, 1, 2, 3, 4, 5, 6]
