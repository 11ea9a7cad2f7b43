"""Figure 1 of the article: specular isocurves on the plane, in units of abs(V_Z)."""

from dataclasses import dataclass

import numpy as np
from skimage.measure import find_contours

from simtest.pages.charts import Axis, Chart, Mark, Panel
from simtest.pages.palette import NEUTRAL, SERIES
from simtest.pages.style import symbols
from simtest.runtime.arrays import Array
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
