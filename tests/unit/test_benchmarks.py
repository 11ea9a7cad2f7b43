"""The benchmarks' own arithmetic: exponents, costs, counts; and that nothing is skipped."""

import importlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import cost, growth
from benchmarks.__main__ import NAMES, ON_REQUEST, main
from benchmarks.measuring import Figure
from simtest.dataset.plan import Plan


@pytest.mark.parametrize("name", ON_REQUEST)
def test_benchmarks_on_request_fit_the_package(name):
    assert callable(importlib.import_module(f"benchmarks.{name}").figures)


def test_an_unknown_benchmark_is_named(capsys):
    assert main(["nope"]) == 2
    assert "benchmark 'nope': unknown" in capsys.readouterr().err
    assert not set(NAMES) & set(ON_REQUEST)


# Growth ----------------------------------------------------------------------------------------------------------


@given(st.floats(0.1, 3.0), st.floats(1e-6, 1e3), st.integers(3, 8))
def test_the_exponent_of_a_power_law_is_found(power, factor, count):
    sizes = [10.0 * 2**i for i in range(count)]
    found = growth.exponent(sizes, [factor * size**power for size in sizes])
    assert found.exponent == pytest.approx(power, abs=1e-9)
    assert found.half_width < 1e-6


def test_the_interval_covers_the_exponent_of_noisy_times():
    rng = np.random.default_rng(0)
    sizes, covered, runs = [2.0**i for i in range(6)], 0, 400
    for _ in range(runs):
        found = growth.exponent(sizes, np.array(sizes) ** 1.1 * rng.lognormal(0, 0.1, len(sizes)))
        covered += abs(found.exponent - 1.1) <= found.half_width
    # 0.95 of 400, 4 standard deviations to either side
    assert 0.905 * runs <= covered <= 0.995 * runs


class Clock:
    """A processor clock that work advances by as much as it is said to cost."""

    def __init__(self):
        self.now = 0.0

    def work(self, seconds):
        def run():
            self.now += seconds

        return run


@pytest.mark.parametrize(("power", "fixed", "met"), [(1.0, 0.0, True), (1.5, 0.0, False), (1.5, 500.0, False)])
def test_growth_beyond_the_limit_is_missed_even_under_a_fixed_cost(monkeypatch, power, fixed, met):
    clock = Clock()
    monkeypatch.setattr(growth.time, "process_time", lambda: clock.now)
    sizes = [16.0, 64.0, 256.0, 1024.0, 4096.0]

    class Works:
        def __enter__(self):
            return {size: clock.work(fixed + size**power) for size in sizes}

        def __exit__(self, *_):
            return None

    figure = growth.grow(growth.Piece("work", "things", Works), rounds=1).figure
    assert figure.met is met
    assert figure.value == pytest.approx(power, abs=0.3 if fixed else 1e-9)


# Cost ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def measured():
    plan = Plan(cost.recipes()["smooth"])
    return cost.Measured(np.array([1.0, 2.0]), np.array([10.0]), 1.5e6, 1e-3, plan)


def test_the_cost_model_is_what_the_measured_times_say(measured):
    assert measured.sample_s == 1.5 + 10 / 20
    assert cost.hours(measured) == pytest.approx(2e7 / 3600)
    assert cost.price(measured) == pytest.approx(2e7 / 3600 * cost.CORE_HOUR + 15 * cost.TB_MONTH)
    text = {row[0]: row[1] for row in cost.table({"it": measured})}
    assert text["10^7 samples: core hours"] == "5,556"
    assert text["10^7 samples: TB"] == "15.0"
    assert text["10^7 samples: shards"] == f"{-(-(10**7) // measured.plan.samples_per_shard):,}"


def test_tables_by_one_process_count_against_many_workers(measured):
    # 1 ms a sample alone, 2 ms shared by a thousand
    assert cost.alone(measured) == pytest.approx(1 / 3)


def test_anatomies_are_timed_in_the_families_shares():
    plan = Plan(cost.recipes()["smooth"])
    blocks = cost._blocks(plan, 3)
    families = [plan.anatomy(block * plan.dataset.samples_per_anatomy).family for block in blocks]
    assert sorted(families) == [0, 0, 1]
    assert len(set(blocks)) == 3


# Nothing is skipped ----------------------------------------------------------------------------------------------


def test_figures_keep_or_miss_their_limits():
    assert Figure("x", 1.0, 1.0).met
    assert not Figure("x", 1.1, 1.0).met
    assert not Figure("x", float("nan"), 1.0).met
