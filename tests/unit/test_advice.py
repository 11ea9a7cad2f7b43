"""`simtest advise`: what it reads, what it plans, what it reads out of results, and that its figures run again."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

import simtest
from simtest.advice import plan
from simtest.advice.advise import MAIN, RUN, advise, counts, narrower, sentence, write_advice, write_scene
from simtest.advice.answers import break_points, mean_error, read_results, spot_size
from simtest.advice.plan import (
    DISTANCES,
    LEAST_FRAMES,
    MOST_FRAMES,
    Question,
    affordable,
    distances_of,
    drawn_values,
    main_experiment,
    surroundings,
    write_experiment,
)
from simtest.advice.scope import SCOPES, ReliefPrior, read_scope
from simtest.advice.tissue import ORGANS, Surroundings, wall
from simtest.errors import InputError
from simtest.rendering.placement_checks import check_camera, check_lights
from simtest.runtime.arrays import kept
from simtest.surfaces import make_surface
from simtest.validation import laws, realisation
from simtest.validation.cases import RELIEF_SEED
from tests.unit.given_numbers import of_given_numbers

CAMERA = "[camera]\nwidth = 96\nheight = 72\nfx = 90.0\nfy = 90.0\n"


def written(tmp_path, text):
    path = tmp_path / "scope.toml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", SCOPES)
def test_every_preset_is_a_scope(name):
    scope = read_scope(name)
    assert scope.size == (640, 480)
    assert len(scope.offsets_mm) >= 1


def test_a_camera_file_replaces_the_scopes_camera(tmp_path):
    (tmp_path / "camera.toml").write_text("width = 320\nheight = 240\nfx = 300.0\nfy = 300.0\ncx = 160.0\ncy = 120.0\n")
    scope = read_scope("laparoscope", tmp_path / "camera.toml")
    assert (scope.size, scope.focal_px) == ((320, 240), pytest.approx(300.0, rel=1e-4))
    assert scope.offsets_mm == pytest.approx(read_scope("laparoscope").offsets_mm)


def test_positions_may_stand_as_in_a_calibration_file(tmp_path):
    scope = read_scope(written(tmp_path, CAMERA + "[rig]\nlights_mm = [[2.0, 0.0, 0.0]]\n"))
    assert scope.offsets_mm == pytest.approx([2.0])


MALFORMED = [
    ("", "camera"),
    (CAMERA + "[rig]\npreset = 'colonoscop'\n", "rig.preset = 'colonoscop'"),
    (CAMERA + "[rig]\nlights_mm = [[1.0, 2.0]]\n", "rig.lights_mm"),
    (CAMERA + "[rig]\nlights_mm = []\n", "rig.lights_mm"),
    (CAMERA + "[rig]\npreset = 'laparoscope'\nlights_mm = [[1.0, 2.0, 0.0]]\n", "rig.preset"),
    (CAMERA + "[sensor]\npreset = 'eye'\n", "sensor.preset = 'eye'"),
    (CAMERA + "[relief]\nslope_deg = -1.0\n", "slope_deg = -1"),
    (CAMERA + "[relief]\nslope_deg = [4.0, 2.0]\n", "slope_deg"),
    (CAMERA + "[relief]\nslope_deg = [0.0, 2.0]\n", "slope_deg"),
    (CAMERA + "[relief]\nslope_deg = 2.0\nwavelength_mm = 50.0\n", "wavelength_mm"),
    ("[camera\n", "TOML"),
]


@pytest.mark.parametrize(("text", "named"), MALFORMED)
def test_a_malformed_scope_is_refused_in_one_line(tmp_path, text, named):
    with pytest.raises(InputError) as error:
        read_scope(written(tmp_path, text))
    assert "scope" in str(error.value)
    assert named in str(error.value)
    assert "\n" not in str(error.value)


QUESTIONS = [
    ({"organ": "spleen"}, "--organ spleen: unknown; organs: colon"),
    ({"organ": "live"}, "did you mean liver"),
    ({"distances_mm": (-5.0, 20.0)}, "--distances = -5.0"),
    ({"distances_mm": (60.0, 20.0)}, "--distances 60,20"),
    ({"distances_mm": (20.0, 9000.0)}, "500 mm"),
    ({"bound_deg": 0.0}, "--bound = 0.0"),
    ({"bound_deg": 60.0}, "--bound 60"),
    ({"frames": 1}, "--frames 1"),
    ({"seed": -1}, "--seed = -1"),
]


@pytest.mark.parametrize(("changed", "named"), QUESTIONS)
def test_a_question_out_of_range_is_refused_in_one_line(changed, named):
    with pytest.raises(InputError) as error:
        Question(read_scope("colonoscope_2"), **changed)
    assert named in str(error.value)
    assert "\n" not in str(error.value)


def test_what_is_refused_leaves_no_files(tmp_path):
    (tmp_path / "large.toml").write_text("[camera]\nwidth = 16000\nheight = 16000\nfov_deg = 70.0\n")
    for scope, workers, said in (("large.toml", 1, "frame_pixels"), (None, 0, "workers = 0")):
        question = Question(read_scope("colonoscope_2" if scope is None else str(tmp_path / scope)))
        with pytest.raises(InputError, match=said):
            advise(question, tmp_path / "out", workers=workers)
        assert not list(tmp_path.glob("out/*"))


def test_a_light_inside_the_tissue_is_refused(tmp_path):
    scope = read_scope(written(tmp_path, CAMERA + "[rig]\nlights_mm = [[0.0, 0.0, 25.0]]\n"))
    with pytest.raises(InputError, match="inside the tissue"):
        Question(scope, distances_mm=(20.0, 60.0))


def test_an_unknown_preset_is_refused():
    with pytest.raises(InputError, match="did you mean laparoscope"):
        read_scope("laparoscop")


@pytest.mark.parametrize("organ", ORGANS)
def test_the_plan_is_a_file_that_reads_back_as_the_same_experiment(tmp_path, organ):
    question = Question(read_scope("laparoscope"), organ, (20.0, 60.0), frames=16, seed=3)
    planned = main_experiment(question)
    read = write_experiment(planned, tmp_path / MAIN)
    assert read == planned
    # Each frame is a setting of its own, and makes a sound scene.
    assert read.realisations == 1
    assert len(simtest.validation.cases.expand(read)) == 16
    assert read.groups[0].pool[0]["surface.distance_mm"] == tuple(distances_of(question)) * 2


def test_drawn_values_fill_their_ranges_evenly_at_each_distance():
    question = Question(read_scope("laparoscope"), "liver", (20.0, 60.0), frames=40, seed=3)
    around = surroundings(question)
    values = drawn_values(around, 3, 5, DISTANCES)
    assert values.keys() == {*around.random, RELIEF_SEED}
    for key, (low, high) in around.random.items():
        shares = (np.array(values[key]).reshape(5, DISTANCES) - low) / (high - low)
        # One in each fifth of the range, in another order at each distance.
        parts = np.floor(5 * shares).astype(int)
        assert np.array_equal(np.sort(parts, axis=0), np.repeat(np.arange(5)[:, None], DISTANCES, axis=1))
        assert len(np.unique(parts, axis=1).T) > 1
    # Frames at one distance share no noise of their relief.
    seeds = np.array(values[RELIEF_SEED]).reshape(5, DISTANCES)
    assert all(len(np.unique(column)) == 5 for column in seeds.T)
    # The same again, and others with another seed.
    assert drawn_values(around, 3, 5, DISTANCES) == values
    other = drawn_values(around, 4, 5, DISTANCES)
    assert all(not set(values[key]) & set(other[key]) for key in values)


def test_a_hypercube_is_as_wide_as_independent_draws_and_its_means_vary_less():
    """alpha about 1e-6: 300 means of 8 uniform numbers; those of independent draws have a variance of 1/96."""
    around = Surroundings({"surface": {}}, {"a": (0.0, 1.0)})
    drawn = np.array([drawn_values(around, seed, 8, DISTANCES)["a"] for seed in range(300)])
    assert drawn.mean() == pytest.approx(0.5, abs=0.002)
    assert drawn.var() == pytest.approx(1 / 12, rel=0.02)
    first = drawn.reshape(300, 8, DISTANCES)[:, :, 0].mean(axis=1)
    assert first.var() < 0.1 / 96
    # Negative control: numbers of different frames at one distance are no fixed grid.
    assert len(np.unique(drawn)) == drawn.size


def test_every_wall_leaves_camera_and_lights_in_free_space():
    """Of the drawn walls of a colon some hold the camera or touch a light; they are drawn anew, the others stay."""
    question = Question(read_scope("colonoscope_2"), "colon", (20.0, 60.0), frames=160, seed=0)
    around = surroundings(question)
    drawn = drawn_values(around, 0, 20, DISTANCES)
    planned = main_experiment(question)
    pool = planned.groups[0].pool[0]
    changed = [i for i in range(160) if any(drawn[key][i] != pool[key][i] for key in drawn)]
    assert 0 < len(changed) < 40
    for case in simtest.validation.cases.expand(planned)[:: 1 if len(changed) > 20 else 4]:
        scene, _ = case.scene(planned, case.numbers()[0])
        surface = make_surface(scene.surface.model_copy(update={"relief": None}))
        check_camera(scene, surface)
        check_lights(scene, surface)
    # What is drawn anew lies within the ends.
    for key, (low, high) in around.random.items():
        assert all(low <= pool[key][i] <= high for i in changed)


def test_a_distance_without_room_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(plan, "TRIES", 3)
    far = "[[0.0, 4000.0, 0.0], [0.0, -4000.0, 0.0], [4000.0, 0.0, 0.0], [-4000.0, 0.0, 0.0]]"
    scope = read_scope(written(tmp_path, CAMERA + f"[rig]\nlights_mm = {far}\n"))
    question = Question(scope, "plane", (20.0, 60.0), frames=16)
    with pytest.raises(InputError, match=r"--distances: at .* mm no wall") as error:
        main_experiment(question)
    assert "\n" not in str(error.value)


class StoringSession:
    """Stands for a session: makes what a surface makes, an anatomy and a relief, and renders nothing."""

    def __init__(self, scene, variant):
        for kind in ("colon", "relief"):
            kept(kind, scene.surface.model_dump_json(), lambda: {"a": np.zeros(1)})


@pytest.mark.parametrize("own", [True, False])
def test_reliefs_that_are_drawn_for_a_frame_are_not_kept(tmp_path, monkeypatch, own):
    monkeypatch.setenv("SIMTEST_CACHE", str(tmp_path / "kept"))
    monkeypatch.setattr(realisation, "Session", StoringSession)
    monkeypatch.setattr(realisation, "render_view", lambda session, scene: SimpleNamespace(scene=scene))
    monkeypatch.setattr(realisation, "further_views", lambda session, scene: [])
    planned = main_experiment(Question(read_scope("colonoscope_2"), "colon", frames=8))
    case = simtest.validation.cases.expand(planned)[0]
    # Negative control: the relief of an experiment that does not draw it is kept.
    case = case if own else replace(case, swept={})
    realisation.Realiser(None).view(planned, case, 0)
    kinds = {path.name.split("-")[0] for path in (tmp_path / "kept").iterdir()}
    assert kinds == ({"colon"} if own else {"colon", "relief"})


def test_a_flat_phantom_is_a_plane():
    around = wall(ORGANS["plane"], None, 20.0)
    assert around.set["surface"] == {"type": "plane"}
    assert around.random.keys() == {"surface.tilt_deg", "surface.azimuth_deg", "reflectance.film.alpha"}


def test_break_points_lie_where_the_laws_put_them():
    question = Question(read_scope("colonoscope_2"), "colon", (20.0, 60.0), bound_deg=4.0)
    offset, unknown, _, relief = break_points(question)
    assert math.degrees(math.atan(4.0 / offset.value) / 2) == pytest.approx(4.0, abs=1e-3)
    at, light = np.array([0.0, 0.0, unknown.value]), np.array([4.0, 0.0, 0.0])
    left = laws.bisector_residual(at, light, question.middle_mm / unknown.value - 1)
    assert math.degrees(float(left)) == pytest.approx(4.0, abs=1e-3)
    assert relief.value == pytest.approx(4.0 / math.sqrt(math.pi / 2), abs=1e-3)


def test_a_bisector_that_knows_the_range_errs_beyond_its_middle_too():
    question = Question(read_scope("colonoscope_2"), "colon", (20.0, 60.0), bound_deg=0.8)
    near, far = (point for point in break_points(question) if point.method == "bisector")
    assert near.value < question.middle_mm < far.value < 60.0
    for point in (near, far):
        # By hand: the light at 4 mm seen from a wall at the true and at the given distance.
        turn = math.degrees(math.atan(4.0 / point.value) - math.atan(4.0 / question.middle_mm)) / 2
        assert abs(turn) == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize(("distances", "beyond"), [((0.5, 3.0), []), ((1.0, 4.0), []), ((1.0, 12.0), [7.039])])
def test_break_points_of_the_bisector_lie_on_their_side_of_the_middle(distances, beyond):
    """Of a middle that is nearer than any endoscope works none lies below it, and none beyond that is as near."""
    question = Question(read_scope("colonoscope_2"), distances_mm=distances, bound_deg=1.0)
    found = [point for point in break_points(question) if point.method == "bisector"]
    middle = sum(distances) / 2
    assert all(("below" in point.title) == (point.value < middle) for point in found)
    assert all(point.value >= 3.0 for point in found)
    assert [point.value for point in found if "beyond" in point.title] == pytest.approx(beyond, abs=1e-3)


def test_a_light_at_the_camera_has_no_break_points_of_offset():
    quantities = [point.quantity for point in break_points(Question(read_scope("colocated")))]
    assert quantities == ["d k", "slope of the relief"]


def test_spots_shrink_with_relief_and_have_the_smooth_size_without():
    rough = spot_size(Question(read_scope("colonoscope_2"), "colon"))
    smooth = spot_size(Question(read_scope("colonoscope_2"), "plane"))
    assert rough.relief_px < 0.2 * rough.smooth_px
    assert smooth.relief_px == smooth.smooth_px
    assert smooth.shapeless_beyond_mm == math.inf


@pytest.mark.parametrize(("slope", "wavelength"), [(6.0, 2.0), ((4.0, 8.0), (1.0, 3.0))])
def test_a_typical_glint_bends_by_slope_times_wave_number_of_the_middle_relief(slope, wavelength):
    scope = replace(read_scope("colonoscope_2"), relief=ReliefPrior(slope_deg=slope, wavelength_mm=wavelength))
    question = Question(scope, "colon")
    told = spot_size(question)
    bend = math.radians(6.0) * 2 * math.pi / 2.0
    assert question.middle_mm * bend > 1
    assert told.smooth_px / told.relief_px == pytest.approx(question.middle_mm * bend, rel=1e-9)


@pytest.mark.parametrize(("asked", "planned"), [(8, 8), (12, 16), (20, 24), (40, 40)])
def test_at_least_the_frames_that_are_asked_for_are_planned(asked, planned):
    question = Question(read_scope("laparoscope"), "plane", (20.0, 60.0), frames=asked)
    assert len(main_experiment(question).groups[0].pool[0]["surface.distance_mm"]) == planned


def test_large_pictures_and_rough_walls_get_fewer_frames(tmp_path):
    large, tiny = read_scope("colonoscope_2"), read_scope(written(tmp_path, CAMERA))
    smooth = replace(large, relief=ReliefPrior(slope_deg=0.0))
    rough, bare, most = (affordable(Question(scope, "colon")) for scope in (large, smooth, tiny))
    assert LEAST_FRAMES < rough < bare < most == MOST_FRAMES
    assert affordable(Question(large, "plane")) == bare
    assert Question(large, "colon").per_distance * DISTANCES == rough
    assert distances_of(Question(large, distances_mm=(20.0, 60.0)))[0] == 22.5


def test_a_stated_relief_takes_the_place_of_the_organs(tmp_path):
    scope = read_scope(written(tmp_path, CAMERA + "[relief]\nslope_deg = [1.0, 2.0]\n"))
    around = wall(ORGANS["colon"], scope.relief, 20.0)
    assert around.set["surface"]["relief"]["bands"] == [{"slope_deg": 1.0, "wavelength_mm": 2.0}]
    assert around.random["surface.relief.bands.0.slope_deg"] == (1.0, 2.0)
    assert "surface.relief.bands.1.slope_deg" not in around.random


def results(errors, frame_of, status=None):
    n = len(errors)
    return pl.DataFrame({
        "experiment": "experiment", "setting": "colon", "label": "colon", "realisation": frame_of,
        "specularity": list(range(n)), "true_id": list(range(n)), "estimator": "cone_axis",
        "status": status or ["ok"] * n, "target": "fine", "error_deg": errors, "error_fine_deg": errors,
        "error_base_deg": [2 * e for e in errors], "visible_id": list(range(n)), "frame_visible": [10] * n,
        "surface.distance_mm": [20.0 + 10 * (frame % 2) for frame in frame_of], "cov_11": 1e-4, "cov_22": 3e-4,
        "eps_over_d": 0.1, "budget_noise_deg": 0.5, "budget_camera_deg": 0.0,
    })  # fmt: skip


def test_figures_of_known_errors():
    found = read_results(results([1.0, 3.0, 2.0, 2.0, 4.0, 6.0], [0, 0, 1, 1, 2, 3]), 4, 2)
    method = found.method("cone_axis")
    assert method.fine.mean_deg == pytest.approx(3.0)
    assert method.base.mean_deg == pytest.approx(6.0)
    assert method.budget_deg == {"noise": pytest.approx(0.5)}
    assert method.stated_deg == pytest.approx(math.degrees(math.sqrt(4e-4)))
    assert (found.visible, found.detections, found.false) == (40, 6, 0)
    assert found.choices[0].best == "cone_axis"
    assert set(found.choices[0].by_distance) == {20.0, 30.0}


def test_the_recommended_method_is_the_first_row_and_a_smaller_mean_is_explained():
    """`curved` refuses the two walls on which all others err by 90 deg, and errs more elsewhere."""
    frames = [frame for frame in range(8) for _ in range(2)]
    errors = [2.0 + 0.1 * (i % 5) for i in range(14)] + [90.0, 90.0]
    cone = results(errors, frames)
    curved = results([error + 0.4 for error in errors], frames, ["ok"] * 14 + ["degenerate_conic"] * 2)
    rows = pl.concat([curved.with_columns(estimator=pl.lit("curved")), cone])
    found = read_results(rows, 8, 2)
    assert found.choices[0].best == "cone_axis"
    assert [method.estimator for method in found.methods] == ["cone_axis", "curved"]
    assert found.method("curved").fine.mean_deg < found.method("cone_axis").fine.mean_deg
    beside = found.beside("curved")
    assert (beside.mean_deg, beside.highlights) == (pytest.approx(0.4), 14)
    assert found.beside("cone_axis") is None
    said = sentence(SimpleNamespace(answers=found), found.choices[0])
    assert (
        "curved has a smaller mean, 2.59 deg, over its 14 answers: over the 14 that both answered its error is" in said
    )
    assert "0.4 deg larger." in said


def test_the_counts_of_detections_add_up_and_are_said():
    rows = results([1.0] * 6, [0, 0, 1, 1, 2, 3]).with_columns(
        true_id=pl.Series([0, 1, 2, 3, None, None]), visible_id=pl.Series([0, 1, 2, 3, 4, None])
    )
    found = read_results(rows, 4, 2)
    assert (found.found, found.matched, found.unmatched, found.false) == (5, 4, 1, 1)
    assert found.matched + found.unmatched + found.false == found.detections
    assert counts(found).startswith(
        "4 frames show 40 visible highlights; the detector found 5 of them. Its 6 detections: 4 at"
    )


def test_distances_without_a_highlight_do_not_add_frames_to_the_others():
    """Of 80 frames 10 are at each distance, also where six of the eight distances have no row."""
    rows = results([1.0, 3.0, 2.0, 2.0, 4.0, 6.0, 1.5, 1.2], [0, 0, 1, 1, 2, 3, 4, 5])
    found = read_results(rows, 80).method("cone_axis").fine
    rows = rows.with_columns(setting=pl.col("surface.distance_mm").cast(pl.String))
    assert found.interval_deg == pytest.approx(mean_error(rows, "error_fine_deg", 10).interval_deg)


def test_refused_and_missed_are_counted_apart():
    rows = results([1.0, 1.0, 1.0], [0, 1, 2], ["ok", "degenerate_conic", "missed"])
    rows = rows.with_columns(
        pl.when(pl.col("status") == "missed").then(None).otherwise("specularity").alias("specularity")
    )
    method = read_results(rows, 3).method("cone_axis")
    # A glint that no detection holds was asked of no method.
    assert (method.asked, method.answered, method.refused, method.missed) == (2, 1, 1, 0)


def test_the_interval_of_a_mean_covers_it_where_frames_differ():
    """alpha = 0.05 over 400 draws: at most 36 misses with a probability of 0.999; frames taken as one have far more."""
    rng, misses, naive = np.random.default_rng(7), 0, 0
    for _ in range(400):
        frames = np.repeat(np.arange(24), 5)
        values = 3.0 + rng.normal(0, 1.0, 24)[frames] + rng.normal(0, 0.3, len(frames))
        rows = results(values.tolist(), frames.tolist())
        low, high = mean_error(rows, "error_fine_deg").interval_deg
        misses += not low <= 3.0 <= high
        # Negative control: highlights as if they were independent.
        half = 2 * values.std() / math.sqrt(len(values))
        naive += abs(values.mean() - 3.0) > half
    assert misses <= 36
    assert naive > 60


def skewed_frames(rng, each):
    """Draw frames at four distances: few highlights or many, errors that are skewed, frames without an answer."""
    frames = []
    for stratum in range(4):
        for _ in range(each):
            many = rng.uniform() < 0.1
            size = int(rng.integers(8, 30)) if many else rng.geometric(0.35) - 1
            middle = (3 - 0.4 * stratum) * np.exp(rng.normal(0, 0.4)) * (1.5 if many else 1)
            frames.append((stratum, middle * np.exp(rng.normal(0, 0.4, size))))
    return frames


def test_the_interval_holds_where_the_number_of_highlights_varies():
    """If 5.7 % of the intervals miss, of 300 more than 31 do with a probability of 0.001."""
    rng = np.random.default_rng(11)
    many = [values for _ in range(800) for _, values in skewed_frames(rng, 10)]
    true = np.concatenate(many).mean()
    missed, naive = 0, 0
    for _ in range(300):
        frames = skewed_frames(rng, 10)
        shown = [(stratum, values) for stratum, values in frames if len(values)]
        counts = [len(values) for _, values in shown]
        values = np.concatenate([values for _, values in shown])
        strata, numbers = np.repeat([stratum for stratum, _ in shown], counts), np.repeat(np.arange(len(shown)), counts)
        rows = results(values.tolist(), numbers.tolist()).with_columns(setting=pl.Series(strata.astype(str)))
        low, high = mean_error(rows, "error_fine_deg", 10).interval_deg
        missed += not low <= true <= high
        # Negative control: numbers of highlights taken as given.
        half = of_given_numbers(values, strata, numbers)
        naive += abs(values.mean() - true) > half
    assert missed <= 31
    assert naive > 31


def test_intervals_of_few_frames():
    def interval(values, distances):
        rows = results(values, range(len(values))).with_columns(setting=pl.Series(distances))
        return mean_error(rows, "error_fine_deg", 1).interval_deg

    assert interval([2.0], ["a"]) == (None, None)
    # Two frames at two distances: the spread between them is all that is known.
    low, high = interval([2.0, 3.0], ["a", "b"])
    assert low < 1
    assert high > 6
    # Equal frames have no spread.
    assert interval([3.0] * 8, [*"aaaabbbb"]) == pytest.approx((3.0, 3.0))
    # A frame at a distance of its own widens nothing where others tell the spread.
    assert interval([2.0, 3.0, 2.5, 4.0, 5.0], [*"aaaab"])[1] > 3.3


@pytest.mark.parametrize(
    ("high", "said"), [(1.1, None), (1.29, "32 frames"), (2.49, "344 frames"), (200.0, "more frames")]
)
def test_a_wide_interval_names_the_frames_that_narrow_it(high, said):
    found = read_results(results([1.0, 1.2, 0.8, 1.0], [0, 1, 2, 3]), 8, 2)
    own = replace(found.method("cone_axis").fine, mean_deg=1.0, interval_deg=(0.5, high))
    found = replace(found, methods=[replace(found.method("cone_axis"), fine=own)])
    advised = SimpleNamespace(answers=found)
    text = sentence(advised, found.choices[0])
    assert ("wide" in text) == (said is not None)
    assert said is None or said in text
    if said is not None and said != "more frames":
        number = said.split()[0]
        for command in ("simtest advise laparoscope --out 'a b'", "simtest advise laparoscope --frames 8 --out 'a b'"):
            assert narrower(advised, command) == f"simtest advise laparoscope --out 'a b' --frames {number}"
    else:
        assert narrower(advised, "simtest advise laparoscope --out a") is None


@pytest.mark.parametrize(("base_deg", "said"), [(2.5, True), (6.5, False), (None, False)])
def test_the_best_for_the_base_is_compared_with_fine_normals(base_deg, said):
    """`cloud` is ranked alone for the base: a method of the fine surface that comes nearer to it is named."""
    found = read_results(results([1.0, 1.2, 0.8, 1.0], [0, 1, 2, 3]), 8, 2)
    single = found.method("cone_axis")
    near = replace(single, base=replace(single.fine, mean_deg=base_deg))
    cloud = replace(single, estimator="cloud", target="base", base=replace(single.fine, mean_deg=6.0))
    choice = replace(found.choices[0], target="base", best="cloud", ties=())
    advised = SimpleNamespace(answers=replace(found, methods=[near, cloud]))
    assert ("fine normals of cone_axis lie nearer to it: mean 2.5 deg, 4 of 4" in sentence(advised, choice)) == said
    assert "lie nearer" not in sentence(advised, found.choices[0])


@pytest.mark.render
@pytest.mark.slow
def test_every_figure_runs_again_and_the_page_prints_how(tmp_path):
    scope = read_scope(written(tmp_path, CAMERA + "[rig]\nlights_mm = [[2.0, 0.0, 0.0]]\n"))
    out = tmp_path / "out"
    found = advise(Question(scope, "plane", (15.0, 30.0), frames=8), out)
    page = write_advice(found, out, "simtest advise").read_text(encoding="utf-8")
    record = json.loads((out / "advice.json").read_text(encoding="utf-8"))
    for command in record["commands"].values():
        assert command in page
    assert counts(found.answers) in page
    # The command of the errors, with another folder: the same rows, so the same figures.
    run = simtest.validate(out / MAIN, tmp_path / "again")
    again = read_results(run.results, 8)
    assert again == found.answers
    by_setting = run.summary["experiments"]["experiment"]["settings"]["plane"]
    assert by_setting["curved"]["mean_deg"] == pytest.approx(found.answers.method("curved").fine.mean_deg)
    # A smooth plane under a light 2 mm beside the camera obeys the law of the offset.
    law = np.mean([math.degrees(math.atan(2.0 / d) / 2) for d in distances_of(found.question)])
    assert found.answers.method("cone_axis").fine.mean_deg == pytest.approx(law, rel=0.1)
    assert len(record["break_points"]) == len(found.breaks) == page.count('<td class="text wrap-short">') / 2
    # Kept runs are not rendered anew.
    kept = (out / RUN / "results.parquet").stat().st_mtime_ns
    advise(found.question, out)
    assert (out / RUN / "results.parquet").stat().st_mtime_ns == kept


@pytest.mark.parametrize(
    ("organ", "relief"),
    [
        *((organ, "") for organ in ORGANS),
        ("colon", "[relief]\nslope_deg = 0.0\n"),
        ("plane", "[relief]\nslope_deg = 2.0\n"),
    ],
)
def test_the_picture_has_a_sound_scene_for_each_organ_and_relief(tmp_path, organ, relief):
    question = Question(read_scope(written(tmp_path, CAMERA + relief)), organ)
    scene = simtest.load_scene(write_scene(question, main_experiment(question), tmp_path / "scene.toml"))
    smooth = relief.endswith("= 0.0\n") or (organ == "plane" and not relief)
    assert (scene.surface.relief is None) == smooth
    assert (scene.camera.width, scene.camera.height) == (96, 72)
    assert scene.sensor.preset == ORGANS[organ].sensor


def test_frames_that_follow_each_other_share_their_relief():
    around = surroundings(Question(read_scope("laparoscope"), "liver", (20.0, 60.0), frames=40, seed=3))
    seeds = np.array(drawn_values(around, 3, 5, DISTANCES)[RELIEF_SEED]).reshape(5, DISTANCES)
    assert all(len(np.unique(row)) == 1 for row in seeds)
