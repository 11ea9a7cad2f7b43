"""Whatever a core does is a Failure that is counted or one line, and leaves neither a process nor a folder."""

import os
import resource
import sys
import tempfile
import threading

import numpy as np
import pytest

from simtest.calibration import NO_PRIORS, Calibration, Frame
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.estimators.dispatch import run, run_in_frame
from simtest.estimators.process.core import (
    MAX_FAULTS,
    Core,
    CoreCommand,
    ProcessEstimator,
    ProcessFrameEstimator,
    parse_core,
)
from simtest.estimators.process.pipe import CoreFault
from tests.unit.core_helpers import CAMERA, PATCH, bad_command, processes_with, wait_until

SHORT_S = 0.3

TRANSPORT = [
    ("kill", "core_died", "ended by SIGKILL"),
    ("segfault", "core_died", "ended by SIGSEGV"),
    ("exit", "core_died", "exit code 3; its last words: no licence for this highlight"),
    ("exit_after_hello", "core_died", "exit code 5"),
    ("grandchild", "core_died", "exit code 0"),
    ("hang", "core_timeout", "no answer within"),
    ("ignores_term", "core_timeout", "no answer within"),
    ("reads_nothing", "core_timeout", "no answer within"),
    ("half_line", "core_timeout", "begun (25 bytes)"),
    pytest.param("half_array", "core_timeout", "begun (5 bytes)", marks=pytest.mark.ci),  # waits 4 s, as half_line does
    ("late", "core_timeout", "no answer within"),
    ("closes_stdin", "core_protocol", "closed its standard input but did not end"),
    ("closes_stdout", "core_protocol", "closed its standard output but did not end"),
    ("flood", "core_protocol", "a line longer than 1048576 bytes"),
    ("garbage_text", "core_protocol", "no JSON: normal: 0 0 1"),
    ("garbage_json", "core_protocol", "no JSON"),
    ("binary", "core_protocol", "no JSON"),
    ("deep", "core_protocol", "no JSON"),
    ("list", "core_protocol", "no JSON object"),
    ("huge_array", "core_protocol", "arrays of 8000000000000 bytes"),
    ("negative", "core_protocol", "shape [-2]"),
    ("dtype", "core_protocol", "dtype '|O'"),
    ("wrong_shape", "core_protocol", 'shape "2"'),
    ("wrong_id", "core_protocol", "an answer with id 8 to request 1"),
    ("unknown_type", "core_protocol", "type 'poem'"),
    ("twice", "core_protocol", "more than one answer"),
]

ANSWERS = [
    ("nan", "not_finite", "normal holds NaN"),
    ("infinite_covariance", "not_finite", "covariance holds NaN or infinity"),
    ("zero", "estimator_error", "length 0"),
    ("long", "estimator_error", "length 2"),
    ("away", "estimator_error", "faces away"),
    ("text", "estimator_error", "must be numbers of shape (3)"),
    ("two", "estimator_error", "must be numbers of shape (3)"),
    ("no_look", "estimator_error", "look_px or look_ray: missing"),
    ("indefinite", "estimator_error", "no negative eigenvalue"),
    ("basis", "estimator_error", "basis"),
    ("candidates", "estimator_error", "first candidate"),
    ("target", "estimator_error", "target 'liver'"),
    ("flags", "estimator_error", "flags"),
]

STARTS = [
    ("exit_at_start", "core_died", "exit code 4; its last words: no such model"),
    ("hang_at_start", "core_timeout", "no answer within"),
    pytest.param("half_hello", "core_timeout", "begun (16 bytes)", marks=pytest.mark.ci),  # waits 2 s
    ("no_hello", "core_protocol", "Welcome to the core!"),
    ("protocol", "core_protocol", "protocol 2; simtest speaks 1"),
    ("kind", "core_protocol", "kind 'film'; must be patch or frame"),
    ("arrays_unknown", "core_protocol", "array 'truth'; must be one of values"),
    ("level", "core_protocol", "isophotes [1.5]"),
    ("no_name", "core_protocol", "name ''"),
    ("transport", "core_protocol", "transport 'smoke'"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Let the cores' folders stand where the test sees them."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    yield tmp_path
    assert list(tmp_path.glob("simtest-core-*")) == []


def limits(fault, reason):
    """Return a short limit where the limit is what is tested, else one that a busy machine keeps to."""
    if reason != "core_timeout":
        return 20.0
    # What was begun must have come by then.
    return 2.0 if fault.startswith("half") else SHORT_S


@pytest.mark.parametrize(("fault", "reason", "words"), TRANSPORT)
def test_a_core_that_breaks_down_is_a_failure_and_the_next_highlight_has_a_new_core(folder, fault, reason, words):
    command, mark = bad_command(fault, limit_s=limits(fault, reason))
    core = Core(command)
    core.start()
    estimator = ProcessEstimator(core)
    failure = run(estimator, PATCH, CAMERA)
    assert isinstance(failure, Failure), failure
    assert (failure.reason, words in failure.detail) == (Reason(reason), True), failure
    assert "\n" not in failure.detail
    # Killed, with everything that it had started; the system may take a moment to end what is none of our children.
    assert wait_until(lambda: not processes_with(mark))
    assert list(folder.glob("simtest-core-*")) == []
    again = run(estimator, PATCH, CAMERA)
    assert isinstance(again, Failure)
    assert again.reason == reason
    core.close()
    assert wait_until(lambda: not processes_with(mark))


@pytest.mark.parametrize(("fault", "reason", "words"), ANSWERS)
@pytest.mark.parametrize("kind", ["patch", "frame"])
def test_a_malformed_answer_is_a_failure_of_its_highlight_and_the_core_goes_on(folder, fault, reason, words, kind):
    command, mark = bad_command(fault, *(["--frame"] if kind == "frame" else []))
    core = Core(command)
    core.start()
    for _ in range(2):
        failure = answer_of(core)
        assert isinstance(failure, Failure)
        assert (failure.reason, words in failure.detail) == (Reason(reason), True), failure
    # Its messages are in step, so it is the same process still.
    assert len(processes_with(mark)) == 1
    core.close()
    assert wait_until(lambda: not processes_with(mark))


def answer_of(core):
    """Ask a core of either kind about a highlight at the image's centre."""
    if core.hello.kind == "patch":
        return run(ProcessEstimator(core), PATCH, CAMERA)
    frame = Frame(np.zeros((480, 640), np.float32) + 0.5, Calibration(CAMERA), 2.0)
    return run_in_frame(ProcessFrameEstimator(core), frame, [PATCH], NO_PRIORS).of_patches[0]


@pytest.mark.parametrize(("fault", "reason", "words"), STARTS)
def test_a_core_that_does_not_greet_as_it_must_is_told_at_the_start(folder, fault, reason, words):
    command, mark = bad_command(fault, start_s=limits(fault, reason))
    with pytest.raises(CoreFault) as caught:
        Core(command).start()
    assert caught.value.reason == reason
    assert words in caught.value.detail
    assert wait_until(lambda: not processes_with(mark))


@pytest.mark.parametrize(("fault", "words"), [("none_found", ""), ("too_many", "20000 estimates of a frame")])
def test_too_few_and_too_many_estimates_of_a_frame(folder, fault, words):
    core = Core(bad_command(fault, "--frame")[0])
    core.start()
    failure = answer_of(core)
    assert isinstance(failure, Failure)
    assert failure.reason == ("estimator_error" if words else "no_estimate")
    assert words in failure.detail
    core.close()


def test_standard_error_is_drained_and_its_end_alone_is_kept(folder):
    core = Core(bad_command("flood_stderr")[0])
    core.start()
    assert isinstance(answer_of(core), Estimate)
    assert len(core._child._stderr) <= 4096
    core.close()


def test_last_words_that_are_cut_begin_with_a_whole_word(folder):
    program = "import sys; sys.exit('first ' + 'word ' * 100 + 'last')"
    with pytest.raises(CoreFault) as caught:
        Core(parse_core(f'command: {sys.executable} -c "{program}"')).start()
    said = str(caught.value).partition("last words: ")[2]
    assert said.startswith("...word word ")
    assert said.endswith("word last")


@pytest.mark.parametrize("fault", ["exit_after", "flood_after"])
def test_a_core_that_breaks_down_after_an_answer_is_told_at_the_next_request(folder, fault):
    command, mark = bad_command(fault)
    core = Core(command)
    core.start()
    made = [answer_of(core) for _ in range(4)]
    failures = [each for each in made if isinstance(each, Failure)]
    assert failures
    assert {each.reason for each in failures} <= {Reason.CORE_DIED, Reason.CORE_PROTOCOL}
    core.close()
    assert wait_until(lambda: not processes_with(mark))


def test_after_some_faults_in_a_row_a_core_is_not_started_again(folder):
    command, mark = bad_command("exit")
    core = Core(command)
    core.start()
    made = [answer_of(core) for _ in range(MAX_FAULTS + 2)]
    assert {each.reason for each in made} == {Reason.CORE_DIED}
    assert [each.detail.startswith("not asked after 5 faults in a row") for each in made] == [False] * 5 + [True] * 2
    assert wait_until(lambda: not processes_with(mark))
    # The end of a run closes its cores; the next run asks again.
    core.close()
    assert "exit code 3" in answer_of(core).detail


def test_a_good_answer_between_faults_lets_a_core_go_on(folder):
    core = Core(bad_command("exit", "--spared1")[0])
    core.start()
    made = [answer_of(core) for _ in range(2 * MAX_FAULTS + 4)]
    assert [isinstance(each, Estimate) for each in made] == [True, False] * (MAX_FAULTS + 2)
    assert not any("not asked" in str(each) for each in made)
    core.close()


def test_a_line_of_type_done_has_the_number_of_its_request(folder):
    script = folder / "files_core.py"
    script.write_text("""import json, sys
hello = {"type": "hello", "protocol": 1, "name": "files", "kind": "patch", "transport": "files"}
answer = {"type": "estimate", "normal": [0, 0, -1], "look_px": [320, 240]}
for line in sys.stdin:
    request = json.loads(line)
    if "folder" in request:
        open(request["folder"] + "/answer.json", "w").write(json.dumps(answer))
    print(json.dumps({"type": "done", "id": 1} if "folder" in request else hello), flush=True)
""")
    core = Core(CoreCommand("files core", "files_core", (sys.executable, "-S", str(script)), (script,)))
    core.start()
    assert isinstance(answer_of(core), Estimate)
    late = answer_of(core)
    assert (late.reason, late.detail) == (Reason.CORE_PROTOCOL, "a line of type done with id 1 to request 2")
    core.close()


@pytest.mark.parametrize(
    ("act", "words"),
    [
        ("os.mkdir(request['folder'] + '/answer.json')", "answer.json: must be a plain file"),
        ("os.mkdir('request-2'); answer(request)", "changed the folder that it runs in"),
        ("answer(request); shutil.rmtree(os.getcwd())", "answer.json cannot be read (No such file"),
    ],
)
def test_a_core_that_spoils_its_folder_breaks_the_protocol(folder, act, words):
    script = folder / "files_core.py"
    script.write_text(f"""import json, os, shutil, sys
hello = {{"type": "hello", "protocol": 1, "name": "files", "kind": "patch", "transport": "files"}}
def answer(request):
    fields = {{"type": "estimate", "normal": [0, 0, -1], "look_px": [320, 240]}}
    open(request["folder"] + "/answer.json", "w").write(json.dumps(fields))
for line in sys.stdin:
    request = json.loads(line)
    if "folder" in request:
        {act}
    print(json.dumps({{"type": "done", "id": request["id"]}} if "folder" in request else hello), flush=True)
""")
    core = Core(CoreCommand("files core", "files_core", (sys.executable, "-S", str(script)), (script,)))
    core.start()
    failures = [each for each in (answer_of(core), answer_of(core)) if isinstance(each, Failure)]
    core.close()
    assert {each.reason for each in failures} == {Reason.CORE_PROTOCOL}
    assert words in failures[0].detail


def test_an_answer_to_a_request_that_was_not_read_counts_for_nothing(folder):
    script = folder / "early_core.py"
    script.write_text("""import json, os
hello = {"type": "hello", "protocol": 1, "name": "early", "kind": "frame", "arrays": ["intensity", "noise"]}
def line():
    text = b""
    while not text.endswith(bytes([10])):
        text += os.read(0, 1)
    return json.loads(text)
def send(message):
    os.write(1, json.dumps(message).encode() + bytes([10]))
line()
send(hello)
number = line()["id"]
send({"type": "estimates", "id": number, "estimates": [{"normal": [0, 0, -1], "look_px": [320, 240]}]})
""")
    held, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    core = Core(CoreCommand("early core", "early", (sys.executable, "-S", str(script)), (script,)))
    core.start()
    failure = answer_of(core)
    core.close()
    assert isinstance(failure, Failure)
    assert (failure.reason, "exit code 0" in failure.detail) == (Reason.CORE_DIED, True), failure
    assert (len(os.listdir("/proc/self/fd")), threading.active_count()) == (held, threads)


def test_an_empty_line_after_an_answer_is_named(folder):
    script = folder / "core.py"
    script.write_text(
        """import json, sys
hello = {"type": "hello", "protocol": 1, "name": "core", "kind": "patch", "arrays": []}
for line in sys.stdin:
    request = json.loads(line)
    answer = {"type": "estimate", "id": request.get("id"), "normal": [0, 0, -1], "look_px": [320, 240]}
    sys.stdout.write(json.dumps(hello) + "\\n" if "id" not in request else json.dumps(answer) + "\\n\\n")
    sys.stdout.flush()
""".replace("\\\\n", "\\n")
    )
    core = Core(CoreCommand("core", "core", (sys.executable, "-S", str(script)), (script,)))
    core.start()
    assert "an empty line" in answer_of(core).detail
    core.close()


def test_a_process_with_many_open_files_has_cores_too(folder):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2048:
        pytest.skip(f"at most {hard} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2048), hard))
    held = [os.dup(0) for _ in range(1100)]
    try:
        core = Core(bad_command("grandchild", "--spared1")[0])
        core.start()
        assert core._child.process.stdout.fileno() > 1023
        assert isinstance(answer_of(core), Estimate)
        failure = answer_of(core)
    finally:
        for file in held:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert (failure.reason, "grandchild" in failure.detail) == (Reason.CORE_DIED, True)
    core.close()


def test_a_core_that_stays_after_its_input_closed_is_killed(folder, monkeypatch):
    monkeypatch.setattr("simtest.estimators.process.pipe.Child.close.__defaults__", (SHORT_S,))
    command, mark = bad_command("stays")
    core = Core(command)
    core.start()
    assert isinstance(answer_of(core), Estimate)
    core.close()
    assert wait_until(lambda: not processes_with(mark))


def test_a_core_that_was_closed_is_started_again_by_the_next_request(folder):
    core = Core(bad_command("none")[0])
    core.start()
    first = core._child.process.pid
    assert isinstance(answer_of(core), Estimate)
    core.close()
    assert isinstance(answer_of(core), Estimate)
    assert core._child.process.pid != first
    core.close()


def test_an_interrupt_in_the_middle_of_a_request_ends_the_core(folder, monkeypatch):
    command, mark = bad_command("hang")
    core = Core(command)
    core.start()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("simtest.estimators.process.pipe.Child._write", interrupt)
    with pytest.raises(KeyboardInterrupt):
        answer_of(core)
    assert wait_until(lambda: not processes_with(mark))
