"""A quadric patch under a highlight: its parameters, and its radiance with derivatives by Dr.Jit's forward mode.

Mitsuba cannot differentiate its intersections of rays with analytic shapes. Here each ray solves a quadratic equation,
written in Dr.Jit, and the surface points are passed to Mitsuba's BSDF; everything that depends on the patch's
parameters is differentiated. Each parameter has its own copy of the pixels, in which it alone varies, so that one pass
of one kernel computes the intensities and all derivatives; another highlight compiles nothing.
"""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from simtest.estimators.bisector import bisect
from simtest.geometry import Array
from simtest.rendering import backend, elements
from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import channel_mean
from simtest.rendering.lighting import Material

PASSING = 1e-6
"""Where a ray misses the quadric, this share of the squared slope replaces the discriminant."""

FLAT = 1e-6
"""Added to tr(K^2), which is 0 on a plane."""


class PatchRenderer:
    """Renders a quadric patch at the pixels of one highlight, of unit sightlines, shape (m, 3), camera frame."""

    def __init__(self, rays: Array) -> None:
        backend.load(None)
        elements.register(str(mi.variant()))
        self.count = len(rays)
        # Gathered: a kernel keeps the length of an array of shape (n, 3), and whether its address is aligned.
        self._rays = [mi.Float(np.ascontiguousarray(part, dtype=np.float32)) for part in rays.T]
        # Lobe and base of unit strength: their factors are differentiated outside of the BSDF.
        self._bsdf = mi.load_dict(
            {"type": "simtest_phong", "specular": 1.0, "diffuse_reflectance": {"type": "rgb", "value": [1.0] * 3}}
        )

    def radiance(self, patch: "RenderedQuadric") -> tuple[Array, Array]:
        """Compute intensities, shape (m,), and their derivatives by the parameters, shape (m, p)."""
        # lanes: a copy of all pixels for each parameter
        columns, count = 6 + patch.open_base, self._opaque(self.count, mi.UInt32)
        lane = dr.arange(mi.UInt32, self.count * columns)
        sightlines = mi.Vector3f(*(dr.gather(mi.Float, part, lane % count) for part in self._rays))
        direct = _Surface(self, patch, self._parameters(patch, columns, lane // count)).radiance(sightlines)
        slope = dr.forward_to(direct) if dr.grad_enabled(direct) else dr.zeros(type(direct), dr.width(direct))
        dr.eval(direct, slope)
        image, slopes = (np.array(values, dtype=np.float64).reshape(columns, self.count) for values in (direct, slope))
        # Mitsuba's virtual calls trace every existing BSDF: this one must not keep the copies alive.
        self._bsdf.exponent = self._opaque(float(np.exp(patch.log_exponent)))
        return image[0], slopes.T

    def _parameters(self, patch: "RenderedQuadric", columns: int, which: Any) -> list[Any]:
        """Return the seven parameters; each of the first ones has gradient 1 in its own copy of the pixels."""
        parameters = []
        for lane, value in enumerate([0.0, 0.0, *patch.stretch, patch.log_scale, patch.base]):
            parameter = dr.zeros(mi.Float, dr.width(which)) + self._opaque(value)
            if lane < columns:
                dr.enable_grad(parameter)
                dr.set_grad(parameter, dr.select(which == lane, mi.Float(1), mi.Float(0)))
            parameters.append(parameter)
        return parameters

    def _opaque(self, value: Any, kind: Any = None) -> Any:
        """Return a value that the kernel reads from memory, so that changing it compiles nothing."""
        opaque = (kind or mi.Float)(value)
        dr.make_opaque(opaque)
        return opaque


class _Surface:
    """The patch as the kernel sees it: everything that depends on its parameters."""

    def __init__(self, renderer: PatchRenderer, patch: "RenderedQuadric", parameters: list[Any]) -> None:
        opaque = renderer._opaque
        by_first, by_second, first, both, second, self.log_scale, self.base = parameters
        log_exponent = opaque(patch.log_exponent)
        shrink = dr.exp(-log_exponent / 2)
        self.K = (first * shrink - 1, both * shrink, second * shrink - 1)
        self.distance = opaque(patch.distance)
        # q = tr(K^3) / tr(K^2), times the roundness
        k11, k12, k22 = self.K
        cubes, squares = k11**3 + k22**3 + 3 * k12**2 * (k11 + k22), k11**2 + 2 * k12**2 + k22**2
        self.bulge = opaque(patch.roundness) * cubes / (squares + FLAT) / self.distance

        def vector(values: Array) -> Any:
            held = mi.Vector3f(*values.tolist())
            dr.make_opaque(held)
            return held

        # frame at the BP: its normal bisects the directions to light and camera
        across, along = (vector(v) for v in patch.turning)
        sightline = dr.normalize(vector(patch.sightline) + by_first * across + by_second * along)
        self.foot = self.distance * sightline
        self.lights = [vector(light) for light in patch.lights]
        to_light = vector(patch.light) - self.foot
        self.normal = dr.normalize(dr.normalize(to_light) - sightline)
        e = vector(patch.first)
        self.e = dr.normalize(e - dr.dot(e, self.normal) * self.normal)
        self.f = dr.cross(self.normal, self.e)
        bsdf = renderer._bsdf
        bsdf.exponent = dr.exp(log_exponent)
        self.material = Material(bsdf, None)

    def radiance(self, rays: Any) -> Any:
        """Return the radiance along rays from the camera that comes straight from the lights."""
        si, radiance = self.first_hit(rays), mi.Float(0)
        for light in self.lights:
            towards = light - si.p
            squared = dr.squared_norm(towards)
            lobe, base = self.material.parts(si, si.to_local(towards * dr.rsqrt(squared)), mi.Bool(True))
            radiance += (channel_mean(lobe) + self.base * channel_mean(base)) / squared * self.distance**2
        return radiance * dr.exp(self.log_scale)

    def local(self, vector: Any) -> tuple[Any, Any, Any]:
        """Return a vector's components along e, f and N."""
        return tuple(dr.dot(axis, vector) for axis in (self.e, self.f, self.normal))

    def bent(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Return K (x, y)^T / d."""
        k11, k12, k22 = self.K
        return (k11 * x + k12 * y) / self.distance, (k12 * x + k22 * y) / self.distance

    def first_hit(self, direction: Any) -> Any:
        """Return the first surface points on rays from the camera."""
        # (x, y, z) = t r - p solves z + ((x, y) K (x, y)^T + q z^2) / (2 d) = 0.
        rx, ry, rz = self.local(direction)
        px, py, pz = self.local(self.foot)
        bx, by = self.bent(rx, ry)
        cx, cy = self.bent(px, py)
        q = self.bulge
        a, b = (rx * bx + ry * by + q * rz * rz) / 2, rz - (px * bx + py * by + q * pz * rz)
        c = (px * cx + py * cy + q * pz * pz) / 2 - pz
        # Where a ray misses the quadric, its closest approach is used.
        root = dr.sqrt(dr.maximum(b * b - 4 * a * c, PASSING * b * b))
        t = 2 * c / (root - b)
        return self.interaction(direction, t * direction, t)

    def interaction(self, direction: Any, position: Any, reach: Any) -> Any:
        """Return Mitsuba's surface interaction at surface points."""
        x, y, z = self.local(position - self.foot)
        kx, ky = self.bent(x, y)
        normal = dr.normalize((1 + self.bulge * z) * self.normal + kx * self.e + ky * self.f)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(position))
        si.t, si.p, si.n = reach, mi.Point3f(position), mi.Normal3f(normal)
        si.sh_frame = mi.Frame3f(si.n)
        si.wi = si.to_local(-direction)
        return si


@dataclass(frozen=True)
class RenderedQuadric:
    """A quadric patch with rendered radiance: a model for `simtest.estimators.least_squares.fit_lobe`.

    The BP is P0 = d s; its normal N bisects the directions to the highlight's light and to the camera. Around it the
    surface is z + ((x, y) K (x, y)^T + q z^2) / (2 d) = 0 along N, K = d S. With q = 0 it is a paraboloid; with
    q = tr(K^3) / tr(K^2) it is a sphere or cylinder where the curvatures are those of one. Parameters: rotation of s
    along `turning` (2), the three of sqrt(n) (I + K) in the basis e, f, log of the scale, then the base where it is
    open. To second order a highlight's shape depends on sqrt(n) (I + K) alone, and hardly on n besides.
    """

    renderer: PatchRenderer  # Holds the pixels' sightlines
    sightline: Array  # (3,): s, unit, camera frame
    first: Array  # (3,): e: unit, across N
    distance: float  # d, mm
    light: Array  # (3,): the highlight's own light, camera frame, mm
    lights: Array  # (L, 3): all lights, camera frame, mm
    stretch: Array  # (3,): sqrt(n) (1 + K11), sqrt(n) K12, sqrt(n) (1 + K22)
    # log_scale, log_exponent, base: Of the lobe c cos^n(beta); the base's albedo over c
    log_scale: float
    log_exponent: float
    base: float
    open_base: bool  # Whether the base is fitted
    roundness: float = 0.0  # Share of q: 0 a paraboloid, 1 a sphere or cylinder

    @property
    def normal(self) -> Array:
        """N, unit, facing the camera, shape (3,)."""
        return bisect(self.distance * self.sightline, self.light)

    @property
    def basis(self) -> Array:
        """Rows e, f across N, shape (2, 3): K's basis."""
        return np.stack([self.first, np.cross(self.normal, self.first)])

    @property
    def turning(self) -> Array:
        """Two unit vectors across s, shape (2, 3): the basis of its rotation."""
        s = self.sightline
        across = self.first - (self.first @ s) * s
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(s, across)])

    @property
    def shape(self) -> Array:
        """K, shape (2, 2), in the basis e, f."""
        first, both, second = self.stretch * np.exp(-self.log_exponent / 2)
        return np.array([[first - 1, both], [both, second - 1]])

    def moved(self, step: Array) -> Self:
        """Return the patch at parameters that differ by a step."""
        # The normal follows from s; e is carried along, made perpendicular to the new normal.
        s = self.sightline + step[:2] @ self.turning
        s /= np.linalg.norm(s)
        normal = bisect(self.distance * s, self.light)
        first = self.first - (self.first @ normal) * normal
        return replace(
            self, sightline=s, first=first / np.linalg.norm(first), stretch=self.stretch + step[2:5],
            log_scale=self.log_scale + float(step[5]), base=self.base + (float(step[6]) if self.open_base else 0.0),
        )  # fmt: skip

    def evaluate(self) -> tuple[Array, Array]:
        """Return the pixels' intensities, shape (m,), and their derivatives, shape (m, p)."""
        return self.renderer.radiance(self)
