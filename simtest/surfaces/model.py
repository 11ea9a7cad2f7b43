"""What every surface offers: its pose relative to the camera, exact points on rays, and a shape to render."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from simtest.geometry.vectors import projector, tangent_basis
from simtest.runtime.arrays import Array, IntArray, Mask

if TYPE_CHECKING:
    from simtest.surfaces.recipe import Polyp
    from simtest.surfaces.relief_field import ReliefField
    from simtest.surfaces.tube import TubeChart


CACHES: list[Any] = []
"""Of the functions that remember their results."""

Function = TypeVar("Function", bound=Callable[..., Any])


def remembered(function: Function) -> Function:
    """Make a function keep its last four results, until `forget_meshes`."""
    cached: Any = lru_cache(maxsize=4)(function)
    CACHES.append(cached)
    return cached


@dataclass(frozen=True)
class RayHits:
    """Hits of rays on the rendered shape, by a ray tracer: the start for the exact solution.

    Parameters
    ----------
    distance : ndarray, shape (N,)
        Distance along each unit ray, mm; inf where the ray misses.
    face : ndarray of int, shape (N,)
        Triangle that was hit (0 for shapes that are no meshes).
    barycentric : ndarray, shape (N, 2)
        Weights of the triangle's second and third corners.
    """

    distance: Array
    face: IntArray
    barycentric: Array

    @property
    def weights(self) -> Array:
        """Weights of all three corners, shape (N, 3)."""
        second, third = self.barycentric.T
        return np.stack([1 - second - third, second, third], axis=1)

    def rows(self, chosen: IntArray | slice) -> "RayHits":
        """Return the hits of some of the rays."""
        return RayHits(self.distance[chosen], self.face[chosen], self.barycentric[chosen])


def in_rows(count: int, chosen: IntArray, *arrays: Array) -> list[Array]:
    """Return arrays of so many rows, NaN but in those chosen, from what is there."""
    whole = [np.full((count, *values.shape[1:]), np.nan) for values in arrays]
    for values, some in zip(whole, arrays, strict=True):
        values[chosen] = some
    return whole


@dataclass(frozen=True)
class SurfacePoints:
    """Exact points of a surface, in the frame of the rays that found them.

    Normal and curvatures are those of the fine surface where there is a relief; those of the base stand beside them,
    equal without a relief. Positions are on the base.

    Parameters
    ----------
    distance : ndarray, shape (N,)
        Distance along the ray, mm; NaN if there is no point.
    position, normal : ndarray, shape (N, 3)
        Point, mm, and unit normal; that of the base faces the ray's origin.
    k_min, k_max : ndarray, shape (N,)
        Principal curvatures, 1/mm, convex towards the ray's origin positive.
    direction_min, direction_max : ndarray, shape (N, 3)
        Unit principal directions.
    normal_base : ndarray, shape (N, 3)
        Unit normal of the base.
    k_min_base, k_max_base : ndarray, shape (N,)
        Principal curvatures of the base, 1/mm.
    pool : ndarray of bool, shape (N,)
        Whether the point lies in a pool of the liquid film.
    valid : ndarray of bool, shape (N,)
        False if the ray misses or no solution was found; all other fields are NaN there (`pool` is False).
    """

    distance: Array
    position: Array
    normal: Array
    k_min: Array
    k_max: Array
    direction_min: Array
    direction_max: Array
    normal_base: Array
    k_min_base: Array
    k_max_base: Array
    pool: Mask
    valid: Mask


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh in the model frame; equal to itself alone.

    Parameters
    ----------
    vertices : ndarray, shape (V, 3)
        mm.
    faces : ndarray of int, shape (F, 3)
        Counter-clockwise seen from the side of the normals.
    normals : ndarray, shape (V, 3)
        Unit vertex normals of the smooth surface, on the side of the camera.
    """

    vertices: Array
    faces: IntArray
    normals: Array


@dataclass(frozen=True)
class Shape:
    """Shape that the renderer builds.

    Parameters
    ----------
    kind : {"plane", "sphere", "cylinder", "mesh"}
        Mitsuba's analytic shape, or a mesh.
    flip : bool
        Whether the analytic shape is seen from inside.
    to_model : ndarray, shape (4, 4)
        From an analytic unit shape to the model frame; a mesh is in that frame.
    mesh : TriangleMesh, optional
        For kind "mesh".
    key : str
        Identity of what the renderer builds; two shapes with equal keys differ in `to_model` alone, and in vertices
        and normals where the surface deforms.
    """

    kind: str
    flip: bool
    to_model: Array
    mesh: TriangleMesh | None
    key: str


class SurfaceModel(ABC):
    """A surface in its own model frame, with the camera's pose.

    Attributes
    ----------
    model_from_camera : ndarray, shape (4, 4)
        Rigid transform from the camera frame to the model frame, mm.
    solid : bool
        Whether the far side is matter, in which no light can be; a shell (a lumen, a sphere seen from inside) has
        free space beyond its wall.
    faceted : bool
        Whether the mesh is itself the surface, whose normals change within its triangles (see `motion`).
    relief : ReliefField or None
        Its fine relief; `points` are those of the base without it (see `fine_points`).
    polyps : sequence of Polyp
        Those of a generated colon.
    """

    model_from_camera: Array
    solid: bool = True
    faceted: bool = False
    relief: "ReliefField | None" = None
    polyps: "Sequence[Polyp]" = ()

    @property
    def at_rest(self) -> "SurfaceModel":
        """The surface before any deformation: itself, unless it is deformed."""
        return self

    @abstractmethod
    def shape(self) -> Shape:
        """Return the shape that the renderer builds, in the model frame."""

    @property
    def chart(self) -> "TubeChart | None":
        """What a kernel needs to solve the base's exact points as `points` does; None where it cannot."""
        return None

    def polyp_at(self, hits: RayHits) -> npt.NDArray[np.uint8]:
        """Return 1 + the number of the polyp that is hit, shape (N,), 0 where none is."""
        return np.zeros(len(hits.distance), dtype=np.uint8)

    @abstractmethod
    def clearance(self, points: Array) -> Array:
        """Return the signed distance of points, shape (N, 3), model frame, to the surface, mm; positive in free space.

        The sign is exact; the magnitude may be of first order.
        """

    def free_mm(self, point: Array) -> float:
        """Return the radius of a ball around a free point, shape (3,), that meets no wall, mm; 0: not known."""
        return 0.0

    def vertex_shape_operators(self) -> Array | None:
        """Return S at the rendered mesh's vertices for its normals, 1/mm, shape (V, 3, 3); None without a mesh."""
        return None

    def fine_points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the points of `points`, with normals and curvatures of the fine surface where there is a relief."""
        points = self.points(origins, directions, hits)
        return points if self.relief is None else self.relief.apply(points)

    def distances(self, origins: Array, directions: Array, hits: RayHits) -> Array:
        """Return how far along rays the base surface lies, shape (N,), mm: `points` without normals and curvatures.

        NaN where a ray has no point.
        """
        return self.points(origins, directions, hits).distance

    def motion(self, points: SurfacePoints, hits: RayHits) -> tuple[Array, Array]:
        """Return how points of the base and their normals move between neighbouring rays.

        Parameters
        ----------
        points : SurfacePoints
            Of `points`, in the model frame.
        hits : RayHits
            What they were computed from.

        Returns
        -------
        plane : ndarray, shape (N, 3)
            Normals, of any length, of the planes on which the points move.
        derivative : ndarray, shape (N, 3, 3)
            Change of the unit normal along these planes, 1/mm: S, except for a mesh that is itself the surface.
        """
        return points.normal_base, shape_operator(points)

    @abstractmethod
    def points(self, origins: Array, directions: Array, hits: RayHits) -> SurfacePoints:
        """Return the exact points where rays meet the base surface, in the model frame.

        Parameters
        ----------
        origins, directions : ndarray, shape (N, 3)
            Rays in the model frame, mm; unit directions.
        hits : RayHits
            Their hits on the rendered shape. Closed forms use the misses only.
        """


def pack_points(
    origins: Array, directions: Array, distance: Array, normal: Array, shape_operator: Array
) -> SurfacePoints:
    """Make `SurfacePoints` from distances, normals and shape operators, turned to face the rays' origins.

    Distances are in mm, NaN or inf if there is no point; normals, shape (N, 3), are unit and of either sign; S, shape
    (N, 3, 3), has dN = S dP for the given sign of N, is symmetric, and S N = 0. Its eigenvalues in the tangent plane
    are k_min and k_max (theory.md section 0).
    """
    # Facing the origin; S changes its sign with the normal.
    sign = np.where(np.einsum("ij,ij->i", normal, directions) > 0, -1.0, 1.0)
    normal = normal * sign[:, None]
    S = shape_operator * sign[:, None, None]
    tangents = tangent_basis(normal)
    tangent, other = tangents
    a = np.einsum("ni,nij,nj->n", tangent, S, tangent)
    b = np.einsum("ni,nij,nj->n", tangent, S, other)
    c = np.einsum("ni,nij,nj->n", other, S, other)
    mean, half, direction_min, direction_max = principal(a, b, c, tangents)
    valid = np.isfinite(distance) & np.isfinite(normal).all(axis=1) & np.isfinite(mean)

    # Whatever is not finite in one field is NaN in all.
    def only_valid(values: Array) -> Array:
        return np.where(valid.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)

    position = origins + np.where(valid, distance, np.nan)[:, None] * directions
    normal, k_min, k_max = only_valid(normal), only_valid(mean - half), only_valid(mean + half)
    return SurfacePoints(
        distance=only_valid(distance),
        position=position,
        normal=normal,
        k_min=k_min,
        k_max=k_max,
        direction_min=only_valid(direction_min),
        direction_max=only_valid(direction_max),
        normal_base=normal,
        k_min_base=k_min,
        k_max_base=k_max,
        pool=np.zeros(len(valid), dtype=bool),
        valid=valid,
    )


def principal(a: Array, b: Array, c: Array, tangents: tuple[Array, Array]) -> tuple[Array, Array, Array, Array]:
    """Return mean and half difference of the eigenvalues of (a b; b c) in a tangent basis, and their directions."""
    mean, half = (a + c) / 2, np.hypot((a - c) / 2, b)
    angle = 0.5 * np.arctan2(b, (a - c) / 2)  # direction of the larger eigenvalue
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return mean, half, cosine * tangents[1] - sine * tangents[0], cosine * tangents[0] + sine * tangents[1]


def shape_operator(points: SurfacePoints) -> Array:
    """Return S, shape (N, 3, 3), of the principal curvatures and directions of points."""
    first, second = points.direction_min, points.direction_max
    return outer(points.k_min[:, None] * first, first) + outer(points.k_max[:, None] * second, second)


def outer(a: Array, b: Array) -> Array:
    """Return the outer products of vectors, both of shape (N, 3), shape (N, 3, 3)."""
    return np.asarray(a[:, :, None] * b[:, None, :])


def principal_curvatures(shape_operator: Array) -> tuple[Array, Array]:
    """Return k_min and k_max, 1/mm, two arrays of shape (N,), of shape operators, shape (N, 3, 3); NaN stays NaN.

    With the trace t and the Frobenius norm f, the two curvatures in the tangent plane are (t +- sqrt(2 f^2 - t^2))/2.
    """
    mean = np.trace(shape_operator, axis1=1, axis2=2) / 2
    square = np.einsum("nij,nij->n", shape_operator, shape_operator) / 2
    half = np.sqrt(np.maximum(square - mean**2, 0.0))
    return mean - half, mean + half


def implicit_shape_operator(gradient: Array, hessian: Array) -> tuple[Array, Array]:
    """Return normal, shape (N, 3), and shape operator, shape (N, 3, 3), of a level set from gradient and Hessian.

    N = g/|g|, dN = (I - N N^T) H dP / |g|, restricted to the tangent plane; the inputs have the same shapes.
    """
    length = np.linalg.norm(gradient, axis=1)
    normal = gradient / length[:, None]
    across = projector(normal)
    return normal, across @ hessian @ across / length[:, None, None]
