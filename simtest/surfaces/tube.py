"""A bent tube with haustral folds, the surface of a generated colon; all derivatives in closed form.

P(u, v) = C(u) + r(u, v) rho(u, v), rho = cos v e1(u) + sin v e2, with C' = T = (sin psi, 0, cos psi),
e1 = (cos psi, 0, -sin psi), e2 = (0, 1, 0) and tau = -sin v e1 + cos v e2. As T' = psi' e1 and e1' = -psi' T,

    P_u  = (1 - psi' r cos v) T + r_u rho
    P_v  = r_v rho + r tau
    P_uu = (-psi'' r cos v - 2 psi' r_u cos v) T + (1 - psi' r cos v) psi' (cos v rho - sin v tau) + r_uu rho
    P_uv = (psi' r sin v - psi' r_v cos v) T + r_uv rho + r_u tau
    P_vv = (r_vv - r) rho + 2 r_v tau

P_u x P_v points into the lumen while 1 - psi' r cos v > 0.

A closed tube goes on beyond its ends by rounded ones of depth a = radius_mm, where C and r are those at
c(u) = length + a sin(phi), phi = (u - length)/a, and the radius is h r, h = (1 - sin^4 phi)^(1/2); at the other end
likewise. Normals and curvatures are continuous, but for the curvatures at the pole, and c' takes the place of 1 in P_u,
c'' T is added to P_uu.

Pedunculated polyps are maps of space applied to P, which preserve the sense of P_u x P_v: each raises a mushroom from
the wall. With z the height over the polyp's foot along its axis a, x the vector across it, q = |x|^2 and h the polyp's
height,

    lift:     z' = z + h E(q) psi(z),   E = exp(-(tau + tau^2)/2), tau = q / (2 s^2),   psi = exp(-(z / 2h)^4)
    stricture: x' = (1 - A g(z') w(q)) x,   g = exp(-((z' - 0.3 h) / 0.3 h)^4),   w = exp(-q^2 / l^4), l = 2.4 s

The lift raises a bump with steep sides, the stricture narrows it at the height of the neck and leaves the head above.
Both are invertible: d(z')/dz > 0, as h |psi'| < 0.77, and d(|x'|)/d|x| >= 1 - A > 0. So the wall cannot intersect
itself, whatever folds are at the polyp's position, and the origin of each point can be found. Far from the polyp both
are the identity to rounding. On the polyp the surface is no radius over the centreline: the head overhangs the neck.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import InputError
from simtest.geometry.vectors import dot, unit
from simtest.runtime.arrays import Array, Mask
from simtest.runtime.seeds import Stage, generator
from simtest.surfaces.jets import Jet
from simtest.surfaces.model import outer
from simtest.surfaces.recipe import ColonRecipe, Polyp

NECK_AT = 0.3
NECK_REACH = 0.3
"""Height and half length of the neck, as shares of the polyp's height."""

ACROSS = 2.4
"""Reach of the stricture across the axis, over the bump's width s."""

LIFT_REACH = 2.0
"""Height at which the lift has fallen to 1/e, over the polyp's height."""

FAR = 40.0
"""With an exponent beyond this an exponential is below rounding."""

NOTHING = 750.0
"""With an exponent beyond this it is 0."""

_STEPS = 80
_PROFILE = np.linspace(0.01, 0.9999, 4000)
"""Heights, as shares of the polyp's, at which its widths are looked up."""


@dataclass(frozen=True)
class Stalk:
    """The map of one polyp."""

    foot: Array  # (3,): point of the wall under the polyp, mm
    axis: Array  # (3,): unit vector into the lumen
    # height, width, depth: h and s, mm, and A
    height: float
    width: float
    depth: float

    @classmethod
    def of_size(cls, foot: Array, axis: Array, height: float, head: float, neck: float) -> "Stalk":
        """Return the polyp of a height and diameters of head and neck, mm, as measured on a flat wall."""
        # The radius is s times a function of A and z / h alone, so A follows from the ratio of the two diameters.
        narrow, wide = 0.0, 1.0
        for _ in range(_STEPS):
            depth = (narrow + wide) / 2
            at_neck, at_head = _widths(depth)
            if at_neck / at_head > neck / head:
                narrow = depth
            else:
                wide = depth
        return cls(foot, axis, height, head / 2 / _widths(narrow)[1], narrow)

    def apply(self, p: Jet) -> Jet:
        """Map a surface, shape (N, 3), mm, with its derivatives."""
        near = np.flatnonzero(self.moves(p.value))
        return p.with_rows(near, self._applied(p.rows(near))) if near.size else p

    def moves(self, points: Array) -> Mask:
        """Return which points, shape (N, 3), mm, are so near that the map moves them by more than rounding."""
        z, x = self._split(points)
        # Of E and w the latter reaches farther, and of g and psi.
        across, along = math.sqrt(FAR) * (ACROSS * self.width) ** 2, FAR**0.25 * LIFT_REACH * self.height
        return np.asarray((dot(x, x) < across) & (np.abs(z) < along))

    def _applied(self, p: Jet) -> Jet:
        # coordinates about the foot
        from_foot = p.affine(1.0, -self.foot)
        z = from_foot.along(self.axis)
        x = from_foot + z.outer(-self.axis)
        q = x.squared()
        # lift, then stricture
        raised = z + self._bump(q) * self._fading(z)
        narrowed = x + self._neck(raised) * self._reach(q) * x
        return narrowed + raised.outer(self.axis).affine(1.0, self.foot)

    def raised(self, points: Array) -> Array:
        """Return how high points of the wall, shape (N, 3), mm, are lifted, over the polyp's height."""
        z, x = self._split(points)
        return self._bump(Jet(dot(x, x))).value * self._fading(Jet(z)).value / self.height

    def undo(self, points: Array) -> Array:
        """Return where points, shape (N, 3), mm, come from, to rounding."""
        near = np.flatnonzero(self.moves(points))
        if not near.size:
            return points
        source = points.copy()
        source[near] = self._undone(points[near])
        return source

    def _undone(self, points: Array) -> Array:
        # The stricture first, at the known height z'; then the lift, at the distance from the axis found there.
        z, x = self._split(points)
        length = np.linalg.norm(x, axis=1)
        g = self.depth * np.exp(-(((z / self.height - NECK_AT) / NECK_REACH) ** 4).clip(max=700))
        across = self.width * ACROSS

        def narrowed(r: Array) -> Array:
            return r * (1 - g * np.exp(-((r / across) ** 4).clip(max=700)))

        # x' is shorter than x, by a share of at most A.
        r = _bisect(narrowed, length, length, length / (1 - self.depth) + 1e-12)
        bump = self._bump(Jet(r * r)).value

        def raised(low: Array) -> Array:
            return low + bump * self._fading(Jet(low)).value

        source = _bisect(raised, z, z - self.height * bump, z)
        moved = (length > 0) & (r > 0)
        stretch = np.where(moved, r / np.where(moved, length, 1.0), 1.0)
        return self.foot + source[:, None] * self.axis + stretch[:, None] * x

    def _split(self, points: Array) -> tuple[Array, Array]:
        """Return z and x of points."""
        from_foot = points - self.foot
        z = from_foot @ self.axis
        return z, from_foot - z[:, None] * self.axis

    def _bump(self, q: Jet) -> Jet:
        """Return E."""
        tau = q.affine(1 / (2 * self.width**2))
        return (tau + tau * tau).affine(-0.5).exp()

    def _fading(self, z: Jet) -> Jet:
        """Return h psi(z); the wall outside, z < 0, is lifted as well, which makes no two walls intersect."""
        return _quartic(z.affine(1 / (LIFT_REACH * self.height))).affine(self.height)

    def _neck(self, z: Jet) -> Jet:
        """Return -A g(z)."""
        return _quartic(z.affine(1 / (NECK_REACH * self.height), -NECK_AT / NECK_REACH)).affine(-self.depth)

    def _reach(self, q: Jet) -> Jet:
        """Return w."""
        return (q * q).affine(-1 / (self.width * ACROSS) ** 4).exp()


def _quartic(x: Jet) -> Jet:
    """Return exp(-x^4)."""
    square = x * x
    return (square * square).affine(-1.0).exp()


def _widths(depth: float) -> tuple[float, float]:
    """Return the radii of neck and head on a flat wall, over the width s."""
    z = _PROFILE
    # Radius at which the lift E equals z, narrowed by the stricture
    tau = (np.sqrt(1 - 8 * np.log(z)) - 1) / 2
    r = np.sqrt(2 * tau)
    r *= 1 - depth * np.exp(-(((z - NECK_AT) / NECK_REACH) ** 4)) * np.exp(-((r / ACROSS) ** 4))
    # The head is the widest part above the neck, the neck the narrowest below the head.
    above = z > NECK_AT + NECK_REACH / 2
    head = int(np.argmax(np.where(above, r, 0.0)))
    return float(r[(z > NECK_AT / 3) & (z <= z[head])].min()), float(r[head])


def _bisect(function: Callable[[Array], Array], target: Array, low: Array, high: Array) -> Array:
    """Solve function(x) = target for a rising function between bounds, each of shape (N,)."""
    for _ in range(_STEPS):
        middle = (low + high) / 2
        if ((middle == low) | (middle == high)).all():
            break
        below = function(middle) < target
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return (low + high) / 2


NEWTON_STEPS = 12
NEWTON_TOLERANCE_MM = 1e-10
MAX_SHIFT_MM = 3.0
"""A solution farther from the mesh's hit than this is another part of the surface: no solution."""

_END_MM, _POLE_MM = 1.0, 1e-6
"""How far beyond an open tube's ends a solution may lie, and a closed one's last points from its poles."""

_PANEL_MM = 4.0
_RELIEF_WAVES = 6
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(10)

RIDGE_MM = 3.0
"""Half width of a taenia's ridge: the standard deviation of its profile."""

ENDLESS_MM = 1e9
"""Width of a fold that does not end along the tube."""

CREASES, CREASE_SHARE, CREASE_KAPPAS = 3, 0.2, (4.0, 40.0)
"""Fine folds around the tube, their width over the distance between them, and how short they are around the tube."""

POLYP_ROOM = 0.25
"""How far a drawn polyp stays from the centreline, over the tube's radius."""

POLYP_STEEPNESS = (3.0, 10.0)
"""Least and largest steepness of a drawn sessile polyp."""

POLYP_EDGE = 0.1
"""A polyp is seen where it raises the wall by this share of its height."""

_BLOCK, _MANY = 8192, 256
"""Points of a block, which the processor's cache holds; with fewer a fold, all its folds are computed at once."""

_PANEL_DEGREE = 12
"""Of the polynomials that stand for the centreline between two knots: exact to rounding for every bend allowed."""


@dataclass(frozen=True)
class _Fold:
    """A fold d exp(E - steep E^2).

    E = -(u - along - slant sin(v - centre))^2 / (2 w^2) + kappa (cos(v - centre) - 1)
    """

    along: float
    centre: float
    depth: float
    width: float
    slant: float
    kappa: float
    steep: float = 0.0

    def shape_at(self, u: Array, v: Array) -> Array:
        """Return its height at points over that of its top, of one that is not slanted."""
        exponent = -((u - self.along) ** 2) / (2 * self.width**2) + self.kappa * (np.cos(v - self.centre) - 1)
        return np.asarray(np.exp(exponent - self.steep * exponent**2))


@dataclass(frozen=True)
class TubeNumbers:
    """A tube as numbers, for a kernel."""

    constants: dict[str, float]  # Scalars of the module's formulas
    # (K, 7) or (K, 8): along, sine and cosine of the centre, depth, 1 / width^2, slant and kappa of each fold (see
    # `_Fold`), and where any is steep how steep
    folds: Array
    reaches: Array  # (K,): how far from its middle along the tube each fold reaches, mm
    waves: Array  # (W, 3): q, m and phase of the relief's waves
    # (knots, 2 + 2 * powers): x and z of each knot, then of the polynomial's coefficients about it, the lowest first
    panels: Array
    stalks: Array  # (P, 9): foot, axis, height, width and depth of each pedunculated polyp (see `Stalk`)


@dataclass(frozen=True)
class TubeChart:
    """A tube with its parameters (u, v) at the corners of a mesh's triangles, shape (F, 3, 2)."""

    tube: "Tube"
    corners: Array


class Tube:
    """The surface of a recipe as a function of (u, v): u along the centreline, mm; v around it, rad.

    Raises `InputError` if the folds close the lumen or the tube bends into itself.
    """

    def __init__(self, recipe: ColonRecipe) -> None:
        self.recipe = recipe
        # Stage.SWEEP: the shape is part of the case, not of a realisation's rendering or noise.
        rng = generator(recipe.seed, "anatomy", "colon", 0, Stage.SWEEP)
        self._phase, self._taenia_phase = rng.uniform(0, 2 * math.pi, size=2)
        self._folds: tuple[_Fold, ...] = ()
        self._add((*self._draw_folds(rng), *self._ridges(), *self._draw_creases()))
        self._relief = self._draw_relief(rng)
        self.polyps = (*recipe.polyps, *self._draw_polyps())
        self._sessile = dict(self._bumps())
        self._add(tuple(self._sessile.values()))
        self.depth = recipe.radius_mm if recipe.closed else 0.0  # of each end, mm
        # u of the ends, short of the poles, where no tangent leads around, and of the last solutions
        arc, slack = (math.pi / 2 * self.depth - _POLE_MM, _POLE_MM) if recipe.closed else (0.0, _END_MM)
        self.ends = (-arc, recipe.length_mm + arc)
        self.bounds = (-arc - slack, self.ends[1] + slack)
        low, high = self._span = (-self.depth, recipe.length_mm + self.depth)
        self._knots = np.linspace(low, high, max(2, math.ceil((high - low) / _PANEL_MM) + 1))
        first = self._integrate(np.zeros(1), self._knots[:1])
        steps = self._integrate(self._knots[:-1], self._knots[1:])
        self._knot_points = np.concatenate([first, first + np.cumsum(steps, axis=0)])
        self._panels = self._fit_panels()
        # Stalks stand on the wall without any, so that is needed first.
        self._stalks: dict[int, Stalk] = {}
        self._check()
        self._stalks = dict(self._draw_stalks())

    def _add(self, folds: tuple[_Fold, ...]) -> None:
        """Add folds, with a table of their numbers and of how far each reaches: to where it is 0, or below rounding."""
        self._folds += folds
        far = FAR if self.recipe.closed else NOTHING
        rows = [
            (f.along, math.sin(f.centre), math.cos(f.centre), f.depth, f.width**2, f.slant, f.kappa, f.steep)
            for f in self._folds
        ]
        self._table = np.ascontiguousarray(np.transpose(rows))
        self._reach = np.abs(self._table[5]) + np.sqrt(2 * far * self._table[4])

    def _draw_folds(self, rng: np.random.Generator) -> tuple[_Fold, ...]:
        recipe, spread, folds = self.recipe, self.recipe.irregularity, []
        rings = max(1, round(recipe.length_mm / recipe.fold_spacing_mm))
        pitch = recipe.length_mm / rings
        for ring in range(rings):
            for third in range(3):
                depth, edge, shift, turn = 1 + spread * rng.uniform(-1, 1, size=4)
                slant = spread * recipe.fold_spacing_mm * rng.uniform(-0.5, 0.5)
                kappa = recipe.fold_concentration * (1 + spread * rng.uniform(-1, 1))
                # The taeniae are where r is largest, cos(3 (v - phase)) = 1; a fold lies between two of them.
                centre = self._taenia_phase + math.pi / 3 + 2 * math.pi / 3 * third + 0.5 * (turn - 1)
                depth *= recipe.fold_depth_mm
                # The crest's radius of curvature along u is width^2 / depth.
                width = math.sqrt(max(depth, 1e-6) * edge * recipe.fold_edge_mm)
                along = ring + 0.5 + shift - 1 + recipe.fold_stagger * (third - 1)
                folds.append(_Fold(along * pitch, centre, depth, width, slant, kappa))
        return tuple(folds)

    def _ridges(self) -> Iterator[_Fold]:
        """Yield a ridge along each taenia: a fold as long as the tube."""
        recipe = self.recipe
        for third in range(3 if recipe.taenia_ridge_mm else 0):
            centre, kappa = self._taenia_phase + 2 * math.pi / 3 * third, (recipe.radius_mm / RIDGE_MM) ** 2
            yield _Fold(recipe.length_mm / 2, centre, recipe.taenia_ridge_mm, ENDLESS_MM, 0.0, kappa)

    def _draw_creases(self) -> Iterator[_Fold]:
        """Yield the fine folds, anywhere around the tube, longer and shorter ones, more or less across it."""
        recipe, rng = self.recipe, self._generator("creases")
        rows = round(recipe.length_mm / recipe.crease_spacing_mm) if recipe.crease_mm else 0
        for number in range(CREASES * rows):
            along = (number + rng.uniform()) / (CREASES * rows) * recipe.length_mm
            depth, width = recipe.crease_mm * rng.uniform(0.5, 1.5), CREASE_SHARE * recipe.crease_spacing_mm
            slant = recipe.crease_spacing_mm * rng.uniform(-1, 1)
            kappa = math.exp(rng.uniform(*np.log(CREASE_KAPPAS)))
            yield _Fold(along, rng.uniform(0, 2 * math.pi), depth, width * rng.uniform(0.8, 1.25), slant, kappa)

    def _generator(self, part: str) -> np.random.Generator:
        """Return the random numbers of a part that not every colon has: it changes no other."""
        return generator(self.recipe.seed, "anatomy", part, 0, Stage.SWEEP)

    def _draw_polyps(self) -> Iterator[Polyp]:
        """Yield polyps along the middle of the tube, smaller where the wall leaves less room."""
        recipe, rng = self.recipe, self._generator("polyps")
        sizes = np.log([recipe.polyp_smallest_mm, recipe.polyp_largest_mm])
        for number in range(recipe.polyp_count):
            along = recipe.length_mm * (0.1 + 0.8 * (number + rng.uniform()) / recipe.polyp_count)
            around, size, stalked = rng.uniform(0, 360), math.exp(rng.uniform(*sizes)), rng.uniform()
            tall, neck = rng.uniform(size=2)
            wall = self.radius(np.array([along]), np.radians([around]), second=False).value[0]
            # Within the bounds of a polyp's own keys
            room = float(np.clip(wall - POLYP_ROOM * recipe.radius_mm, 1.0, 20.0))
            if stalked < recipe.polyp_stalked:
                size = min(size, room)
                height, narrow = min(size * (1 + 0.4 * tall), room), max(size * (0.35 + 0.25 * neck), 0.5)
                yield Polyp(along_mm=along, around_deg=around, height_mm=height, width_mm=size, neck_mm=narrow)
            else:
                height = min(size * (0.35 + 0.35 * tall), room)
                steep = float(np.interp(neck, (0, 1), POLYP_STEEPNESS))
                yield Polyp(along_mm=along, around_deg=around, height_mm=height, width_mm=size, steepness=steep)

    def _bumps(self) -> Iterator[tuple[int, _Fold]]:
        """Yield the sessile polyps, by number: folds that are as wide around the tube as along it, and not slanted."""
        for number, polyp in enumerate(self.polyps):
            if polyp.neck_mm is not None:
                continue
            # At half height E - steep E^2 = -ln 2.
            half = 2 * math.log(2) / (1 + math.sqrt(1 + 4 * polyp.steepness * math.log(2)))
            width, around = polyp.width_mm / math.sqrt(8 * half), math.radians(polyp.around_deg)
            kappa = (self.recipe.radius_mm / width) ** 2
            yield number, _Fold(polyp.along_mm, around, polyp.height_mm, width, 0.0, kappa, polyp.steepness)

    def _draw_stalks(self) -> Iterator[tuple[int, Stalk]]:
        """Yield the pedunculated polyps, by number, each on the wall without any, towards the centreline."""
        for number, polyp in enumerate(self.polyps):
            if polyp.neck_mm is not None:
                u, v = np.array([polyp.along_mm]), np.radians([polyp.around_deg])
                foot, axis = self.tangents(u, v)[0][0], -self.frame(u, v)[1][0]
                yield number, Stalk.of_size(foot, axis, polyp.height_mm, polyp.width_mm, polyp.neck_mm)

    def polyp_at(self, u: Array, v: Array, edge: float = POLYP_EDGE) -> npt.NDArray[np.uint8]:
        """Return 1 + the number of the polyp at points, shape (N,), 0 where none is.

        A polyp is where it raises the wall by more than a share `edge` of its height; of several that which does most.
        """
        most, numbers = np.full(len(u), edge), np.zeros(len(u), dtype=np.uint8)
        bare = self._wall(u, v, second=False).value if self._stalks else np.empty(0)
        at = self._placed(u)[0] if self.depth else u
        for number in range(len(self.polyps)):
            bump = self._sessile.get(number)
            raised = self._stalks[number].raised(bare) if bump is None else bump.shape_at(at, v)
            numbers[raised > most] = number + 1
            most = np.maximum(most, raised)
        return numbers

    def _draw_relief(self, rng: np.random.Generator) -> tuple[tuple[float, int, float], ...]:
        """Draw the waves cos(q u + m v + phase) of the mucosa's relief; m is an integer, so that they close."""
        recipe = self.recipe
        if not recipe.relief_mm:
            return ()
        waves = []
        for _ in range(_RELIEF_WAVES):
            heading, phase = rng.uniform(0, 2 * math.pi, size=2)
            number = 2 * math.pi / (recipe.relief_length_mm * rng.uniform(0.8, 1.25))
            waves.append((number * math.cos(heading), round(recipe.radius_mm * number * math.sin(heading)), phase))
        return tuple(waves)

    def _check(self) -> None:
        """Raise `InputError` if the folds close the lumen or the tube bends into itself."""
        u, v = np.meshgrid(np.linspace(*self._span, 200), np.linspace(0, 2 * math.pi, 180), indexing="ij")
        r = self.radius(u.ravel(), v.ravel()).value
        if r.min() < 0.1 * self.recipe.radius_mm:
            raise InputError(
                f"colon recipe: folds leave a radius of {r.min():.3g} mm; at least {0.1 * self.recipe.radius_mm:.3g} "
                "is needed: lower fold_depth_mm or raise fold_spacing_mm"
            )
        # 1 - psi' r cos v must stay positive.
        bend = np.abs(self.heading(u.ravel())[1]) * r
        if bend.max() > 0.9:
            raise InputError(
                f"colon recipe: the tube bends into itself (curvature times radius {bend.max():.3g}; at most 0.9 is "
                "allowed): lower bend_deg or sway_deg or raise length_mm"
            )

    def heading(self, u: Array) -> tuple[Array, Array, Array]:
        """Return psi, rad, and its first and second derivatives at u, mm, shape (N,)."""
        rate = math.radians(self.recipe.bend_deg) / self.recipe.length_mm
        sway, omega = math.radians(self.recipe.sway_deg), 2 * math.pi / self.recipe.sway_length_mm
        sine, cosine = np.sin(omega * u + self._phase), np.cos(omega * u + self._phase)
        return rate * u + sway * sine, rate + sway * omega * cosine, -sway * omega**2 * sine

    def _integrate(self, start: Array, stop: Array) -> Array:
        """Return C(stop) - C(start), mm, shape (N, 3)."""
        half = (stop - start) / 2
        # Gauss-Legendre nodes on each interval; the integrand is the unit tangent.
        psi = self.heading(((start + stop) / 2)[:, None] + half[:, None] * _GAUSS_NODES)[0]
        x, z = (half * (part(psi) @ _GAUSS_WEIGHTS) for part in (np.sin, np.cos))
        return np.stack([x, np.zeros_like(x), z], axis=1)

    def centreline(self, u: Array) -> Array:
        """Return C(u), mm, by polynomials about the nearest knot; by the quadrature itself beyond the tube's ends."""
        spacing = self._knots[1] - self._knots[0]
        knot = np.clip(np.rint((u - self._knots[0]) / spacing), 0, len(self._knots) - 1).astype(np.int64)
        points = self._knot_points[knot]
        share = (u - self._knots[knot]) / (spacing / 2)
        inside = np.abs(share) <= 1 + 1e-9
        for axis, coefficients in zip((0, 2), self._panels, strict=True):
            # Horner's scheme
            value = coefficients[-1, knot]
            for row in coefficients[-2::-1]:
                value *= share
                value += row[knot]
            points[:, axis] += np.where(inside, value, 0.0)
        if not inside.all():
            beyond = np.flatnonzero(~inside)
            points[beyond] += self._integrate(self._knots[knot[beyond]], u[beyond])
        return points

    def _fit_panels(self) -> Array:
        """Fit C(u) - C(knot) within half a spacing of each knot, x and z, shape (2, _PANEL_DEGREE + 1, knots).

        The coefficients are those of the powers of (u - knot) over half the spacing, the lowest first.
        """
        half = (self._knots[1] - self._knots[0]) / 2
        nodes = np.polynomial.chebyshev.chebpts1(_PANEL_DEGREE + 1)
        start = np.repeat(self._knots, len(nodes))
        values = self._integrate(start, start + half * np.tile(nodes, len(self._knots)))
        values = values[:, [0, 2]].reshape(len(self._knots), len(nodes), 2)
        # Chebyshev's basis is well conditioned; powers are quicker to evaluate.
        fitted = np.linalg.solve(np.polynomial.chebyshev.chebvander(nodes, _PANEL_DEGREE), values)
        powers = np.stack(
            [np.pad(p, (0, len(nodes) - len(p))) for p in map(np.polynomial.chebyshev.cheb2poly, np.eye(len(nodes)))]
        )
        return np.ascontiguousarray(np.einsum("kcx,cp->xpk", fitted, powers))

    def slice_of(self, points: Array) -> tuple[Array, Array, Array]:
        """Return (u, v) and the distance from the centreline, mm, of points, shape (N, 3), near the tube.

        A point that a pedunculated polyp has moved counts where it came from. u solves (x - C(u)) . T(u) = 0 by
        Newton's method, started at the nearest of a row of centreline points.
        """
        for stalk in reversed(self._stalks.values()):
            points = stalk.undo(points)
        # start
        row = np.linspace(*self._span, 129)
        gaps = points[:, None] - self.centreline(row)
        u = row[np.argmin(np.einsum("nki,nki->nk", gaps, gaps), axis=1)]
        # refine
        for _ in range(20):
            psi, bend, _ = self.heading(u)
            s, c = np.sin(psi), np.cos(psi)
            x, z = (points - self.centreline(u))[:, [0, 2]].T
            slope = np.maximum(1 - bend * (x * c - z * s), 0.1)  # the tube keeps it positive
            before, u = u, u + np.clip((x * s + z * c) / slope, -5.0, 5.0)
            if np.array_equal(before, u):
                break
        # angle and distance in the slice
        psi = self.heading(u)[0]
        x, y, z = (points - self.centreline(u)).T
        across = x * np.cos(psi) - z * np.sin(psi)
        return u, np.arctan2(y, across), np.hypot(across, y)

    def radius(self, u: Array, v: Array, second: bool = True) -> Jet:
        """Return r(u, v), mm, and its derivatives, without `second` only the first; u, v of shape (N,)."""
        order = np.argsort(u)
        u, v = u[order], v[order]
        # taeniae
        amplitude, angle = self.recipe.taenia_mm, 3 * (v - self._taenia_phase)
        sine, cosine = np.sin(angle), np.cos(angle)
        zero = np.zeros_like(u)
        f, fu, fv = self.recipe.radius_mm + amplitude * cosine, zero.copy(), -3 * amplitude * sine
        fuu, fuv, fvv = zero.copy(), zero.copy(), -9 * amplitude * cosine
        # folds and sessile polyps: block by block one after the other, or, of a few points, all at once
        parts, sine_v, cosine_v = (f, fu, fv, fuu, fuv, fvv), np.sin(v), np.cos(v)
        for start in range(0, len(u), _BLOCK):
            block = slice(start, start + _BLOCK)
            first = np.searchsorted(u[block], self._table[0] - self._reach)
            counts = np.searchsorted(u[block], self._table[0] + self._reach, side="right") - first
            each = np.flatnonzero(counts)
            if counts.sum() < _MANY * len(each):
                at = np.arange(counts.sum()) + np.repeat(first - np.cumsum(counts) + counts, counts)
                groups: list[Any] = [(at, np.repeat(self._table, counts, axis=1))]
            else:
                groups = [(slice(first[n], first[n] + counts[n]), self._table[:, n]) for n in each]
            for at, fold in groups:
                bumps = _bumps(fold, u[block][at], sine_v[block][at], cosine_v[block][at], second)
                for part, bump in zip(parts, bumps, strict=False):
                    if isinstance(at, slice):
                        part[block][at] -= bump
                    else:
                        np.subtract.at(part[block], at, bump)
        # relief
        for q, m, phase in self._relief:
            angle = q * u + m * v + phase
            sine, cosine = self.recipe.relief_mm * np.sin(angle), self.recipe.relief_mm * np.cos(angle)
            f += cosine
            fu -= q * sine
            fv -= m * sine
            if not second:
                continue
            fuu -= q * q * cosine
            fuv -= q * m * cosine
            fvv -= m * m * cosine
        # in the order of the points
        back = np.empty_like(order)
        back[order] = np.arange(len(order))
        hessian = [np.stack([fuu, fuv, fuv, fvv], axis=1)[back].reshape(-1, 2, 2)] if second else []
        return Jet(f[back], np.stack([fu, fv], axis=1)[back], *hessian)

    def numbers(self) -> TubeNumbers:
        """Return the tube as numbers."""
        recipe = self.recipe
        rate, omega = math.radians(recipe.bend_deg) / recipe.length_mm, 2 * math.pi / recipe.sway_length_mm
        constants = {
            "length": recipe.length_mm, "radius": recipe.radius_mm, "taenia": recipe.taenia_mm,
            "taenia_phase": float(self._taenia_phase), "relief": recipe.relief_mm, "rate": rate,
            "sway": math.radians(recipe.sway_deg), "omega": omega, "phase": float(self._phase),
            "spacing": float(self._knots[1] - self._knots[0]), "least": self.bounds[0], "most": self.bounds[1],
            "depth": self.depth,
        }  # fmt: skip
        folds = [
            (f.along, math.sin(f.centre), math.cos(f.centre), f.depth, 1 / f.width**2, f.slant, f.kappa)
            + ((f.steep,) if any(fold.steep for fold in self._folds) else ())
            for f in self._folds
        ]
        powers = self._panels.transpose(2, 1, 0).reshape(len(self._knots), -1)
        panels = np.hstack([self._knot_points[:, [0, 2]], powers])
        stalks = [(*s.foot, *s.axis, s.height, s.width, s.depth) for s in self._stalks.values()]
        waves = np.array(self._relief).reshape(-1, 3)
        return TubeNumbers(constants, np.array(folds), self._reach, waves, panels, np.array(stalks).reshape(-1, 9))

    def frame(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return T, rho and tau, three arrays of shape (N, 3)."""
        psi = self.heading(u)[0]
        s, c, zero = np.sin(psi), np.cos(psi), np.zeros_like(psi)
        e1, e2 = np.stack([c, zero, -s], axis=1), np.array([0.0, 1.0, 0.0])
        cv, sv = np.cos(v)[:, None], np.sin(v)[:, None]
        return np.stack([s, zero, c], axis=1), cv * e1 + sv * e2, cv * e2 - sv * e1

    def tangents(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return P, mm, P_u and P_v, three arrays of shape (N, 3)."""
        p = self.jet(u, v, second=False)
        along, around = np.ascontiguousarray(np.moveaxis(p.gradient, 2, 0))
        return p.value, along, around

    def jet(self, u: Array, v: Array, second: bool = True) -> Jet:
        """Return P, mm, and its derivatives by the formulas at the head of this module; u, v of shape (N,)."""
        wall = self._wall(u, v, second)
        for stalk in self._stalks.values():
            wall = stalk.apply(wall)
        return wall

    def _wall(self, u: Array, v: Array, second: bool) -> Jet:
        """Return what `jet` returns, without pedunculated polyps."""
        at, *placed = self._placed(u) if self.depth else (u, 1.0, 0.0, 1.0, 0.0, 0.0)
        radius = self.radius(at, v, second)
        r, (ru, rv) = radius.value[:, None], radius.gradient.T[:, :, None]
        bend, twist = (part[:, None] for part in self.heading(at)[1:])
        # By u, on which a closed tube's place and h depend
        speed, gain, h, h1, h2 = (np.reshape(part, (-1, 1)) for part in placed)
        bend, twist = bend * speed, twist * speed**2 + bend * gain
        if second:
            ruu, ruv, _, rvv = radius.hessian.reshape(-1, 4).T[:, :, None]
            ruu = h2 * r + 2 * h1 * ru * speed + h * (ruu * speed**2 + ru * gain)
            ruv, rvv = h1 * rv + h * ruv * speed, h * rvv
        r, ru, rv = h * r, h1 * r + h * ru * speed, h * rv
        cv, sv = np.cos(v)[:, None], np.sin(v)[:, None]
        T, rho, tau = self.frame(at, v)
        along = speed - bend * r * cv
        parts = [self.centreline(at) + r * rho, np.stack([along * T + ru * rho, rv * rho + r * tau], axis=2)]
        if second:
            uu = (gain - twist * r * cv - 2 * bend * ru * cv) * T
            uu += (along * bend * cv + ruu) * rho - along * bend * sv * tau
            uv = bend * (r * sv - rv * cv) * T + ruv * rho + ru * tau
            vv = (rvv - r) * rho + 2 * rv * tau
            parts.append(np.stack([uu, uv, uv, vv], axis=2).reshape(-1, 3, 2, 2))
        return Jet(*parts)

    def _placed(self, u: Array) -> tuple[Array, ...]:
        """Return c(u), c' and c'' of a closed tube, and h, h' and h''."""
        middle, a = np.clip(u, 0.0, self.recipe.length_mm), self.depth
        sine, cosine = np.sin((u - middle) / a), np.cos((u - middle) / a)
        root, square = np.sqrt(1 + sine**2), sine**2
        first, second = -2 * square * sine / root, -2 * square * cosine * (3 + 2 * square) / root**3
        return middle + a * sine, cosine, -sine / a, cosine * root, first / a, second / a**2

    def reach(self, along: Array, v: Array) -> Array:
        """Return how far the lumen reaches from a place along the centreline, mm, shape (N,); 0 beyond the ends."""
        beyond = np.abs(along - np.clip(along, 0, self.recipe.length_mm)) / (self.depth or _POLE_MM)
        return np.asarray(np.sqrt(np.maximum(1 - beyond**4, 0.0)) * self.radius(along, v, second=False).value)

    def is_pole(self, u: Array) -> Mask:
        """Return which parameters are those of a pole of a closed tube, where v says nothing."""
        return np.asarray((self.depth > 0) & ((u <= self.ends[0]) | (u >= self.ends[1])))

    @property
    def has_stalks(self) -> bool:
        """Whether there are pedunculated polyps."""
        return bool(self._stalks)

    def moved_by_stalks(self, points: Array) -> Mask:
        """Return which points, shape (N, 3), mm, are near enough to a pedunculated polyp to be moved by it."""
        moved = np.zeros(len(points), dtype=bool)
        for stalk in self._stalks.values():
            moved |= stalk.moves(points)
        return moved

    def normal_and_shape_operator(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return the unit normal into the lumen, shape (N, 3), and S, 1/mm, shape (N, 3, 3), at u, v of shape (N,)."""
        p = self.jet(u, v)
        pu, pv = np.ascontiguousarray(np.moveaxis(p.gradient, 2, 0))
        normal = unit(np.cross(pu, pv))
        # First fundamental form G and second fundamental form II = -N . P_ij
        E, F, G = (dot(a, b) for a, b in ((pu, pu), (pu, pv), (pv, pv)))
        second_derivatives = np.ascontiguousarray(np.moveaxis(p.hessian.reshape(-1, 3, 4), 2, 0))
        L, M, _, N = (-dot(normal, d) for d in second_derivatives)
        # dN(P_i) . P_j = II_ij, so S = sum of II_ij d_i d_j^T with the dual tangents d = J G^-1, J = (P_u, P_v).
        det = E * G - F * F
        first = (G / det)[:, None] * pu - (F / det)[:, None] * pv
        second = (E / det)[:, None] * pv - (F / det)[:, None] * pu
        along, across = L[:, None] * first + M[:, None] * second, M[:, None] * first + N[:, None] * second
        return normal, outer(first, along) + outer(second, across)

    def solve(
        self, origins: Array, directions: Array, distance: Array, u: Array, v: Array
    ) -> tuple[Array, Array, Array]:
        """Solve P(u, v) = origin + t direction by Newton's method from a start close by; return t, NaN: none, u, v."""
        u, v, t = u.copy(), v.copy(), distance.copy()
        solved = np.zeros(len(u), dtype=bool)
        active = np.flatnonzero(np.isfinite(distance))
        for _ in range(NEWTON_STEPS):
            p, pu, pv = self.tangents(u[active], v[active])
            towards = directions[active]
            miss = p - origins[active] - t[active, None] * towards
            # The linear system P_u du + P_v dv - direction dt = -miss by Cramer's rule, for -du, -dv and dt
            minor = np.cross(pv, towards)
            with np.errstate(divide="ignore", invalid="ignore"):
                inverse = 1.0 / _dot(pu, minor)
                du, dv, dt = (_dot(miss, m) * inverse for m in (minor, np.cross(towards, pu), np.cross(pu, pv)))
            done = _dot(miss, miss) < NEWTON_TOLERANCE_MM**2
            solved[active[done]] = True
            # A grazing ray has a nearly singular matrix: bound the step to the mesh's neighbourhood.
            scale = np.minimum(1.0, MAX_SHIFT_MM / np.maximum(np.abs(dt), np.finfo(float).tiny))
            scale[done] = 0.0
            u[active] -= scale * du
            v[active] -= scale * dv
            t[active] += scale * dt
            # A ray that leaves the neighbourhood of its hit is given up; the others go on.
            active = active[~done & (np.abs(t[active] - distance[active]) <= MAX_SHIFT_MM)]
            if not active.size:
                break
        inside = (u >= self.bounds[0]) & (u <= self.bounds[1])
        return np.where(solved & inside, t, np.nan), u, v


def _bumps(fold: Array, u: Array, sine_v: Array, cosine_v: Array, second: bool) -> list[Array]:
    """Return a fold at points, and its derivatives; by a column of `Tube._table`, or one for each point."""
    along, sine_c, cosine_c, depth, w2, slant, kappa, steep = fold
    # Of v - centre, without a sine of each point for each fold
    sine, cosine = sine_v * cosine_c - cosine_v * sine_c, cosine_v * cosine_c + sine_v * sine_c
    x = u - along - slant * sine
    exponent = -(x**2) / (2 * w2) + kappa * (cosine - 1)
    # Derivatives of the exponent E; x_v = -slant cos.
    eu, ev = -x / w2, x * slant * cosine / w2 - kappa * sine
    steeper = steep.any()
    if steeper:
        turn, a, b = 1 - 2 * steep * exponent, eu, ev
        exponent, eu, ev = exponent - steep * exponent**2, turn * a, turn * b
    bump = depth * np.exp(exponent)
    bumps = [bump, bump * eu, bump * ev]
    if second:
        euu, euv = -1 / w2, slant * cosine / w2
        evv = -((slant * cosine) ** 2 + x * slant * sine) / w2 - kappa * cosine
        if steeper:
            twice = 2 * steep
            euu, euv, evv = turn * euu - twice * a**2, turn * euv - twice * a * b, turn * evv - twice * b**2
        bumps += [bump * (eu * eu + euu), bump * (eu * ev + euv), bump * (ev * ev + evv)]
    return bumps


def _dot(a: Array, b: Array) -> Array:
    """Return the dot products of vectors, shape (N,), added in order."""
    product = a * b
    return np.asarray(product[:, 0] + product[:, 1] + product[:, 2])
