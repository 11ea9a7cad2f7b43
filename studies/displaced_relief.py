"""Print what it costs to turn only the normal: `python -m studies.displaced_relief [SEEDS]`.

A patch of a plane or of a cylinder is displaced by its relief along the base's normal, as a fine mesh that Mitsuba
traces, and compared with the same relief applied to the normal of the smooth base.

First table, by the angle between the base's normal and a parallel view: difference of the normals that a ray sees; how
much of the displaced surface faces away from the view, and how much is hidden behind crests; a light in the direction
of the view is blocked from as much. Second table: glints of camera and light together, 20 mm away, at 400 px focal
length: how far displacement moves them in the image, and how far their normals turn.
"""

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np

from simtest.geometry.vectors import angle_deg
from simtest.rendering import backend
from simtest.rendering.built_scene import make_shape
from simtest.rendering.truth import trace_starts
from simtest.runtime.arrays import Array
from simtest.spec.surfaces import Relief, ReliefBand
from simtest.surfaces import RayHits, Shape, TriangleMesh
from simtest.surfaces.relief_field import ReliefField, make_relief, normal_derivative

WAVELENGTH_MM = 1.5
EDGE_MM = WAVELENGTH_MM / 20
HALF_MM = 4.0
"""Half the side of the displaced patch."""

JUDGED_MM = (1.0, 3.0)
"""Half the sides of its middle, which is judged: narrow around the cylinder, where the angle of view varies."""

ANGLES_DEG = (0, 30, 60, 75, 80)
SLOPES_DEG = (3.0, 6.0)
RADII_MM = {"plane": np.inf, "cylinder R = 15 mm": 15.0}
DISTANCE_MM = 20.0
FOCAL_PX = 400.0
GLINT_RADII_MM = {"plane": np.inf, "cylinder kd = 1": 20.0, "cylinder kd = -0.5": -40.0}


@dataclass(frozen=True)
class Patch:
    """A patch over a plane or a cylinder, in coordinates (a, b) on its base: a around the cylinder, b along it.

    `radius`: mm, convex positive; inf for a plane; `field`: its relief.
    """

    radius: float
    field: ReliefField

    def base(self, feet: Array) -> tuple[Array, Array, Array]:
        """Return positions, normals and the tangents along a, shape (N, 3), of base points (a, b), shape (N, 2)."""
        a, b = feet.T
        zero = np.zeros_like(a)
        if np.isinf(self.radius):
            return (
                np.stack([a, b, zero], axis=1),
                np.stack([zero, zero, zero + 1], axis=1),
                np.stack([zero + 1, zero, zero], axis=1),
            )
        sine, cosine = np.sin(a / self.radius), np.cos(a / self.radius)
        position = np.stack([self.radius * sine, b, self.radius * (cosine - 1)], axis=1)
        return position, np.stack([sine, zero, cosine], axis=1), np.stack([cosine, zero, -sine], axis=1)

    def turned(self, feet: Array) -> tuple[Array, Array]:
        """Return base positions and the normals of the relief on them."""
        position, N, _ = self.base(feet)
        return position, normal_derivative(N, np.zeros((len(N), 3, 3)), self.field.jets(position))[0]

    def displaced(self, feet: Array, share: float = 1.0) -> tuple[Array, Array]:
        """Return positions displaced by a share of the height, and the normals of the surface that they make.

        Its tangents are (1 + s h k) t + (t.G) N along a and y + (y.G) N along b; the gradient itself is not shared.
        """
        position, N, t = self.base(feet)
        jets = self.field.jets(position)
        h, along, across = share * jets.value, np.sum(t * jets.gradient, axis=1), jets.gradient[:, 1]
        normal = N - (along / (1 + h / self.radius))[:, None] * t - across[:, None] * np.array([0.0, 1.0, 0.0])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return position + h[:, None] * N, normal

    def mesh(self) -> tuple[TriangleMesh, Array]:
        """Return the displaced mesh and the base coordinates of its vertices, shape (V, 2)."""
        side = np.arange(-HALF_MM, HALF_MM + EDGE_MM / 2, EDGE_MM)
        a, b = np.meshgrid(side, side, indexing="ij")
        feet, n = np.stack([a.ravel(), b.ravel()], axis=1), len(side)
        corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        first = np.stack([corner, corner + n, corner + n + 1], axis=1)
        second = np.stack([corner, corner + n + 1, corner + 1], axis=1)
        vertices, normals = self.displaced(feet)
        return TriangleMesh(vertices, np.concatenate([first, second]), normals), feet


class TracedPatch:
    """A displaced mesh in Mitsuba.

    `mi`: mitsuba with the variant set; `patch`: what is displaced.
    """

    def __init__(self, mi: Any, patch: Patch) -> None:
        self.mi, self.patch = mi, patch
        self.mesh, self.feet = patch.mesh()
        self.shape = Shape("mesh", False, np.eye(4), self.mesh, "displaced")
        made = make_shape(self.shape, {"type": "diffuse"})
        self.scene = mi.load_dict({"type": "scene", "surface": made}, optimize=False)

    def trace(self, origins: Array, direction: Array) -> RayHits:
        """Trace parallel rays."""
        directions = np.broadcast_to(direction, origins.shape)
        return trace_starts(self.scene, origins, directions)

    def judge(self, view_deg: float) -> tuple[Array, float, float]:
        """View the patch's middle under an angle to the base's normal.

        Returns angle between the normals that a ray sees on the displaced patch and on the smooth one, deg.
        Returns shares of the displaced surface that face away, and that face the view behind others.
        """
        theta = np.radians(view_deg)
        view = np.array([np.sin(theta), 0.0, np.cos(theta)])
        sides = (np.linspace(-half, half, 120) for half in JUDGED_MM)
        feet = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
        # Normals at the same ray.
        base, turned = self.patch.turned(feet)
        hits = self.trace(base + 20 * view, -view)
        hit = np.isfinite(hits.distance)
        corners = self.feet[self.mesh.faces[hits.face[hit]]]
        seen = self.patch.displaced(np.einsum("nc,nci->ni", hits.weights[hit], corners))[1]
        difference = angle_deg(seen, turned[hit])
        # Shares of the surface, which is 1 / (n.N) as large as its base.
        position, normal = self.patch.displaced(feet)
        area = 1 / np.sum(normal * self.patch.base(feet)[1], axis=1)
        away = normal @ view <= 0
        blocked = np.isfinite(self.trace(position + 2e-3 * normal, view).distance) & ~away
        return difference, float(area[away].sum() / area.sum()), float(area[blocked].sum() / area.sum())


def glints(patch: Patch, slope_deg: float) -> tuple[Array, Array, Array]:
    """Find the glints of camera and light at 20 mm over the origin.

    Returns how far displacement moves each in the image, and turns its normal. Returns which glints displacement
    removes.
    """
    camera = np.array([0.0, 0.0, DISTANCE_MM])
    # Starts over the whole cloud, d^2 M^-1 Sigma M^-T.
    gain = 1 + DISTANCE_MM / patch.radius
    reach = 3.5 * np.radians(slope_deg) * DISTANCE_MM
    a, b = (np.arange(-r, r, WAVELENGTH_MM / 6) for r in (reach / abs(gain), reach))
    starts = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    found, good = _solve(lambda feet: _miss(patch, feet, 0.0, camera), starts)
    zeros = _distinct(found[good])
    # Follow each zero while the height grows.
    feet, kept = zeros, np.ones(len(zeros), dtype=bool)
    for share in np.linspace(0.1, 1, 10):
        feet, good = _solve(lambda x, share=share: _miss(patch, x, share, camera), feet)
        kept &= good
    kept &= np.linalg.norm(feet - zeros, axis=1) < WAVELENGTH_MM / 4
    sightlines = [_sightline(patch.displaced(x, share)[0], camera) for x, share in ((zeros, 0.0), (feet, 1.0))]
    px = [FOCAL_PX * s[:, :2] / s[:, 2:] for s in sightlines]
    return np.linalg.norm(px[1] - px[0], axis=1)[kept], angle_deg(*sightlines)[kept], ~kept


def _sightline(position: Array, camera: Array) -> Array:
    towards = camera - position
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def _miss(patch: Patch, feet: Array, share: float, camera: Array) -> Array:
    """Return how far the fine normal misses the sightline, along the base's tangents, shape (N, 2)."""
    position, normal = patch.displaced(feet, share)
    off = normal - _sightline(position, camera)
    return np.stack([np.sum(off * patch.base(feet)[2], axis=1), off[:, 1]], axis=1)


def _solve(miss: Any, feet: Array, steps: int = 25) -> tuple[Array, Array]:
    """Solve by Newton's method with bounded steps; return feet and which have converged."""
    e = 1e-6
    for _ in range(steps):
        value = miss(feet)
        J = np.stack([(miss(feet + e * axis) - value) / e for axis in np.eye(2)], axis=2)
        J += 1e-12 * np.eye(2)
        step = np.linalg.solve(J, value[:, :, None])[:, :, 0]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        feet = feet - step * np.minimum(1, WAVELENGTH_MM / 10 / np.maximum(length, 1e-12))
    return feet, np.linalg.norm(miss(feet), axis=1) < 1e-9


def _distinct(feet: Array) -> Array:
    """Return feet that lie apart from one another."""
    kept: list[Array] = []
    for foot in feet:
        if all(np.linalg.norm(foot - other) > 1e-4 for other in kept):
            kept.append(foot)
    return np.array(kept).reshape(-1, 2)


def make_patch(radius: float, slope_deg: float, seed: int) -> Patch:
    """Make a patch with one gaussian band of relief."""
    band = ReliefBand(slope_deg=slope_deg, wavelength_mm=WAVELENGTH_MM)
    return Patch(radius, make_relief(Relief(bands=(band,), seed=seed)))


def main() -> None:
    """Print both tables."""
    seeds = range(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
    mi = backend.load()
    print("| surface | slope, deg | view, deg | normals differ, deg: median (95 %) | faces away, % | hidden, % |")
    print("|---|---|---|---|---|---|")
    for name, radius in RADII_MM.items():
        for slope in SLOPES_DEG:
            patches = [TracedPatch(mi, make_patch(radius, slope, seed)) for seed in seeds]
            for angle in ANGLES_DEG:
                found = [patch.judge(angle) for patch in patches]
                difference = np.concatenate([f[0] for f in found])
                away, hidden = (100 * np.mean([f[i] for f in found]) for i in (1, 2))
                middle, most = np.quantile(difference, [0.5, 0.95])
                print(f"| {name} | {slope:g} | {angle} | {middle:.2f} ({most:.2f}) | {away:.1f} | {hidden:.1f} |")
    print("\n| surface | slope, deg | glints | moved, px: median (95 %) | turned, deg: median (95 %) | lost, % |")
    print("|---|---|---|---|---|---|")
    for name, radius in GLINT_RADII_MM.items():
        for slope in SLOPES_DEG:
            moved, turned, lost = (
                np.concatenate(parts)
                for parts in zip(*(glints(make_patch(radius, slope, seed), slope) for seed in seeds), strict=True)
            )
            cells = [f"{np.median(v):.3f} ({np.quantile(v, 0.95):.3f})" for v in (moved, turned)]
            print(f"| {name} | {slope:g} | {len(lost)} | {cells[0]} | {cells[1]} | {100 * lost.mean():.1f} |")


if __name__ == "__main__":
    main()
