"""What the 3D view of a scene shows, as arrays in the camera frame."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.calibration import Calibration
from simtest.errors import Failure, InputError
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.arrays import Array, IntArray
from simtest.simulation.rendered_view import render_view
from simtest.spec import Scene

GRID = 240
"""Samples of the visible surface along the longer side of the frame."""

OCCLUSION = 1.15
"""Neighbouring samples whose distances differ by a larger factor lie on both sides of an edge."""


@dataclass(frozen=True)
class Content:
    """A scene's 3D view, camera frame, mm.

    Parameters
    ----------
    vertices : ndarray, shape (V, 3)
        Samples of the visible surface.
    faces : ndarray of int, shape (F, 3)
        Triangles between them.
    curvature : ndarray, shape (V,)
        Principal curvature of larger size, 1/mm, convex towards the camera positive.
    frustum : ndarray, shape (4, 3)
        Unit sightlines through the corners of the image, in turn.
    lights : ndarray, shape (L, 3)
        True places.
    places, normals : ndarray, shape (N, 3)
        True isolated highlights and their normals.
    estimator : ndarray of str, shape (E,)
        Name of each estimate's estimator.
    looks, estimates : ndarray, shape (E, 3)
        Point that an estimate looks at, and the proposed normal.
    """

    vertices: Array
    faces: IntArray
    curvature: Array
    frustum: Array
    lights: Array
    places: Array
    normals: Array
    estimator: npt.NDArray[Any]
    looks: Array
    estimates: Array

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

    Parameters
    ----------
    scene : Scene
        The scene.
    variant : str, optional
        Mitsuba variant.

    Returns
    -------
    Content

    Raises
    ------
    InputError
        If the camera sees no surface.
    BackendError
        If the rendering backend cannot be used.
    """
    session = Session(scene, variant)
    seen = render_view(session, scene)
    vertices, faces, curvature = _visible(session)
    camera = session.camera
    corners = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], dtype=float)
    found = [truth for truth in seen.highlights if truth.isolated]
    names, looks, estimates = _estimates(session, seen.frame(scene.sensor.seed), seen.calibration)
    return Content(
        vertices=vertices,
        faces=faces,
        curvature=curvature,
        frustum=np.asarray(camera.unproject(corners)),
        lights=np.asarray(scene.rig.true_mm()),
        places=np.array([h.position for h in found]).reshape(-1, 3),
        normals=np.array([h.normal for h in found]).reshape(-1, 3),
        estimator=np.array(names, dtype=np.str_),
        looks=looks,
        estimates=estimates,
    )


def _visible(session: Session) -> tuple[Array, IntArray, Array]:
    stride = max(1, -(-max(session.camera.width, session.camera.height) // GRID))
    truth = session.truth(stride)
    position, curvature = (np.asarray(part, dtype=float) for part in (truth.position, truth.larger_curvature))
    valid = np.isfinite(position).all(axis=-1)
    number = np.where(valid, np.cumsum(valid).reshape(valid.shape) - 1, -1)
    distance = np.linalg.norm(position, axis=-1)
    corners = [np.s_[:-1, :-1], np.s_[:-1, 1:], np.s_[1:, :-1], np.s_[1:, 1:]]
    a, b, c, d = (number[corner].ravel() for corner in corners)
    depth = np.stack([distance[corner].ravel() for corner in corners])
    with np.errstate(invalid="ignore"):
        whole = (np.stack([a, b, c, d]) >= 0).all(axis=0) & (depth.max(axis=0) < OCCLUSION * depth.min(axis=0))
    faces = np.concatenate([np.stack([a, c, b], axis=1)[whole], np.stack([b, c, d], axis=1)[whole]])
    if not len(faces):
        raise InputError("the camera sees no surface; move it or choose another viewpoint")
    return position[valid], faces, curvature[valid]


def _estimates(
    session: Session, frame: npt.NDArray[np.float32], calibration: Calibration
) -> tuple[list[str], Array, Array]:
    """Give names, points looked at and normals of all estimates that look at the surface."""
    names, pixels, normals = [], [], []
    for specularity in reconstruct(frame, calibration):
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
