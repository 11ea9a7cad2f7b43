"""The bisector: a falloff's shift of the peak is undone once; the budget says which lights nobody can tell."""

from dataclasses import replace

import numpy as np
import pytest

from simtest.calibration import Calibration, Priors, exactly
from simtest.estimators.bisector import ALONE, bisector, light_of_highlight
from simtest.estimators.highlight import fit_highlight
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg, bisect
from simtest.reconstruction.pipeline import reconstruct
from tests.unit.core_helpers import PATCH

# One light, on a plane lit from aside, written out --------------------------------------------------------------------


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


# Several lights: who chooses, and what the budget says ----------------------------------------------------------------


WIDE = Camera(640, 480, 320.0, 320.0, 320.0, 240.0)
LIGHTS = ((4.0, 0.0, 0.0), (-4.0, 0.0, 0.0))
PRIORS = Priors(LIGHTS, exactly(20.0), falloff_power=None)


def among(offsets):
    """Return the highlight at the image's centre, with others at offsets from its peak, px."""
    return replace(PATCH, others_px=tuple((x, y) for x, y in PATCH.peak_px + np.reshape(offsets, (-1, 2))))


@pytest.mark.parametrize(
    ("others", "light"),
    [
        ([(-60, 0)], 0),
        ([(60, 0)], 1),
        ([(-60, 0), (0, 200)], 0),
        ([(-60, 0), (0, 150)], None),
        ([(0, 60)], None),
        ([], None),
    ],
    ids=["its light on the right", "on the left", "far from a third", "one of many", "across the line", "no other"],
)
def test_a_pair_tells_two_lights_only_where_it_stands_alone(others, light):
    patch = among(others)
    assert light_of_highlight(fit_highlight(patch, WIDE, (0.3, 0.5, 0.7)), PRIORS) == light
    found = bisector.estimate(patch, WIDE, PRIORS)
    assert ("ambiguous_light" in found.flags) == (light is None)
    assert ("light_offset" in found.budget) == (light is None)
    assert len(found.candidates) == (1 if light is not None else 3)


def test_neighbours_on_rough_tissue_seldom_choose_one_of_two_lights(monkeypatch):
    # Highlights strewn at random tell nothing of the lights, so half of what they choose is wrong.
    fields = 500 * np.random.default_rng(7).random((400, 30, 2)) - 250
    fitted = fit_highlight(PATCH, WIDE, (0.5,))

    def chosen():
        families = [replace(fitted, patch=among(offsets)) for offsets in fields]
        return np.mean([light_of_highlight(family, PRIORS) is not None for family in families])

    # A sixth of the neighbours lies along the lights' line; a ninth of those stands alone. Bound: 3 deviations above.
    assert chosen() < 1 / 6 / ALONE**2 + 3 * np.sqrt(1 / 6 / ALONE**2 / len(fields))
    # Negative control: the same fields choose where nothing stands alone.
    monkeypatch.setattr("simtest.estimators.bisector.ALONE", 1.0)
    assert chosen() > 0.11


def test_neighbours_on_rough_tissue_hardly_ever_choose_one_of_three_lights(monkeypatch):
    three = replace(PRIORS, lights_mm=((4.0, 0.0, 0.0), (-2.0, 3.5, 0.0), (-2.0, -3.5, 0.0)))
    fields = 500 * np.random.default_rng(8).random((600, 30, 2)) - 250
    fitted = fit_highlight(PATCH, WIDE, (0.5,))

    def chosen():
        families = [replace(fitted, patch=among(offsets)) for offsets in fields]
        return sum(light_of_highlight(family, three) is not None for family in families)

    assert chosen() <= 4
    # Their arrangement alone, as of a smooth surface: the first light's highlight, with the others 36 px to the left.
    group = [(-36, 21), (-36, -21)]
    for others, light in ((group, 0), ([*group, (0, 250)], 0), ([*group, (0, 100)], None)):
        assert light_of_highlight(replace(fitted, patch=among(others)), three) == light
    # Negative control.
    monkeypatch.setattr("simtest.estimators.bisector.ALONE", 1.0)
    assert chosen() >= 9


@pytest.mark.filterwarnings("error")
def test_lights_at_one_place_are_one_light():
    patch, one = among([(-60, 0)]), Priors(LIGHTS[:1], exactly(20.0), falloff_power=None)
    alone, twice = (
        bisector.estimate(patch, WIDE, replace(one, lights_mm=lights)) for lights in (LIGHTS[:1], LIGHTS[:1] * 2)
    )
    np.testing.assert_array_equal(twice.candidates, alone.candidates)
    assert twice.flags == alone.flags
    assert twice.budget.keys() == alone.budget.keys()
    # Beside another one they are two that nothing tells apart.
    both = bisector.estimate(patch, WIDE, replace(one, lights_mm=LIGHTS[:1] + LIGHTS))
    assert "ambiguous_light" in both.flags
