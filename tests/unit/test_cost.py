"""Costs of a night: what gives no answer is not fast."""

from types import SimpleNamespace

import polars as pl
import pytest

from simtest.errors import Failure, Reason
from simtest.nightly import cost
from simtest.reconstruction.pipeline import reconstruct


@pytest.fixture
def frame_pieces(monkeypatch):
    """Have pieces of a frame without rendering: a highlight in a frame of its own."""
    patch, camera = cost.highlight()

    def pieces(variant):
        return {"reconstruct": lambda: reconstruct(patch.raw, camera)}

    monkeypatch.setattr(cost, "_frame_pieces", pieces)
    return pieces


def test_every_piece_has_an_answer(frame_pieces):
    found = cost.run_times(rounds=2)
    times = found.filter(kind="cost")
    assert set(times["estimator"]) == {"circle_pose", "cone_axis", "curved", "photometric", "reconstruct"}
    assert (times["value"] > 0).all()
    assert times["n"].to_list() == [2] * 5
    (canary,) = found.filter(kind="canary").to_dicts()
    assert (canary["experiment"], canary["value"], canary["n"], canary["passed"]) == ("costs", 0.0, 5, True)


def test_a_piece_that_fails_is_not_timed_as_a_fast_one(frame_pieces, monkeypatch):
    broken = SimpleNamespace(estimate=lambda *_: Failure(Reason.NO_PEAK, "broken"))
    monkeypatch.setattr(cost, "cone_axis", broken)
    monkeypatch.setattr(cost, "reconstruct", lambda *_: [], raising=True)
    monkeypatch.setattr(cost, "_frame_pieces", lambda _: {"reconstruct": lambda: cost.reconstruct()})
    found = cost.run_times(rounds=2)
    idle = found.filter(pl.col("kind") == "cost", pl.col("value").is_null())
    assert idle["estimator"].to_list() == ["cone_axis", "reconstruct"]
    assert "broken" in idle["about"][0]
    (canary,) = found.filter(kind="canary").to_dicts()
    assert (canary["value"], canary["passed"]) == (2.0, False)
    assert "cone_axis" in canary["about"]
