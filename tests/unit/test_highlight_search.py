"""The search for the places where the normal bisects the directions to light and camera."""

from types import SimpleNamespace

import numpy as np

from simtest.rendering import highlights


class Facing:
    """A plane across the optical axis, lit from the camera: the misfit is linear in the pixel and 0 at the centre."""

    def cast(self, points_px):
        x, y = (np.asarray(points_px) - 50.0).T
        position = np.stack([x, y, np.full_like(x, 400.0)], axis=1)
        normal = np.tile([0.0, 0.0, -1.0], (len(position), 1))
        return SimpleNamespace(position=position, normal=normal), None, None


def test_a_seed_may_be_the_place_itself():
    found = highlights._newton(Facing(), np.array([[50.0, 50.0], [52.0, 49.0]]), np.zeros(3))
    np.testing.assert_allclose(found, 50.0, atol=1e-6)
