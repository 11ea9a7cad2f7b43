"""The check of a core against the process protocol: it is started, asked and ended, and each step is judged.

The highlights that it is asked about are made by formula: their normals are known without a renderer.
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from simtest.calibration import LIGHT_AT_CAMERA, Calibration, Frame, LogUniform, Normal, Priors
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
from simtest.geometry import Array, BrownConrady, Camera, KannalaBrandt, ViewMask
from simtest.geometry.vectors import angle_deg, basis_across
from simtest.runtime import provenance
from simtest.runtime.files import JsonObject
from simtest.runtime.seeds import from_integer

SMOOTHING_PX = 1.0
RADIUS_PX = 9.0
"""Of a highlight's isophote at half of its peak."""

REACH_PX = 36
"""Half of the width of a region of interest."""

TIGHT_PX = 5
"""The same where the isophote at half of the peak must not close."""

SEED = 20261123

PINHOLE = Camera.from_fov(70.0, 640, 480)
BARREL = Camera(640, 480, 460.0, 455.0, 322.0, 236.0, distortion=BrownConrady(k1=-0.1, p1=1e-3))
SMALL = Camera.from_fov(70.0, 160, 120)
FISHEYE = Camera(
    640, 480, 250.0, 250.0, 320.0, 240.0, distortion=KannalaBrandt(k1=-0.02), view_mask=ViewMask(320.0, 240.0, 230.0)
)

OTHER_PRIORS = Priors(
    ((3.0, 0.0, 0.0), (-3.0, 0.0, 0.0)), Normal(30.0, 2.0), LogUniform(100.0, 1000.0), falloff_power=None
)
"""Two lights beside the camera, a told distance and a told lobe."""


@dataclass(frozen=True)
class CoreCase:
    """One request of the check.

    Parameters
    ----------
    name : str
        What is special about it.
    frame : Frame
        The picture.
    normals : ndarray, shape (N, 3)
        Of the highlights in it, unit, camera frame; the light is at the camera.
    priors : Priors
        What the core is told.
    reach_px : int
        Half of the width of the region of interest around the first highlight.
    is_accurate : bool
        Whether the normal of a simple method is expected to be near the true one.
    """

    name: str
    frame: Frame
    normals: Array
    priors: Priors = LIGHT_AT_CAMERA
    reach_px: int = REACH_PX
    is_accurate: bool = True

    @property
    def box(self) -> tuple[int, int, int, int]:
        """The region of interest around the first highlight, cut at the border of the frame: column, row, w, h."""
        camera = self.frame.camera
        centre = np.floor(camera.project(-self.normals[0])).astype(int)
        low = np.maximum(centre - self.reach_px, 0)
        high = np.minimum(centre + self.reach_px + 1, [camera.width, camera.height])
        return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


@cache
def core_cases(kind: str) -> tuple[CoreCase, ...]:
    """Return the requests for a core of a kind, patch or frame; made once, since their frames take most of a check."""
    return tuple(_patch_cases() if kind == "patch" else _frame_cases())


def _patch_cases() -> Iterator[CoreCase]:
    first, second = _normals(PINHOLE, (220.2, 180.7), (460.4, 300.1))
    yield _case("plane", PINHOLE, [first])
    yield _case("another plane", PINHOLE, [second])
    yield _case("cylinder", PINHOLE, [second], gains=(1.0, 2.5))
    yield _case("lens with distortion", BARREL, _normals(BARREL, (500.3, 120.2)))
    yield _case("fisheye with a round view", FISHEYE, _normals(FISHEYE, (180.6, 260.3)))
    yield _case("noise", PINHOLE, [first], noise=0.01)
    yield _case("two lights, distance and lobe told", PINHOLE, [first], priors=OTHER_PRIORS, is_accurate=False)
    yield _case("clipped peak", PINHOLE, [first], clip=0.7, is_accurate=False)
    yield _case("isophote that does not close", PINHOLE, [first], reach_px=TIGHT_PX, is_accurate=False)
    yield _case("region at the frame's border", PINHOLE, _normals(PINHOLE, (3.0, 240.0)), is_accurate=False)
    yield _case("dark", PINHOLE, [first], peak=1e-5)
    yield _case("large region", PINHOLE, _normals(PINHOLE, (300.2, 250.9)), reach_px=200, radius_px=60.0)


def _frame_cases() -> Iterator[CoreCase]:
    first, second = _normals(PINHOLE, (220.2, 180.7), (460.4, 300.1))
    yield _case("one highlight", PINHOLE, [first])
    yield _case("two highlights", PINHOLE, [first, second])
    yield _case("lens with distortion", BARREL, _normals(BARREL, (500.3, 120.2)))
    yield _case("fisheye with a round view", FISHEYE, _normals(FISHEYE, (180.6, 260.3)))
    yield _case("noise", PINHOLE, [first, second], noise=0.01)
    yield _case("two lights, distance and lobe told", PINHOLE, [first], priors=OTHER_PRIORS, is_accurate=False)
    yield _case("colour", PINHOLE, [first], channels=3)
    yield _case("clipped peaks", PINHOLE, [first, second], clip=0.7, is_accurate=False)
    yield _case("no highlight", PINHOLE, [], noise=0.01)
    yield _case("dark", PINHOLE, [first], peak=1e-5)
    yield _case("small frame", SMALL, _normals(SMALL, (70.2, 60.9)))


def _case(
    name: str,
    camera: Camera,
    normals: list[Array] | Array,
    gains: tuple[float, float] = (1.0, 1.0),
    noise: float = 1e-3,
    clip: float | None = None,
    peak: float = 0.8,
    channels: int = 1,
    radius_px: float = RADIUS_PX,
    priors: Priors = LIGHT_AT_CAMERA,
    reach_px: int = REACH_PX,
    is_accurate: bool = True,
) -> CoreCase:
    """Return a request about highlights of equal shape; the noise is a share of the peak."""
    size = (camera.height, camera.width)
    light = np.full(size, 0.02) + sum((_lobe(camera, n, gains, radius_px) for n in normals), np.zeros(size))
    light = peak * np.maximum(light + noise * from_integer(SEED).standard_normal(size), 0.0)
    if camera.seen is not None:
        light[~camera.seen] = 0.0
    if clip is not None:
        light = np.minimum(light, clip)
    encoded = light.astype(np.float32)
    if channels > 1:
        encoded = np.repeat(encoded[:, :, None], channels, axis=2)
    calibration = Calibration(camera, priors=priors, saturation_level=clip)
    frame = Frame(encoded, calibration, SMOOTHING_PX)
    return CoreCase(name, frame, np.array(normals).reshape(-1, 3), priors, reach_px, is_accurate)


def _normals(camera: Camera, *pixels: tuple[float, float]) -> Array:
    """Return the normals that point back along the sightlines of pixels, shape (N, 3)."""
    return -camera.unproject(np.array(pixels))


@cache
def _rays(camera: Camera) -> Array:
    return camera.unproject(camera.pixel_centres())


def _lobe(camera: Camera, normal: Array, gains: tuple[float, float], radius_px: float) -> Array:
    """Return a highlight of peak 1, shape (H, W), with the light at the camera (theory.md section 3).

    Its isophotes are cones of sightlines about the normal, of half-angles that are smaller by 1 + d k along a principal
    direction of curvature k at the distance d.

    Parameters
    ----------
    gains : tuple of float
        1 + d k along both principal directions.
    """
    rays = _rays(camera)
    first, second = basis_across(normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(-(rays @ normal) > 0, -(rays @ normal), np.nan)
        reach = (gains[0] * (rays @ first) / depth) ** 2 + (gains[1] * (rays @ second) / depth) ** 2
    tangent = radius_px / camera.fx
    return np.nan_to_num(np.exp(-np.log(2.0) * reach / tangent**2), nan=0.0)


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
