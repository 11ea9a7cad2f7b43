"""Measure what triangulation alone does to a highlight: python -m studies.fineness OUT.png [--quick].

A highlight (Phong, camera and light together) on a patch of known shape is traced on triangles of several edge lengths,
shaded with flat normals, with normals interpolated between exact vertex normals, and between vertex normals estimated
from the triangles; `cone_axis` reads the normal and the axis ratio from the picture without noise. What a much finer
mesh with exact vertex normals gives is the reference, so that only the triangles are left.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import igl
import matplotlib
import numpy as np

from simtest.errors import Failure
from simtest.estimators.cone_axis import cone_axis
from simtest.geometry import Camera, Patch
from simtest.surfaces.colon import build
from simtest.surfaces.mesh_surface import concentration, half_width, vertex_normals
from simtest.surfaces.recipe import ColonRecipe

matplotlib.use("Agg")

Patches = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

DISTANCE_MM = 30.0
EXPONENT = 200.0
PIXELS = 241
HALF_WIDTH_PX = 30.0
RATIOS = (2.0, 1.5, 1.0, 0.7, 0.5, 0.35, 0.25)
"""Edge length over the highlight's half-width."""

REFERENCE_RATIO = 0.03
PLACES = 12
SHADINGS = ("flat", "estimated", "exact")


def graph(height: Callable, slope: Callable) -> Patches:
    """Return a patch z = height(x, y), -grad z = slope(x, y), over its tangent plane."""

    def at(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = xy.T
        normal = np.stack([*slope(x, y), np.ones_like(x)], axis=1)
        return np.stack([x, y, height(x, y)], axis=1), normal / np.linalg.norm(normal, axis=1, keepdims=True)

    return at


def round_patch(radius: float, bent: tuple[float, float]) -> Patches:
    """Return the near side of a sphere, bent (1, 1), or of a cylinder, bent (1, 0)."""
    a, b = bent

    def root(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sqrt(radius**2 - a * x**2 - b * y**2)

    return graph(lambda x, y: root(x, y) - radius, lambda x, y: (a * x / root(x, y), b * y / root(x, y)))


def saddle(k1: float, k2: float) -> Patches:
    """Return the graph z = -(k1 x^2 + k2 y^2)/2."""
    return graph(lambda x, y: -(k1 * x**2 + k2 * y**2) / 2, lambda x, y: (k1 * x, k2 * y))


def colon_patch(u: float, v: float) -> tuple[Patches, np.ndarray]:
    """Return the generated colon around (u, v) in its tangent frame, and its curvatures there."""
    tube = build(ColonRecipe()).tube
    point, along, around = (part[0] for part in tube.tangents(np.array([u]), np.array([v])))
    normal, operator = (part[0] for part in tube.normal_and_shape_operator(np.array([u]), np.array([v])))
    x = along / np.linalg.norm(along)
    frame = np.stack([x, np.cross(normal, x), normal])
    to_parameters = np.linalg.inv(frame[:2] @ np.stack([along, around], axis=1))

    def at(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        du, dv = to_parameters @ xy.T
        places, first, second = tube.tangents(u + du, v + dv)
        normals = np.cross(first, second)
        return (places - point) @ frame.T, normals / np.linalg.norm(normals, axis=1, keepdims=True) @ frame.T

    return at, np.linalg.eigvalsh(frame[:2] @ operator @ frame[:2].T)


def lattice(edge: float, reach: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return an equilateral lattice of the plane, randomly turned and shifted, and its counter-clockwise triangles."""
    count = int(reach / edge * 1.3) + 3
    i, j = (g.ravel() for g in np.meshgrid(*[np.arange(-count, count + 1)] * 2, indexing="ij"))
    shift, turn = rng.random(2), rng.uniform(0, 2 * np.pi)
    points = edge * np.stack([i + shift[0] + (j + shift[1]) / 2, (j + shift[1]) * np.sqrt(3) / 2], axis=1)
    cut = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    side = 2 * count + 1
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + side, corner + 1], axis=1),
            np.stack([corner + side, corner + side + 1, corner + 1], axis=1),
        ]
    )
    keep = np.abs(points[faces] @ cut.T).max(axis=(1, 2)) < reach + 2 * edge
    used, faces = np.unique(faces[keep], return_inverse=True)
    return points[used] @ cut.T, faces.reshape(-1, 3).astype(np.int64)


def look(patch: Patches, edge: float, width: float, rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Return the error of the normal, deg, and the axis ratio for each shading; NaN without an estimate."""
    focal = HALF_WIDTH_PX * DISTANCE_MM / width
    reach = 1.1 * PIXELS / 2 / focal * DISTANCE_MM
    plane, faces = lattice(edge, reach, rng)
    vertices, exact = patch(plane)
    # Pixel centres are at + 0.5; the camera looks down the normal of the patch's middle.
    pixel = (np.arange(PIXELS) + 0.5 - PIXELS / 2) / focal
    x, y = (g.ravel() for g in np.meshgrid(pixel, pixel))
    directions = np.stack([x, -y, -np.ones_like(x)], axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.tile([0.0, 0.0, DISTANCE_MM], (len(x), 1))
    tree = igl.AABB()
    tree.init(vertices, faces)
    face, distance, weights = tree.intersect_ray_first(vertices, faces, origins, directions)
    weights = np.asarray(weights)
    weights = np.column_stack([1 - weights.sum(axis=1), weights]) if weights.shape[1] == 2 else weights
    corners = vertices[faces[face]]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    estimated = vertex_normals(vertices, faces)
    at_vertices = (("estimated", estimated), ("exact", exact))
    normals = {"flat": flat} | {n: np.einsum("nc,nci->ni", weights, of[faces[face]]) for n, of in at_vertices}
    camera = Camera(width=PIXELS, height=PIXELS, fx=focal, fy=focal, cx=PIXELS / 2, cy=PIXELS / 2)
    answers = {}
    for name, normal in normals.items():
        cosine = -np.einsum("ni,ni->n", normal, directions) / np.linalg.norm(normal, axis=1)
        image = np.where(face >= 0, np.maximum(2 * cosine**2 - 1, 0) ** EXPONENT / distance**2, 0.0)
        cut = Patch.cut(image.reshape(PIXELS, PIXELS), (0, 0, PIXELS, PIXELS))
        found = cut if isinstance(cut, Failure) else cone_axis.estimate(cut, camera)
        if isinstance(found, Failure):
            answers[name] = (np.nan, np.nan)
        else:
            answers[name] = (float(np.degrees(np.arccos(min(1.0, -found.normal[2])))), float(found.axis_ratio))
    return answers


def surfaces() -> dict[str, list[tuple[Patches, float]]]:
    """Return the patches of each kind of surface, each with the half-width of the highlight on it, mm."""
    c = concentration(EXPONENT)

    def narrow(*curvatures: float) -> float:
        return float(min(half_width(DISTANCE_MM, c, k) for k in curvatures))

    k = 1 / DISTANCE_MM
    spots = []
    for u, v in np.random.default_rng(3).uniform([15, 0], [100, 2 * np.pi], size=(60, 2)):
        patch, curvatures = colon_patch(u, v)
        stretch = np.abs(1 + DISTANCE_MM * curvatures)
        # What counts as an isolated highlight (docs/concepts/theory.md).
        if stretch.min() > 0.25 and (1 + DISTANCE_MM * curvatures).min() > 0:
            spots.append((patch, narrow(*curvatures)))
    return {
        "sphere, d k = 1": [(round_patch(DISTANCE_MM, (1, 1)), narrow(k, k))],
        "cylinder, d k = 1": [(round_patch(DISTANCE_MM, (1, 0)), narrow(k, 0.0))],
        "saddle, d k = 0.5, -0.4": [(saddle(0.5 * k, -0.4 * k), narrow(0.5 * k, -0.4 * k))],
        "colon, 12 places": spots,
    }


def main() -> None:
    """Print the table and draw the figure."""
    from matplotlib import pyplot as plt

    target, repeats = Path(sys.argv[1]), 2 if "--quick" in sys.argv else 8
    figure, axes = plt.subplots(2, 4, figsize=(13, 6), sharex=True, sharey="row", constrained_layout=True)
    for column, (name, patches) in enumerate(surfaces().items()):
        rows: dict[tuple[str, float], list[tuple[float, float]]] = {}
        used = 0
        for patch, width in patches:
            reference = look(patch, REFERENCE_RATIO * width, width, np.random.default_rng(0))["exact"]
            # No closed isophote on the smooth surface either: no isolated highlight.
            if np.isnan(reference[0]) or used == PLACES:
                continue
            used += 1
            for ratio in RATIOS:
                for repeat in range(repeats if len(patches) == 1 else max(1, repeats // 4)):
                    answers = look(patch, ratio * width, width, np.random.default_rng([1, repeat]))
                    for shading, (error, axis) in answers.items():
                        off = (abs(error - reference[0]), abs(axis / reference[1] - 1))
                        rows.setdefault((shading, ratio), []).append(off)
        for shading in SHADINGS:
            cells = np.array([np.nanquantile(rows[shading, ratio], 0.9, axis=0) for ratio in RATIOS])
            failed = [int(np.isnan(np.array(rows[shading, ratio])[:, 0]).sum()) for ratio in RATIOS]
            for row in (0, 1):
                axes[row, column].loglog(RATIOS, np.maximum(cells[:, row], 1e-6) * (1, 100)[row], "o-", label=shading)
            text = " ".join(f"{a:.4f}/{100 * b:.2f}" for a, b in cells)
            print(f"{name:<22} {shading:<10} {text}  failed {failed}", flush=True)
        axes[0, column].set_title(name)
        axes[1, column].set_xticks(RATIOS, [f"{ratio:g}" for ratio in RATIOS])
        axes[1, column].minorticks_off()
        axes[1, column].set_xlabel("edge / half-width of the highlight")
    axes[0, 0].set_ylabel("error of the normal, deg (90 %)")
    axes[1, 0].set_ylabel("error of the axis ratio, % (90 %)")
    axes[0, 0].legend()
    figure.savefig(target, dpi=90)


if __name__ == "__main__":
    main()
