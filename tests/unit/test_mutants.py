"""The guard: each planted fault applies to today's source, and a test is on record that catches it."""

import re
from types import SimpleNamespace

import pytest

from studies.gate.faults import FAULTS, HARMLESS
from studies.mutants import judging
from studies.mutants.__main__ import main
from studies.mutants.planting import Mutation, function_at
from studies.mutants.rows import BY_NAME, ROWS, TESTS, row

KEY = "names enter the seed tree by their length"


def test_every_fault_applies_to_the_source_and_its_tests_are_there():
    wrong = []
    for own in ROWS:
        try:
            # Other code, not another spelling of it
            assert all(each.code() != each.function.__code__ for each in own.mutations()), own.name
            assert own.tests, own.name
        except LookupError as error:
            wrong.append(f"{own.name}: {error}")
    assert not wrong
    assert len(BY_NAME) == len(ROWS) >= 181
    assert all(each.code() != each.function.__code__ for name in HARMLESS for each in HARMLESS[name])
    assert all(FAULTS.values())


def test_somebody_catches_every_fault():
    caught, files = judging.read_table(), {path.relative_to(TESTS.parent).as_posix() for path in TESTS.rglob("*.py")}
    assert set(caught) == set(BY_NAME)
    for name, who in caught.items():
        assert judging.is_caught(who), name
        if who.startswith("tests/"):
            path, _, test = who.partition("::")
            assert path in BY_NAME[name].tests, name
            assert path in files, name
            function = re.match(r"\w+", test.split("::")[-1])[0]
            assert re.search(rf"def {function}\(", (TESTS.parent / path).read_text(encoding="utf-8")), who


@pytest.mark.parametrize(
    ("where", "old"),
    [("geometry.camera:Camera.unproject", "nowhere in it"), ("geometry.camera:Camera.gone", "return"),
     ("gone:here", "return"), ("geometry.camera:Camera.unproject", "rays")],
)  # fmt: skip
def test_a_fault_that_does_not_apply_is_an_error(where, old):
    with pytest.raises(LookupError):
        row("gone", "lens", where, old, "1", "camera").mutations()


def test_a_test_file_that_is_gone_or_there_twice_is_an_error(tmp_path, monkeypatch):
    with pytest.raises(LookupError, match=r"test_gone\.py is there 0 times"):
        row("fault", "lens", "geometry.camera:Camera.unproject", "rays", "1", "gone").tests  # noqa: B018
    for folder in ("a", "b"):
        (tmp_path / "tests" / folder).mkdir(parents=True)
        (tmp_path / "tests" / folder / "test_two.py").write_text("", encoding="utf-8")
    monkeypatch.setattr("studies.mutants.rows.TESTS", tmp_path / "tests")
    with pytest.raises(LookupError, match=r"test_two\.py is there 2 times"):
        row("fault", "lens", "geometry.camera:Camera.unproject", "rays", "1", "two").tests  # noqa: B018
    assert row("fault", "lens", "geometry.camera:Camera.unproject", "rays", "1", "b/two").tests == (
        "tests/b/test_two.py",
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Write a test that sees names enter the seed tree by their length alone."""
    path = tmp_path_factory.mktemp("guard") / "test_own.py"
    text = "from simtest.runtime.seeds import key\n\n\ndef test_names():\n    assert key('ab') != key('cd')\n"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("fault", "who"), [(KEY, "::test_names"), ("k4 of a fisheye lost", judging.NOBODY)], ids=["caught", "not caught"]
)
def test_the_first_test_that_fails_catches_a_fault(file, fault, who):
    assert judging.catcher(SimpleNamespace(name=fault, tests=(str(file),))).endswith(who)


def test_tests_that_fail_or_hang_without_a_fault_are_said(file, tmp_path, monkeypatch):
    judging.check_sound(str(file))
    bad = tmp_path / "test_bad.py"
    bad.write_text("def test_red():\n    assert False\n", encoding="utf-8")
    with pytest.raises(judging.GuardError, match="without a fault the tests must pass"):
        judging.check_sound(str(bad))
    assert not judging.is_caught(judging.catcher(SimpleNamespace(name=KEY, tests=(str(tmp_path / "gone.py"),))))
    monkeypatch.setattr(judging, "LIMIT_S", 0.01)
    assert judging.catcher(SimpleNamespace(name=KEY, tests=(str(file),))) == judging.HANGS


def test_the_table_keeps_what_was_not_asked(tmp_path):
    path, (first, second, third) = tmp_path / "caught.json", ROWS[:3]
    judging.write_table(ROWS, {first.name: "a", "a row that is gone": "b", third.name: "c"}, path)
    assert judging.read_table(path) == {first.name: "a", third.name: "c"}
    judging.write_table(ROWS, {**judging.read_table(path), second.name: "d"}, path)
    assert list(judging.read_table(path)) == [first.name, second.name, third.name]


def test_the_command_prints_the_table_and_refuses_unknown_names(capsys, monkeypatch):
    assert main(["--only", "bench"]) == 0
    output = capsys.readouterr().out
    assert (
        output.splitlines()[-1] == f"{sum(own.room == 'bench' for own in ROWS)} of {output.count('| bench |')} caught."
    )
    assert main(["--only", "a fault that nobody wrote"]) == 2
    assert "--only a fault that nobody wrote: unknown; allowed: advice, " in capsys.readouterr().err
    monkeypatch.setattr("studies.mutants.__main__.read_table", dict)
    assert main(["--only", KEY]) == 1
    assert "| not asked |" in capsys.readouterr().out


def test_a_planted_change_is_taken_out_again():
    from simtest.runtime.seeds import key
    from studies.mutants.planting import planted

    before = key("ab")
    with planted(Mutation(function_at("simtest.runtime.seeds:key"), "text.encode()", "b''")):
        assert key("ab") == key("cd") != before
    assert key("ab") == before
