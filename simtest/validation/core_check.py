"""The check of a core against the process protocol: it is started, asked and ended, and each step is judged."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from simtest.errors import Failure, Reason
from simtest.estimators.dispatch import run, run_in_frame
from simtest.estimators.names import short_name
from simtest.estimators.process import PREFIX, is_core
from simtest.estimators.process.core import (
    Core,
    CoreCommand,
    Hello,
    ProcessEstimator,
    ProcessFrameEstimator,
    hello_of,
    parse_core,
)
from simtest.estimators.process.pipe import END_S, PROTOCOL, Child, CoreFault, encode
from simtest.estimators.protocol import Estimate
from simtest.geometry import Array
from simtest.geometry.vectors import angle_deg
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject
from simtest.validation.core_cases import CoreCase, core_cases

REPEATS = 20
MOST_FAULTS = 3
"""After so many faults a core is asked no further."""

WRONG = (Reason.ESTIMATOR_ERROR, Reason.NOT_FINITE, Reason.CORE_DIED, Reason.CORE_TIMEOUT, Reason.CORE_PROTOCOL)
"""Failures that a core brings about; with the others it refuses."""

FAR_DEG = 10.0
NEAR_DEG = 3.0
FLIPS = {
    "x points to the left": np.diag([-1.0, 1.0, 1.0]),
    "y points up": np.diag([1.0, -1.0, 1.0]),
    "x and y are both reversed": np.diag([-1.0, -1.0, 1.0]),
    "x and y are swapped": np.eye(3)[[1, 0, 2]],
}
"""Frames that a core may state its normals in by mistake, each as the matrix that leads to ours."""

Answer = Failure | list[Estimate]


@dataclass(frozen=True)
class CheckStep:
    """One step of the check.

    Parameters
    ----------
    name : str
        What was asked.
    is_ok : bool
        Whether the core kept to the protocol.
    text : str
        What came of it; where it is wrong, what is expected too.
    """

    name: str
    is_ok: bool
    text: str


@dataclass
class CoreReport:
    """What the check of a core found.

    Parameters
    ----------
    command : str
        As the user named the core.
    hello : Hello, optional
        The core's greeting; None where it did not greet.
    steps : list of CheckStep
        In the order in which they were taken.
    median_ms, slowest_ms : float, optional
        Time of a request, its making included, over `REPEATS` equal ones.
    """

    command: str
    hello: Hello | None = None
    steps: list[CheckStep] = field(default_factory=list)
    median_ms: float | None = None
    slowest_ms: float | None = None

    @property
    def is_ok(self) -> bool:
        """Whether every step was ok."""
        return all(step.is_ok for step in self.steps)

    def to_json(self) -> JsonObject:
        """Return the report for a script."""
        hello = None if self.hello is None else vars(self.hello)
        steps = [{"step": step.name, "ok": step.is_ok, "text": step.text} for step in self.steps]
        times = {"median_ms": self.median_ms, "slowest_ms": self.slowest_ms}
        return {"command": self.command, "ok": self.is_ok, "hello": hello, "steps": steps, **times}

    def lines(self) -> Iterator[str]:
        """Return the report for a terminal: the core, a line for each step, the time and the verdict."""
        if self.hello is not None:
            hello = self.hello
            kind = f"kind {hello.kind}, transport {hello.transport}"
            yield f"core   {hello.name} {hello.version} ({kind}; wants {', '.join(hello.arrays) or 'no arrays'})"
        width = max(len(step.name) for step in self.steps)
        for step in self.steps:
            yield f"{'ok' if step.is_ok else 'WRONG':<6} {step.name:<{width}}  {step.text}".rstrip()
        if self.median_ms is not None:
            yield f"time   {self.median_ms:.2g} ms a request (median of {REPEATS}; slowest {self.slowest_ms:.2g} ms)"
        wrong = sum(not step.is_ok for step in self.steps)
        yield f"result {f'{wrong} of {len(self.steps)} steps wrong' if wrong else f'all {len(self.steps)} steps ok'}"


def check_core(text: str) -> CoreReport:
    """Check a core step by step.

    Parameters
    ----------
    text : str
        A command, with or without ``command:`` before it, or a core's TOML file.
    """
    # A command may end with the name of a TOML file too, which is an argument of it.
    is_named = text.startswith(PREFIX) or (is_core(text) and (len(text.split()) == 1 or Path(text).exists()))
    name = text if is_named else f"{PREFIX} {text}"
    short_name(name)
    command = parse_core(name)
    report = CoreReport(text)
    core = Core(command)
    try:
        start = time.perf_counter()
        try:
            report.hello = core.start()
        except CoreFault as fault:
            report.steps.append(CheckStep("start", False, f"{fault.reason}: {fault.detail}"))
            return report
        report.steps.append(CheckStep("start", True, f"greets within {time.perf_counter() - start:.2g} s"))
        _check_requests(core, report)
    finally:
        core.close()
    report.steps.append(_end(command))
    return report


def _check_requests(core: Core, report: CoreReport) -> None:
    """Send the requests of the core's kind and judge each answer; stop where it breaks down again and again."""
    assert report.hello is not None
    of_patches = report.hello.kind == "patch"
    cases = core_cases(report.hello.kind)
    ask: Callable[[CoreCase], Answer] = _ask_patch(core) if of_patches else _ask_frame(core)
    accurate: list[tuple[Array, Array]] = []
    faults = 0
    for number, case in enumerate(cases):
        answer = ask(case)
        report.steps.append(_judge(case, answer, of_patches))
        if case.is_accurate and not isinstance(answer, Failure):
            accurate += _pairs(case, answer)
        faults += isinstance(answer, Failure) and answer.reason in WRONG[2:]
        if faults >= MOST_FAULTS or (isinstance(answer, Failure) and answer.reason == Reason.CORE_TIMEOUT):
            left = len(cases) - number - 1
            report.steps.append(CheckStep("further requests", False, f"{left} not sent after the faults above"))
            return
    report.steps.append(_repeat(ask, cases[0], report))
    if accurate:
        report.steps.append(_judge_frame(accurate))


def _ask_patch(core: Core) -> Callable[[CoreCase], Answer]:
    estimator = ProcessEstimator(core)

    def ask(case: CoreCase) -> Answer:
        patch = case.frame.patch(case.box)
        # Each of these frames shows one highlight.
        alone = patch if isinstance(patch, Failure) else replace(patch, others_px=())
        found = run(estimator, alone, case.frame.camera, case.priors)
        return found if isinstance(found, Failure) else [found]

    return ask


def _ask_frame(core: Core) -> Callable[[CoreCase], Answer]:
    estimator = ProcessFrameEstimator(core)

    def ask(case: CoreCase) -> Answer:
        camera = case.frame.camera
        # A region that holds the whole frame takes one of the estimates, or the failure where there is none.
        whole = case.frame.patch((0, 0, camera.width, camera.height))
        found = run_in_frame(estimator, case.frame, [whole], case.priors)
        first = found.of_patches[0]
        if failed := next((each for each in (*found.refused, first) if isinstance(each, Failure)), None):
            return failed
        return [*found.elsewhere, *([first] if isinstance(first, Estimate) else [])]

    return ask


def _judge(case: CoreCase, answer: Answer, of_patch: bool) -> CheckStep:
    """Return whether an answer keeps to the protocol, with how near its normals are where that says something."""
    if isinstance(answer, Failure):
        return CheckStep(case.name, answer.reason not in WRONG, str(answer))
    if not case.is_accurate:
        return CheckStep(case.name, True, _counted(answer))
    for look in (estimate.look_px for estimate in answer):
        if of_patch and not _holds(case.box, look):
            x, y = look.round(1).tolist()
            wrong = f"looks at the pixel ({x:g}, {y:g}), outside the region; must count from the corner of the frame"
            return CheckStep(case.name, False, wrong)
    gaps = [float(angle_deg(normal, truth)) for normal, truth in _pairs(case, answer)]
    near = f", {max(gaps):.2g} deg from the true normal" if gaps else ""
    return CheckStep(case.name, True, _counted(answer) + near)


def _holds(box: tuple[int, int, int, int], point: Array) -> bool:
    x, y, width, height = box
    return bool(x <= point[0] <= x + width and y <= point[1] <= y + height)


def _counted(estimates: list[Estimate]) -> str:
    return "an estimate" if len(estimates) == 1 else f"{len(estimates)} estimates"


def _pairs(case: CoreCase, estimates: list[Estimate]) -> Iterator[tuple[Array, Array]]:
    """Return each estimate's normal with that of the highlight it looks at."""
    if not len(case.normals):
        return
    peaks = case.frame.camera.project(-case.normals)
    for estimate in estimates:
        nearest = int(np.argmin(np.sum((peaks - estimate.look_px) ** 2, axis=1)))
        yield estimate.normal, case.normals[nearest]


def _repeat(ask: Callable[[CoreCase], Answer], case: CoreCase, report: CoreReport) -> CheckStep:
    """Send one request several times: the answers must be equal; measure the time."""
    times, answers = [], []
    for _ in range(REPEATS):
        start = time.perf_counter()
        answers.append(ask(case))
        times.append(1e3 * (time.perf_counter() - start))
    report.median_ms, report.slowest_ms = float(np.median(times)), max(times)
    name = f"{case.name}, {REPEATS} times"
    wrong = next((a for a in answers if isinstance(a, Failure) and a.reason in WRONG), None)
    if wrong is not None:
        return CheckStep(name, False, str(wrong))
    if len({_numbers(answer) for answer in answers}) > 1:
        return CheckStep(name, False, "the answers differ; equal requests must get equal answers")
    return CheckStep(name, True, "equal answers")


def _numbers(answer: Answer) -> tuple[object, ...]:
    if isinstance(answer, Failure):
        return (answer.reason,)
    return tuple((*each.normal.tolist(), *each.look_px.tolist()) for each in answer)


def _judge_frame(pairs: list[tuple[Array, Array]]) -> CheckStep:
    """Return whether the normals are in the camera frame: far off, but near after a flip of axes, they are not."""
    normals, truth = (np.array(part) for part in zip(*pairs, strict=True))
    gap = float(np.median(angle_deg(normals, truth)))
    flipped = {name: float(np.median(angle_deg(normals @ flip.T, truth))) for name, flip in FLIPS.items()}
    name = min(flipped, key=flipped.__getitem__)
    if gap > FAR_DEG and flipped[name] < NEAR_DEG:
        wrong = f"in the core's normals {name}; must be x to the right, y down, z forward"
        return CheckStep("camera frame", False, wrong)
    return CheckStep("camera frame", True, f"median {gap:.2g} deg from the true normals of smooth surfaces")


def _end(command: CoreCommand) -> CheckStep:
    """Start the core once more, close its standard input, and judge how it ends."""
    name = "end of standard input"
    try:
        child = Child.start(command.arguments, command.variables())
    except OSError as error:
        return CheckStep(name, False, f"cannot be started a second time ({error.strerror or error})")
    try:
        greeting = {"type": "hello", "protocol": PROTOCOL, "simtest": provenance.version()}
        hello_of(child.exchange(encode(greeting, {}), command.start_limit_s).header)
        child.check_silent()
        assert child.process.stdin is not None
        child.process.stdin.close()
        start = time.monotonic()
        while not (ended := child.has_ended()) and time.monotonic() - start < END_S:
            time.sleep(0.01)
    except CoreFault as fault:
        return CheckStep(name, False, f"{fault.reason}: {fault.detail}")
    finally:
        child.kill()
    if not ended:
        return CheckStep(name, False, f"the core runs on; must end within {END_S:g} s")
    code = child.process.returncode
    return CheckStep(name, code == 0, "ends" if code == 0 else f"ends with exit code {code}; must be 0")
