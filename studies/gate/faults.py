"""Faults planted into the code that runs, one at a time, and changes that do no harm.

Each is a replacement in the source of one function, compiled into that very function: whoever holds it runs the fault.
"""

import contextlib
import inspect
import textwrap
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from simtest.geometry import ellipse_fit, gaussian_smoothing, vectors
from simtest.geometry.circle_from_cone import _ordered
from simtest.geometry.isophotes import IsophoteTracer
from simtest.geometry.patch import Patch
from simtest.rendering import exact_points as exact
from simtest.rendering.built_scene import BuiltScene
from simtest.rendering.direct import DirectLight
from simtest.simulation.rendered_view import RenderedView
from simtest.spec.scene import Scene
from simtest.surfaces import analytic
from simtest.validation.cases import Case
from simtest.validation.execution import forget
from simtest.validation.paper.rows import pipeline_with


@dataclass(frozen=True)
class Mutation:
    """A change of one function's source.

    Parameters
    ----------
    function : callable
        Whose code is replaced.
    old, new : str
        What of its source, found once, becomes what.
    """

    function: Callable[..., Any]
    old: str
    new: str

    def code(self) -> Any:
        """Compile the changed source into the function's new code."""
        source = textwrap.dedent(inspect.getsource(self.function))
        if source.count(self.old) != 1:
            raise LookupError(f"{self.function.__qualname__}: {self.old!r} occurs {source.count(self.old)} times")
        # A property's or class method's decorator would wrap what is wanted bare.
        lines = [line for line in source.replace(self.old, self.new).splitlines() if not line.startswith("@")]
        made: dict[str, Any] = {}
        exec(
            compile("\n".join(lines), f"<{self.function.__qualname__}, changed>", "exec"),
            self.function.__globals__.copy(),
            made,
        )
        return made[self.function.__name__].__code__


@contextlib.contextmanager
def planted(*mutations: Mutation) -> Iterator[None]:
    """Run with mutations; sessions and pipelines that hold what was made before are let go."""
    kept = [(mutation.function, mutation.function.__code__) for mutation in mutations]
    _forget()
    try:
        for mutation in mutations:
            mutation.function.__code__ = mutation.code()
        yield
    finally:
        for function, code in kept:
            function.__code__ = code
        _forget()


def _forget() -> None:
    forget()
    pipeline_with.cache_clear()


def unscaled_fit(contours: list[Any]) -> Any:
    """Fit ellipses by the published reduced eigenproblem on pixels as they are, neither centred nor scaled [HF98]."""
    conics = np.zeros((len(contours), 3, 3))
    for index, (x, y) in enumerate(contour.T for contour in contours):
        quadratic = np.stack([x * x, x * y, y * y], axis=1)
        linear = np.stack([x, y, np.ones_like(x)], axis=1)
        T = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
        M = quadratic.T @ quadratic + (quadratic.T @ linear) @ T
        _, vectors_of = np.linalg.eig(np.stack([M[2] / 2, -M[1], M[0] / 2]))
        vectors_of = vectors_of.real
        constraint = 4 * vectors_of[0] * vectors_of[2] - vectors_of[1] ** 2
        a, b, c = vectors_of[:, int(constraint.argmax())]
        d, e, f = T @ (a, b, c)
        conic = np.array([[a, b / 2, d / 2], [b / 2, c, e / 2], [d / 2, e / 2, f]])
        conics[index] = conic * (1.0 if a + c > 0 else -1.0) / np.sqrt((conic * conic).sum())
    return ellipse_fit.FittedConics(conics, np.broadcast_to(np.eye(3), conics.shape))


_FIT = "    batch, failures = _Batch.of(contours), _Failures()\n"

_WIDER = "(lambda c: type(c)(c.width, c.height, 1.02 * c.fx, 1.02 * c.fy, c.cx, c.cy))(self.camera.model()),"

FAULTS: dict[str, tuple[Mutation, ...]] = {
    "sign flip of an axis": (
        Mutation(
            _ordered,
            "np.where(side < 0, -1.0, 1.0)[..., None, None]",
            "np.where(side < 0, -1.0, 1.0)[..., None, None] * np.array([-1.0, 1.0, 1.0])[:, None]",
        ),
    ),
    "half-pixel shift of the isophotes": (
        Mutation(Patch._first_centre.fget, "np.array(self.origin_px) + PIXEL_CENTRE", "np.array(self.origin_px)"),
    ),
    "wrong K: focal length told 2 % too long": (Mutation(Scene.calibration, "self.camera.model(),", _WIDER),),
    "degree for radian: tilt of a surface": (
        Mutation(analytic.placement, "np.radians([tilt_deg, azimuth_deg, spin_deg])", "[tilt_deg, azimuth_deg, 0.0]"),
    ),
    "degree for radian: the metric": (Mutation(vectors.angle_deg, "np.degrees(np.arctan2(", "(np.arctan2("),),
    "isovalue off: traced at 0.9 t": (
        Mutation(
            IsophoteTracer.closed, "_checked(isovalue) * self.peak_value", "0.9 * _checked(isovalue) * self.peak_value"
        ),
    ),
    "noise seed reused": (Mutation(Case.noise_seed, "realisation, Stage.SENSOR", "0, Stage.SENSOR"),),
    "falloff dropped": (
        Mutation(
            DirectLight._from, "values, -direction) / squared)", "values, -direction))"
        ),
    ),
    "normals in the world frame": (Mutation(exact.in_camera, "normal=exact.normal @ rotation", "normal=exact.normal"),),
    "light moved 1 mm": (
        Mutation(
            BuiltScene.place_lights, "rig.true_mm()", "(rig.true_mm() + np.array([1.0, 0.0, 0.0]))"
        ),
    ),
    "ellipse fit unscaled": (
        Mutation(
            ellipse_fit._fit_together,
            _FIT,
            "    from studies.gate.faults import unscaled_fit\n    return unscaled_fit(contours)\n" + _FIT,
        ),
    ),
}  # fmt: skip
"""Planted faults by name; degree for radian twice, in a scene and in the metric."""


def doubly_blurred(image: Any, sigma_px: float) -> Any:
    """Blur in double precision what the code blurs in single."""
    wide = cv2.GaussianBlur(image.astype(np.float64), (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    return wide.astype(np.float32)


_BLUR = "np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT))"
_BLUR_TWICE = "__import__('studies.gate.faults', fromlist=['_']).doubly_blurred(image, sigma_px)"
_CAPTURE = "capture(self.light, self.full_scale, "

HARMLESS: dict[str, tuple[Mutation, ...]] = {
    "sums of the ellipse fit in reverse order": (
        Mutation(ellipse_fit._points, "xy = np.asarray(points, dtype=float)", "xy = np.asarray(points, float)[::-1]"),
    ),
    "smoothing in double precision": (
        Mutation(gaussian_smoothing._blurred, _BLUR, _BLUR_TWICE),
    ),
    "light off by 1e-7 of itself": (
        Mutation(
            RenderedView.frame,
            _CAPTURE,
            _CAPTURE.replace(
                "self.light", "(self.light * (1 + 1e-7 * np.cos(np.arange(self.light.size))).reshape(self.light.shape)"
                ".astype(np.float32))"
            ),
        ),
    ),
}  # fmt: skip
"""Changes of rounding, as another processor, compiler or order of operations brings."""
