"""Light positions from highlights on mirrors of known shape: one least-squares problem over all pictures.

A picture's mirror is known with an error z, three standard normal numbers (`mirrors`). Its highlights share it. For
given lights the errors z are linear to first order, so they are eliminated picture by picture: the residuals of a
picture have the covariance R + Jz Jz^T, with R that of the measured highlights. What remains is a small problem in the
lights alone, whose inverse normal matrix is the covariance of the joint problem.
"""

from dataclasses import dataclass, replace

import numpy as np

from simtest.calibration.lights.mirrors import Mirrors
from simtest.geometry.camera import Camera
from simtest.runtime.arrays import Array, Index

REACH_MM = 30.0
"""A light of an endoscope lies about so far from the camera, at most. A prior of this standard deviation along each
axis keeps the problem solvable where pictures do not show a light's distance; the interval is then as wide."""

STEP_MM, STEP_Z = 1e-3, 1e-3
"""Steps of the central differences."""

ITERATIONS = 30
CONVERGED_MM = 1e-7
LARGEST_STEP_MM = 20.0


@dataclass(frozen=True)
class Highlights:
    """Measured highlights of all pictures."""

    view: Index  # (N,): number of the picture
    pixels: Array  # (N, 2): centres, px
    covariance: Array  # (N, 2, 2): of the centres, px^2

    def __len__(self) -> int:
        """Return the number of highlights."""
        return len(self.view)


@dataclass(frozen=True)
class Bundle:
    """Lights that explain assigned highlights."""

    lights: Array  # (S, 3): mm, camera frame
    covariance: Array  # (3 S, 3 S): mm^2, if the stated errors of highlights and mirrors hold
    z: Array  # (V, 3): fitted errors of the mirrors, in their standard deviations
    chi2: float  # sum of squared residuals in their standard deviations
    freedom: int  # its degrees of freedom

    def covariance_of(self, source: int) -> Array:
        """Return the covariance of one light, shape (3, 3), mm^2."""
        return self.covariance[3 * source : 3 * source + 3, 3 * source : 3 * source + 3]


def derivatives(camera: Camera, mirrors: Mirrors, view: Index, lights: Array, z: Array) -> tuple[Array, Array, Array]:
    """Return predicted pixels and their derivatives by light and mirror error, shapes (..., 2), (..., 2, 3) twice."""
    lights, z = np.broadcast_arrays(lights, z)
    steps = np.eye(3)

    def along(light_step: float, z_step: float) -> Array:
        ahead, behind = (
            np.stack(
                [
                    mirrors.predict(camera, view, lights + sign * light_step * axis, z + sign * z_step * axis)
                    for axis in steps
                ],
                axis=-1,
            )
            for sign in (1.0, -1.0)
        )
        return np.asarray((ahead - behind) / (2 * (light_step + z_step)))

    return mirrors.predict(camera, view, lights, z), along(STEP_MM, 0.0), along(0.0, STEP_Z)


def solve(camera: Camera, mirrors: Mirrors, highlights: Highlights, source: Index, start: Array) -> Bundle | None:
    """Fit lights to highlights by Gauss-Newton steps from `start`, (S, 3), mm, the mirror errors eliminated.

    `source`, (N,), says which light made each highlight; negative: none, it is left out. None where a step leads to
    lights that no mirror shows.
    """
    kept = np.flatnonzero(source >= 0)
    lights, z = np.array(start, dtype=float), np.zeros((len(mirrors), 3))
    for _ in range(ITERATIONS):
        normal, gradient, _, z = _normal_equations(camera, mirrors, highlights, source, kept, (lights, z))
        if not np.isfinite(normal).all() or not np.isfinite(gradient).all():
            return None
        step = np.linalg.solve(normal, gradient).reshape(-1, 3)
        length = float(np.linalg.norm(step, axis=1).max())
        lights = lights + step * min(1.0, LARGEST_STEP_MM / max(length, CONVERGED_MM))
        if length < CONVERGED_MM:
            break
    normal, _, chi2, z = _normal_equations(camera, mirrors, highlights, source, kept, (lights, z))
    if not np.isfinite(normal).all():
        return None
    return Bundle(lights, np.asarray(np.linalg.inv(normal), dtype=float), z, chi2, 2 * len(kept) - 3 * len(lights))


def _normal_equations(
    camera: Camera, mirrors: Mirrors, highlights: Highlights, source: Index,
    kept: Index, at: tuple[Array, Array],
) -> tuple[Array, Array, float, Array]:  # fmt: skip
    """Return the normal matrix and gradient in the lights, chi-squared, and the mirror errors at these lights."""
    lights, z = at
    view, of = highlights.view[kept], source[kept]
    predicted, by_light, by_z = derivatives(camera, mirrors, view, lights[of], z[view])
    # Linear in z: the residual at z = 0.
    residual = highlights.pixels[kept] - predicted + np.einsum("nij,nj->ni", by_z, z[view])
    size = 3 * len(lights)
    normal, gradient = np.eye(size) / REACH_MM**2, -lights.ravel() / REACH_MM**2
    chi2, errors = 0.0, np.zeros_like(z)
    for picture in np.unique(view):
        rows = np.flatnonzero(view == picture)
        count = 2 * len(rows)
        J, K, r = np.zeros((count, size)), by_z[rows].reshape(count, 3), residual[rows].ravel()
        covariance = K @ K.T
        for i, row in enumerate(rows):
            J[2 * i : 2 * i + 2, 3 * of[row] : 3 * of[row] + 3] = by_light[row]
            covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += highlights.covariance[kept[row]]
        if not (np.isfinite(covariance).all() and np.isfinite(r).all()):
            return np.full((size, size), np.nan), gradient, np.inf, errors
        weighted = np.linalg.solve(covariance, np.column_stack([J, r, K]))
        normal += J.T @ weighted[:, :size]
        gradient += J.T @ weighted[:, size]
        chi2 += float(r @ weighted[:, size])
        errors[picture] = K.T @ weighted[:, size]
    return normal, gradient, chi2, errors


def prediction(camera: Camera, mirrors: Mirrors, bundle: Bundle, view: Index, source: Index) -> tuple[Array, Array]:
    """Return where lights' highlights are expected, px, shape (..., 2), and the covariance of that, (..., 2, 2).

    The covariance is that of the lights and of the mirrors before any highlight was seen.
    """
    predicted, by_light, by_z = derivatives(
        camera, mirrors, view, bundle.lights[source], np.zeros((*np.shape(view), 3))
    )
    blocks = np.array([bundle.covariance_of(i) for i in range(len(bundle.lights))])
    spread = by_light @ blocks[source] @ np.swapaxes(by_light, -1, -2) + by_z @ np.swapaxes(by_z, -1, -2)
    return predicted, spread


def with_error(highlights: Highlights, sd_px: float) -> Highlights:
    """Return the highlights with an independent error of their centres more, px an axis."""
    return replace(highlights, covariance=highlights.covariance + sd_px**2 * np.eye(2))
