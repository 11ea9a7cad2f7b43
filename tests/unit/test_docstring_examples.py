"""The examples in the docstrings of all public names: each has one, and each runs as written."""

import doctest
import inspect

import pytest

import simtest
from simtest import api

PUBLIC = sorted({*simtest.__all__, *(name for name in api.__all__ if name in ("render", "export", "validate"))})
MARKS = {
    "LabelledFrame": [pytest.mark.render],
    "export": [pytest.mark.render],
    "render": [pytest.mark.render],
    "validate": [pytest.mark.render, pytest.mark.slow],
}


def examples_of(name):
    text = inspect.getdoc(getattr(simtest, name))
    return doctest.DocTestParser().get_doctest(text, {}, name, None, 0)


@pytest.mark.parametrize("name", PUBLIC)
def test_each_public_name_has_an_example(name):
    assert examples_of(name).examples, name


@pytest.mark.parametrize("name", [pytest.param(name, marks=MARKS.get(name, ())) for name in PUBLIC])
def test_examples_run_as_written(name, monkeypatch, tmp_path):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    outcome = runner.run(examples_of(name), out=said.append, clear_globs=True)
    assert outcome.failed == 0, "".join(said)


def test_a_wrong_example_is_noticed():
    wrong = doctest.DocTestParser().get_doctest(">>> 1 + 1\n3\n", {}, "wrong", None, 0)
    assert doctest.DocTestRunner().run(wrong, out=lambda text: None).failed == 1
