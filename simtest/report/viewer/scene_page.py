"""What the 3D view of a scene shows: surface, highlights and normals of one frame, and the page that holds it."""

from pathlib import Path

import numpy as np

from simtest.calibration.photometry import srgb_encode
from simtest.errors import Failure, InputError
from simtest.pages.charts import packed
from simtest.pages.html import environment
from simtest.pages.style import colours, estimator_order
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.report.scene3d import CAMERA, TRUE, TRUE_BASE, Content, estimators, framed, grid_triangles
from simtest.runtime.arrays import Array, IntArray, Mask
from simtest.runtime.files import write_atomically
from simtest.simulation.frame import RenderedView, coloured, expose_for_eye, matt_light, render_view
from simtest.simulation.highlights import TrueHighlight
from simtest.spec import Scene

GRID = 240  # samples of the visible surface along the longer side of the frame
PAGE_GRID = 110  # the same of a page, which holds the samples as text
FINE_GRID = 1000  # the same where relief or vessels are to be seen: they are as fine as a pixel
BRIGHTEST = 0.9  # share of full scale that the brightest colours of tissue are shown with
OCCLUSION = 1.15  # factor between the distances of neighbouring samples beyond which there is an edge
SHORTER = 0.11  # share of its length by which each estimator's line is shorter than that of the one before


def make_content(scene: Scene, variant: str | None = None, grid: int | None = None) -> Content:
    """Render a scene, reconstruct the normals at its highlights, and gather what is shown.

    The surface is sampled `grid` times along the longer side of the frame, by default as finely as it has to be seen.
    Raises `InputError` if the camera sees no surface, `BackendError` if the rendering backend cannot be used.
    """
    session = Session(scene, variant)
    seen = render_view(session, scene)
    vertices, faces, curvature, normal, colour, lit = _visible(session, seen, grid)
    distance = np.linalg.norm(vertices, axis=1)
    near, reach = 0.5 * float(np.quantile(distance, 0.05)), 0.35 * float(np.median(distance))

    # The camera's frustum: to the corners of the image, and around it.
    camera = session.camera
    size = np.array([camera.width, camera.height], dtype=float)
    sightlines = np.asarray(camera.unproject(size * [[0, 0], [1, 0], [1, 1], [0, 1]]))
    corners = near * sightlines / sightlines[:, 2:3]
    segments = [(CAMERA, start, end) for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    segments += [(CAMERA, np.zeros(3), corner) for corner in corners]

    # True normals are the longest, and each estimator's are shorter than the one's before, so that all show.
    segments += [(TRUE, h.position, h.position + 1.3 * reach * h.normal) for h in _true(seen)]
    if seen.is_rough:
        segments += [(TRUE_BASE, h.position, h.position + 1.3 * reach * h.normal) for h in seen.clouds]
    estimates = _estimates(session, seen)
    length = {name: reach * (1 - SHORTER * i) for i, name in enumerate(estimator_order(n for n, _, _ in estimates))}
    segments += [(name, look, look + length[name] * normal) for name, look, normal in estimates]
    names, starts, ends = zip(*segments, strict=True)
    lights = np.asarray(scene.rig.true_mm())
    shown = (vertices, faces, curvature, normal, colour, lit)
    return Content(*shown, lights, np.array(names), np.array(starts), np.array(ends))


def _true(seen: RenderedView) -> list[TrueHighlight]:
    """Return the true highlights whose normals are shown: isolated ones, on a relief those that are alone in a spot."""
    if not seen.is_rough:
        return [truth for truth in seen.highlights if truth.isolated]
    return [seen.highlights[spot.glints[0]] for spot in seen.visible_highlights if len(spot.glints) == 1]


def _visible(
    session: Session, seen: RenderedView, grid: int | None
) -> tuple[Array, IntArray, Array, Array, Array, Array]:
    """Sample the visible surface; return vertices, faces, curvature, normals, colours and light (see `Content`)."""
    relief, tissue = session.surface.relief is not None, session.scene.albedo
    grid = grid or (FINE_GRID if relief or tissue else GRID)
    stride = max(1, -(-max(session.camera.width, session.camera.height) // grid))
    truth = session.truth(stride)
    position = np.asarray(truth.position, dtype=float)
    # Curvature is the base's: that of the relief would be noise.
    k_min, k_max = truth.k_min_base, truth.k_max_base
    curvature = np.asarray(np.where(np.abs(k_max) >= np.abs(k_min), k_max, k_min), dtype=float)
    faces, valid = grid_triangles(position, OCCLUSION), np.isfinite(position).all(axis=-1)
    if not len(faces):
        raise InputError("the camera sees no surface; move it or choose another viewpoint")
    normal = np.asarray(truth.normal, dtype=float)[valid] if relief else np.empty((0, 3))
    colour = np.empty((0, 3))
    if tissue is not None:
        from simtest.surfaces.tissue_pattern import make_pattern

        albedo = make_pattern(session.surface, tissue).albedo(session.to_model(position[valid]))
        colour = srgb_encode(np.clip(BRIGHTEST * albedo / np.quantile(albedo.max(axis=1), 0.99), 0, 1))
    lit = _lit(session, seen, position[valid], np.asarray(truth.normal_base, dtype=float)[valid])
    return position[valid], faces, curvature[valid], normal, colour, lit


def _lit(session: Session, seen: RenderedView, points: Array, normals: Array) -> Array:
    """Return the surface's light at points, as an eye sees it (`expose`), sRGB from 0 to 1, shape (V, 3)."""
    height, width = seen.radiance.specular.shape[:2]
    column, row = np.floor(session.camera.project(points)).astype(int).T
    at = np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)
    specular, own = seen.radiance.specular, seen.radiance.diffuse + seen.radiance.indirect
    matt = matt_light(points, normals, np.asarray(seen.scene.rig.true_mm(), dtype=float))
    seen_light = expose_for_eye(coloured(specular)[at], coloured(own)[at], matt, np.ones(len(points), dtype=bool))
    return srgb_encode(np.clip(np.asarray(seen_light, float), 0, 1))


def _estimates(session: Session, seen: RenderedView) -> list[tuple[str, Array, Array]]:
    """Return name, point looked at and normal of all estimates that look at the surface."""
    found = [
        (name, estimate)
        for specularity in reconstruct(seen.frame(seen.scene.sensor.seed), seen.calibration)
        for name, estimate in specularity.estimates.items()
        if not isinstance(estimate, Failure)
    ]
    if not found:
        return []
    points = session.exact_points(np.array([estimate.look_px for _, estimate in found])).position
    hits = zip(found, points, strict=True)
    return [(name, point, estimate.normal) for (name, estimate), point in hits if np.isfinite(point).all()]


def check_page(path: Path) -> None:
    """Raise `InputError` where it is plain, before anything is rendered, that there can be no page."""
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"--page {path}: suffix {path.suffix!r}; must be .html")


def write_scene_page(content: Content, path: Path, title: str) -> None:
    """Write the page of a scene; raises `InputError` if the file cannot be written."""
    check_page(path)
    frame, parts = framed(content, "lit")
    html = environment().get_template("scene.html.j2").render(
        title=title, errors=errors_deg(content), frame=packed(frame), parts=parts, colours=colours(estimators(content)),
        highlights=int((content.names == TRUE).sum()), rough=bool((content.names == TRUE_BASE).any()),
        compared=compared_with(content),
    )  # fmt: skip
    write_atomically(path, lambda part: part.write_text(html, encoding="utf-8"))


def errors_deg(content: Content) -> dict[str, list[float]]:
    """Return the angles of each estimator's normals to the nearest true one, deg; none where nothing is true.

    True normals are those of the fine surface, or else those of the base (`compared_with`).
    """
    is_true = content.names == compared_with(content)
    if not is_true.any():
        return {name: [] for name in estimators(content)}
    made: dict[str, list[float]] = {}
    for name in estimators(content):
        own = content.names == name
        starts = content.starts[own]
        nearest = np.linalg.norm(starts[:, None] - content.starts[is_true][None], axis=2).argmin(axis=1)
        cosine = (_directions(content, own) * _directions(content, is_true)[nearest]).sum(axis=1)
        made[name] = np.degrees(np.arccos(np.clip(cosine, -1, 1))).tolist()
    return made


def compared_with(content: Content) -> str:
    """Return the name of the true normals that the estimates are compared with."""
    return TRUE if (content.names == TRUE).any() else TRUE_BASE


def _directions(content: Content, own: Mask) -> Array:
    along = content.ends[own] - content.starts[own]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))
