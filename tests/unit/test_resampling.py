"""The bootstrap over groups that the studies share."""

import numpy as np

from studies.resampling import drawn_groups, interval_of_mean

DRAWS, SEED = 2000, 2026


def test_each_draw_takes_as_many_groups_as_there_are():
    drawn = drawn_groups(5, 400, 1)
    assert drawn.shape == (400, 5)
    assert np.array_equal(np.unique(drawn), np.arange(5))
    assert np.array_equal(drawn, drawn_groups(5, 400, 1))


def test_a_group_is_drawn_with_all_its_values():
    groups = np.array([7, 7, 7, 2, 9, 9])
    values = np.array([1.0, 2.0, 3.0, -4.0, 0.5, 1.5])
    by_hand = [
        np.concatenate([values[groups == np.array([2, 7, 9])[k]] for k in row]).mean()
        for row in np.random.default_rng(SEED).integers(3, size=(DRAWS, 3))
    ]
    assert np.allclose(interval_of_mean(values, groups, DRAWS, SEED), np.percentile(by_hand, [2.5, 97.5]))


def test_the_interval_holds_where_values_of_a_group_are_alike_and_values_taken_alone_do_not():
    rng = np.random.default_rng(3)
    groups = np.repeat(np.arange(40), rng.integers(1, 15, 40))
    held = {"groups": 0, "values": 0}
    for seed in range(200):
        values = rng.normal(size=40)[groups] + 0.1 * rng.normal(size=len(groups))
        for name, own in (("groups", groups), ("values", np.arange(len(groups)))):
            low, high = interval_of_mean(values, own, 300, seed)
            held[name] += low < 0 < high
    # Of 200, 95 % are 190 (deviation 3); few groups and the percentile method cost some 2 %.
    assert held["groups"] >= 176
    assert held["values"] < 140
