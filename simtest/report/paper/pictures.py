"""The article's figures drawn anew: isocurves on a plane, and the pipeline in pictures."""

from dataclasses import dataclass

import numpy as np
from skimage.measure import find_contours

from simtest.geometry.vectors import angle_deg
from simtest.pages.charts import Axis, Chart, Mark, Panel, Picture
from simtest.pages.pixels import displayed
from simtest.pages.style import NEUTRAL, SERIES, TRUTH, degrees, labelled, symbols
from simtest.report.paper.sweeps import PARAMETERS
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array, Image
from simtest.spec.recipes import PaperSetting
from simtest.validation.kept_frames import KeptEstimate, KeptItem
from simtest.validation.paper.isocurves import brightest_point, isocurve_radii, on_isophote_branch, specular_isocurve

KAPPA = 0.55  # the article's value
OFFSET_LIGHT = (1.2, 0.0, 1.0)  # a light beside the camera, abs(V_Z)
REACH = 3.6  # half-width of the drawn part of the plane, abs(V_Z)
_SAMPLES, _POINTS, _CURVE = 721, 241, 200
_LIMITS = (1e-3, 0.999)
_ISOPHOTE, _BRANCH, _FOOT = SERIES[0], SERIES[1], SERIES[5]
_CROSS, _STAR = "+", "★"
_TILTED = "×"


@dataclass(frozen=True)
class Branch:
    """One closed curve of the quartic, with whether it is the isophote (cos beta = tau, not -tau)."""

    points: Array
    is_isophote: bool


@dataclass(frozen=True)
class IsocurveFigure:
    """The parts of Figure 1; lengths over abs(V_Z)."""

    inner: float  # r- at `KAPPA`
    outer: float  # r+
    together: tuple[Branch, ...]  # with the light at the camera: the two circles
    apart: tuple[Branch, ...]  # with the light at `OFFSET_LIGHT`
    bp: Array  # brightest point of the latter, shape (2,)
    kappa: Array  # shape (m,)
    inner_of_kappa: Array  # r- against kappa
    outer_of_kappa: Array


def isocurve_figure() -> IsocurveFigure:
    """Compute Figure 1."""
    inner, outer = (float(r) for r in isocurve_radii(KAPPA, 1.0))
    angle = np.linspace(0, 2 * np.pi, _POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    camera, light = np.array([0.0, 0.0, 1.0]), np.array(OFFSET_LIGHT)
    bp = brightest_point(light, camera)
    values = np.linspace(*_LIMITS, _CURVE)
    return IsocurveFigure(
        inner, outer, (Branch(inner * circle, True), Branch(outer * circle, False)),
        _quartic(light, camera), bp, values, *isocurve_radii(values, 1.0),
    )  # fmt: skip


def _quartic(light: Array, camera: Array) -> tuple[Branch, ...]:
    """Trace the zeros of Q and tell its branches apart."""
    side = np.linspace(-REACH, REACH, _SAMPLES)
    grid = np.stack(np.meshgrid(side, side), axis=-1)
    branches = []
    for contour in find_contours(specular_isocurve(grid, light, camera, np.sqrt(1 - KAPPA)), 0.0):
        points = -REACH + contour[:, ::-1] * (side[1] - side[0])
        branches.append(Branch(points, bool(on_isophote_branch(points, light, camera).all())))
    return tuple(sorted(branches, key=lambda branch: not branch.is_isophote))


def isocurve_charts(data: IsocurveFigure) -> list[Chart]:
    """Describe the three parts of Figure 1."""
    words = [f"r− = {data.inner:.5f}", f"r+ = {data.outer:.5f}"]
    radii = Mark([0, 0], np.array([data.inner, data.outer]) + 0.22, NEUTRAL, words=words)
    foot = _point((0, 0), _CROSS, "camera's foot")
    together = (radii, _point((0, 0), _CROSS, "camera's foot, light's foot, BP"))
    light = _point((2 * data.bp[0], 2 * data.bp[1]), _STAR, "light's foot")
    apart = (foot, light, _point((data.bp[0], data.bp[1]), _TILTED, "BP"))
    return [
        _plane("isocurves_together", f"Light at the camera, κ = {KAPPA}", data.together, together),
        _plane("isocurves_apart", f"Light beside the camera, κ = {KAPPA}", data.apart, apart),
        _radii(data),
    ]


def _plane(key: str, title: str, branches: tuple[Branch, ...], more: tuple[Mark, ...]) -> Chart:
    marks = []
    for branch in branches:
        x, y = branch.points[:: max(1, len(branch.points) // 240)].T
        name = "isophote: cos β = τ" if branch.is_isophote else "cos β = −τ, no isophote"
        marks.append(
            Mark(np.append(x, x[0]), np.append(y, y[0]), _ISOPHOTE if branch.is_isophote else _BRANCH, name,
                 line="solid" if branch.is_isophote else "dash", width=2.2, hover=f"{name}\nx = {{x}}, y = {{y}} |V_Z|")
        )  # fmt: skip
    x_axis, y_axis = (Axis(f"{name} (|V_Z|)", limits=(-REACH, REACH)) for name in "xy")
    return Chart(key, title, (Panel(x_axis, y_axis, (*marks, *more), equal=True),), 440)


def _point(at: tuple[float, float], symbol: str, name: str) -> Mark:
    return Mark([at[0]], [at[1]], _FOOT, name, symbol=symbol, size=10, hover=name)


def _radii(data: IsocurveFigure) -> Chart:
    dot, told = symbols([""])[""], "κ = {x}: {y} |V_Z|"
    inner = Mark(
        data.kappa, data.inner_of_kappa, _ISOPHOTE, "r−/|V_Z|, the isophote", line="solid", width=2.2, hover=told
    )
    outer = Mark(data.kappa, data.outer_of_kappa, _BRANCH, "r+/|V_Z|, no isophote", line="dash", width=2.2, hover=told)
    both = Mark(
        [KAPPA] * 2, [data.inner, data.outer], _FOOT, f"κ = {KAPPA}", line="dot", width=1.2, symbol=dot, hover=told
    )
    one = Mark([0.0, 1.0], [1.0, 1.0], NEUTRAL, line="solid", width=1)
    x, y = Axis("κ = 1 − τ²", limits=(0.0, 1.0)), Axis("radius (|V_Z|)", "log", (1e-2, 1e2))
    return Chart("isocurve_radii", "Radii against κ", (Panel(x, y, (one, inner, outer, both)),), 440)


_STAGE_ISOPHOTE = "#00C2D1"
_DOT, _STAGE_CROSS = "●", "✖"
PICTURES = ("texture", "clean", "smoothed")


@dataclass(frozen=True)
class Stages:
    """The stages of one realisation; pictures are shares of the noise-free peak."""

    setting: PaperSetting
    texture: Image
    clean: Image  # the part of the camera's picture that is used, shape (h, w)
    noisy: Image
    smoothed: Image  # normalised to its peak
    extent: tuple[float, float, float, float]  # x0, x1, y1, y0 of that part, px
    isophote: Array | None  # px, shape (k, 2); None where the realisation failed
    ellipse: Array | None
    truth: Array  # true normal
    candidates: tuple[Array, ...]  # the proposed one first
    errors_deg: tuple[float, ...]  # of the candidates
    status: str  # "ok" or the failure's reason

    @property
    def is_default(self) -> bool:
        """Whether the setting is the article's."""
        return self.setting == PaperSetting()

    @property
    def values(self) -> str:
        """The setting in words."""
        names = ("sigma", "theta_deg", "exponent", "isovalue", "eps")
        values = ", ".join(PARAMETERS[name].text(getattr(self.setting, name)) for name in names)
        return f"{values}, smoothing {PARAMETERS['smoothing_px'].text(self.setting.smoothing_px)}"

    @property
    def result(self) -> str:
        """How the realisation came out."""
        errors = [degrees(error) for error in self.errors_deg]
        return f"candidates off by {labelled(errors)}" if errors else f"no normal ({self.status})"

    @property
    def better(self) -> int:
        """Index of the better candidate."""
        return int(np.argmin(self.errors_deg))


def stages(run: Run) -> Stages | None:
    """Choose the kept realisation at the article's defaults, else one that answered, and read its stages.

    Returns None where the run kept no realisation of the published protocol.
    """
    kept = [item for item in run.gallery if item.meta.paper and all(name in item.pictures for name in PICTURES)]
    if not kept:
        return None
    return _read(max(kept, key=lambda item: (item.meta.paper == PaperSetting(), _pose(item).status == "ok")))


def _pose(item: KeptItem) -> KeptEstimate:
    """Return circle pose's estimate, else the first one."""
    estimates = item.meta.estimates or (KeptEstimate(estimator="", status="no estimate"),)
    return next((estimate for estimate in estimates if estimate.estimator == "circle_pose"), estimates[0])


def _read(item: KeptItem) -> Stages:
    meta, estimate = item.meta, _pose(item)
    assert meta.paper is not None
    x, y, width, height = meta.outer
    peak = meta.peak_value or float(np.max(item.pictures["smoothed"])) or 1.0
    truth, candidates = np.array(meta.truth[0].normal), tuple(estimate.normals)
    return Stages(
        setting=meta.paper,
        texture=item.pictures["texture"],
        clean=item.pictures["clean"],
        noisy=item.frame[y : y + height, x : x + width],
        smoothed=item.pictures["smoothed"] / np.float32(peak),
        extent=(x, x + width, y + height, y),
        isophote=np.array(estimate.isophotes[0].points) if estimate.isophotes else None,
        ellipse=np.array(estimate.curves[0]) if estimate.curves else None,
        truth=truth,
        candidates=candidates,
        errors_deg=tuple(float(angle_deg(candidate, truth)) for candidate in candidates),
        status=estimate.status,
    )


def stage_charts(data: Stages, colour: str) -> list[Chart]:
    """Describe the six pictures of the pipeline; `colour` is the estimator's."""
    half = data.setting.size / 2
    plane = tuple(f"{name} on the plane (texture units)" for name in "xy")
    texture = _picture("1  texture of the specular term", data.texture, (-half, half, half, -half), plane, ())
    pictures = (
        ("2  slanted view, no noise", data.clean, ()),
        ("3  with noise", data.noisy, ()),
        ("4  smoothed, normalised; isophote, ellipse", data.smoothed, tuple(_fitted(data, colour))),
    )
    shown = [_picture(title, values, data.extent, ("x (px)", "y (px)"), marks) for title, values, marks in pictures]
    return [texture, *shown, _side_view(data, colour), _close_up(data, colour)]


def _picture(
    title: str, values: Image, extent: tuple[float, float, float, float], titles: tuple[str, ...],
    marks: tuple[Mark, ...],
) -> Chart:  # fmt: skip
    x0, x1, y1, y0 = extent
    x, y = Axis(titles[0], limits=(x0, x1)), Axis(titles[1], limits=(y1, y0))
    panel = Panel(x, y, marks, equal=True, picture=Picture(displayed(values), extent))
    return Chart(f"pipeline_{title[0]}", title, (panel,), round(105 + 365 * min((y1 - y0) / (x1 - x0), 1.0)))


def _fitted(data: Stages, colour: str) -> list[Mark]:
    marks = []
    if data.isophote is not None:
        x, y = np.vstack([data.isophote, data.isophote[:1]]).T
        marks.append(Mark(x, y, _STAGE_ISOPHOTE, f"isophote t = {data.setting.isovalue:g}", line="solid", width=2.8))
    if data.ellipse is not None:
        x, y = data.ellipse.T
        marks.append(Mark(x, y, colour, "fitted ellipse", line="dash", width=2.0))
    return marks


def _side_view(data: Stages, colour: str) -> Chart:
    """Describe the normals in the plane of the tilt, seen from the side: the camera looks along z."""
    theta = np.radians(data.setting.theta_deg)
    end = 0.95 * np.array([np.cos(theta), np.sin(theta)])
    marks = [
        Mark([0, 0], [0, -1.12], NEUTRAL, line="dot"),
        Mark([0], [-1.2], NEUTRAL, words=["towards the camera"]),
        Mark(
            [-end[0], end[0]],
            [-end[1], end[1]],
            NEUTRAL,
            f"plane, slant {data.setting.theta_deg:g}°",
            line="solid",
            width=3,
        ),
        _normal(data.truth, TRUTH, "true normal", 7),
    ]
    for index, candidate in enumerate(data.candidates):
        which, dashed = ("better", False) if index == data.better else ("other", True)
        name = f"{which} candidate, off by {data.errors_deg[index]:.2f}°"
        marks.append(_normal(candidate, colour, name, 2.4, dashed))
    if not data.candidates:
        marks.append(Mark([0], [0.8], NEUTRAL, words=[f"no normal: {data.status}"]))
    x, y = Axis("y of the unit normal", limits=(-1.25, 1.25)), Axis("z of the unit normal", limits=(1.05, -1.35))
    return Chart("pipeline_5", "5  normals from the side", (Panel(x, y, tuple(marks), equal=True),), 460)


def _normal(normal: Array, colour: str, name: str, width: float, dashed: bool = False) -> Mark:
    return Mark(
        [0, normal[1]], [0, normal[2]], colour, name, line="dash" if dashed else "solid", width=width, head=True
    )


def _close_up(data: Stages, colour: str) -> Chart:
    """Describe the better candidate about the truth: slant error up, the error across it to the right, deg."""
    marks, reach = [Mark([0], [0], TRUTH, "true normal", symbol=_DOT, size=15)], 1.0
    if data.candidates:
        candidate, error = data.candidates[data.better], data.errors_deg[data.better]
        across = np.array([1.0, 0.0, 0.0])
        miss = np.array([candidate @ across, candidate @ np.cross(data.truth, across)])
        size = np.linalg.norm(miss)
        miss = miss * (error / size) if size > 0 else miss
        angle = np.linspace(0, 2 * np.pi, 120)
        name = f"better candidate, error {error:.2f}°"
        marks = [
            Mark(error * np.cos(angle), error * np.sin(angle), NEUTRAL, line="solid", width=1.2), *marks,
            Mark([0, miss[0]], [0, miss[1]], colour, line="solid", width=2),
            Mark([miss[0]], [miss[1]], colour, name, symbol=_STAGE_CROSS, size=14),
        ]  # fmt: skip
        reach = 1.35 * error
    x, y = (Axis(f"error of the {of} (deg)", limits=(-reach, reach)) for of in ("tilt's direction", "slant"))
    return Chart("pipeline_6", "6  better candidate about the truth", (Panel(x, y, tuple(marks), equal=True),), 460)
