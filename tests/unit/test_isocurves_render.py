"""Mitsuba's isophotes of a Phong plane lie on the isocurves of [MB], to 0.05 px."""

import numpy as np
import pytest
from skimage.measure import find_contours

from simtest.rendering import Session
from simtest.spec import scene_from_dict
from simtest.validation.paper import isocurves
from tests import isocurve_formulas as formulas

pytestmark = pytest.mark.render

EXPONENT = 20.0


def contours_on_plane(light, isovalue, tilt):
    """Return isophote points of the specular term on the plane, and V and L in the plane's frame, all in mm."""
    session = Session(
        scene_from_dict(
            {
                "surface": {"type": "plane", "distance_mm": 10.0, "tilt_deg": tilt},
                "reflectance": {"type": "phong", "exponent": EXPONENT},
                "rig": {"lights": [{"position_mm": light}]},
            }
        )
    )
    place = np.array(light)
    # The article's isophote is that of the specular term: the falloff with the light's distance is divided out.
    distance2 = np.sum((session.truth().position - place) ** 2, axis=-1)
    term = session.radiance().total * distance2
    contour = max(find_contours(term, isovalue), key=len)[:, ::-1] + 0.5
    model_from_camera = session.surface.model_from_camera
    rays = session.camera.unproject(contour) @ model_from_camera[:3, :3].T
    V = model_from_camera[:3, 3]
    points = V - rays * (V[2] / rays[:, 2])[:, None]
    return session, points[:, :2], V, session.to_model(place[None])[0], contour


def test_colocated_isophote_is_the_inner_circle():
    isovalue = 0.4
    session, points, V, _, contour = contours_on_plane([0.0, 0.0, 0.0], isovalue, tilt=10.0)
    k = formulas.kappa(formulas.cosine_of_isovalue(isovalue, EXPONENT))
    inner, _ = isocurves.isocurve_radii(k, V[2])
    angle = np.arctan2(*(points - V[:2]).T[::-1])
    circle = V[:2] + inner * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    seen = session.camera.project(from_plane(session, circle))
    assert len(contour) > 200
    assert np.hypot(*(seen - contour).T).max() < 0.05


def test_isophote_of_a_distant_light_lies_on_the_quartic():
    isovalue = 0.5
    session, points, V, L, contour = contours_on_plane([6.0, -2.0, 1.0], isovalue, tilt=20.0)
    tau = formulas.cosine_of_isovalue(isovalue, EXPONENT)
    assert isocurves.on_isophote_branch(points, L, V).all()

    # Distance to the quartic in px: its value over its gradient along the image's axes.
    def value(pixels):
        rays = session.camera.unproject(pixels) @ session.surface.model_from_camera[:3, :3].T
        plane = V - rays * (V[2] / rays[:, 2])[:, None]
        return isocurves.specular_isocurve(plane[:, :2], L, V, tau)

    step = 1e-3
    gradient = [(value(contour + d) - value(contour - d)) / (2 * step) for d in ([step, 0], [0, step])]
    distance = np.abs(value(contour)) / np.hypot(*gradient)
    assert len(contour) > 100
    assert distance.max() < 0.05


def from_plane(session, points):
    camera_from_model = np.linalg.inv(session.surface.model_from_camera)
    model = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    return model @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]
