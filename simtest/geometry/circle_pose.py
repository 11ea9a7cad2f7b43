"""Circle pose from one conic [F91; MB, section 2.3, step 4] and the axis of the back-projected cone."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from simtest.errors import Failure, Reason

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CirclePose:
    """What a cone of sightlines says about a circle.

    Parameters
    ----------
    normals : ndarray, shape (2, 3)
        N+ and N-, unit, facing the camera; each makes the same angle with the cone's axis.
    axis : ndarray, shape (3,)
        e3, unit, pointing into the scene.
    axis_ratio : float
        sqrt(l2 / l1) = b / a, the smaller over the larger tangent of the cone's half-angles.
    centres : ndarray, shape (2, 3)
        Directions of the circles' centres for N+ and N-, unit, camera frame: C'^-1 N.
    """

    normals: Array
    axis: Array
    axis_ratio: float
    centres: Array


FORWARD = (0.0, 0.0, 1.0)


def cone_axes(cones: npt.ArrayLike, sightline: npt.ArrayLike = FORWARD) -> tuple[Array, Array]:
    """Give eigenvalues and eigenvectors of cones in the order of circle pose: l1 >= l2 > 0 > l3.

    Parameters
    ----------
    cones : array_like, shape (..., 3, 3)
        Symmetric matrices of signature (2, 1) or (1, 2).
    sightline : array_like, shape (3,) or (..., 3)
        Any direction on the side of the cone that is meant; default forward. A fisheye also sees cones whose axis
        points backwards.

    Returns
    -------
    values : ndarray, shape (..., 3)
        l1, l2, l3; the sign of each matrix is chosen so that det C' < 0.
    vectors : ndarray, shape (..., 3, 3)
        Columns e1, e2, e3, right-handed, e3 on the sightline's side (the cone's axis, pointing into the scene).
    """
    C = np.asarray(cones, dtype=float)
    values, vectors = np.linalg.eigh(C)
    # Two eigenvalues share a sign; eigh sorts upwards, so the middle one tells which.
    flipped = values[..., 1] < 0
    values = np.where(flipped[..., None], -values, values[..., ::-1])
    vectors = np.where(flipped[..., None, None], vectors, vectors[..., ::-1])
    side = np.sum(vectors[..., 2] * np.asarray(sightline, dtype=float), axis=-1)
    vectors = np.where(side[..., None, None] < 0, -vectors, vectors)
    hand = np.sign(np.linalg.det(vectors))[..., None]
    vectors = np.concatenate([vectors[..., :1] * hand[..., None], vectors[..., 1:]], axis=-1)
    return values, vectors


def circle_pose(cone: npt.ArrayLike, sightline: npt.ArrayLike = FORWARD) -> CirclePose | Failure:
    """Give the two normals of a circle seen as a conic [MB, section 2.3; F91].

    g = sqrt((l1 - l2)/(l1 - l3)), h = sqrt((l2 - l3)/(l1 - l3)), N+- = -(+-g e1 + h e3). The circle's radius, hence
    its distance, is not observable.

    Parameters
    ----------
    cone : array_like, shape (3, 3)
        C' = K^T C K, any scale and sign.
    sightline : array_like, shape (3,)
        Any direction on the side of the cone that is meant; default forward.

    Returns
    -------
    CirclePose or Failure
        A Failure if C' is not finite or not the cone of an ellipse.
    """
    C = np.asarray(cone, dtype=float)
    if not np.isfinite(C).all():
        return Failure(Reason.NOT_FINITE, "C' holds NaN or infinity")
    (l1, l2, l3), vectors = cone_axes(C, sightline)
    if not (l1 >= l2 > 0 > l3):
        return Failure(Reason.DEGENERATE_CONIC, f"eigenvalues {l1:.3g}, {l2:.3g}, {l3:.3g} are not those of a cone")
    e1, _, e3 = vectors.T
    g, h = np.sqrt((l1 - l2) / (l1 - l3)), np.sqrt((l2 - l3) / (l1 - l3))
    normals = -np.stack([g * e1 + h * e3, -g * e1 + h * e3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # C'^-1 N in the eigenbasis; the centre lies in front of the camera, on the axis' side.
    centres = -np.stack([g / l1 * e1 + h / l3 * e3, -g / l1 * e1 + h / l3 * e3])
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    return CirclePose(normals, e3, float(np.sqrt(l2 / l1)), centres)
