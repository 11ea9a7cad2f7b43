"""The example cores in C++ and Octave answer as the one in Python does."""

import shlex
import subprocess

import core_driver
import numpy as np
import pytest
import test_example_cores
from test_example_cores import CLOSE, CORES, answers_of, check_refusals

from simtest.estimators.process.check import check_core

asked, of_python = test_example_cores.asked, test_example_cores.of_python


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    program = tmp_path_factory.mktemp("cpp") / "core"
    source = str(CORES / "cpp" / "core.cpp")
    subprocess.run(["g++", "-O2", "-std=c++17", "-Wall", "-Werror", "-o", str(program), source], check=True)
    return [str(program)]


def command_of(kind, request):
    if kind == "cpp":
        return request.getfixturevalue("compiled")
    transport = ["files"] if kind == "octave_files" else []
    return ["octave-cli", "-qf", str(CORES / "octave" / "core.m"), *transport]


@pytest.mark.parametrize("kind", ["cpp", "octave", "octave_files"])
def test_another_language_gives_the_same_numbers(kind, asked, of_python, tmp_path, request):
    hello, answers = answers_of(command_of(kind, request), asked, tmp_path)
    assert (hello["type"], hello["protocol"], hello["kind"]) == ("hello", 1, "patch")
    for own, python in zip(answers, of_python, strict=True):
        assert own["type"] == python["type"] == "estimate"
        assert own["id"] == python["id"]
        np.testing.assert_allclose(own["normal"], python["normal"], rtol=0, atol=CLOSE)
        np.testing.assert_allclose(own["look_ray"], python["look_ray"], rtol=0, atol=CLOSE)
        assert own["axis_ratio"] == pytest.approx(python["axis_ratio"], abs=CLOSE)


@pytest.mark.parametrize("kind", ["cpp", "octave"])
def test_unknown_keys_are_passed_over(kind, asked, of_python, tmp_path, request):
    header, arrays, *_ = asked[0]
    later = {"a later field": [{"deep": [1, None, True, 'ä " \\ \n']}, -1.5e-3], **header}
    with core_driver.CoreDriver(command_of(kind, request), tmp_path) as core:
        answer = core.ask(later, arrays)
    np.testing.assert_allclose(answer["normal"], of_python[0]["normal"], rtol=0, atol=CLOSE)


@pytest.mark.parametrize("kind", ["cpp", "octave"])
def test_the_other_languages_pass_the_check(kind, request):
    named = CORES / "octave" / "core.toml" if kind == "octave" else shlex.join(request.getfixturevalue("compiled"))
    report = check_core(str(named))
    assert report.is_ok, list(report.lines())


@pytest.mark.parametrize("kind", ["cpp", "octave", "octave_files"])
def test_a_refusal_states_its_reason(kind, tmp_path, request):
    check_refusals(command_of(kind, request), tmp_path)
