"""The suite of mutants: each applies to today's source, answers are kept, and a handful is named by its canary."""

import json

import pytest
from simtest.nightly.canaries import measures

from studies.mutants import judging
from studies.mutants.__main__ import main, table
from studies.mutants.catalogue import BY_NAME, MUTANTS, UNCHANGED
from studies.mutants.child import LADDER
from studies.mutants.further import FURTHER
from studies.mutants.kinds import KINDS, MEASURES, QUANTITIES, measures_of, naming
from studies.mutants.mutant import mutant


@pytest.mark.parametrize("own", BY_NAME.values(), ids=lambda own: own.name)
def test_a_mutant_applies_to_the_source(own):
    for mutation in own.mutations():
        # Other code, not another spelling of it
        assert mutation.code() != mutation.function.__code__
        assert mutation.old != mutation.new


def test_the_list_is_whole():
    assert len(MUTANTS) >= 60
    assert len(FURTHER) == 10
    assert len(BY_NAME) == len(MUTANTS) + len(FURTHER) + 1
    assert {own.kind for own in BY_NAME.values()} == set(KINDS)
    assert set(QUANTITIES) <= set(KINDS)
    assert {name for names in KINDS.values() for name in names} <= set(MEASURES)
    assert {name for names in MEASURES.values() for name in names} <= {*measures(), LADDER}


@pytest.mark.parametrize(
    ("where", "old"),
    [("simtest.geometry.camera:Camera.unproject", "nowhere in it"), ("simtest.geometry.camera:Camera.gone", "return"),
     ("simtest.gone:here", "return"), ("simtest.geometry.camera:Camera.unproject", "rays")],
)  # fmt: skip
def test_a_mutant_that_does_not_apply_is_an_error(where, old):
    with pytest.raises(LookupError):
        mutant("gone", "lens", where, old, "1").mutations()


def test_what_is_kept_on_disk_is_not_spoilt():
    spoils = {own.name for own in MUTANTS if own.spoils_kept_arrays}
    assert {"slope of the relief 20 % too low", "stages share one branch of the seed tree"} <= spoils
    assert "mean is the median" not in spoils


def test_only_canaries_of_the_faults_subject_name_it():
    assert naming("lens", ["photometry", "lens", "lens", "plane"]) == ["lens"]
    assert naming("lens", ["photometry"]) == []
    assert measures_of("light sign") == ["rigs", "photometry", "told_light"]


@pytest.fixture
def asked(monkeypatch):
    """Answers without processes: the canaries name statistics and nothing else, the gate calls `n` worse."""
    names = []

    def answer(name, stage):
        names.append((name, stage))
        if stage == "night":
            return {"name": name, "stage": stage, "worse": [] if name == UNCHANGED.name else [["grid", "n"]]}
        failed = [["statistics", "mean_off", 1.0]] if name == "mean is the median" else []
        return {"name": name, "stage": stage, "failed": failed}

    def answers(some, stage, file, profile):
        return [answer(name, stage) for name in some]

    monkeypatch.setattr(judging, "_asked", answers)
    return names


def test_the_gate_is_asked_about_what_canaries_do_not_name(asked, tmp_path):
    names = ["mean is the median", "only answers are counted", "k4 of a fisheye lost"]
    found = judging.run(names, tmp_path / "out" / "answers.jsonl", 2, lambda line: None)
    assert [each.by_name for each in found] == [False, True, True, False]
    assert ("mean is the median", "night") not in asked
    assert asked.index((UNCHANGED.name, "night")) < asked.index(("only answers are counted", "night"))
    text = table(found)
    assert "2 of 3 named" in text
    assert "| only answers are counted | counts | gate: grid n |" in text
    assert "| k4 of a fisheye lost | lens | nobody |" in text


def test_a_later_call_goes_on(asked, tmp_path):
    file = tmp_path / "answers.jsonl"
    known = {"name": "median is the mean", "stage": "canaries", "failed": [["statistics", "median_off", 1.0]]}
    known |= judging.stamp("")
    # The last line is what a kill left of one.
    file.write_text(json.dumps(known) + "\n" + '{"name": "mean is', encoding="utf-8")
    names = ["median is the mean", "mean is the median"]
    found = judging.run(names, file, 1, lambda line: None, None)
    assert asked == [(UNCHANGED.name, "canaries"), ("mean is the median", "canaries")]
    assert [each.by_name for each in found] == [False, True, True]
    judging.run(names, file, 1, lambda line: None, None)
    assert len(asked) == 2


def test_answers_about_other_code_are_not_told(asked, tmp_path, monkeypatch):
    file, names = tmp_path / "answers.jsonl", ["mean is the median"]
    judging.run(names, file, 1, lambda line: None, None)
    before, folder = len(asked), judging.night_folder(file, "quick")
    monkeypatch.setattr(judging, "source_hash", lambda: "of other code")
    judging.code_hash.cache_clear()
    try:
        assert judging.read(file) == {}
        assert judging.night_folder(file, "quick") != folder
        judging.run(names, file, 1, lambda line: None, None)
        assert len(asked) == 2 * before
    finally:
        judging.code_hash.cache_clear()


def test_nights_of_another_profile_are_not_told(asked, tmp_path):
    file, mine = tmp_path / "answers.jsonl", tmp_path / "mine.toml"
    mine.write_text("costs = false", encoding="utf-8")
    night = ("k4 of a fisheye lost", "night")
    judging.run([night[0]], file, 1, lambda line: None, str(mine))
    assert night in judging.read(file, str(mine))
    assert night not in judging.read(file, "quick")
    # What canaries told holds for every profile.
    assert (night[0], "canaries") in judging.read(file, "quick")
    folder = judging.night_folder(file, str(mine))
    mine.write_text("costs = true", encoding="utf-8")
    assert night not in judging.read(file, str(mine))
    assert len({folder, judging.night_folder(file, str(mine)), judging.night_folder(file, "quick")}) == 3
    judging.run([night[0]], file, 1, lambda line: None, "quick")
    assert asked.count(night) == 2
    assert asked.count((night[0], "canaries")) == 1


def _answers(monkeypatch, canaries=None, night=None):
    """Let the canaries, and the night, answer alike about unchanged code; a planted fault is named by its canary."""

    def answer(name, stage):
        if name != UNCHANGED.name:
            return {"name": name, "stage": stage, "failed": [["statistics", "mean_off", 1.0]]}
        return {"name": name, "stage": stage, **((canaries if stage == "canaries" else night) or {})}

    monkeypatch.setattr(judging, "_asked", lambda some, stage, *rest: [answer(name, stage) for name in some])


def _called(tmp_path, *more):
    return main(["--out", str(tmp_path / "answers.jsonl"), "--only", "mean is the median", *more])


def test_a_canary_that_fails_on_unchanged_code_is_an_alarm(monkeypatch, tmp_path, capsys):
    _answers(monkeypatch, canaries={"failed": [["photometry", "residual", 1.0]]})
    assert _called(tmp_path, "--canaries") == 1
    assert "alarms on unchanged code: 1 canaries, the gate not asked (photometry)." in capsys.readouterr().out


@pytest.mark.parametrize("canaries", [{}, {"stopped": "exit 1: no renderer"}])
def test_unchanged_code_must_be_quiet(monkeypatch, tmp_path, canaries):
    _answers(monkeypatch, canaries=canaries)
    assert _called(tmp_path, "--canaries") == (1 if canaries else 0)


@pytest.mark.parametrize("night", [{"worse": []}, {"worse": [["grid", "mean_deg"]]}, {"stopped": "exit 1: killed"}])
def test_the_gates_alarm_on_unchanged_code_is_one(monkeypatch, tmp_path, capsys, night):
    _answers(monkeypatch, night=night)
    # Nobody names this one but the gate, by a quantity of its kind: so the unchanged night is asked for.
    answer = judging._asked

    def answers(some, stage, *rest):
        if some == ["only answers are counted"]:
            worse = [["grid", "n"], ["grid", "mean_deg"]] if stage == "night" else []
            return [{"name": some[0], "stage": stage, "worse": worse}]
        return answer(some, stage, *rest)

    monkeypatch.setattr(judging, "_asked", answers)
    monkeypatch.setattr(judging, "BATCH", 1)
    quiet = night == {"worse": []}
    assert _called(tmp_path, "only answers are counted") == (0 if quiet else 1)
    text = capsys.readouterr().out
    assert "| only answers are counted | counts | gate: grid n | gate: grid mean_deg |" in text
    assert quiet or "grid mean_deg)." in text or "exit 1: killed)." in text


def test_the_gates_alarm_under_another_name_is_seen():
    answers = {
        ("k4 of a fisheye lost", "canaries"): {"failed": []},
        ("k4 of a fisheye lost", "night"): {"worse": [["grid", "mean_deg"]]},
    }
    (found,) = judging.judged(answers, ["k4 of a fisheye lost"])
    assert found.is_seen
    assert not found.by_name
    assert "0 of 1 named, 1 seen" in table([found])


def test_an_unknown_mutant_is_refused(capsys):
    assert main(["--only", "a fault that nobody wrote"]) == 2
    assert "unknown" in capsys.readouterr().err


def test_a_process_that_ends_without_an_answer_is_told(tmp_path):
    (answer,) = judging._asked(["mean is the median"], "night", tmp_path / "a.jsonl", "a profile that nobody wrote")
    assert answer["stopped"].startswith("exit 1: ")
    assert "a profile that nobody wrote" in answer["stopped"]


HANDFUL = (
    "k4 of a fisheye lost",
    "mean is the median",
    "one bounce too many",
    "covariance x 0.8",
    "instances counted from 0",
)


@pytest.mark.render
@pytest.mark.slow
def test_a_handful_is_named(tmp_path):
    found = judging.run(HANDFUL, tmp_path / "answers.jsonl", 1, lambda line: None, None)
    control, *planted = found
    assert not control.is_seen
    assert all(each.by_name for each in planted)


PROFILE = """
canaries = false
costs = false

[[experiments]]
experiment = "overview"
realisations = 2
labels = ["plane"]
"""


@pytest.mark.render
@pytest.mark.slow
def test_the_gate_names_what_it_can(tmp_path):
    profile = tmp_path / "small.toml"
    profile.write_text(PROFILE, encoding="utf-8")
    file = tmp_path / "answers.jsonl"
    answers = judging.ask([UNCHANGED.name], "night", file, 1, lambda line: None, str(profile))
    assert answers[UNCHANGED.name, "night"]["worse"] == []
    assert answers[UNCHANGED.name, "night"]["cells"] > 0
    answers = judging.ask(["error halved"], "night", file, 1, lambda line: None, str(profile))
    assert "worse" in answers["error halved", "night"]
