"""Light that walls send to each other, by radiosity: against traced paths, and where it falls."""

import cv2
import numpy as np
import pytest

from simtest.errors import InputError
from simtest.rendering import Session
from simtest.spec import load_scene

COLON = {
    "camera.width": 96, "camera.height": 72, "camera.fx": 48.0, "camera.fy": 48.0, "surface.recipe.closed": True,
    "reflectance": {"type": "phong", "specular": 0.0, "albedo": {"preset": "colon_mucosa"}},
}  # fmt: skip


def rendered(**more):
    session = Session(load_scene("tissue_colon", {**COLON, **more}))
    return session.frame()


@pytest.mark.slow
@pytest.mark.parametrize("viewpoint", [3, 4, 11])
def test_light_from_wall_to_wall_is_about_that_of_traced_paths(viewpoint):
    view = {"surface.viewpoint": viewpoint}
    traced = rendered(**view, **{"render.path_depth": 8, "render.samples_per_pixel": 32})
    plain, lit = (rendered(**view, **{"render.samples_per_pixel": 4, "render.ambient": on}) for on in (False, True))
    found, expected = lit.radiance.diffuse - plain.radiance.diffuse, traced.radiance.indirect
    assert found.mean() / expected.mean() == pytest.approx(0.93, abs=0.06)
    # The noise of paths smoothed away
    off = cv2.GaussianBlur(found - expected, (0, 0), 2.0)
    depth = lit.labels.depth
    for part, share in ((depth <= 45, 0.06), (depth > 45, 0.3)):
        whole = (traced.radiance.indirect + traced.radiance.diffuse)[part]
        assert not part.any() or np.sqrt(np.mean(off[part] ** 2)) < share * whole.mean()
    # Without it the far walls lack a third of their light and more.
    far = depth > 45
    assert not far.any() or expected[far].mean() > 0.3 * (expected + traced.radiance.diffuse)[far].mean()


def test_it_adds_to_the_diffuse_base_alone_and_reaches_shadows():
    """Also on a relief, with translucency and an instrument, and seen by several samples a pixel."""
    shaft = [{"kind": "shaft", "tip": [0.6, 0.5], "diameter_mm": 5.0, "depth_share": 0.6}]
    film = {"index": 1.35, "alpha": 0.03, "level": -0.8}
    tissue = {
        "reflectance": {"type": "tissue", "albedo": {"preset": "colon_mucosa"}, "translucency": {}, "film": film},
        "instruments": shaft,
        "render.samples_per_pixel": 4,
    }
    plain, lit = (rendered(**tissue, **{"render.ambient": on}) for on in (False, True))
    np.testing.assert_array_equal(lit.radiance.specular, plain.radiance.specular)
    assert not lit.radiance.indirect.any()
    added = lit.radiance.diffuse - plain.radiance.diffuse
    metal = lit.labels.instrument > 0
    assert metal.any()
    assert not added[metal].any()
    assert (added[~metal] > 0).all()
    assert added[..., 0].mean() > 2 * added[..., 1].mean()
    dark = (plain.radiance.diffuse.sum(axis=2) < 1e-2 * plain.radiance.diffuse.sum(axis=2).mean()) & ~metal
    assert lit.radiance.diffuse.sum(axis=2)[dark].min(initial=1.0) > 0


def test_a_plane_sends_itself_nothing():
    plane = load_scene("plane", {"camera.width": 48, "camera.height": 36, "reflectance.diffuse": 0.5})
    plain = Session(plane).radiance().diffuse
    lit = Session(plane.model_copy(update={"render": plane.render.model_copy(update={"ambient": True})})).radiance()
    np.testing.assert_allclose(lit.diffuse, plain, rtol=1e-4)


def test_traced_paths_beside_it_are_refused():
    with pytest.raises(InputError, match="path_depth = 3"):
        load_scene("plane", {"render.ambient": True, "render.path_depth": 3})


def test_it_is_the_same_in_several_launches(monkeypatch):
    whole = rendered(**{"render.ambient": True}).radiance.diffuse
    monkeypatch.setattr("simtest.rendering.trace.LANES", 96 * 20)
    np.testing.assert_allclose(rendered(**{"render.ambient": True}).radiance.diffuse, whole, rtol=1e-5)


@pytest.mark.parametrize(("width", "height"), [(40, 2), (1, 1)])
def test_the_smallest_pictures_have_it_too(width, height):
    size = {"camera.width": width, "camera.height": height, "camera.fx": 20.0, "camera.fy": 20.0}
    plain, lit = (rendered(**size, **{"render.ambient": on}).radiance.diffuse for on in (False, True))
    assert (lit > plain).all()
