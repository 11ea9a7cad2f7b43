"""The 3D view's data: the visible surface of one gallery item with true and estimated normals."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.conventions import PIXEL_CENTRE
from simtest.pages.style import Array
from simtest.report.gallery import anchor, estimated_normals, grey
from simtest.report.run_folder import GalleryItem, Run

_GRID = 72
_NORMALS = 9


@dataclass(frozen=True)
class Segments:
    """Line segments of one kind: `start` and `end` have shape (n, 3), mm, camera frame."""

    name: str
    estimator: str | None
    start: Array
    end: Array


@dataclass(frozen=True)
class Surface3D:
    """A triangle mesh in the camera frame with a grey value per vertex, and normals as segments.

    `curvature`, where the run kept it, is the principal curvature of larger size at the vertices; `lights` are places,
    shape (L, 3).
    """

    title: str
    vertices: Array
    triangles: npt.NDArray[np.int64]
    intensity: Array
    segments: tuple[Segments, ...]
    unit: str
    curvature: Array | None
    lights: Array

    @property
    def curvature_limit(self) -> float:
        """Curvature at which the colours end: a few sharp edges must not take them all."""
        assert self.curvature is not None
        finite = np.abs(self.curvature[np.isfinite(self.curvature)])
        return max(float(np.quantile(finite, 0.97)), 1e-4) if finite.size else 1.0


def surface_3d(run: Run) -> Surface3D | None:
    """Choose the gallery item with the most curved highlight that circle pose answered, and make its 3D view.

    Parameters
    ----------
    run : Run
        A run directory.

    Returns
    -------
    Surface3D or None
        None where no item has a surface.
    """
    usable = [item for item in run.gallery if np.isfinite(item.position).all(axis=-1).sum() >= 16]
    if not usable:
        return None
    return _build(max(usable, key=_interest))


def _interest(item: GalleryItem) -> tuple[int, float]:
    answered = {e.get("estimator") for e in item.estimates if e.get("status") == "ok"}
    sizes = [abs(float(t[k])) for t in item.truth for k in ("kd_min", "kd_max") if t.get(k) is not None]
    return len(answered), min(max(sizes, default=0.0), 2.0)


def _build(item: GalleryItem) -> Surface3D | None:
    rows, columns = item.position.shape[:2]
    step = max(1, -(-max(rows, columns) // _GRID))
    position = item.position[::step, ::step].astype(float)
    normal = item.normal[::step, ::step].astype(float)
    valid = np.isfinite(position).all(axis=-1)
    kept = item.pictures.get("curvature")
    curvature = None if kept is None else kept[::step, ::step].astype(float)[valid]
    index = np.cumsum(valid.ravel()).reshape(valid.shape) - 1
    triangles = _triangles(position, valid, index)
    if not len(triangles):
        return None
    vertices = position[valid]
    reach = 0.12 * float(np.median(np.linalg.norm(vertices, axis=1)))
    name, setting = item.meta.get("label") or item.meta.get("surface") or item.name, item.meta.get("setting", "")
    return Surface3D(
        setting if setting.startswith(name) else f"{name}: {setting}",
        vertices, triangles, _intensity(item, position.shape[:2], step)[valid],
        (_sparse(position, normal, valid, reach), *_highlights(item, 2.5 * reach)), item.length_unit, curvature,
        np.asarray(item.meta.get("lights") or [], dtype=float).reshape(-1, 3),
    )  # fmt: skip


def _triangles(position: Array, valid: npt.NDArray[np.bool_], index: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Join neighbouring samples, but not across occlusions, where the distance jumps."""
    distance = np.linalg.norm(position, axis=-1)
    corners = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    a, b, c, d = (np.where(valid, index, -1)[corner].ravel() for corner in corners)
    depth = np.stack([distance[corner].ravel() for corner in corners])
    with np.errstate(invalid="ignore"):
        whole = np.all(np.stack([a, b, c, d]) >= 0, axis=0) & (depth.max(axis=0) < 1.25 * depth.min(axis=0))
    return np.concatenate([np.stack([a, c, b], axis=1)[whole], np.stack([b, c, d], axis=1)[whole]])


def _intensity(item: GalleryItem, shape: tuple[int, int], step: int) -> Array:
    frame = grey(item.frame)
    rows, columns = item.position.shape[:2]
    y = ((np.arange(shape[0]) * step + PIXEL_CENTRE) / rows * frame.shape[0]).astype(int)
    x = ((np.arange(shape[1]) * step + PIXEL_CENTRE) / columns * frame.shape[1]).astype(int)
    return np.clip(frame[np.ix_(y, x)], 0, 1).astype(float)


def _sparse(position: Array, normal: Array, valid: npt.NDArray[np.bool_], reach: float) -> Segments:
    rows, columns = (np.linspace(0, n - 1, min(n, _NORMALS + 2)).round().astype(int)[1:-1] for n in position.shape[:2])
    kept = np.zeros_like(valid)
    kept[np.ix_(rows, columns)] = True
    kept &= valid & np.isfinite(normal).all(axis=-1)
    start = position[kept]
    return Segments("true normals", None, start, start + reach * normal[kept])


def _highlights(item: GalleryItem, reach: float) -> list[Segments]:
    """Collect the normals at the highlights: the true ones, then each estimator's with all its candidates."""
    groups: dict[str | None, list[tuple[Array, Array]]] = {None: []}
    for truth in item.truth:
        if truth.get("position") is not None and truth.get("normal") is not None:
            groups[None].append((np.asarray(truth["position"], float), np.asarray(truth["normal"], float)))
    sightlines = [point for point, _ in groups[None]]
    for estimate in item.estimates:
        point = anchor(item, estimate)
        for normal in estimated_normals(estimate) if point is not None else ():
            groups.setdefault(str(estimate.get("estimator")), []).append((np.asarray(point), normal))
    segments = []
    for name, pairs in groups.items():
        if pairs:
            start = np.array([point for point, _ in pairs])
            # The true normal is longer, so that it shows where an estimate lies on top of it.
            end = start + reach * (1.0 if name else 1.4) * np.array([normal for _, normal in pairs])
            segments.append(Segments(name or "true normal at the highlight", name, start, end))
    if sightlines:
        ends = np.array(sightlines)
        segments.append(Segments("sightline from the camera", None, np.zeros_like(ends), ends))
    return segments
