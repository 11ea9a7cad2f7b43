"""The gate's verdict on nights that were made up: every kind of change has its stated outcome."""

import numpy as np
import polars as pl
import pytest
from gate_nights import changed, night, raised, rows, whole

from simtest.nightly.compare import compare
from simtest.nightly.quantities import digests_of, setting_figures
from simtest.nightly.records import COMPARISONS, FIGURES, OUTCOMES, POOLED
from tests.marked import marked

FIRST_12 = pl.col("realisation") < 12


def one(verdict, quantity, **cell):
    found = verdict.comparisons.filter(pl.col("quantity") == quantity, setting=cell.pop("setting", "a"), **cell)
    assert found.height == 1, verdict.comparisons
    return found.row(0, named=True)


def test_the_same_night_is_the_same_without_a_test():
    table = rows(estimators=("cone_axis", "circle_pose"), settings=("a", "b"))
    verdict = compare(night(table), night(table.sample(fraction=1, shuffle=True, seed=3)))
    assert (verdict.state, verdict.bit_equal, verdict.notes) == ("fine", True, ())
    assert set(verdict.comparisons["outcome"]) == {"same"}
    assert set(verdict.comparisons["method"]) == {"equal"}
    assert verdict.comparisons["p"].null_count() == verdict.comparisons.height


def test_a_rise_of_one_estimator_is_worse_and_of_no_other():
    table = rows(estimators=("cone_axis", "circle_pose"), settings=("a", "b"))
    verdict = compare(night(raised(table, 1.1)), night(table))
    assert verdict.state == "regression"
    assert not verdict.bit_equal
    assert set(verdict.regressions["estimator"]) == {"cone_axis"}
    assert set(verdict.regressions["quantity"]) == {"mean_deg"}
    row = one(verdict, "mean_deg", estimator="cone_axis")
    assert row["difference"] == pytest.approx(0.1 * row["baseline"])
    assert row["low"] < row["difference"] < row["high"]
    assert row["margin"] == pytest.approx(0.02 * row["baseline"])
    assert (row["method"], row["n"]) == ("paired", 20)
    better = compare(night(table), night(raised(table, 1.1)))
    assert (better.state, better.exit_code, better.regressions.height) == ("changed", 1, 0)
    assert one(better, "mean_deg", estimator="cone_axis")["outcome"] == "better"
    assert set(better.unexplained["estimator"]) == {"cone_axis"}


def test_a_rise_within_the_margin_is_equivalent():
    small = rows(level=0.01)
    assert one(compare(night(raised(small, 1.1)), night(small)), "mean_deg")["outcome"] == "equivalent"
    large = rows()
    assert one(compare(night(raised(large, 1.015)), night(large)), "mean_deg")["outcome"] == "equivalent"


def test_another_rounding_is_equivalent_and_said():
    table = rows()
    verdict = compare(night(raised(table, 1 + 1e-7), processor="two"), night(table))
    assert verdict.state == "fine"
    assert set(verdict.comparisons["outcome"]) == {"equivalent"}
    assert verdict.notes[0] == "The processor changed from one to two."
    assert verdict.notes[1].startswith("Medians agree to 0.001 deg in 1 of 1 cells")
    assert "0 differ in status" in verdict.notes[2]


def test_answers_that_fail_do_not_vanish():
    table = rows()
    failed = changed(table, FIRST_12, status="no_closed_isophote", error_deg=None, mahalanobis2=None, axis_ratio=None)
    verdict = compare(night(failed), night(table))
    assert one(verdict, "unanswered")["outcome"] == "worse"
    assert one(verdict, "unanswered")["tonight"] == pytest.approx(0.6)
    assert one(verdict, "mean_penalised_deg")["difference"] == pytest.approx(0.6 * 90, abs=1)
    assert one(verdict, "mean_penalised_deg")["outcome"] == "worse"
    # Of those that both nights answered, nothing changed.
    assert one(verdict, "mean_deg")["outcome"] == "equivalent"
    assert "12 differ in status, 12 of them answered in the baseline alone and 0 tonight alone" in verdict.notes[-1]


def test_a_cell_without_any_result():
    table = rows()
    none = changed(table, True, status="no_peak", error_deg=None, mahalanobis2=None, axis_ratio=None)
    gone = compare(night(none), night(table))
    assert one(gone, "mean_deg")["outcome"] == "gone"
    assert one(gone, "coverage95")["outcome"] == "gone"
    assert one(gone, "unanswered")["outcome"] == "worse"
    other = changed(none, FIRST_12, status="missed")
    both = compare(night(other), night(none))
    assert both.state == "changed"
    assert set(both.unexplained["quantity"]) == {"missed", "single answers"}
    assert one(both, "unanswered")["outcome"] == "equivalent"
    assert one(both, "mean_penalised_deg")["difference"] == 0
    assert both.comparisons.filter(quantity="mean_deg").is_empty()


def test_an_error_that_is_no_number_is_no_answer():
    table = rows()
    broken = changed(table, FIRST_12, error_deg=float("nan"))
    verdict = compare(night(broken), night(table))
    assert one(verdict, "unanswered")["tonight"] == pytest.approx(0.6)
    assert np.isfinite(one(verdict, "mean_penalised_deg")["tonight"])


def test_answers_whose_errors_are_no_numbers_are_lost_in_one_realisation_too():
    table = rows(count=1, settings=("a", "b"))
    verdict = compare(night(changed(table, pl.col("setting") == "a", error_deg=float("nan"))), night(table))
    row = one(verdict, "single answers")
    assert (row["setting"], row["baseline"], row["tonight"], row["n"], row["outcome"]) == ("a", 1, 0, 1, "worse")
    assert verdict.exit_code == 1


def test_detections_that_no_longer_count_as_on_an_instrument_are_false_ones():
    """All other columns are the same bytes."""
    held = whole(settings=("a",)).with_columns(on_instrument=pl.col("true_id").is_null())
    lost = held.with_columns(on_instrument=pl.lit(False))
    verdict = compare(night(lost), night(held))
    assert (verdict.bit_equal, verdict.exit_code) == (False, 1)
    moved = verdict.comparisons.filter(quantity="single false")
    assert moved["baseline"].to_list() == [0, 0]
    assert moved["tonight"].to_list() == [5, 5]
    # Where nothing lies on an instrument, the column says nothing.
    assert digests_of(lost) == digests_of(whole(settings=("a",)))


def test_counts_are_written_in_full():
    table = rows(count=1234)
    verdict = compare(night(table.filter(pl.col("realisation") != 3)), night(table))
    assert verdict.causes[0].startswith("cone_axis in e, a: the number of true highlights is 1233, was 1234 (worse).")


def test_one_realisation_decides_nothing_but_that_nothing_changed():
    table = rows(count=1)
    verdict = compare(night(raised(table, 2.0)), night(table))
    row = one(verdict, "mean_deg")
    assert (row["outcome"], row["p"], row["low"], row["high"]) == ("undecided", None, None, None)
    assert one(compare(night(raised(table, 1.01)), night(table)), "mean_deg")["outcome"] == "equivalent"


def test_large_rises_of_single_realisations_are_told():
    table = rows(count=1, level=0.01, settings=tuple("abcdefghi"))
    verdict = compare(night(raised(table, 4000.0)), night(table))
    assert set(verdict.comparisons.filter(quantity="mean_deg")["outcome"]) == {"undecided"}
    # Of the same seeds on the same machine each single result is held against itself; elsewhere it is told.
    assert (verdict.state, set(verdict.unexplained["quantity"])) == ("changed", {"single error"})
    elsewhere = compare(night(raised(table, 4000.0), processor="two"), night(table))
    assert elsewhere.state == "fine"
    verdict = elsewhere
    assert verdict.notes[-1].startswith("In 9 cells of one realisation the error rose by more than 10 margins")
    for quiet in (raised(table, 50.0), raised(table, 0.001)):
        assert "of one realisation" not in compare(night(quiet), night(table)).notes[-1]
    assert "of one realisation" not in compare(night(raised(rows(), 40.0)), night(rows())).notes[-1]


def test_many_settings_decide_where_one_cannot():
    settings = tuple("abcdefghijklmnopqrst")
    table = rows(count=1, settings=settings, estimators=("cone_axis", "curved"))
    verdict = compare(night(raised(table, 1.1)), night(table))
    pooled = one(verdict, "mean_deg", setting=POOLED, estimator="cone_axis")
    assert (pooled["outcome"], pooled["unit"], pooled["baseline"]) == ("worse", "x", 1.0)
    assert pooled["tonight"] == pytest.approx(1.1, abs=0.01)
    assert set(verdict.regressions["setting"]) == {POOLED}


def test_cells_that_one_night_lacks():
    table = rows(settings=("a", "b"))
    verdict = compare(night(table.filter(setting="b")), night(table.filter(setting="a")))
    outcomes = dict(verdict.comparisons.select("setting", "outcome").iter_rows())
    assert outcomes == {"a": "worse", "b": "new"}
    assert (verdict.bit_equal, verdict.state) == (False, "regression")
    row = one(verdict, "n")
    assert (row["baseline"], row["tonight"], row["difference"], row["method"]) == (20, 0, -20, "none")
    # More than before does no harm; nothing at all, or other names alone, does.
    assert compare(night(table), night(table.filter(setting="a"))).state == "fine"
    assert compare(night(rows(count=0)), night(table)).state == "regression"
    renamed = compare(night(changed(table, True, experiment="f")), night(table))
    assert (renamed.state, renamed.regressions.height) == ("regression", 2)


def test_highlights_that_are_lost_make_nothing_better():
    table = rows()
    easy = table.filter(pl.col("error_deg") < pl.col("error_deg").median())
    verdict = compare(night(easy), night(table))
    assert verdict.state == "regression"
    assert set(verdict.regressions["quantity"]) == {"n"}
    row = one(verdict, "n")
    assert (row["baseline"], row["tonight"], row["difference"]) == (20, 10, -10)
    # What both nights have is compared pair by pair, and is the same.
    assert (one(verdict, "mean_deg")["method"], one(verdict, "mean_deg")["outcome"]) == ("paired", "equivalent")
    assert one(verdict, "mean_deg")["n"] == 10
    assert "better" not in set(verdict.comparisons["outcome"])
    assert verdict.notes[0].startswith("In 1 cells highlights of the baseline are missing")
    worse = compare(night(raised(easy, 1.1)), night(table))
    assert set(worse.regressions["quantity"]) == {"n", "mean_deg"}


def test_lost_frames_are_no_frames_without_false_detections():
    table = rows()
    find = changed(table, True, true_id=None, specularity=1, error_deg=None, mahalanobis2=None, axis_ratio=None)
    verdict = compare(night(pl.concat([table, find]).filter(~FIRST_12)), night(pl.concat([table, find])))
    row = one(verdict, "false")
    assert (row["n"], row["baseline"], row["tonight"], row["outcome"]) == (8, 1.0, 1.0, "equivalent")


def test_highlights_that_are_lost_beside_new_ones_are_told():
    table = rows()
    moved = changed(table, FIRST_12, true_id=7)
    verdict = compare(night(moved), night(table))
    assert (one(verdict, "n")["outcome"], one(verdict, "n")["tonight"]) == ("worse", 8)
    # New ones alone are judged with all others, unpaired.
    more = compare(night(pl.concat([table, changed(table, True, true_id=7)])), night(table))
    assert (more.state, set(more.comparisons["method"])) == ("fine", {"unpaired"})


def test_with_other_versions_a_loss_is_told_and_not_judged():
    table = rows()
    verdict = compare(night(table.head(15), versions={"numpy": "2.5", "simtest": "0.1"}), night(table))
    assert (verdict.state, one(verdict, "n")["outcome"]) == ("fine", "undecided")


@pytest.mark.parametrize("cause", marked(["seeds", "versions", "more"], ci=["versions", "more"]))
def test_without_exact_pairs_the_test_is_unpaired(cause):
    table, run = rows(), {}
    other = rows(seed=1) if cause == "seeds" else rows(count=25) if cause == "more" else raised(table, 1 + 1e-9)
    if cause == "versions":
        run = {"versions": {"numpy": "2.5", "simtest": "0.1"}}
    verdict = compare(night(other, **run), night(table))
    assert set(verdict.comparisons["method"]) == {"unpaired"}
    assert verdict.state == "fine"
    told = "Versions changed from numpy 2.4 to numpy 2.5" if cause == "versions" else "of 1 cells differ from"
    assert told in verdict.notes[0]
    worse = compare(night(raised(other, 3.0), **run), night(table))
    assert one(worse, "mean_deg")["outcome"] == "worse"
    better = compare(night(raised(other, 0.3), **run), night(table))
    assert one(better, "mean_deg")["outcome"] == "better"


def test_a_new_version_of_simtest_itself_leaves_pairs_pairs():
    table = rows()
    verdict = compare(night(raised(table, 1.1), versions={"numpy": "2.4", "simtest": "0.2"}), night(table))
    assert set(verdict.comparisons["method"]) == {"paired"}
    assert verdict.notes[0] == "Versions changed from simtest 0.1 to simtest 0.2."


def test_another_definition_of_an_experiment_unpairs_its_cells():
    table = pl.concat([rows(), rows(seed=3, experiment="f")])
    known, other = {"e": "1", "f": "1"}, {"e": "2", "f": "1", "g": "9"}
    tonight = changed(raised(table, 1 + 1e-9), (pl.col("experiment") == "e") & FIRST_12, error_deg=0.1)
    verdict = compare(night(tonight, definitions=other), night(table, definitions=known))
    methods = dict(
        verdict.comparisons.filter(quantity="mean_deg", label="l").select("experiment", "method").iter_rows()
    )
    assert methods == {"e": "unpaired", "f": "paired"}
    assert verdict.notes[0] == "The definition of e changed: their cells were compared unpaired."
    # The same bytes all the same: it is said.
    same = compare(night(table, definitions=other), night(table, definitions=known))
    assert (same.bit_equal, len(same.notes)) == (True, 1)
    # What is not known is no change.
    assert compare(night(table, definitions=other), night(table)).notes == ()
    assert compare(night(table), night(table, definitions=known)).notes == ()
    # Fewer highlights by another definition are told, and not judged.
    fewer = night(table.filter(pl.col("realisation") > 2), definitions=other)
    lost = compare(fewer, night(table, definitions=known)).comparisons.filter(quantity="n")
    assert dict(lost.select("experiment", "outcome").iter_rows()) == {"e": "undecided", "f": "worse"}


@pytest.mark.parametrize("key", ["profile", "variant", "llvm", "python"])
def test_what_else_ran_otherwise_is_said(key):
    table = rows()
    verdict = compare(night(table, **{key: "new"}), night(table, **{key: "old"}))
    assert verdict.notes == (f"The {key} changed from old to new.",)
    assert compare(night(table, **{key: "new"}), night(table)).notes == ()


def test_an_experiment_of_another_variant_is_named():
    table, mono, rgb = rows(), {"e": "mono", "f": "mono", "old": "rgb"}, {"e": "rgb", "f": "mono", "new": "rgb"}
    verdict = compare(night(table, variant="mono", variants=rgb), night(table, variant="mono", variants=mono))
    assert verdict.notes == ("The variant of e changed from mono to rgb.",)
    # The change of the whole run's variant is told once; records of older versions have no variants.
    whole_run = compare(night(table, variant="rgb", variants={"e": "rgb"}), night(table, variant="mono", variants=mono))
    assert whole_run.notes == ("The variant changed from mono to rgb.",)
    assert compare(night(table, variants=rgb), night(table)).notes == ()


def test_false_detections_are_counted_by_frames():
    table = rows()
    false = changed(table, True, true_id=None, specularity=1, error_deg=None, mahalanobis2=None, axis_ratio=None)
    verdict = compare(night(pl.concat([table, false])), night(table))
    row = one(verdict, "false")
    assert (row["outcome"], row["baseline"], row["tonight"]) == ("worse", 0.0, 1.0)
    assert set(verdict.regressions["quantity"]) == {"false"}
    assert "20 have another number of detections" in verdict.notes[-1]


def test_coverage_is_worse_where_it_falls():
    table = changed(rows(), True, mahalanobis2=1.0)
    verdict = compare(night(changed(table, FIRST_12, mahalanobis2=50.0)), night(table))
    row = one(verdict, "coverage95")
    assert (row["outcome"], row["baseline"]) == ("worse", 1.0)
    assert row["tonight"] == pytest.approx(0.4)
    assert row["low"] < row["difference"] < row["high"] < 0


@pytest.mark.parametrize("value", [float("nan"), pytest.param(float("inf"), marks=pytest.mark.ci)])
def test_an_uncertainty_that_is_no_number_covers_nothing(value):
    table = changed(rows(), True, mahalanobis2=1.0)
    verdict = compare(night(changed(table, FIRST_12, mahalanobis2=value)), night(table))
    assert set(verdict.regressions["quantity"]) == {"coverage95"}
    assert one(verdict, "coverage95")["tonight"] == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("condition", "share", "lost", "quantity"),
    [
        (FIRST_12, 0.6, "mahalanobis2", "no_region"),
        pytest.param(FIRST_12, 0.6, "axis_ratio", "no_axis_ratio", marks=pytest.mark.ci),
        pytest.param(True, 1.0, "mahalanobis2", "no_region", marks=pytest.mark.ci),
        (True, 1.0, "axis_ratio", "no_axis_ratio"),
    ],
    ids=[
        "some-mahalanobis2-no_region", "some-axis_ratio-no_axis_ratio",
        "all-mahalanobis2-no_region", "all-axis_ratio-no_axis_ratio",
    ],
)  # fmt: skip
def test_an_uncertainty_that_is_no_longer_stated_is_seen(condition, share, lost, quantity):
    table = changed(rows(), True, mahalanobis2=1.0)
    verdict = compare(night(changed(table, condition, **{lost: None})), night(table))
    assert set(verdict.regressions["quantity"]) == {quantity}
    row = one(verdict, quantity)
    assert (row["baseline"], row["tonight"]) == (0, pytest.approx(share))


@pytest.mark.parametrize(
    ("lost", "quantity"),
    [("mahalanobis2", "no_region"), pytest.param("axis_ratio", "no_axis_ratio", marks=pytest.mark.ci)],
)
def test_where_no_uncertainty_was_ever_stated_there_is_none_to_lose(lost, quantity):
    never = changed(rows(), True, **{"mahalanobis2": 1.0, lost: None})
    quiet = compare(night(raised(never, 1 + 1e-9)), night(never))
    assert quantity not in set(quiet.comparisons["quantity"])


def test_an_uncertainty_that_is_not_stated_at_other_seeds_is_seen():
    table = changed(rows(), True, mahalanobis2=1.0)
    fresh = compare(night(changed(rows(seed=1), True, mahalanobis2=None)), night(table))
    assert (one(fresh, "no_region")["outcome"], one(fresh, "no_region")["method"]) == ("worse", "unpaired")


def test_the_axis_ratio_is_held_to_its_law():
    table = rows()
    verdict = compare(night(changed(table, True, axis_ratio=0.6)), night(table))
    assert set(verdict.regressions["quantity"]) == {"axis_ratio"}
    # A law of 0 says nothing.
    flat = changed(table, True, axis_ratio_law=0.0)
    assert compare(night(changed(flat, True, axis_ratio=0.6)), night(flat)).regressions.is_empty()


def test_without_a_baseline_there_is_nothing_to_compare():
    verdict = compare(night(rows()), None)
    assert (verdict.state, verdict.exit_code, verdict.bit_equal, verdict.baseline) == ("no baseline", 0, None, None)
    assert (verdict.comparisons.is_empty(), verdict.notes, verdict.causes) == (True, (), ())


def test_a_find_in_a_frame_without_highlights_leaves_the_others_pairs():
    table = rows()
    find = changed(
        table.head(1), True, realisation=77, seed=77, true_id=None, error_deg=None, mahalanobis2=None, axis_ratio=None
    )
    verdict = compare(night(pl.concat([table, find])), night(table))
    row = one(verdict, "false")
    assert (row["method"], row["n"], row["tonight"]) == ("paired", 21, pytest.approx(1 / 21))
    assert one(verdict, "mean_deg")["n"] == 20


def test_tables_keep_to_their_columns():
    table = rows(estimators=("cone_axis", "curved"))
    figures = setting_figures(table)
    assert dict(figures.schema) == FIGURES
    comparisons = compare(night(raised(table, 1.1)), night(table)).comparisons
    assert dict(comparisons.schema) == COMPARISONS
    assert set(comparisons["outcome"]) <= set(OUTCOMES)
    empty = rows(count=0)
    assert compare(night(empty), night(empty)).state == "fine"


def test_figures_of_a_cell():
    table = rows(count=4)
    table = changed(
        table, pl.col("realisation") == 3, status="missed", error_deg=None, mahalanobis2=None, axis_ratio=None
    )
    table = changed(table, pl.col("realisation") == 0, mahalanobis2=99.0)
    found = setting_figures(table)
    values = dict(found.select("quantity", "value").iter_rows())
    assert (values["n"], values["n_ok"], values["missed"], values["failed"], values["false"]) == (4, 3, 0.25, 0, 0)
    assert values["coverage95"] <= 2 / 3
    assert values["mean_penalised_deg"] == pytest.approx((3 * values["mean_deg"] + 90) / 4)
    share = found.filter(quantity="missed").row(0, named=True)
    # Clopper and Pearson's interval of 1 in 4.
    assert (share["low"], share["high"]) == (pytest.approx(0.0063, abs=1e-4), pytest.approx(0.8059, abs=1e-4))
    assert found["digest"].n_unique() == 1


def test_the_hash_is_that_of_the_numbers():
    table = rows(count=5)
    assert digests_of(table) == digests_of(table.reverse())
    next_number = np.nextafter(table["error_deg"][2], 9)
    assert digests_of(table) != digests_of(changed(table, pl.col("realisation") == 2, error_deg=next_number))
    nothing = changed(table, pl.col("realisation") == 2, choice_margin=0.0)
    assert digests_of(nothing) != digests_of(table)
    assert digests_of(changed(table, True, flags="saturated")) != digests_of(table)
    failed = changed(table, pl.col("realisation") == 1, status="no_peak", flags="12 points")
    assert digests_of(changed(failed, pl.col("status") == "no_peak", flags="13 points")) == digests_of(failed)
    assert digests_of(changed(table, pl.col("realisation") == 1, status="missed")) != digests_of(table)
