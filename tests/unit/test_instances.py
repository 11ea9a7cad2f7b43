"""Pixels of isolated highlights in datasets: above half of their lobe's peak, in light that nothing has smoothed."""

import numpy as np
import pytest
from scipy import ndimage

from simtest.dataset.fields import BY_NAME
from simtest.dataset.maker import Maker
from simtest.dataset.plan import Plan
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.spec import scene_from_dict
from simtest.spec.recipes import Dataset

pytestmark = pytest.mark.render

ONE = {"samples": 1, "highlights": 0, "splits": {"train": 1.0, "validation": 0.0, "test": 0.0}, "estimators": []}

CAMERA = {"camera": {"width": 120, "height": 90, "fx": 80.0, "fy": 80.0}}


def made(scene="plane", **values):
    family = {"scene": scene, "set": {"camera.width": 120, "camera.height": 90, "sensor.noise_sigma": 0.0, **values}}
    maker = Maker(Plan(Dataset.model_validate({"name": "one", **ONE, "families": [family]})))
    _, view, _ = maker.view(0)
    sample = maker.make(0)
    return view, sample.images["instance"], sample.meta["highlights"]


def test_the_mask_is_the_lobe_above_half_of_its_peak():
    """A wide point spread and a bright base are in the frame, and not in the label."""
    view, instance, highlights = made(**{
        "camera.fx": 150.0, "camera.fy": 150.0, "reflectance.exponent": 300.0, "reflectance.diffuse": 0.5,
        "sensor.point_spread_px": 3.0,
    })  # fmt: skip
    [(number, found)] = [(i, own) for i, own in enumerate(highlights) if own["isolated"]]
    lobe = view.radiance.specular.mean(axis=2)
    pieces, _ = ndimage.label(lobe >= lobe.max() / 2)
    expected = pieces == pieces[np.unravel_index(lobe.argmax(), lobe.shape)]
    assert np.count_nonzero(expected) > 50
    # The brightest pixel lies within half a pixel of the peak.
    assert np.count_nonzero((instance == number + 1) != expected) <= 2
    assert found["region"]["instance_px"] == np.count_nonzero(instance)
    assert found["region"]["lobe_peak"] == pytest.approx(lobe.max() / view.full_scale, rel=0.01)


SMALL = {"surface.radius_mm": 2.0, "camera.fx": 50.0, "camera.fy": 50.0, "reflectance.exponent": 2000.0}


def test_a_highlight_below_a_pixel_has_no_mask_and_says_why():
    _, instance, highlights = made("sphere", **SMALL, **{"render.samples_per_pixel": 16})
    [found] = [own for own in highlights if own["isolated"]]
    assert found["radius_px"] < 0.3
    assert not instance.any()
    assert found["region"]["instance_px"] is None
    assert found["region"]["no_instance"] == "no pixel reaches half height"


def test_the_lobe_at_a_point_is_what_a_ray_through_it_sees():
    """The published lobe is 1 at its peak, and falls with the squared distance alone."""
    maker = Maker(Plan(Dataset.model_validate({"name": "one", **ONE, "families": [{"scene": "sphere", "set": SMALL}]})))
    _, view, session = maker.view(0)
    [point] = view.highlights
    assert session.lobe_at([point])[0] == pytest.approx(1 / point.distance**2, rel=1e-4)
    assert session.lobe_at([]).shape == (0,)


def test_numbers_beyond_255_are_kept():
    field, numbers = BY_NAME["instance"], np.arange(600, dtype=np.int32).reshape(20, 30)
    assert np.array_equal(field.codec.decode(field.codec.encode(numbers), {}), numbers)


def test_labels_do_not_hold_the_renderers_noise():
    """Bounces at one sample a pixel are noise: labels and full scale are those of direct light, whatever the seed."""
    tube = {"surface": {"type": "cylinder", "radius_mm": 15.0, "side": "inside", "distance_mm": 12.0}, **CAMERA}
    tube |= {"reflectance": {"type": "phong", "exponent": 60.0, "diffuse": 0.8}}
    tube |= {"rig": {"lights": [{"position_mm": [3.0, 0.0, 0.0]}, {"position_mm": [-3.0, 1.0, 0.0]}]}}
    found = []
    for seed in range(4):
        scene = scene_from_dict(tube | {"render": {"path_depth": 6, "samples_per_pixel": 1, "seed": seed}})
        view = render_view(Session(scene), scene)
        assert view.radiance.indirect.max() > 0
        spots = [spot.to_json() for spot in view.visible_highlights]
        found.append((view.full_scale, spots, [own.to_json() for own in view.highlights], view.spots.regions.tolist()))
    assert len(found[0][1]) > 0
    assert found[1:] == found[:1] * 3
