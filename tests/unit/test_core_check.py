"""`simtest core check`: sound cores pass, and each planted fault is found and told in one line."""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from simtest.errors import InputError
from simtest.estimators.process import check as checks
from simtest.estimators.process.check import check_core, core_cases

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "cores" / "python"
BAD = Path(__file__).parent / "cores" / "bad_core.py"

pytestmark = pytest.mark.skipif(not EXAMPLES.is_dir(), reason="the checkout's examples folder is not there")

# Each way in which a core fails once; tests/unit/test_process_faults.py has all that may be wrong.
AT_START = {
    "protocol": "core_protocol: hello: protocol 2; simtest speaks 1",
    "exit_at_start": "core_died: the core ended with exit code 4; its last words: no such model",
    "hang_at_start": "core_timeout: no answer within",
}

IN_ANSWERS = {
    "nan": "not_finite: normal holds NaN",
    "zero": "normal of length 0",
    "none": r"looks at the pixel \(320, 240\), outside the region",
    "garbage_text": "no JSON: normal: 0 0 1",
    "wrong_id": "an answer with id .* to request",
    "exit": "core_died: the core ended with exit code 3; its last words: no licence for this highlight",
    "hang": "core_timeout: no answer within",
    "exit_after": "core_died: the core ended with exit code 0",
    "exit_after_hello": "core_died: the core ended with exit code 5",
}

SLOW = {
    "closes_stdout": "closed its standard output but did not end",
    "closes_stdin": "closed its standard input but did not end",
    "reads_nothing": "core_timeout",
    "stays": "the core runs on; must end within 2 s",
}

OF_FRAMES = {
    "nan": "not_finite: estimate 0: normal holds NaN",
    "none": r"looks at the pixel \(320, 240\); must lie in the frame of 160 x 120 px",
    "unknown_type": "must be estimates or failure",
    "exit": "core_died",
    "level": "must be none, since a frame has no peak",
}


def check(folder, command, limit_s=0.4, start_limit_s=10.0):
    """Check a core whose limits are short."""
    file = folder / "core.toml"
    words, limits = json.dumps(shlex.join(command)), f"time_limit_s = {limit_s}\nstart_limit_s = {start_limit_s}\n"
    file.write_text(f'[core]\nname = "under_test"\ncommand = {words}\n{limits}')
    return check_core(str(file))


def check_fault(folder, fault, *options):
    report = check(folder, [sys.executable, "-S", str(BAD), fault, *options])
    assert not report.is_ok
    return report, [step.text for step in report.steps if not step.is_ok]


@pytest.mark.parametrize("fault", AT_START)
def test_a_core_that_does_not_greet_is_told_why(fault, tmp_path):
    # Only the one that is to time out is given little time: a busy machine starts Python slowly.
    start_limit_s = 0.5 if fault == "hang_at_start" else 30.0
    report = check(tmp_path, [sys.executable, "-S", str(BAD), fault], start_limit_s=start_limit_s)
    assert [(step.name, step.is_ok) for step in report.steps] == [("start", False)]
    assert re.search(AT_START[fault], report.steps[0].text)


@pytest.mark.parametrize("fault", IN_ANSWERS)
def test_a_fault_in_answers_is_found(fault, tmp_path):
    report, wrong = check_fault(tmp_path, fault)
    assert report.steps[0].is_ok
    assert any(re.search(IN_ANSWERS[fault], text) for text in wrong), wrong
    assert all("\n" not in text for text in wrong)


@pytest.mark.slow
@pytest.mark.parametrize("fault", SLOW)
def test_a_core_that_does_not_end_is_found(fault, tmp_path):
    _, wrong = check_fault(tmp_path, fault)
    assert any(SLOW[fault] in text for text in wrong), wrong


@pytest.mark.parametrize("fault", OF_FRAMES)
def test_a_fault_of_a_frame_core_is_found(fault, tmp_path):
    _, wrong = check_fault(tmp_path, fault, "--frame")
    assert any(re.search(OF_FRAMES[fault], text) for text in wrong), wrong


def test_no_highlight_found_is_an_answer(tmp_path):
    assert check(tmp_path, [sys.executable, "-S", str(BAD), "none_found", "--frame"]).is_ok


@pytest.mark.parametrize("script", ["core.py", "frame_core.py"])
def test_a_sound_core_passes_and_is_near_the_truth(script, tmp_path, monkeypatch):
    # A busy machine ends Python slowly.
    monkeypatch.setattr(checks, "END_S", 30.0)
    report = check(tmp_path, [sys.executable, str(EXAMPLES / script)], limit_s=10.0)
    assert report.is_ok, list(report.lines())
    assert report.hello.kind == ("patch" if script == "core.py" else "frame")
    cases = core_cases(report.hello.kind)
    assert [step.name for step in report.steps][1 : len(cases) + 1] == [case.name for case in cases]
    (frame,) = (step.text for step in report.steps if step.name == "camera frame")
    assert float(frame.split()[1]) < 0.02
    assert 0 < report.median_ms <= report.slowest_ms


def changed_core(folder, change):
    """Return the command of the Python core whose answers a statement changes."""
    script = folder / "changed.py"
    script.write_text(
        f"import random, sys\nsys.path.insert(0, {str(EXAMPLES)!r})\nimport core\nsound = core.estimate\n"
        f"def estimate(request, arrays):\n    answer = sound(request, arrays)\n"
        f"    if answer['type'] == 'estimate':\n        {change}\n    return answer\n"
        "core.estimate = estimate\ncore.main()\n"
    )
    return [sys.executable, str(script)]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("answer['normal'][1] *= -1", "in the core's normals y points up; must be x to the right, y down"),
        ("answer['normal'][0] *= -1", "in the core's normals x points to the left"),
        pytest.param(
            "answer['normal'] = [-answer['normal'][0], -answer['normal'][1], answer['normal'][2]]",
            "both reversed",
            marks=pytest.mark.ci,
        ),
        ("answer['normal'][:2] = answer['normal'][1::-1]", "x and y are swapped; must be x to the right, y down"),
        pytest.param(
            "answer['normal'] = [-n for n in answer['normal']]",
            "the normal faces away from the camera",
            marks=pytest.mark.ci,
        ),
        ("del answer['look_ray']; answer['look_px'] = [36.0, 36.0]", "outside the region; must count from the corner"),
        pytest.param(
            "answer['normal'] = [0.0, 0.6 + 1e-4 * random.random(), -0.8]", "the answers differ", marks=pytest.mark.ci
        ),
    ],
)
def test_a_usual_mistake_is_named(change, expected, tmp_path):
    report = check(tmp_path, changed_core(tmp_path, change), limit_s=10.0)
    assert any(expected in step.text for step in report.steps if not step.is_ok), list(report.lines())


def test_a_core_that_ends_badly_is_told_its_exit_code(tmp_path):
    script = tmp_path / "ends.py"
    script.write_text(f"import sys\nsys.path.insert(0, {str(EXAMPLES)!r})\nimport core\ncore.main()\nsys.exit(7)\n")
    report = check(tmp_path, [sys.executable, str(script)], limit_s=10.0)
    assert [step.text for step in report.steps if not step.is_ok] == ["ends with exit code 7; must be 0"]


def test_a_command_may_end_with_a_toml_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "settings.toml").write_text("[core]\n")
    report = check_core(f"{sys.executable} -c 'import sys; sys.exit(3)' settings.toml")
    assert [step.text for step in report.steps] == ["core_died: the core ended with exit code 3"]
    (tmp_path / "my core.toml").write_text(f"[core]\nname = 'mine'\ncommand = \"{sys.executable} -c 'exit(4)'\"\n")
    assert "exit code 4" in check_core("my core.toml").steps[0].text


def test_a_command_that_cannot_be_run_is_bad_input(tmp_path):
    with pytest.raises(InputError, match="no program 'no_such_core' on PATH"):
        check_core("no_such_core --fast")
    with pytest.raises(InputError, match=r"core\.toml"):
        check_core(str(tmp_path / "core.toml"))


def test_the_cases_show_what_their_names_say():
    patch = {case.name: case.frame.patch(case.box) for case in core_cases("patch")}
    assert patch["clipped peak"].saturated.any()
    assert not hasattr(patch["isophote that does not close"].isophote(0.5), "shape")
    assert hasattr(patch["plane"].isophote(0.5), "shape")
    assert patch["region at the frame's border"].origin_px[0] == 0
    assert min(patch["large region"].values.shape) > 400
    assert patch["dark"].peak_value < 1e-4
    for case in (*core_cases("patch"), *core_cases("frame")):
        np.testing.assert_allclose(np.linalg.norm(case.normals, axis=1), 1.0)
        assert case.frame.camera.contains(case.frame.camera.project(-case.normals)).all()


def test_the_command_prints_lines_or_json_and_exits_with_the_verdict(here):
    command = shlex.join([sys.executable, str(EXAMPLES / "core.py")])
    code, out, _ = here("core", "check", command)
    assert code == 0
    assert out.splitlines()[0].startswith("core   cone_axis_python 1.0 (kind patch, transport stream; wants isophote_")
    assert out.splitlines()[-1] == "result all 16 steps ok"
    code, out, _ = here("core", "check", shlex.join([sys.executable, str(BAD), "exit"]), "--json")
    assert code == 1
    report = json.loads(out)
    assert report["ok"] is False
    assert report["hello"]["name"] == "bad core"
    assert report["steps"][1]["text"].endswith("no licence for this highlight")
    assert here("core", "check", "no_such_core")[0] == 2


def test_a_core_called_as_an_installed_estimator_is_refused(tmp_path):
    script = tmp_path / "cone_axis.py"
    script.write_text(BAD.read_text())
    with pytest.raises(InputError, match="is called cone_axis, as an installed estimator is"):
        check_core(shlex.join([sys.executable, str(script)]))
