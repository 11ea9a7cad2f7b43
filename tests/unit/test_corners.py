"""The study of corners: its array holds all pairs, planted faults are found, and some scenes are right."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from studies.corners import __main__ as command
from studies.corners import checks, formulas
from studies.corners.case import Case
from studies.corners.coverage import Answer, share_by_scene, table
from studies.corners.scenes import FACTORS, MESH, SMOOTH, refusals, rows

QUICK = ("law", "projection", "surface", "search", "mirror", "turn", "answers", "calibration")


def test_every_pair_that_is_not_refused_is_in_a_row_and_no_other():
    refused, array = refusals(), rows()
    assert 0 < len(refused) < 10
    for first, second in combinations(FACTORS, 2):
        for a in FACTORS[first]:
            for b in FACTORS[second]:
                held = sum(row[first] == a and row[second] == b for row in array)
                assert (held == 0) == (((first, a), (second, b)) in refused), (first, a, second, b)
    assert all(list(row) == list(FACTORS) and all(row[name] in FACTORS[name] for name in FACTORS) for row in array)


def a_smooth_row(**levels):
    """Return the number of the first row of a smooth surface without relief and instruments with these levels."""
    wanted = {"relief": "none", **levels}
    return next(
        i for i, row in enumerate(rows())
        if row["surface"] in SMOOTH and all(row[name] == level for name, level in wanted.items())
    )  # fmt: skip


@pytest.fixture(scope="module")
def case():
    number = a_smooth_row()
    made = Case(number, rows()[number])
    yield made
    made.close()


@pytest.mark.render
@pytest.mark.parametrize("check", QUICK)
def test_a_smooth_scene_is_right(case, check):
    verdict, reasons = checks.run(check, case)
    assert verdict == "green", reasons


@pytest.mark.render
@pytest.mark.skipif(not MESH.is_file(), reason="needs ../shared/data/meshes")
def test_a_turned_camera_finds_the_glints_of_a_mesh_whose_steps_fall_slowly():
    made = Case(1, rows()[1])
    verdict, reasons = checks.run("turn", made)
    made.close()
    assert verdict == "green", reasons


@pytest.mark.render
def test_a_turned_normal_and_a_moved_highlight_are_red(case, monkeypatch):
    good = case.seen.highlights[0]
    tilted = formulas.unit(good.normal + np.array([0, 1e-4, 0]))
    for check, bad in (
        ("law", replace(good, normal=tilted)),
        ("projection", replace(good, bp_px=good.bp_px + 1e-3)),
        ("search", replace(good, bp_px=good.bp_px + 3)),
        ("mirror", replace(good, kd_max=good.kd_max + 0.01)),
        ("turn", replace(good, why_not="in shadow")),
    ):
        monkeypatch.setattr(case, "seen", replace(case.seen, highlights=[bad]))
        assert checks.run(check, case)[0] == "red", check
        monkeypatch.undo()


@pytest.mark.render
def test_wrong_depths_and_normals_are_red(case, monkeypatch):
    truth = case.truth
    tilted = formulas.unit(truth.normal_base + np.array([1e-4, 0, 0]))
    for wrong in ({"depth": truth.depth * 1.001}, {"normal_base": tilted}, {"k_min_base": truth.k_min_base + 1e-3}):
        monkeypatch.setattr(case, "truth", replace(truth, **wrong))
        assert checks.run("surface", case)[0] == "red", list(wrong)
        monkeypatch.undo()


def test_an_exception_is_one_red_line_and_a_refusal_is_none(case, monkeypatch):
    from simtest.errors import InputError

    def broken(_):
        raise KeyError("nothing")

    def refused(_):
        raise InputError("key = 1: must be 2")

    monkeypatch.setitem(checks.CHECKS, "law", broken)
    assert checks.run("law", case) == ("red", ["KeyError: 'nothing'"])
    monkeypatch.setitem(checks.CHECKS, "law", refused)
    assert checks.run("law", case) == ("refused", ["key = 1: must be 2"])


def answers(inside, outside, **given):
    """Return answers of one scene each: so many whose region holds the truth, and so many whose does not."""
    flags = [True] * inside + [False] * outside
    plain = {"estimator": "cone_axis", "matched": True, "smooth": True, "error_deg": 1.0, "reported_deg": 1.0}
    return [Answer(scene=(i % 60, i), inside=flag, **(plain | given)) for i, flag in enumerate(flags)]


def test_coverage_is_red_below_its_least_and_counts_scenes():
    count, scenes, share, low, high = share_by_scene(answers(90, 10))
    assert (count, scenes, share) == (100, 100, 0.9)
    # As wide as Wilson's at least, and no wider than both ways together.
    assert low == pytest.approx(formulas.wilson(90, 100)[0], abs=0.01)
    assert high == pytest.approx(0.9 + 1.96 * 0.03, abs=0.01)
    assert not table(answers(95, 5), rows())[1]
    assert any("coverage of all" in fault for fault in table(answers(85, 15), rows())[1])
    # Twenty answers of one scene are one.
    assert share_by_scene([each._replace(scene=(0, 0)) for each in answers(20, 0)])[1] == 1


def test_wrong_and_sure_is_red():
    sure = answers(100, 0, error_deg=6.0, reported_deg=1.0)
    assert any("wrong and sure" in fault for fault in table(sure, rows())[1])
    assert not table(answers(100, 0, error_deg=6.0, reported_deg=3.0), rows())[1]


@pytest.mark.ci
@pytest.mark.render
def test_the_command_prints_its_tables(capsys):
    number = a_smooth_row()
    assert command.main(["--only", str(number), "--checks", "law", "coverage", "--draws", "1"]) in (0, 1)
    printed = capsys.readouterr().out
    assert "| law | 1 | 0 | 0 | 0 |" in printed
    assert "| wrong and sure |" in printed


@pytest.mark.slow
@pytest.mark.render
def test_all_corners_are_right(capsys):
    assert command.main([]) == 0, capsys.readouterr().out
