"""Which method a run recommends, and where it breaks: situations, figures, words, terminal."""

import io
import json
from itertools import groupby
from pathlib import Path
from typing import get_args

import numpy as np
import polars as pl
import pytest
from test_report import make_run

from simtest.estimators.names import DESCRIPTIONS
from simtest.report import write_report
from simtest.report.guide_text import answers, guide_content, guide_rows, method_rows, practice, seen_sentence
from simtest.report.run_folder import read_run
from simtest.report.tables import pairs
from simtest.runtime.statistics import median_interval
from simtest.spec import Experiment, load_experiment, load_scene
from simtest.spec.lights import LightSpec, Rig
from simtest.spec.reflectance import Reflectance
from simtest.spec.sensor import Sensor
from simtest.spec.spec_model import validate
from simtest.validation.cases import expand
from simtest.validation.comparison import LEAST_FRAMES
from simtest.validation.guide import guide_of
from simtest.validation.run_summary import summarise_run
from simtest.validation.situations import conditions, conditions_of

ROOT = Path(__file__).parents[2]
FLAT = {"kd_min": 0.0, "kd_max": 0.0, "eps_over_d": 0.0, "surface": "plane"}


TUBE = FLAT | {"kd_max": 1.0, "surface": "cylinder"}


def rows_of(estimator, errors, setting="a", label="one", first=0, **more):
    """Rows of one estimator: an error for each realisation, None for a failure, "missed" for a miss."""
    return [
        {
            "experiment": "made", "setting": setting, "label": label, "realisation": first + index, "true_id": 0,
            "estimator": estimator, "n_lights": 1,
            "status": "missed" if error == "missed" else "no_peak" if error is None else "ok",
            "error_deg": error if isinstance(error, float) else None, **(FLAT | more),
        }
        for index, error in enumerate(errors)
    ]  # fmt: skip


def guide_from(*parts, **told):
    return guide_of(pl.DataFrame([row for part in parts for row in part], infer_schema_length=None), **told)


def noisy(mean, count=20, seed=0, spread=0.1):
    return [float(value) for value in mean + spread * np.random.default_rng(seed).standard_normal(count)]


def test_methods_are_ranked_on_the_highlights_that_both_answered():
    steady, refusing = noisy(0.63, spread=0.02), [*noisy(0.35, 18, seed=1, spread=0.02), None, None]
    (advice,) = guide_from(rows_of("cone_axis", steady), rows_of("curved", refusing)).advice
    # What it refuses stands in a column of its own: as 90 deg each, two of 20 would be 9 deg.
    assert (advice.best, advice.ties, advice.unranked) == ("curved", (), ())
    assert (advice.methods["curved"].answered, advice.methods["curved"].refused, advice.n) == (18, 2, 20)
    assert advice.methods["curved"].mean_penalised_deg > 9


def test_refusing_more_than_half_is_no_way_to_be_best():
    (advice,) = guide_from(rows_of("cone_axis", noisy(1.0)), rows_of("curved", noisy(0.1, 8) + [None] * 12)).advice
    assert (advice.best, advice.ties) == ("cone_axis", ())
    # Where all do, the rule has nobody else to name.
    parts = rows_of("cone_axis", noisy(1.0, 9) + [None] * 11), rows_of("curved", noisy(0.1, 8) + [None] * 12)
    assert guide_from(*parts).advice[0].best == "curved"


def test_of_methods_that_are_alike_the_one_that_answers_more_is_best():
    errors = noisy(1.0)
    parts = rows_of("cone_axis", [*errors[:18], None, None]), rows_of("curved", [error + 0.02 for error in errors])
    (advice,) = guide_from(*parts).advice
    assert (advice.best, advice.ties) == ("curved", ("cone_axis",))


def test_methods_that_answered_nothing_in_common_are_not_ranked():
    parts = rows_of("cone_axis", noisy(1.0, 10) + [None] * 9), rows_of("curved", [None] * 10 + noisy(3.0, 9))
    (advice,) = guide_from(*parts).advice
    assert (advice.best, advice.ties, advice.unranked) == ("cone_axis", (), ())
    parts = rows_of("cone_axis", noisy(1.0, 10) + [None] * 10), rows_of("curved", [None] * 10 + noisy(3.0, 10))
    (row,) = guide_rows(guide_from(*parts))
    assert (row.best, row.ties, row.unranked) == ("cone_axis", (), "too few highlights to rank beside curved")


def test_a_method_that_chance_may_have_put_second_is_tied_and_a_worse_one_is_not():
    same = noisy(1.0, seed=1)
    close = [error + float(delta) for error, delta in zip(same, np.tile([0.05, -0.04], 10), strict=True)]
    worse = [error + 0.3 for error in same]
    parts = (rows_of("cone_axis", same), rows_of("curved", close), rows_of("brightest_point", worse))
    (advice,) = guide_from(*parts).advice
    assert (advice.best, advice.ties) == ("cone_axis", ("curved",))


def test_highlights_of_one_frame_count_once():
    """Ten highlights with the same difference in each of two frames are two differences, which tell nothing."""
    one = frames_of("cone_axis", [[1.0] * 10] * 2)
    other = frames_of("curved", [[1.05] * 10, [1.4] * 10])
    (advice,) = guide_from(one, other).advice
    assert (advice.best, advice.ties, advice.unranked, advice.n) == ("cone_axis", (), ("curved",), 20)
    # As frames of their own, the same 20 differences decide.
    apart = [[row | {"realisation": 10 * row["realisation"] + row["true_id"]} for row in rows] for rows in (one, other)]
    (advice,) = guide_from(*apart).advice
    assert (advice.best, advice.ties) == ("cone_axis", ())


def test_few_highlights_make_no_tie_and_no_claim():
    guide = guide_from(
        rows_of("cone_axis", [2.0, 2.4]), rows_of("curved", [1.0, 4.0]), rows_of("cone_axis", [1.0], "b", **TUBE)
    )
    assert [(row.best, row.ties, row.unranked, row.breaks) for row in guide_rows(guide)] == [
        ("cone_axis", (), "too few highlights to rank", "not in these 2 highlights"),
        ("cone_axis", (), "", "not in this highlight"),
    ]
    assert seen_sentence(guide, 8) == "3 true highlights in 8 frames; 5 frames without one."
    assert seen_sentence(guide, 3) == seen_sentence(guide, None) == ""


def test_a_method_that_breaks_is_not_tied_with_one_that_does_not():
    """Chance may have made the difference, but not the claim that both serve."""
    wild = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 60.0]
    parts = (rows_of("curved", noisy(2.0, 7)), rows_of("circle_pose", wild))
    (advice,) = guide_from(*parts).advice
    assert advice.methods["circle_pose"].breaks
    assert (advice.best, advice.ties) == ("curved", ())


SITUATIONS = {
    "flat": ({}, "flat, light at the camera"),
    "tube": (TUBE, "outside of a tube, light at the camera"),
    "tube, twice as curved": (TUBE | {"kd_max": 2.0}, "outside of a tube, light at the camera"),
    "beside": ({"eps_over_d": 0.05}, "flat, light beside the camera (ε/d up to 0.1)"),
    "far": ({"eps_over_d": 0.2}, "flat, light beside the camera (ε/d above 0.1)"),
    "dome": (TUBE | {"kd_min": 0.5}, "dome, light at the camera"),
    "saddle": (TUBE | {"kd_min": -0.5}, "saddle, light at the camera"),
    "bowl": ({"kd_min": -0.5, "kd_max": -0.4}, "bowl, light at the camera"),
    "hollow": ({"kd_min": -0.5}, "inside of a tube, light at the camera"),
}


def test_settings_that_differ_in_kind_never_share_a_situation():
    guide = guide_from(*(rows_of("cone_axis", [1.0], name, **own) for name, (own, _) in SITUATIONS.items()))
    found = {name: each.situation.title for each in guide.advice for name in each.situation.settings}
    assert found == {name: title for name, (_, title) in SITUATIONS.items()}


def test_a_light_is_far_beside_where_it_is_for_any_highlight():
    """The mean of the setting, 0.07, would call it near."""
    rows = [row for number, eps in enumerate((0.02, 0.02, 0.17)) for row in
            rows_of("cone_axis", [1.0], first=number, eps_over_d=eps)]  # fmt: skip
    assert guide_from(rows).shared == ("light beside the camera (ε/d above 0.1)",)
    near = [row | {"eps_over_d": min(row["eps_over_d"], 0.109)} for row in rows]
    assert guide_from(near).shared == ("light beside the camera (ε/d up to 0.1)",)


def test_conditions_set_situations_apart_and_what_all_share_is_told_once():
    told = {
        "a": {"sensor": "no noise", "relief": "smooth surface"},
        "b": {"sensor": "blur", "relief": "smooth surface"},
    }
    guide = guide_from(rows_of("cone_axis", [1.0], "a"), rows_of("cone_axis", [1.0], "b"), conditions=told)
    assert [each.situation.circumstances for each in guide.advice] == ["no noise", "blur"]
    assert guide.shared == ("light at the camera", "smooth surface")


def test_a_small_spot_is_told_apart():
    told = {"half_width_rad": 0.01, "focal_px": 400.0}
    parts = (
        rows_of("cone_axis", [1.0], "a"),
        rows_of("cone_axis", [1.0], "b", **TUBE | {"kd_min": 1.0, "kd_max": 3.0}),
    )
    # 4 px on the plane; a quarter and a half of it on the dome.
    guide = guide_from(*parts, conditions={"a": told, "b": told})
    assert [each.situation.title for each in guide.advice] == ["flat", "dome, small spot (below 3 px)"]


@pytest.mark.parametrize(("base", "surface"), [((0.0, 0.5), "outside of a tube"), ((-0.5, 0.0), "inside of a tube")])
def test_a_surface_with_relief_is_named_by_its_base(base, surface):
    fine = ((-3.0, 2.0), (0.5, 4.0), (-2.0, -1.0))
    rows = [
        row | {"kd_min": low, "kd_max": high, "kd_min_base": base[0], "kd_max_base": base[1]}
        for row, (low, high) in zip(rows_of("cone_axis", [1.0] * 3), fine, strict=True)
    ]
    assert guide_from(rows).advice[0].situation.surface == surface
    # Without a base of its own, the surface itself counts; tissue is named by its surface too.
    none = [row | {"kd_min_base": None, "kd_max_base": None} for row in rows]
    assert guide_from(none).advice[0].situation.surface == "mixed curvature"
    tissue = [row | {"surface": "colon"} for row in none]
    assert guide_from(tissue).advice[0].situation.surface == "colon: mixed curvature"


def test_no_median_of_a_situation_is_above_the_largest_of_its_settings():
    """Settings of unlike sizes and skews, with frames that repeat each other, as without noise."""
    rng = np.random.default_rng(3)
    for _ in range(30):
        drawn = [rng.lognormal(-3, rng.uniform(0.01, 2), rng.integers(1, 8)).tolist() for _ in range(3)]
        drawn[0] = [drawn[0][0]] * len(drawn[0])
        (advice,) = guide_from(
            *(rows_of("cone_axis", own, name) for name, own in zip("abc", drawn, strict=True))
        ).advice
        assert advice.methods["cone_axis"].median_deg <= advice.by_setting[advice.worst].median_deg


BREAKS = [
    ({"a": [1.0] * 4, "b": [2.0] * 4}, "nowhere here (largest median: 2°, at b)", False),
    ({"a": [1.0] * 4, "b": [6.0] * 4}, "1 of 2 settings, b: mean 6°", True),
    ({"a": [1.0] * 4, "b": [6.0] * 4, "c": [9.0] * 4}, "2 of 3 settings: mean 6° (b) to 9° (c)", True),
    ({"a": [7.0] * 4, "b": [6.0] * 4}, "all 2 settings: mean 6° or more", True),
    ({"a": [0.1, None, "missed", None]}, "here: 1 of 4 answered", True),
    ({"a": [0.1, None, None], "b": [None, "missed"]}, "all 2 settings: 1 of 3 answered or fewer", True),
    ({"a": [0.1, None, None], "b": [9.0]}, "1 of 2 settings, b: mean 9°; 1 of 2 settings, a: 1 of 3 answered", True),
    # One in 18 refused: 5.6 % of 90 deg alone are 5 deg.
    ({"a": [*noisy(1.0, 17, spread=0.001), None]}, "nowhere here", False),
    ({"a": [None, "missed"]}, "no method answered", True),
    ({"a": [*noisy(1.0, 6, spread=0.001), "missed", None]},
     "25 % of the highlights have no answer (1 missed, 1 refused); else nowhere here", False),
]  # fmt: skip


@pytest.mark.parametrize(("errors", "said", "is_broken"), BREAKS)
def test_where_the_best_method_breaks(errors, said, is_broken):
    (row,) = guide_rows(guide_from(*(rows_of("cone_axis", own, setting) for setting, own in errors.items())))
    assert (row.breaks, row.is_broken) == (said, is_broken)


def test_false_detections_count_nowhere_and_settings_without_highlights_are_named():
    false = [row | {"true_id": None} for row in rows_of("cone_axis", [80.0], "b")]
    guide = guide_from(rows_of("cone_axis", [1.0]), false)
    assert (guide.left_out, guide.advice[0].n) == (("b",), 1)
    assert guide_of(pl.DataFrame(false)).advice == ()
    # Where nothing at all was seen there is no row.
    told = {"a": {}, "dark": {}}
    assert guide_from(rows_of("cone_axis", [1.0]), conditions=told).left_out == ("dark",)


def frames_of(estimator, errors, **more):
    """Rows of frames that hold several highlights; a list of errors for each."""
    return [
        row | {"true_id": true_id}
        for realisation, own in enumerate(errors)
        for true_id, error in enumerate(own)
        for row in rows_of(estimator, [error], first=realisation, **more)
    ]


def test_an_estimator_answers_for_the_highlights_that_it_has_rows_of():
    """One row a cloud, of one cloud a frame, beside a row of each of its glints."""
    base = {"kd_min_base": 0.0, "kd_max_base": 0.0}
    glints = frames_of("cone_axis", [noisy(8.0, 7, seed) for seed in range(6)], target="fine", **base)
    clouds = frames_of("cloud", [[error] for error in noisy(2.0, 6, seed=9)], target="base", **base)
    fine, normals_of_base = guide_from(glints, clouds).advice
    assert (fine.target, fine.best, fine.n, list(fine.methods)) == ("fine", "cone_axis", 42, ["cone_axis"])
    own = normals_of_base.methods["cloud"]
    assert (normals_of_base.target, normals_of_base.best, own.n, own.answered) == ("base", "cloud", 6, 6)
    assert own.mean_penalised_deg == own.mean_deg == pytest.approx(2.0, abs=0.2)
    assert [row.surface for row in guide_rows(guide_from(glints, clouds))] == ["flat", "flat, normal of the base"]


def test_estimators_of_different_surfaces_are_no_pair(tmp_path):
    """The base's highlight 0 is not the fine surface's highlight 0."""
    rows = [*rows_of("cone_axis", noisy(1.0, 5), target="fine"), *rows_of("curved", noisy(2.0, 5), target="fine"),
            *rows_of("cloud", noisy(3.0, 5), target="base")]  # fmt: skip
    found = pairs(read_run(make_run(tmp_path, "noise", rows, items=0)))
    assert [(pair.first, pair.second, pair.n) for _, pair in found] == [("cone_axis", "curved", 5)]


def test_highlights_of_the_base_count_as_seen():
    clouds = rows_of("cloud", noisy(2.0, 3), target="base")
    guide = guide_from(clouds)
    assert (guide.highlights, guide.frames) == (3, 3)
    assert seen_sentence(guide, 4) == "3 true highlights in 4 frames; 1 frame without one."
    # Beside glints they are seen already.
    glints = frames_of("cone_axis", [noisy(8.0, 7, seed) for seed in range(3)], target="fine")
    assert guide_from(glints, clouds).highlights == 21


def test_of_one_surface_too_only_highlights_with_a_row_count():
    every, few = noisy(1.0, 20), noisy(0.5, 8, seed=1)
    (advice,) = guide_from(rows_of("cone_axis", every), rows_of("curved", few)).advice
    assert (advice.best, advice.methods["curved"].n, advice.methods["cone_axis"].n) == ("curved", 8, 20)
    assert advice.ties == ()


def test_a_failed_cloud_is_one_of_the_base():
    parts = (rows_of("cloud", [None, 2.0, "missed"], target="base"), rows_of("cone_axis", [1.0], target="fine"))
    fine, base = guide_from(*parts).advice
    assert (fine.n, base.n, base.methods["cloud"].missed, base.methods["cloud"].refused) == (1, 3, 1, 1)
    # A failure of an estimator of single highlights names no surface; its answers do.
    odd = [row | {"target": "base" if row["status"] == "ok" else "fine"} for row in rows_of("own", [None, 2.0])]
    (advice,) = guide_from(odd).advice
    assert (advice.target, advice.n) == ("base", 2)


def test_spread_between_settings_does_not_hide_a_worse_method():
    """As inside of a tube: one method is worse in every frame of some settings, and as good in the others."""
    steps = (0.0, 0.0, 0.02, 0.5, 3.0)
    one, other = [], []
    for number, step in enumerate(steps):
        errors = noisy(0.05, 3, seed=number, spread=0.005)
        one += rows_of("cone_axis", errors, f"r={number}")
        shifted = [error + step + shift for error, shift in zip(errors, noisy(0, 3, 50 + number, 0.01), strict=True)]
        other += rows_of("bisector", shifted, f"r={number}")
    (advice,) = guide_from(one, other).advice
    assert (advice.best, advice.ties) == ("cone_axis", ())


def test_one_frame_a_setting_leaves_the_spread_between_settings():
    one = [row for k in range(5) for row in rows_of("cone_axis", [1.0 + k / 100], f"r={k}")]
    far, near = (
        [row for k, delta in enumerate(deltas) for row in rows_of("curved", [1.0 + k / 100 + delta], f"r={k}")]
        for deltas in ([0.5, 0.6, 0.7, 0.5, 0.6], [0.0, 0.0, 0.02, 0.5, 3.0])
    )
    (advice,) = guide_from(one, far).advice
    assert advice.ties == ()
    (advice,) = guide_from(one, near).advice
    assert advice.ties == ("curved",)


def test_frames_that_are_copies_count_once():
    """Without noise, realisations repeat each other: no interval, and what matters decides."""
    errors = {"cone_axis": 1.0, "centroid": 1.04, "curved": 1.06, "brightest_point": 3.0}
    (advice,) = guide_from(*(rows_of(name, [error] * 20) for name, error in errors.items())).advice
    assert advice.n == 1
    assert advice.methods["cone_axis"].interval_deg == (None, None)
    # 0.04 deg are below 5 % of the best method's mean; 0.06 are not, and copies leave nothing to chance.
    assert (advice.best, advice.ties) == ("cone_axis", ("centroid",))
    # A single frame may owe its order to noise: nothing says that another would be the same.
    (advice,) = guide_from(*(rows_of(name, [error]) for name, error in errors.items())).advice
    assert (advice.ties, advice.unranked) == ((), ("centroid", "curved", "brightest_point"))


def test_frames_without_an_answer_are_no_copies():
    rows = rows_of("cone_axis", ["missed"] * 9 + noisy(1.0, 6) + [None, None])
    # An error inside the method is no refusal.
    rows[-1]["status"] = "estimator_error"
    (advice,) = guide_from(rows).advice
    figures = advice.methods["cone_axis"]
    assert (figures.n, figures.answered, figures.missed, figures.refused) == (17, 6, 9, 1)


def test_differences_below_a_hundredth_of_a_degree_are_tied():
    errors = noisy(0.02, 20, spread=0.001)
    for delta, ties in ((0.009, ("curved",)), (0.011, ())):
        (advice,) = guide_from(rows_of("cone_axis", errors), rows_of("curved", [e + delta for e in errors])).advice
        assert advice.ties == ties


@pytest.mark.parametrize(("frames", "highlights"), [pytest.param(12, 3, marks=pytest.mark.ci), (8, 2)])
def test_the_interval_of_a_median_holds_it_in_95_of_100_samples_of_frames(frames, highlights):
    random, trials = np.random.default_rng(5), 150
    number = np.repeat(np.arange(frames), highlights)
    held = alone = 0
    for _ in range(trials):
        values = random.standard_normal(frames)[number] + 0.3 * random.standard_normal(len(number))
        for counted, units in (("frames", number), ("highlights", np.arange(len(number)))):
            low, high = median_interval(values, units)
            held += counted == "frames" and low <= 0 <= high
            alone += counted == "highlights" and low <= 0 <= high
    # Four standard deviations below 95 % in 150 trials.
    assert held / trials > 0.88
    # As independent highlights, the same values claim too much.
    assert alone < held - 0.05 * trials


def test_settings_of_few_frames_have_no_interval():
    few, enough = (np.arange(float(n)) for n in (LEAST_FRAMES - 1, LEAST_FRAMES))
    assert median_interval(few) == (None, None)
    low, high = median_interval(enough)
    assert low < np.median(enough) < high
    assert median_interval(np.empty(0)) == (None, None)
    # Spread between settings is no chance.
    both = np.repeat([1.0, 2.0, 3.0], 6)
    low, high = median_interval(both, np.arange(18), np.repeat([0, 1, 2], 6))
    without = median_interval(both, np.arange(18))
    assert without[0] < low <= 2.0 <= high < without[1]


def test_methods_say_what_they_are_and_where_they_break():
    parts = [rows_of("cone_axis", [1.0] * 4, "a"), rows_of("circle_pose", [2.0] * 4, "a"),
             rows_of("cone_axis", [1.0] * 4, "b", **TUBE), rows_of("circle_pose", [60.0] * 4, "b", **TUBE)]  # fmt: skip
    cone, pose = method_rows(guide_from(*parts), DESCRIPTIONS)
    assert (cone.best, cone.breaks) == ("2 of 2", "in none as a whole")
    assert (pose.best, pose.breaks) == ("0 of 2", "1 of 2: outside of a tube (mean 60°)")
    assert pose.about == DESCRIPTIONS["circle_pose"]


def test_conditions_come_from_the_scene():
    plain = conditions(load_scene("plane"))
    assert (plain.relief, plain.camera) == ("smooth surface", "pinhole camera")
    assert plain.half_width_rad == pytest.approx(0.083063, abs=1e-6)  # n = 50
    changed = {"sensor.noise_sigma": 0.01, "sensor.full_well": 1000, "known.lights": False, "render.path_depth": 3}
    found = conditions(load_scene("plane", changed))
    assert (found.told, found.sensor) == ("position not known", "noise up to 2 %, shot noise")
    assert "bounced light" in found.render
    told = load_scene("plane", {"known.distance_error": 0.0})
    assert conditions(told).told == "position and distance known"
    # A distance whose error is drawn for each realisation is known as well.
    known = conditions_of(expand(load_experiment("known_light")))
    assert {found.told for found in known.values()} == {"position and distance known"}


def test_conditions_are_of_the_values_that_are_drawn():
    drawn = {"sensor.noise_sigma": {"low": 0.03, "high": 0.05}, "reflectance.exponent": {"low": 10.0, "high": 20.0}}
    group = {"scene": "plane", "set": {"sensor.noise_sigma": 0.0}, "random": drawn}
    data = {"name": "drawn", "seed": 1, "realisations": 1, "estimators": ["cone_axis"], "groups": [group]}
    (found,) = conditions_of(expand(validate(Experiment, data, "experiment"))).values()
    assert found.sensor == "noise above 2 %"
    assert found.half_width_rad == conditions(load_scene("plane", {"reflectance.exponent": 20.0})).half_width_rad


def test_summary_json_holds_conditions_and_descriptions():
    experiment = load_experiment("relief")
    cases = expand(experiment)
    none = dict.fromkeys(("mahalanobis2", "cov_11", "cov_22"))
    rows = pl.DataFrame(rows_of("cone_axis", [1.0], cases[0].setting, error_oracle_deg=1.0, **none))
    content = summarise_run(experiment, cases, rows).model_dump(mode="json")
    assert content["estimators"] == {name: DESCRIPTIONS[name] for name in experiment.estimators}
    assert list(content["conditions"]) == list(conditions_of(cases))
    assert content["conditions"][cases[0].setting]["relief"] == "relief"


def printed(run, width, terminal):
    from rich.console import Console

    from simtest.cli.runs import print_guide

    write_report(run)
    file = io.StringIO()
    print_guide(run, Console(file=file, width=width, force_terminal=terminal, emoji=False, highlight=False))
    return file.getvalue()


def test_the_terminal_shows_a_summary_within_80_columns_and_plain_where_nobody_looks(tmp_path):
    run = make_run(tmp_path, items=0)
    text = printed(run, 80, terminal=False)
    assert "\x1b" not in text
    assert all(len(line.rstrip()) <= 80 for line in text.splitlines())
    guide = read_run(run).guide
    for row in guide_rows(guide):
        assert row.best in text
    # A line a situation at least, and no line for each of the run's rows.
    assert len(guide.advice) < len(text.splitlines()) < 60
    headed = [line for line in text.splitlines() if line.startswith(("light at", "light beside"))]
    assert [name for name, _ in groupby(headed)] == [
        "light at the camera", "light beside the camera (ε/d up to 0.1)", "light beside the camera (ε/d above 0.1)"
    ]  # fmt: skip
    assert "\x1b[1m" in printed(run, 120, terminal=True)


def test_an_estimator_from_elsewhere_has_a_line_in_each_situation_on_page_and_terminal(tmp_path):
    near = noisy(0.1, spread=0.01)
    saddle = {"kd_min": -0.5, "kd_max": 0.5}
    parts = [
        rows_of("cone_axis", near, "a"), rows_of("mine", [*noisy(7.0, 18), None, "missed"], "a"),
        rows_of("cone_axis", near, "b", **TUBE), rows_of("mine", near, "b", **TUBE),
        rows_of("cone_axis", noisy(2.0), "c", **saddle), rows_of("mine", near, "c", **saddle),
    ]  # fmt: skip
    run = make_run(tmp_path, "noise", [row for part in parts for row in part], items=0)
    flat, tube, best = guide_rows(read_run(run).guide)
    (worse,), (tied,) = flat.guests, tube.guests
    assert (worse.estimator, worse.standing, worse.answered) == ("mine", "not best", "18 of 20")
    assert (worse.unanswered, worse.is_broken) == ("1 missed, 1 refused", True)
    assert worse.breaks.startswith("here: mean 7")
    assert (tied.estimator, tied.standing, tied.breaks, tied.is_broken) == ("mine", "tied", "nowhere here", False)
    # The best one has the situation's own line.
    assert (best.best, best.guests) == ("mine", ())
    text = printed(run, 80, terminal=False)
    assert text.count("mine") == 4  # one of them among those tied
    assert "(not best)" in text
    page = (run / "index.html").read_text(encoding="utf-8")
    assert page.count('class="guest"') == 2
    # A phone shows each line as a card: it names its situation, and no method "best" that is not.
    begin = '<tr class="guest"><th scope="row" class="text soft">flat</th><td class="text" data-label="method">'
    assert page.count(begin) == 1
    assert ">the same<" not in page


def test_the_page_s_first_table_has_a_line_for_each_kind_of_light_and_best_method():
    guide = guide_from(
        rows_of("cone_axis", noisy(0.1, spread=0.01), "a"),
        rows_of("cone_axis", noisy(0.2, spread=0.01), "b", **TUBE),
        rows_of("curved", noisy(7.0, spread=0.01), "c", kd_min=-0.5, kd_max=0.5),
    )
    good, bad = answers(guide_content(guide, {}))
    assert (good["best"], good["error"]) == ("cone_axis", "0.098 to 0.2°")
    assert (bad["best"], bad["error"]) == ("curved", "7°")
    assert bad["note"].endswith("breaks: saddle")


def test_a_run_without_true_highlights_says_so(tmp_path):
    run = make_run(tmp_path, "noise", [row | {"true_id": None} for row in rows_of("cone_axis", [1.0])], items=0)
    assert "nothing to compare" in printed(run, 80, terminal=False)


def test_guide_json_holds_rows_and_figures_and_is_printed_with_json(tmp_path, capsys):
    from simtest.cli.common import print_json, run_record

    run = make_run(tmp_path, items=0)
    write_report(run)
    content = json.loads((run / "guide.json").read_text(encoding="utf-8"))
    guide = read_run(run).guide
    for row, text, advice in zip(content["rows"], guide_rows(guide), guide.advice, strict=True):
        assert (row["surface"], row["best"], row["breaks"]) == (text.surface, advice.best, text.breaks)
        told, own = row["methods"][advice.best], advice.methods[advice.best]
        assert (told["n"], told["mean_deg"]) == (own.n, own.mean_deg)
        assert tuple(row["settings"]) == advice.situation.settings
    print_json(run_record(run))
    assert json.loads(capsys.readouterr().out)["guide"] == content


def test_the_overview_shows_what_practice_gives_beside_its_own_figures(tmp_path):
    run = make_run(tmp_path, items=0)
    text = " ".join(printed(run, 120, terminal=False).split())
    page = (run / "index.html").read_text(encoding="utf-8")
    told = practice("overview")
    assert json.loads((run / "guide.json").read_text(encoding="utf-8"))["practice"] == told
    for row in told["rows"]:
        assert row["command"] in text
        assert f"{row['command']}</code>" in page
        assert f"{row['median_deg']:g}°" in text
    assert practice("sensor") is None


def test_readme_and_manual_have_the_figures_of_practice():
    """One table, practice.toml, feeds page and terminal; README repeats it, and the manual's tables are its source."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for row in practice("overview")["rows"]:
        below = f"{row['p95_deg']:g}°" if "p95_deg" in row else ""
        covers = f"{row['covered_percent']} %" if "covered_percent" in row else ""
        cells = [f"{row['median_deg']:g}°", below, f"{row['region_deg']:g}°", covers, f"`{row['command']}`"]
        line = f"| {row['surface']} | `{row['best']}` | {' | '.join(cells)} |"
        assert line.replace("|  |", "| |") in readme
    manual = (ROOT / "docs/measured/clouds.md").read_text(encoding="utf-8")
    told = {row["surface"]: row for row in practice("overview")["rows"]}
    for name in ("light given", "not given"):
        row = told[f"organ's normal, light {name.removeprefix('light ')}"]
        (line,) = [line for line in manual.splitlines() if line.startswith(f"| {name}, all |")]
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert row["answered"] == f"{cells[2]} of {cells[1]} frames"
        assert [row["median_deg"], row["p95_deg"], row["region_deg"]] == [
            float(cells[4]), float(cells[5]), round(float(cells[6]))
        ]  # fmt: skip
        assert f"{row['covered_percent']} %" == cells[7]
    photograph = told["organ's normal, photograph of a phantom"]
    assert f"| {photograph['median_deg']} | {photograph['region_deg']:.1f} |" in manual


@pytest.mark.parametrize("spoil", [lambda file: file.unlink(), lambda file: file.write_text("{")])
def test_a_guide_that_is_missing_is_told_as_missing(tmp_path, capsys, spoil):
    from simtest.cli.common import run_record
    from simtest.cli.runs import print_guide

    run = make_run(tmp_path, items=0)
    write_report(run)
    spoil(run / "guide.json")
    print_guide(run)
    said = capsys.readouterr().out
    assert "guide.json: missing" in said
    assert "No true highlight" not in said
    assert run_record(run)["guide"] is None


def test_verbose_prints_every_situation(tmp_path, monkeypatch):
    from simtest.cli.common import MOST_ROWS
    from simtest.cli.main import MANNERS

    names = [f"organ {k}" for k in range(MOST_ROWS + 3)]
    rows = [row for name in names for row in rows_of("cone_axis", [1.0], name, surface=name)]
    run = make_run(tmp_path, "noise", rows, items=0)
    short = printed(run, 80, terminal=False)
    assert "and 3 more" in " ".join(short.split())
    assert names[MOST_ROWS] not in short
    monkeypatch.setattr(MANNERS, "verbose", True)
    every = printed(run, 80, terminal=False)
    assert names[-1] in every
    assert "--verbose" not in every


_PRESET = "stands for lights, which count themselves"


_NUMBER = "in the number of lights and their offset, which the results tell"


_TOLD_EMISSION = "told to the estimators, unless emission_known is false"


DEGREES: dict[str, dict[str, str]] = {
    "rig": {
        **dict.fromkeys(("preset", "count", "radius_mm", "azimuth_deg", "axial_mm", "power", "each"), _PRESET),
        "seed": "of position_error_mm",
        **{f"lights.{key}": _NUMBER for key in ("position_mm", "offset_mm", "azimuth_deg")},
        **{f"lights.{key}": _TOLD_EMISSION for key in ("colour", "profile", "direction", "spot_deg", "soft_edge_deg",
                                                       "power")},
    },
    "reflectance": {
        "colour": "of the diffuse base, which is a kind",
        "albedo": "colour of the diffuse base, which is a kind",
        "translucency": "of the diffuse base, which is a kind",
        "specular": "scales the picture",
        "normalised": "scales the picture",
        "film": "its roughness is the half-width of the lobe, its level stands with the relief",
    },
    "sensor": {
        "preset": "stands for other keys, which count themselves",
        "vignetting": "taken out of the picture, unless vignetting_known is false",
        "exposure": "scales the picture; what it clips is told by saturation",
        "read_noise": "part of shot noise",
        "seed": "of the noise",
    },
}  # fmt: skip
"""Keys of a scene that set no situations apart, each with why; all others are kinds."""


# A change of each key that sets situations apart, with what it needs beside.
KINDS = {
    "rig": {
        "emission_known": {"rig.emission_known": False},
        "lights.position_error_mm": {"rig.lights.0.position_error_mm": 0.2},
        "lights.source": {"rig.lights.0.source.type": "disc", "rig.lights.0.source.radius_mm": 1.0},
    },
    "reflectance": {
        "type": {"reflectance.type": "rough_conductor"},
        "diffuse": {"reflectance.diffuse": 0.3},
        "exponent": {"reflectance.exponent": 2e4},
        "alpha": {"reflectance.type": "rough_conductor", "reflectance.alpha": 0.003},
        "roughness": {"reflectance.type": "principled", "reflectance.roughness": 0.05},
    },
    "sensor": {
        "point_spread_px": {"sensor.point_spread_px": 1.0},
        "full_well": {"sensor.full_well": 1000},
        "noise_sigma": {"sensor.noise_sigma": 0.0},
        "saturation": {"sensor.saturation": True},
        "response": {"sensor.response.type": "srgb"},
        "response_known": {"sensor.response.type": "srgb", "sensor.response_known": False},
        "bits": {"sensor.bits": 8},
        "mosaic": {"sensor.mosaic.pattern": "rggb"},
        "colour": {"sensor.colour.white_balance": [1.2, 1.0, 1.1]},
        "denoising": {"sensor.denoising.level": 0.1},
        "sharpening": {"sensor.sharpening.amount": 0.5},
        "scaling": {"sensor.scaling.factor": 0.5},
        "overlay": {"sensor.overlay.boxes": [{"x": 0, "y": 0, "width": 0.1, "height": 0.1}]},
        "coding": {"sensor.bits": 8, "sensor.coding.type": "jpeg"},
        "fringe": {"sensor.fringe.red": 0.001},
        "interlacing": {"sensor.interlacing.zoom": 1.01},
        "vignetting_known": {"sensor.vignetting_known": False},
    },
}


def keys_of(*models):
    """Keys of some models; those of a light behind "lights"."""
    names = {name for model in models for name in model.model_fields}
    if "lights" in names:
        names = (names - {"lights"}) | {f"lights.{name}" for name in LightSpec.model_fields}
    return names


@pytest.mark.parametrize(
    ("part", "models"),
    [("rig", [Rig]), ("sensor", [Sensor]), ("reflectance", get_args(get_args(Reflectance)[0]))],
)
def test_every_key_of_a_scene_is_of_a_kind_or_a_degree(part, models):
    keys, degrees = keys_of(*models), set(DEGREES[part])
    assert keys == KINDS[part].keys() | degrees
    assert not KINDS[part].keys() & degrees


@pytest.mark.parametrize("key", [f"{part} {key}" for part, keys in KINDS.items() for key in keys])
def test_a_key_of_a_kind_sets_situations_apart(key):
    part, name = key.split()
    changes = KINDS[part][name]
    # Without the key alone, so that what it needs beside does not count.
    last = name.removeprefix("lights.")
    beside = {path: value for path, value in changes.items() if last not in path.split(".")}
    told = {name: conditions(load_scene("plane", own)).to_json() for name, own in (("a", changes), ("b", beside))}
    offset = FLAT | {"eps_over_d": 0.05}
    parts = (rows_of("cone_axis", [1.0], setting, **offset) for setting in told)
    assert len(guide_from(*parts, conditions=told).advice) == 2
