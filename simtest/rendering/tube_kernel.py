"""The exact points of a generated colon in one kernel, in double precision: the formulas of `simtest.surfaces.tube`.

The tube in NumPy is the plain reference. There every operation on a frame's rays writes an array; here Newton's method
and the curvatures of a ray stay in registers. In the orthonormal basis (T, rho, tau) of a point

    P_u = (A, r_u, 0),  P_v = (0, r_v, r),  A = 1 - psi' r cos v
    P_u x P_v = (r_u r, -A r, A r_v)

The maps of pedunculated polyps are applied in the model frame.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any

import numpy as np

from simtest.rendering.backend import dr, mi
from simtest.rendering.kernel_values import to_kernel, vectors_from_kernel, vectors_to_kernel
from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces import RayHits
from simtest.surfaces.tube import (
    ACROSS,
    LIFT_REACH,
    MAX_SHIFT_MM,
    NECK_AT,
    NECK_REACH,
    NEWTON_STEPS,
    NEWTON_TOLERANCE_MM,
    TubeChart,
    TubeNumbers,
)

BLOCK = 2**17
"""Rays of a launch: they bound the memory."""

CELLS = 512
"""Parts of the tube along it, each with a list of the folds that reach it: most folds are far from most points."""

_FIELDS: dict[str, tuple[tuple[int, ...], type]] = {
    **dict.fromkeys(("distance", "k_min", "k_max"), ((), float)),
    **dict.fromkeys(("position", "normal", "direction_min", "direction_max"), ((3,), float)),
    **dict.fromkeys(("pool", "valid"), ((), bool)),
}
"""What `TubeKernel.solve` returns: shapes of a point's values, and their types."""

_TINY = float(np.finfo(float).tiny)


@dataclass(frozen=True)
class _Jet:
    """A number or vector, and its derivatives by u and v, at the lanes of a kernel; the second ones 0 if not asked for.

    What nothing uses of them Dr.Jit leaves out of the kernel.
    """

    f: Any
    u: Any
    v: Any
    uu: Any
    uv: Any
    vv: Any

    def __add__(self, other: "_Jet") -> "_Jet":
        return _Jet(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))

    def __mul__(self, other: "_Jet") -> "_Jet":
        return self.times(other, lambda a, b: a * b)

    def times(self, other: "_Jet", product: Callable[[Any, Any], Any]) -> "_Jet":
        """Return a bilinear product of both."""
        a, b = self, other
        first = (product(a.u, b.f) + product(a.f, b.u), product(a.v, b.f) + product(a.f, b.v))
        uu = product(a.uu, b.f) + 2 * product(a.u, b.u) + product(a.f, b.uu)
        uv = product(a.uv, b.f) + product(a.u, b.v) + product(a.v, b.u) + product(a.f, b.uv)
        vv = product(a.vv, b.f) + 2 * product(a.v, b.v) + product(a.f, b.vv)
        return _Jet(product(a.f, b.f), *first, uu, uv, vv)

    def affine(self, scale: Any, shift: Any = 0.0) -> "_Jet":
        """Return scale times it plus a constant."""
        return _Jet(scale * self.f + shift, *(scale * part for part in list(vars(self).values())[1:]))

    def exp(self) -> "_Jet":
        """Return the exponential of a number."""
        e, u, v = dr.exp(self.f), self.u, self.v
        return _Jet(e, e * u, e * v, e * (self.uu + u * u), e * (self.uv + u * v), e * (self.vv + v * v))


@dataclass(frozen=True)
class _Frame:
    """Position, mm, and basis of points: C(u), T, rho, tau, mitsuba.Vector3d; psi' and psi''; cosine and sine of v."""

    centre: Any
    T: Any
    rho: Any
    tau: Any
    bend: Any
    twist: Any
    cosine: Any
    sine: Any
    # u, v: Along the centreline, mm, and around it. speed, gain, fade: c', c'', and h with its derivatives
    u: Any
    v: Any
    speed: Any
    gain: Any
    fade: tuple[Any, ...]


class _Table:
    """Rows of numbers that a kernel gathers."""

    def __init__(self, rows: Array) -> None:
        self.columns = rows.shape[1]
        self._values = mi.Float64(np.ascontiguousarray(rows, dtype=np.float64).ravel())

    def row(self, index: Any, active: Any = True) -> list[Any]:
        """Return the numbers of rows, mitsuba.UInt32."""
        first = index * self.columns
        return [dr.gather(mi.Float64, self._values, first + i, active) for i in range(self.columns)]


class TubeKernel:
    """Solves rays against a tube."""

    def __init__(self, chart: TubeChart) -> None:
        numbers = chart.tube.numbers()
        self._folds, self._panels = _Table(numbers.folds), _Table(numbers.panels)
        self._waves, self._stalks = (_Table(rows) if len(rows) else None for rows in (numbers.waves, numbers.stalks))
        self._corners = _Table(chart.corners.reshape(-1, 2))
        constants = {**numbers.constants, "last_knot": len(numbers.panels) - 1}
        self._n = {name: mi.Float64(value) for name, value in constants.items()}
        self._closed = chart.tube.depth > 0
        rows = {"waves": numbers.waves, "stalks": numbers.stalks}
        self._counts = {name: mi.UInt32(len(values)) for name, values in rows.items()}
        self._first, self._listed = (mi.UInt32(part.astype(np.uint32)) for part in _lists(numbers))
        # Opaque, so that another colon compiles no new kernel.
        dr.make_opaque(list(self._n.values()), list(self._counts.values()))

    def solve(self, origins: Array, directions: Array, hits: RayHits, model_from_camera: Array) -> dict[str, Array]:
        """Compute the exact points of `truth.solve` by field, but for those that are the base's own."""
        if not len(origins):
            # Dr.Jit ends the process on a kernel without rays.
            return {name: np.empty((0, *shape), dtype=kind) for name, (shape, kind) in _FIELDS.items()}
        origin, direction, t, u, v, solved = self._solved(origins, directions, hits)
        return self._described(origin, direction, t, u, v, solved, model_from_camera)

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Compute the distances of `solve` alone, shape (N,), mm; NaN where a ray has no point."""
        if not len(origins):
            return np.empty(0)
        t, _, _, solved = self._solved(origins, directions, hits)[2:]
        return np.array(dr.select(solved & dr.isfinite(t), t, dr.nan))

    def _solved(self, origins: Array, directions: Array, hits: RayHits) -> tuple[Any, ...]:
        """Return rays as lanes of a kernel, and their solutions: distance, u, v and which are solved."""
        origin, direction = (
            vectors_to_kernel(mi.Vector3d, mi.Float64, rays, np.float64) for rays in (origins, directions)
        )
        start = to_kernel(mi.Float64, hits.distance, np.float64)
        valid = dr.isfinite(start)
        second, third = (to_kernel(mi.Float64, part, np.float64) for part in hits.barycentric.T)
        # (u, v) of the hit in its triangle
        face = to_kernel(mi.UInt32, hits.face, np.uint32)
        corners = [self._corners.row(3 * face + i, valid) for i in range(3)]
        shares = (1 - second - third, second, third)
        u, v = (sum((s * c[i] for s, c in zip(shares, corners, strict=True)), mi.Float64(0)) for i in range(2))
        t, u, v, solved = self._newton(origin, direction, start, u, v, valid)
        solved &= (u >= self._n["least"]) & (u <= self._n["most"])
        return origin, direction, t, u, v, solved

    def _newton(self, origin: Any, direction: Any, start: Any, u: Any, v: Any, valid: Any) -> tuple[Any, ...]:
        """Solve P(u, v) = origin + t direction (see `Tube.solve`); return t, u, v and which are solved."""

        def body(t: Any, u: Any, v: Any, active: Any, solved: Any, step: Any) -> tuple[Any, ...]:
            frame = self._frame(u, v)
            r = self._radius(frame, second=False)
            along = frame.speed - frame.bend * r.f * frame.cosine
            p, pu, pv = self._stalked(
                (frame.centre + r.f * frame.rho, along * frame.T + r.u * frame.rho, r.v * frame.rho + r.f * frame.tau)
            )
            miss = p - origin - t * direction
            # The linear system P_u du + P_v dv - direction dt = -miss by Cramer's rule, for -du, -dv and dt
            minor = dr.cross(pv, direction)
            inverse = 1 / dr.dot(pu, minor)
            du = dr.dot(miss, minor) * inverse
            dv = dr.dot(miss, dr.cross(direction, pu)) * inverse
            dt = dr.dot(miss, dr.cross(pu, pv)) * inverse
            done = dr.squared_norm(miss) < NEWTON_TOLERANCE_MM**2
            # A grazing ray has a nearly singular matrix: bound the step to the mesh's neighbourhood.
            scale = dr.minimum(1, MAX_SHIFT_MM / dr.maximum(dr.abs(dt), _TINY))
            solved |= active & done
            scale = dr.select(active & ~done, scale, 0)
            # 0 times the NaN of a singular matrix is NaN: such a ray is given up.
            u, v, t = u - scale * du, v - scale * dv, t + scale * dt
            # A ray that leaves the neighbourhood of its hit is given up.
            active &= ~done & (dr.abs(t - start) <= MAX_SHIFT_MM)
            step += 1
            return t, u, v, active, solved, step

        t, u, v, _, solved, _ = dr.while_loop(
            state=(mi.Float64(start), u, v, mi.Bool(valid), mi.Bool(False), mi.UInt32(0)),
            cond=lambda t, u, v, active, solved, step: active & (step < NEWTON_STEPS),
            body=body,
            labels=("t", "u", "v", "active", "solved", "step"),
        )
        return t, u, v, solved

    def _described(
        self, origin: Any, direction: Any, t: Any, u: Any, v: Any, solved: Any, model_from_camera: Array
    ) -> dict[str, Array]:
        """Evaluate normals and curvatures at solutions, and turn all to the camera frame (see `pack_points`)."""
        frame = self._frame(u, v)
        r = self._radius(frame, second=True)
        bend, cosine, sine, gain = frame.bend, frame.cosine, frame.sine, frame.gain
        A = frame.speed - bend * r.f * cosine
        # Derivatives and normal in the basis (T, rho, tau)
        basis = frame.T, frame.rho, frame.tau
        pu, pv = mi.Vector3d(A, r.u, 0), mi.Vector3d(0, r.v, r.f)
        puu = mi.Vector3d(
            gain - frame.twist * r.f * cosine - 2 * bend * r.u * cosine, A * bend * cosine + r.uu, -A * bend * sine
        )
        puv = mi.Vector3d(bend * (r.f * sine - r.v * cosine), r.uv, r.u)
        pvv = mi.Vector3d(0, r.vv - r.f, 2 * r.v)
        inward = dr.normalize(mi.Vector3d(r.u * r.f, -A * r.f, A * r.v))
        if self._stalks is not None:
            # In the model frame from here on
            turned = [w.x * frame.T + w.y * frame.rho + w.z * frame.tau for w in (pu, pv, puu, puv, pvv)]
            _, pu, pv, puu, puv, pvv = self._stalked((frame.centre + r.f * frame.rho, *turned))
            inward = dr.normalize(dr.cross(pu, pv))
            basis = tuple(mi.Vector3d(*row) for row in np.eye(3).tolist())
        E, F, G = dr.dot(pu, pu), dr.dot(pu, pv), dr.dot(pv, pv)
        L, M, N = (-dr.dot(inward, d) for d in (puu, puv, pvv))
        inverse = 1 / (E * G - F * F)
        duals = (G * inverse) * pu - (F * inverse) * pv, (E * inverse) * pv - (F * inverse) * pu
        # Model frame, turned to face the origin; S changes its sign with the normal.
        normal, first, second = (sum((c * b for c, b in zip(w, basis, strict=True)), mi.Vector3d(0))
                                 for w in (inward, *duals))  # fmt: skip
        sign = dr.select(dr.dot(normal, direction) > 0, mi.Float64(-1), mi.Float64(1))
        normal = normal * sign
        # Eigenvalues and eigenvectors of S in a tangent basis, S = sum of II_ij d_i d_j^T
        tangent, other = _tangent_basis(normal)
        along = [(dr.dot(first, w), dr.dot(second, w)) for w in (tangent, other)]
        a, b, c = (
            sign * (L * (f1 * f2) + M * (f1 * s2 + s1 * f2) + N * (s1 * s2))
            for (f1, s1), (f2, s2) in combinations_with_replacement(along, 2)
        )
        mean, half = (a + c) / 2, dr.sqrt(dr.square((a - c) / 2) + dr.square(b))
        turned_sine, turned_cosine = dr.sincos(dr.atan2(b, (a - c) / 2) / 2)
        solved &= dr.isfinite(mean) & dr.isfinite(t) & dr.all(dr.isfinite(normal))
        rotation = mi.Matrix3d(model_from_camera[:3, :3].T.tolist())
        centre = mi.Vector3d(*model_from_camera[:3, 3].tolist())
        dr.make_opaque(rotation, centre)
        values = {
            "distance": t,
            "position": rotation @ (origin + t * direction - centre),
            "normal": rotation @ normal,
            "k_min": mean - half,
            "k_max": mean + half,
            "direction_min": rotation @ (turned_cosine * other - turned_sine * tangent),
            "direction_max": rotation @ (turned_cosine * tangent + turned_sine * other),
        }
        return _arrays(values, solved)

    def _frame(self, u: Any, v: Any) -> _Frame:
        """Compute C(u) and the basis (see `Tube.heading`, `Tube.centreline` and `Tube.frame`)."""
        n = self._n
        start, speed, gain, fade = 0, 1, 0, ()
        if self._closed:
            u, speed, gain, fade = self._placed(u)
            start = -n["depth"]
        swaying, turning = dr.sincos(n["omega"] * u + n["phase"])
        psi = n["rate"] * u + n["sway"] * swaying
        bend = n["rate"] + n["sway"] * n["omega"] * turning
        twist = -n["sway"] * dr.square(n["omega"]) * swaying
        if self._closed:
            bend, twist = bend * speed, twist * dr.square(speed) + bend * gain
        # Polynomials about the nearest knot; x and z stand side by side.
        knot = dr.clip(dr.round((u - start) / n["spacing"]), 0, n["last_knot"])
        start_x, start_z, *powers = self._panels.row(_bounded(knot, n["last_knot"]))
        share = (u - start - knot * n["spacing"]) / (n["spacing"] / 2)
        x, z = powers[-2], powers[-1]
        for i in range(len(powers) - 4, -1, -2):
            x, z = dr.fma(x, share, powers[i]), dr.fma(z, share, powers[i + 1])
        s, c = dr.sincos(psi)
        sine, cosine = dr.sincos(v)
        T = mi.Vector3d(s, 0, c)
        rho, tau = mi.Vector3d(cosine * c, sine, -cosine * s), mi.Vector3d(-sine * c, cosine, sine * s)
        centre = mi.Vector3d(start_x + x, 0, start_z + z)
        return _Frame(centre, T, rho, tau, bend, twist, cosine, sine, u, v, speed, gain, fade)

    def _placed(self, u: Any) -> tuple[Any, Any, Any, tuple[Any, ...]]:
        """Compute c(u), c' and c'' of a closed tube, and h, h' and h'' (see `Tube._placed`)."""
        depth, middle = self._n["depth"], dr.clip(u, 0, self._n["length"])
        sine, cosine = dr.sincos((u - middle) / depth)
        squared, root = dr.square(sine), dr.sqrt(1 + dr.square(sine))
        first, second = -2 * squared * sine / root, -2 * squared * cosine * (3 + 2 * squared) / (root * (1 + squared))
        return middle + depth * sine, cosine, -sine / depth, (cosine * root, first / depth, second / dr.square(depth))

    def _radius(self, frame: _Frame, second: bool) -> _Jet:
        """Compute r and its derivatives (see `Tube.radius`), of a closed tube h r."""
        n, u, v = self._n, frame.u, frame.v
        # taeniae
        sine, cosine = dr.sincos(3 * (v - n["taenia_phase"]))
        zero = mi.Float64(0)
        sums = [n["radius"] + n["taenia"] * cosine, zero, -3 * n["taenia"] * sine]
        sums += [zero, zero, -9 * n["taenia"] * cosine] if second else []
        # folds and sessile polyps
        sine_v, cosine_v = dr.sincos(v)

        def fold(i: Any, *sums: Any) -> tuple[Any, ...]:
            number = dr.gather(mi.UInt32, self._listed, i)
            along, sine_c, cosine_c, depth, inverse, slant, kappa, *steep = self._folds.row(number)
            sine, cosine = sine_v * cosine_c - cosine_v * sine_c, cosine_v * cosine_c + sine_v * sine_c
            x, leaning = u - along - slant * sine, slant * cosine
            exponent = -dr.square(x) * inverse / 2 + kappa * (cosine - 1)
            eu, ev = -x * inverse, x * leaning * inverse - kappa * sine
            evv = -(dr.square(leaning) + x * slant * sine) * inverse - kappa * cosine
            forms = [-inverse, leaning * inverse, evv]
            if steep:
                turn = 1 - 2 * steep[0] * exponent
                forms = [turn * e - 2 * steep[0] * p for e, p in zip(forms, (eu * eu, eu * ev, ev * ev), strict=True)]
                exponent, eu, ev = exponent - steep[0] * dr.square(exponent), turn * eu, turn * ev
            bump = depth * dr.exp(exponent)
            parts = [1, eu, ev]
            if second:
                parts += [p + e for p, e in zip((eu * eu, eu * ev, ev * ev), forms, strict=True)]
            return i + 1, *(total - bump * part for total, part in zip(sums, parts, strict=True))

        cell = _bounded((u - n["least"]) * (CELLS / (n["most"] - n["least"])), CELLS - 1)
        first, last = (dr.gather(mi.UInt32, self._first, cell + k) for k in range(2))
        sums = self._summed(fold, first, last, sums)

        def wave(i: Any, *sums: Any) -> tuple[Any, ...]:
            q, m, phase = self._waves.row(i)  # type: ignore[union-attr]
            sine, cosine = dr.sincos(q * u + m * v + phase)
            sine, cosine = n["relief"] * sine, n["relief"] * cosine
            parts = [-cosine, q * sine, m * sine]
            parts += [q * q * cosine, q * m * cosine, m * m * cosine] if second else []
            return i + 1, *(total - part for total, part in zip(sums, parts, strict=True))

        if self._waves is not None:
            sums = self._summed(wave, mi.UInt32(0), self._counts["waves"], sums)
        if self._closed:
            (r, ru, rv), speed, (h, h1, h2) = sums[:3], frame.speed, frame.fade
            if second:
                sums[3] = h2 * r + 2 * h1 * ru * speed + h * (sums[3] * dr.square(speed) + ru * frame.gain)
                sums[4:] = h1 * rv + h * sums[4] * speed, h * sums[5]
            sums[:3] = h * r, h1 * r + h * ru * speed, h * rv
        return _Jet(*sums, *([] if second else [zero] * 3))

    def _stalked(self, wall: tuple[Any, ...]) -> tuple[Any, ...]:
        """Apply the maps of pedunculated polyps to points and their first, or first and second, derivatives."""
        if self._stalks is None:
            return wall
        stalks, missing = self._stalks, [mi.Vector3d(0)] * (6 - len(wall))

        def stalk(i: Any, *parts: Any) -> tuple[Any, ...]:
            a, b, c, k, m, n, height, width, depth = stalks.row(i)
            foot, axis = mi.Vector3d(a, b, c), mi.Vector3d(k, m, n)
            start = _Jet(*parts, *missing)
            from_foot = start.affine(1, -foot)
            z = _Jet(*(dr.dot(axis, part) for part in vars(from_foot).values()))
            x = from_foot + _along(z.affine(-1), axis)
            q = x.times(x, dr.dot)
            # lift, then stricture (see `simtest.surfaces.tube.Stalk`)
            bent = q.affine(1 / (2 * dr.square(width)))
            bump = (bent + bent * bent).affine(-0.5).exp()
            raised = z + bump * _fading(z.affine(1 / (LIFT_REACH * height))).affine(height)
            neck = _fading(raised.affine(1 / (NECK_REACH * height), -NECK_AT / NECK_REACH)).affine(-depth)
            reach = (q * q).affine(-1 / dr.square(dr.square(width * ACROSS))).exp()
            moved = (x + neck * reach * x + _along(raised, axis)).affine(1, foot)
            return i + 1, *list(vars(moved).values())[: len(parts)]

        names = ("i", *(f"part_{i}" for i in range(len(wall))))
        state = (mi.UInt32(0), *(mi.Vector3d(part) for part in wall))
        return tuple(dr.while_loop(state, lambda i, *_: i < self._counts["stalks"], stalk, labels=names)[1:])

    def _summed(self, term: Any, first: Any, last: Any, sums: list[Any]) -> list[Any]:
        names = ("i", *(f"sum_{i}" for i in range(len(sums))))
        state = (first, *(mi.Float64(part) for part in sums))
        return list(dr.while_loop(state, lambda i, *_: i < last, term, labels=names)[1:])


def _bounded(number: Any, last: Any) -> Any:
    """Return the whole part of numbers, mitsuba.UInt32, from 0 to the last: also of the NaN of lanes given up."""
    return dr.minimum(mi.UInt32(dr.maximum(number, 0)), mi.UInt32(last))


def _lists(numbers: TubeNumbers) -> tuple[IntArray, IntArray]:
    """Return where each cell's list of folds starts in the lists, shape (`CELLS` + 1,), and the lists."""
    edges = np.linspace(numbers.constants["least"], numbers.constants["most"], CELLS + 1)[:, None]
    low, high = numbers.folds[:, 0] - numbers.reaches, numbers.folds[:, 0] + numbers.reaches
    # A cell more on both sides: a place at an edge may round into either.
    margin = edges[1] - edges[0]
    reached = (low <= edges[1:] + margin) & (high >= edges[:-1] - margin)
    return np.append(0, np.cumsum(reached.sum(axis=1))), np.nonzero(reached)[1]


def _along(length: _Jet, axis: Any) -> _Jet:
    """Return vectors of lengths along an axis."""
    return _Jet(*(part * axis for part in vars(length).values()))


def _fading(x: _Jet) -> _Jet:
    """Return exp(-x^4)."""
    square = x * x
    return (square * square).affine(-1).exp()


def _tangent_basis(normal: Any) -> tuple[Any, Any]:
    """Return the basis of `simtest.geometry.vectors.tangent_basis`."""
    sign = dr.select(normal.z >= 0, mi.Float64(1), mi.Float64(-1))
    a = -1 / (sign + normal.z)
    b = normal.x * normal.y * a
    first = mi.Vector3d(1 + sign * dr.square(normal.x) * a, sign * b, -sign * normal.x)
    return first, mi.Vector3d(b, sign + dr.square(normal.y) * a, -normal.y)


def _arrays(values: dict[str, Any], solved: Any) -> dict[str, Array]:
    """Return lanes as arrays of double precision, NaN where there is no point."""
    kept = {name: dr.select(solved, value, dr.nan) for name, value in values.items()}
    dr.eval(kept, solved)
    arrays: dict[str, Array] = {"valid": np.array(solved), "pool": np.zeros(len(solved), dtype=bool)}
    for name, value in kept.items():
        arrays[name] = vectors_from_kernel(value, np.float64) if dr.depth_v(value) > 1 else np.array(value)
    return arrays
