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
from simtest.estimators.process.core import MAX_FAULTS, Core, ProcessEstimator, ProcessFrameEstimator, parse_core
from simtest.estimators.process.pipe import CoreFault
from tests.unit.core_helpers import CAMERA, PATCH, bad_command, processes_with, script_command, wait_until

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


FILES_CORE = """import json, os, shutil, sys
hello = {"type": "hello", "protocol": 1, "name": "files", "kind": "patch", "transport": "files"}
def answer(request):
    fields = {"type": "estimate", "normal": [0, 0, -1], "look_px": [320, 240]}
    open(request["folder"] + "/answer.json", "w").write(json.dumps(fields))
for line in sys.stdin:
    request = json.loads(line)
    if "folder" in request:
        ACT
    print(json.dumps({"type": "done", "id": NUMBER} if "folder" in request else hello), flush=True)
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Let the cores' folders stand where the test sees them."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    yield tmp_path
    assert list(tmp_path.glob("simtest-core-*")) == []


@pytest.fixture
def started(folder):
    """Start cores that break down, each with the word of its processes; at the end none of these may be left."""
    held = []

    def start(*arguments, **limits):
        command, mark = bad_command(*arguments, **limits)
        core = Core(command)
        held.append((core, mark))
        core.start()
        return core, mark

    yield start
    for core, mark in held:
        core.close()
        assert wait_until(lambda mark=mark: not processes_with(mark))


@pytest.fixture
def scripted(folder):
    """Start a core of a given text."""
    held = []

    def start(text):
        held.append(Core(script_command(folder, text)))
        held[-1].start()
        return held[-1]

    yield start
    for core in held:
        core.close()


def limits(fault, reason):
    """Return a short limit where the limit is what is tested, else one that a busy machine keeps to."""
    if reason != "core_timeout":
        return 20.0
    # What was begun must have come by then.
    return 2.0 if fault.startswith("half") else SHORT_S


def answer_of(core):
    """Ask a core of either kind about a highlight at the image's centre."""
    if core.hello.kind == "patch":
        return run(ProcessEstimator(core), PATCH, CAMERA)
    frame = Frame(np.zeros((480, 640), np.float32) + 0.5, Calibration(CAMERA), 2.0)
    return run_in_frame(ProcessFrameEstimator(core), frame, [PATCH], NO_PRIORS).of_patches[0]


def failure_of(core):
    made = answer_of(core)
    assert isinstance(made, Failure), made
    assert "\n" not in made.detail
    return made


@pytest.mark.parametrize(("fault", "reason", "words"), TRANSPORT)
def test_a_core_that_breaks_down_is_a_failure_and_the_next_highlight_has_a_new_core(
    folder, started, fault, reason, words
):
    core, mark = started(fault, limit_s=limits(fault, reason))
    failure = failure_of(core)
    assert (failure.reason, words in failure.detail) == (Reason(reason), True), failure
    # Killed, with everything that it had started; the system may take a moment to end what is none of our children.
    assert wait_until(lambda: not processes_with(mark))
    assert list(folder.glob("simtest-core-*")) == []
    assert failure_of(core).reason == reason


@pytest.mark.parametrize("kind", ["patch", "frame"])
def test_a_malformed_answer_is_a_failure_of_its_highlight_and_the_core_goes_on(started, kind):
    # Each fault twice, all in one process: its messages are in step.
    core, mark = started(",".join(fault for fault, *_ in ANSWERS for _ in range(2)), f"--{kind}")
    for fault, reason, words in ANSWERS:
        for _ in range(2):
            failure = failure_of(core)
            assert (failure.reason, words in failure.detail) == (Reason(reason), True), (fault, failure)
    assert len(processes_with(mark)) == 1


@pytest.mark.parametrize(("fault", "reason", "words"), STARTS)
def test_a_core_that_does_not_greet_as_it_must_is_told_at_the_start(started, fault, reason, words):
    with pytest.raises(CoreFault) as caught:
        started(fault, start_s=limits(fault, reason))
    assert (caught.value.reason, words in caught.value.detail) == (reason, True), caught.value.detail


@pytest.mark.parametrize(("fault", "words"), [("none_found", ""), ("too_many", "20000 estimates of a frame")])
def test_too_few_and_too_many_estimates_of_a_frame(started, fault, words):
    failure = failure_of(started(fault, "--frame")[0])
    assert failure.reason == ("estimator_error" if words else "no_estimate")
    assert words in failure.detail


def test_standard_error_is_drained_and_its_end_alone_is_kept(started):
    core, _ = started("flood_stderr")
    assert isinstance(answer_of(core), Estimate)
    assert len(core._child._stderr) <= 4096


def test_last_words_that_are_cut_begin_with_a_whole_word(folder):
    program = "import sys; sys.exit('first ' + 'word ' * 100 + 'last')"
    with pytest.raises(CoreFault) as caught:
        Core(parse_core(f'command: {sys.executable} -c "{program}"')).start()
    said = str(caught.value).partition("last words: ")[2]
    assert said.startswith("...word word ")
    assert said.endswith("word last")


@pytest.mark.parametrize("fault", ["exit_after", "flood_after"])
def test_a_core_that_breaks_down_after_an_answer_is_told_at_the_next_request(started, fault):
    core, _ = started(fault)
    made = [answer_of(core) for _ in range(4)]
    failures = [each for each in made if isinstance(each, Failure)]
    assert failures
    assert {each.reason for each in failures} <= {Reason.CORE_DIED, Reason.CORE_PROTOCOL}


def test_after_some_faults_in_a_row_a_core_is_not_started_again(started):
    core, mark = started("exit")
    made = [failure_of(core) for _ in range(MAX_FAULTS + 2)]
    assert {each.reason for each in made} == {Reason.CORE_DIED}
    assert [each.detail.startswith("not asked after 5 faults in a row") for each in made] == [False] * 5 + [True] * 2
    assert wait_until(lambda: not processes_with(mark))
    # The end of a run closes its cores; the next run asks again.
    core.close()
    assert "exit code 3" in answer_of(core).detail


def test_a_good_answer_between_faults_lets_a_core_go_on(started):
    core, _ = started("exit", "--spared1")
    made = [answer_of(core) for _ in range(2 * MAX_FAULTS + 4)]
    assert [isinstance(each, Estimate) for each in made] == [True, False] * (MAX_FAULTS + 2)
    assert not any("not asked" in str(each) for each in made)


@pytest.mark.parametrize(
    ("act", "number", "words"),
    [
        ("answer(request)", "1", "a line of type done with id 1 to request 2"),
        ("os.mkdir(request['folder'] + '/answer.json')", "request['id']", "answer.json: must be a plain file"),
        ("os.mkdir('request-2'); answer(request)", "request['id']", "changed the folder that it runs in"),
        ("answer(request); shutil.rmtree(os.getcwd())", "request['id']", "answer.json cannot be read (No such file"),
    ],
)
def test_a_core_that_spoils_its_folder_or_numbers_breaks_the_protocol(scripted, act, number, words):
    core = scripted(FILES_CORE.replace("ACT", act).replace("NUMBER", number))
    failures = [each for each in (answer_of(core), answer_of(core)) if isinstance(each, Failure)]
    assert {each.reason for each in failures} == {Reason.CORE_PROTOCOL}
    assert words in failures[0].detail
    assert (len(failures) == 1) == (number == "1" or "request-2" in act)


def test_an_answer_to_a_request_that_was_not_read_counts_for_nothing(scripted):
    held, threads = len(os.listdir("/proc/self/fd")), threading.active_count()
    core = scripted("""import json, os
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
    failure = failure_of(core)
    core.close()
    assert (failure.reason, "exit code 0" in failure.detail) == (Reason.CORE_DIED, True), failure
    assert (len(os.listdir("/proc/self/fd")), threading.active_count()) == (held, threads)


def test_an_empty_line_after_an_answer_is_named(scripted):
    core = scripted("""import json, sys
hello = {"type": "hello", "protocol": 1, "name": "core", "kind": "patch", "arrays": []}
for line in sys.stdin:
    request = json.loads(line)
    answer = {"type": "estimate", "id": request.get("id"), "normal": [0, 0, -1], "look_px": [320, 240]}
    print(json.dumps(answer) + chr(10) if "id" in request else json.dumps(hello), flush=True)
""")
    assert "an empty line" in answer_of(core).detail


def test_a_process_with_many_open_files_has_cores_too(started):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2048:
        pytest.skip(f"at most {hard} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 2048), hard))
    held = [os.dup(0) for _ in range(1100)]
    try:
        core, _ = started("grandchild", "--spared1")
        assert core._child.process.stdout.fileno() > 1023
        assert isinstance(answer_of(core), Estimate)
        failure = answer_of(core)
    finally:
        for file in held:
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert (failure.reason, "grandchild" in failure.detail) == (Reason.CORE_DIED, True)


def test_a_core_that_stays_after_its_input_closed_is_killed(started, monkeypatch):
    monkeypatch.setattr("simtest.estimators.process.pipe.Child.close.__defaults__", (SHORT_S,))
    core, mark = started("stays")
    assert isinstance(answer_of(core), Estimate)
    core.close()
    assert wait_until(lambda: not processes_with(mark))


def test_a_core_that_was_closed_is_started_again_by_the_next_request(started):
    core, _ = started("none")
    first = core._child.process.pid
    assert isinstance(answer_of(core), Estimate)
    core.close()
    assert isinstance(answer_of(core), Estimate)
    assert core._child.process.pid != first


def test_an_interrupt_in_the_middle_of_a_request_ends_the_core(started, monkeypatch):
    core, mark = started("hang")

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("simtest.estimators.process.pipe.Child._write", interrupt)
    with pytest.raises(KeyboardInterrupt):
        answer_of(core)
    assert wait_until(lambda: not processes_with(mark))
