"""Verdict on a user's mesh: faults, repairs, and whether it is fine enough for highlights."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simtest.conventions import EDGES_PER_HALF_WIDTH
from simtest.runtime.arrays import Array, IntArray
from simtest.surfaces.mesh_file import MAX_CROSSING_FACES, Condition, Repairs, examine, other_unit, read_mesh
from simtest.surfaces.mesh_surface import curvature_and_edge, is_lumen
from simtest.surfaces.poses import nearest_mm
from simtest.surfaces.triangles import area_quantile, edge_lengths, edge_uses, vertex_areas

TUBE_RIMS = 2
"""A mesh with as many wide rims may be a tube that is cut open at both ends; ..."""

WIDE_RIM = 0.5
"""... a rim that extends over this share of the mesh's smallest extent is wide. A hole of a scan is not."""

FINE_SHARE = 0.95
"""A mesh is fine enough if this share of its surface is."""

MAX_CURVATURE_FACES = 2_000_000
"""Above this many faces curvature and fineness are not computed (about 15 s at the limit)."""


@dataclass(frozen=True)
class MeshCheck:
    """Result of `check_mesh`; numbers of vertices, faces and edges are those after the repairs."""

    file: str
    vertices: int
    faces: int
    extents_mm: tuple[float, float, float]  # Along x, y, z
    lumen: bool  # Whether the camera belongs inside
    repairs: Repairs
    condition: Condition
    edge_median_mm: float
    edge_p95_mm: float
    distance_mm: float  # Of the highlights in question, as the next
    concentration: float
    # Quantiles of the larger absolute principal curvature, by area; None if the mesh is too large, as the next two
    curvature_median_per_mm: float | None
    curvature_p95_per_mm: float | None
    needed_edge_mm: float | None  # With which all but 5 % of the surface is fine enough
    fine_share: float | None  # Share of the surface that is fine enough as it is
    other_unit: str  # Guess at another unit than mm, or empty
    rims: int = 0  # Wide rows of open edges
    guessed: bool = False  # Whether the side is a guess by the shape

    @property
    def fine(self) -> bool:
        """Whether the mesh is fine enough as it is."""
        return self.fine_share is not None and self.fine_share >= FINE_SHARE

    @property
    def side(self) -> str:
        """What the mesh is taken for, and where the camera is."""
        return "a lumen, camera inside" if self.lumen else "an organ, camera outside"

    @property
    def doubt(self) -> str:
        """Why what its shape makes an organ may be a tube, cut open at two rims or more; empty where not."""
        if self.lumen or not self.guessed or self.rims < TUBE_RIMS:
            return ""
        return f"open at {self.rims} rims, as a tube is: if it is seen from inside, its kind is lumen"

    @property
    def problems(self) -> list[str]:
        """Faults that are not repaired, worst first."""
        condition, problems = self.condition, []
        if condition.crossing_faces:
            problems.append(f"{condition.crossing_faces} faces cut through others: normals around them mean nothing")
        if condition.non_manifold_edges:
            problems.append(f"{condition.non_manifold_edges} edges belong to more than two faces: cannot be refined")
        if self.other_unit:
            problems.append(f"lengths are taken as mm; by its extent the file may be in {self.other_unit}")
        return problems

    @property
    def usable(self) -> bool:
        """Whether the mesh is fine enough and has no fault that would spoil the truth."""
        return self.fine and not self.problems

    def to_json(self) -> dict[str, Any]:
        """Return all numbers as JSON holds them."""
        return {
            **asdict(self),
            "condition": self.condition.to_json(),
            "fine": self.fine,
            "problems": self.problems,
            "usable": self.usable,
        }

    def lines(self) -> Iterator[str]:
        """Yield the verdict in words, with numbers."""
        return (f"{label:<12}{text}" for label, text in self._rows())

    def _rows(self) -> Iterator[tuple[str, str]]:
        condition, size = self.condition, " x ".join(f"{extent:.4g}" for extent in self.extents_mm)
        yield "file", self.file
        yield "size", f"{self.vertices} vertices, {self.faces} faces, {size} mm"
        yield "taken for", self.side
        if self.doubt:
            yield "doubt", self.doubt
        yield "pieces", f"{condition.pieces}"
        if condition.watertight:
            yield "surface", "watertight"
        elif condition.open_edges:
            yield "surface", f"open: {condition.open_edges} edges at its rims"
        if condition.crossing_faces is None:
            yield "crossings", f"not looked for above {MAX_CROSSING_FACES} faces"
        elif not condition.crossing_faces:
            yield "crossings", "none"
        yield from (("repaired", sentence) for sentence in self.repairs.sentences(self.lumen))
        yield "normals", "computed from the triangles; those of a file are not used"
        yield "edges", f"median {self.edge_median_mm:.3g} mm, 95th percentile {self.edge_p95_mm:.3g} mm"
        yield from (("problem", problem) for problem in self.problems)
        if self.needed_edge_mm is None or self.fine_share is None:
            yield "highlights", f"not looked at above {MAX_CURVATURE_FACES} faces: decimate the mesh"
            return
        median, p95 = self.curvature_median_per_mm, self.curvature_p95_per_mm
        yield "curvature", f"median {median:.3g}, 95th percentile {p95:.3g} 1/mm"
        lobe = f"of n = {self.concentration / 4:.3g} at {self.distance_mm:g} mm"
        per_width = f"{EDGES_PER_HALF_WIDTH:g} edges in a half-width"
        yield "highlights", f"{lobe}: {100 * self.fine_share:.1f} % of the surface has {per_width}"
        if self.fine:
            yield "verdict", "fine enough" + ("; but see the problems above" if self.problems else "")
        else:
            yield "verdict", f"too coarse: edges of {self.needed_edge_mm:.2g} mm are needed (surface.edge_mm)"


def check_mesh(path: str | Path, distance_mm: float | None, concentration: float, kind: str = "auto") -> MeshCheck:
    """Judge a mesh file for highlights of a lobe of c = `concentration`, seen from a distance, mm.

    With no distance it is that of the nearest viewpoints on the camera's side, which `kind` ("auto", "lumen", "organ")
    tells. Raises `InputError` if the file is missing or no usable mesh.
    """
    # size, unit and side, after the repairs
    vertices, faces, repairs = read_mesh(path)
    lumen = is_lumen(vertices, faces, kind)
    distance_mm = nearest_mm(lumen) if distance_mm is None else distance_mm
    lengths, extents = edge_lengths(vertices, faces), np.ptp(vertices, axis=0)
    # Curvature, and the edges that highlights need because of it
    median = p95 = needed = share = None
    if len(faces) <= MAX_CURVATURE_FACES:
        larger, wanted = curvature_and_edge(vertices, faces, lumen, distance_mm, concentration)
        needed = area_quantile(wanted, vertices, faces, 1 - FINE_SHARE)
        share = _fine_share(wanted, vertices, faces)
        median, p95 = (area_quantile(larger, vertices, faces, level) for level in (0.5, 0.95))
    return MeshCheck(
        file=str(path),
        vertices=len(vertices),
        faces=len(faces),
        extents_mm=(float(extents[0]), float(extents[1]), float(extents[2])),
        lumen=lumen,
        repairs=repairs,
        condition=examine(vertices, faces),
        edge_median_mm=float(np.median(lengths)),
        edge_p95_mm=float(np.quantile(lengths, 0.95)),
        distance_mm=distance_mm,
        concentration=concentration,
        curvature_median_per_mm=median,
        curvature_p95_per_mm=p95,
        needed_edge_mm=needed,
        fine_share=share,
        other_unit=other_unit(float(extents.max())),
        rims=_wide_rims(vertices, faces),
        guessed=kind == "auto",
    )


def _wide_rims(vertices: Array, faces: IntArray) -> int:
    """Count the connected rows of open edges that are wide beside the mesh."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, uses = edge_uses(faces)
    if not (uses == 1).any():
        return 0
    start, end = edges[uses == 1].T
    on_rim, joined = np.unique([start, end], return_inverse=True)
    first, second = joined.reshape(2, -1)
    links = coo_array((np.ones(len(first)), (first, second)), shape=(len(on_rim), len(on_rim)))
    count, rim = connected_components(links, directed=False)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, rim, vertices[on_rim])
    np.maximum.at(high, rim, vertices[on_rim])
    return int(((high - low).max(axis=1) > WIDE_RIM * np.ptp(vertices, axis=0).min()).sum())


def _fine_share(wanted: Array, vertices: Array, faces: IntArray) -> float:
    """Return the share of the area whose edges are at most as long as wanted there; `wanted` at the vertices."""
    # Mean length of the edges at each vertex
    edges, length = edge_uses(faces)[0], edge_lengths(vertices, faces)
    count = np.bincount(edges.ravel(), minlength=len(vertices))
    mean = np.bincount(edges.ravel(), np.repeat(length, 2), len(vertices)) / count
    weight = vertex_areas(vertices, faces)
    # Unknown curvature, NaN, counts as too coarse.
    return float(weight[mean <= wanted].sum() / weight.sum())
