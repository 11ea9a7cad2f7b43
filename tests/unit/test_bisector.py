"""The bisector on a plane lit from aside, written out: the falloff's shift of the peak is undone once."""

import numpy as np
import pytest

from simtest.calibration import Calibration, Priors, exactly
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg, bisect
from simtest.reconstruction.pipeline import reconstruct

CAMERA = Camera(240, 240, 300.0, 300.0, 120.0, 120.0)
DISTANCE = 20.0


def picture(normal, light, exponent):
    """Return Phong's lobe over the squared distance of a light, on the plane through the axis at the distance."""
    rays = CAMERA.unproject(CAMERA.pixel_centres())
    points = DISTANCE * normal[2] / (rays @ normal)[..., None] * rays
    to_light = light - points
    length = np.linalg.norm(to_light, axis=-1)
    mirrored = 2 * (to_light @ normal)[..., None] * normal - to_light
    cosine = np.maximum(-np.sum(mirrored * rays, axis=-1) / length, 0)
    values = cosine**exponent / length**2
    return (values / values.max()).astype(np.float32), points


@pytest.mark.parametrize("light", [(6.0, 0.0, 0.0), (-3.0, 5.0, 2.0)])
@pytest.mark.parametrize("exponent", [80.0, 200.0])
def test_the_normal_of_a_plane_is_found(light, exponent):
    normal = np.array([0.1, -0.05, -1.0])
    normal /= np.linalg.norm(normal)
    frame, points = picture(normal, np.array(light), exponent)
    row, column = np.unravel_index(frame.argmax(), frame.shape)
    at_peak = float(np.linalg.norm(points[row, column]))
    priors = Priors(lights_mm=(light,), distance_mm=exactly(at_peak), falloff_power=None)
    (found,) = reconstruct(frame, Calibration(CAMERA, priors=priors), ["bisector"])
    error = float(angle_deg(found.estimates["bisector"].normal, normal))
    assert error < 0.02
    # Negative control: at the brightest pixel the bisector is farther off, so that a shift left out would show.
    assert float(angle_deg(bisect(points[row, column], np.array(light)), normal)) > 0.05
