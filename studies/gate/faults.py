"""The planted faults of the gate's study, rows of `studies.mutants`, and changes that do no harm."""

from typing import Any

import cv2
import numpy as np

from simtest.geometry import ellipse_fit, patch
from simtest.simulation.frame import RenderedView
from studies.mutants.planting import Mutation, planted
from studies.mutants.rows import BY_NAME

__all__ = ["FAULTS", "HARMLESS", "Mutation", "doubly_blurred", "planted", "unscaled_fit"]

_NAMES = (
    "sign flip of an axis", "half-pixel shift of the isophotes", "wrong K: focal length told 2 % too long",
    "degree for radian: tilt of a surface", "degree for radian: the metric", "isovalue off: traced at 0.9 t",
    "noise seed reused", "falloff dropped", "normals in the world frame", "light moved 1 mm", "ellipse fit unscaled",
)  # fmt: skip
_ROWS = {
    "isovalue off: traced at 0.9 t": "isophotes traced at 0.9 t",
    "noise seed reused": "noise shared by all realisations",
}
"""Names of rows that the study calls otherwise."""

FAULTS: dict[str, tuple[Mutation, ...]] = {name: BY_NAME[_ROWS.get(name, name)].mutations() for name in _NAMES}
"""Planted faults by name; degree for radian twice, in a scene and in the metric."""


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
        Mutation(patch._blurred, _BLUR, _BLUR_TWICE),
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
