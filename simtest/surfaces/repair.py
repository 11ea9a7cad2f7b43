"""Faults of a user's triangles: repaired if that is safe, else counted."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces.mesh_geometry import edge_uses

SLIVER = 1e-14
"""Area over the squared extent below which rounding decides the direction of a face."""

MAX_CROSSING_FACES = 1_000_000
"""Above this many faces self-intersections are not searched for (about 5 s and 2 GB at the limit)."""


@dataclass(frozen=True)
class Repairs:
    """Counts of what was repaired.

    Parameters
    ----------
    merged_vertices : int
        Vertices at the position of another; the three that each triangle of an STL file has of its own do not count.
    repeated_faces, faces_without_area : int
        Faces left out.
    reversed_faces : int
        Faces turned so that neighbours wind the same way.
    turned_pieces : int
        Whole pieces that were inside out.
    """

    merged_vertices: int = 0
    repeated_faces: int = 0
    faces_without_area: int = 0
    reversed_faces: int = 0
    turned_pieces: int = 0

    def sentences(self, lumen: bool = False) -> Iterator[str]:
        """Yield a sentence for each repair; for a lumen, faces may wind inward or outward."""
        if self.merged_vertices:
            yield f"merged {_many(self.merged_vertices, 'repeated vertex', 'repeated vertices')}"
        if self.faces_without_area:
            yield f"left out {_many(self.faces_without_area, 'face without area', 'faces without area')}"
        if self.repeated_faces:
            yield f"left out {_many(self.repeated_faces, 'repeated face', 'repeated faces')}"
        if self.reversed_faces:
            yield f"reversed {_many(self.reversed_faces, 'face that winds', 'faces that wind')} against the neighbours"
        if self.turned_pieces and not lumen:
            yield f"turned {_many(self.turned_pieces, 'piece that was', 'pieces that were')} inside out"


@dataclass(frozen=True)
class Condition:
    """Faults of the repaired mesh that are left as they are.

    Parameters
    ----------
    pieces : int
        Connected pieces.
    open_edges : int
        Edges of one face; 0 for a watertight mesh.
    non_manifold_edges : int
        Edges of more than two faces.
    crossing_faces : int or None
        Faces that cut through another; None if they were not searched for.
    """

    pieces: int
    open_edges: int
    non_manifold_edges: int
    crossing_faces: int | None

    @property
    def watertight(self) -> bool:
        """Whether each edge belongs to two faces."""
        return self.open_edges == 0 and self.non_manifold_edges == 0

    def to_json(self) -> dict[str, int | bool | None]:
        """Return the fields, and whether the mesh is watertight."""
        return {"watertight": self.watertight, **asdict(self)}


def _many(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"


def repair(vertices: Array, faces: IntArray, soup: bool = False) -> tuple[Array, IntArray, Repairs]:
    """Repair what can be repaired without a guess at the shape.

    `soup` says that by the file's format each face has its own vertices, so that merging them is no repair.

    Returns
    -------
    vertices : ndarray, shape (V', 3)
        mm; each is used, and none repeated.
    faces : ndarray of int, shape (F', 3)
        Winding consistent within each piece, normals outward: positive volume about the piece's centroid.
    repairs : Repairs
    """
    import trimesh  # slow to import

    # vertices
    used = len(np.unique(faces))
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    merged = 0 if soup else used - len(np.unique(mesh.faces))
    before = len(mesh.faces)
    # Faces without area, relative to the extent, and repeated faces
    mesh.update_faces(mesh.area_faces > SLIVER * float(np.ptp(vertices, axis=0).max()) ** 2)
    flat = before - len(mesh.faces)
    before = len(mesh.faces)
    mesh.update_faces(mesh.unique_faces())
    repeated = before - len(mesh.faces)
    mesh.remove_unreferenced_vertices()
    # winding
    points = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
    triangles = np.ascontiguousarray(mesh.faces, dtype=np.int64)
    if not len(triangles):
        return points, triangles, Repairs(merged, repeated, flat)
    triangles, against, turned = _outward(points, triangles)
    return points, triangles, Repairs(merged, repeated, flat, against, turned)


def _outward(vertices: Array, faces: IntArray) -> tuple[IntArray, int, int]:
    """Make the winding consistent within each connected piece, and the normals of each piece point outward.

    Returns the faces, how many of them wound against the majority of their piece, and how many pieces pointed inward.
    """
    import igl

    oriented, piece = igl.bfs_orient(faces)
    piece = np.asarray(piece).ravel()
    count = int(piece.max()) + 1
    corners = vertices[oriented]
    # Volumes about each piece's own centroid, so that an open piece has a meaningful sign.
    size = np.maximum(np.bincount(piece, minlength=count), 1)
    middle = np.stack([np.bincount(piece, c, count) for c in corners.mean(axis=1).T], axis=1) / size[:, None]
    a, b, c = (corners[:, i] - middle[piece] for i in range(3))
    volume = np.bincount(piece, np.einsum("ni,ni->n", a, np.cross(b, c)), count)
    # Pieces of negative volume are inside out.
    outward = np.where((volume[piece] < 0)[:, None], oriented[:, ::-1], oriented)
    # A face and its reverse differ by an odd permutation: compare the corner that follows the smallest.
    inward = np.bincount(piece, _follower(faces) != _follower(outward), count)
    turned = inward > size / 2
    against = np.where(turned, size - inward, inward).sum()
    return np.ascontiguousarray(outward, dtype=np.int64), int(against), int(turned.sum())


def _follower(faces: IntArray) -> IntArray:
    """Return the corner that comes after the smallest one in each face, shape (F,)."""
    after = (np.argmin(faces, axis=1) + 1) % 3
    return faces[np.arange(len(faces)), after]


def examine(vertices: Array, faces: IntArray, crossings: bool = True) -> Condition:
    """Find the faults of a mesh from `repair`; `crossings`, the search for self-intersections, takes longest."""
    import igl
    from igl import predicates

    _, uses = edge_uses(faces)
    # Connected by shared vertices: two pieces that touch in one vertex count as one.
    pieces = int(np.max(igl.vertex_components(faces))) + 1
    crossing = None
    if crossings and len(faces) <= MAX_CROSSING_FACES:
        found, pairs, _ = predicates.find_self_intersections(vertices, faces)
        crossing = len(np.unique(pairs)) if found else 0
    return Condition(pieces, int((uses == 1).sum()), int((uses > 2).sum()), crossing)
