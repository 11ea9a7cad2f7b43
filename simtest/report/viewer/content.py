"""Content of the 3D view of a scene, as arrays in the camera frame."""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from simtest.errors import Failure, InputError
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.report.view3d import grid_triangles
from simtest.runtime.arrays import AnyArray, Array, IntArray
from simtest.simulation.rendered_view import RenderedView, render_view
from simtest.spec import Scene

GRID = 240
"""Samples of the visible surface along the longer side of the frame."""

OCCLUSION = 1.15
"""Neighbouring samples whose distances differ by a larger factor lie on both sides of an edge."""


@dataclass(frozen=True)
class Content:
    """A scene's 3D view, camera frame, mm."""

    vertices: Array  # samples of the visible surface, shape (V, 3)
    faces: IntArray  # triangles between them, shape (F, 3)
    curvature: Array  # principal curvature of larger size, 1/mm, convex towards the camera positive, shape (V,)
    frustum: Array  # unit sightlines through the corners of the image, in turn, shape (4, 3)
    lights: Array  # true positions, shape (L, 3)
    highlights: Array  # true isolated ones, shape (N, 3)
    normals: Array  # at these
    estimator: AnyArray  # name of each estimate's estimator, shape (E,)
    looks: Array  # point that each estimate looks at, shape (E, 3)
    estimates: Array  # proposed normals

    def save(self, path: Path) -> None:
        """Write the arrays to a NumPy archive."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "Content":
        """Read what `save` wrote."""
        with np.load(path) as archive:
            return cls(**{field.name: archive[field.name] for field in fields(cls)})


def make_content(scene: Scene, variant: str | None = None) -> Content:
    """Render a scene, reconstruct the normals at its highlights, and gather what is shown.

    Raises `InputError` if the camera sees no surface, `BackendError` if the rendering backend cannot be used.
    """
    session = Session(scene, variant)
    seen = render_view(session, scene)
    vertices, faces, curvature = _visible(session)
    camera = session.camera
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=float)
    found = [truth for truth in seen.highlights if truth.isolated]
    names, looks, estimates = _estimates(session, seen)
    return Content(
        vertices=vertices,
        faces=faces,
        curvature=curvature,
        frustum=np.asarray(camera.unproject(corners)),
        lights=np.asarray(scene.rig.true_mm()),
        highlights=np.array([h.position for h in found]).reshape(-1, 3),
        normals=np.array([h.normal for h in found]).reshape(-1, 3),
        estimator=np.array(names, dtype=np.str_),
        looks=looks,
        estimates=estimates,
    )


def _visible(session: Session) -> tuple[Array, IntArray, Array]:
    stride = max(1, -(-max(session.camera.width, session.camera.height) // GRID))
    truth = session.truth(stride)
    position, curvature = (np.asarray(part, dtype=float) for part in (truth.position, truth.larger_curvature))
    faces, valid = grid_triangles(position, OCCLUSION), np.isfinite(position).all(axis=-1)
    if not len(faces):
        raise InputError("the camera sees no surface; move it or choose another viewpoint")
    return position[valid], faces, curvature[valid]


def _estimates(session: Session, seen: RenderedView) -> tuple[list[str], Array, Array]:
    """Return names, points looked at and normals of all estimates that look at the surface."""
    names, pixels, normals = [], [], []
    for specularity in reconstruct(seen.frame(seen.scene.sensor.seed), seen.calibration):
        for name, estimate in specularity.estimates.items():
            if not isinstance(estimate, Failure):
                names.append(name)
                pixels.append(estimate.look_px)
                normals.append(estimate.normal)
    if not names:
        return [], np.empty((0, 3)), np.empty((0, 3))
    points = session.cast(np.array(pixels))[0].position
    hit = np.asarray(np.isfinite(points).all(axis=1))
    return [name for name, kept in zip(names, hit, strict=True) if kept], points[hit], np.array(normals)[hit]
