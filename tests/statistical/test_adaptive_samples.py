"""Frames that take samples only where the picture is not smooth: no more error than samples everywhere, and no bias."""

import numpy as np
import pytest

from simtest.rendering import Session, adaptive
from simtest.spec import scene_from_dict
from simtest.surfaces import Shape, TriangleMesh
from simtest.surfaces.analytic import Quadric

pytestmark = [pytest.mark.render, pytest.mark.slow]

CAMERA = {"width": 96, "height": 72, "fx": 80.0, "fy": 78.0, "skew": 0.5}
ASIDE = {"position_mm": [3.0, -2.0, 1.0], "power": 3.0}
GLOSSY = {"type": "phong", "exponent": 200.0, "diffuse": 0.4}
SAMPLES, MANY, SEEDS = 16, 1024, 6
TILE = 6

T_LIMIT = 5.9
"""Student's t of 5 degrees of freedom, one-sided, alpha = 0.001 for each part and region of each scene."""

Z_LIMIT = 4.0
"""Two-sided, alpha = 6e-5."""

ROUNDING = 2e-6
"""Single precision's share of a mean."""


def scene(surface, lights=(ASIDE,), reflectance=None, camera=None, **render):
    tables = {"surface": surface, "camera": {**CAMERA, **(camera or {})}, "rig": {"lights": list(lights)}}
    return scene_from_dict(tables | {"reflectance": reflectance or GLOSSY, "render": render})


SPOT = {**ASIDE, "direction": [-0.2, 0.1, 1.0], "spot_deg": 40.0}
TABLE = {"type": "table", "angle_deg": [0.0, 5.0, 15.0, 40.0], "value": [1.0, 0.7, 0.3, 0.0]}
LENS = {"distortion": {"type": "brown_conrady", "k1": -0.15, "k2": 0.03}}
COLON = {"type": "anatomy", "path": "colon", "viewpoint": 3}
LIVER = {"type": "anatomy", "path": "liver", "viewpoint": 2}

SCENES = {
    "plane": ({"type": "plane", "tilt_deg": 20.0}, {}),
    "plane, spot": ({"type": "plane", "tilt_deg": 20.0}, {"lights": [SPOT]}),
    "plane, table": ({"type": "plane"}, {"lights": [{**ASIDE, "profile": TABLE}]}),
    "plane, three lights": ({"type": "plane"}, {"lights": [{}, ASIDE, {"offset_mm": 2.0, "colour": [1, 0.5, 0.2]}]}),
    "plane, narrow lobe": ({"type": "plane"}, {"reflectance": {**GLOSSY, "exponent": 1e5}}),
    "plane, rough conductor": ({"type": "plane"}, {"reflectance": {"type": "rough_conductor", "diffuse": 0.3}}),
    "light near the plane": ({"type": "plane"}, {"lights": [{"position_mm": [1.05, 0.6, 9.9]}]}),
    "sphere": ({"type": "sphere", "radius_mm": 3.0}, {}),
    "small sphere": ({"type": "sphere", "radius_mm": 0.12}, {}),
    "cylinder": ({"type": "cylinder", "radius_mm": 3.0, "spin_deg": 25.0}, {}),
    "thin cylinder": ({"type": "cylinder", "radius_mm": 0.03}, {"lights": [{}]}),
    "cylinder inside": ({"type": "cylinder", "radius_mm": 11.0, "side": "inside"}, {}),
    "saddle": ({"type": "quadric", "k1_per_mm": 0.1, "k2_per_mm": -0.06, "tilt_deg": 15.0}, {}),
    "colon": (COLON, {}),
    "colon, light at the camera, narrow lobe": (COLON, {"lights": [{}], "reflectance": {**GLOSSY, "exponent": 2000.0}}),
    "liver": (LIVER, {}),
    "liver, lens": (LIVER, {"camera": LENS}),
    "colon, view mask": (COLON, {"camera": {"view_mask": {"cx": 48.0, "cy": 36.0, "radius": 30.0}}}),
}


def frames(session, described, adaptive, samples, seed):
    surface, more = described
    session.update(scene(surface, **more, samples_per_pixel=samples, seed=seed, adaptive=adaptive))
    radiance = session.radiance()
    return [part.reshape(*part.shape[:2], -1).mean(axis=2).astype(float) for part in
            (radiance.specular, radiance.diffuse)]  # fmt: skip


def tiles(values, region):
    """Means over the tiles of a map that lie in a region; NaN elsewhere."""
    height, width = values.shape
    masked = np.where(region, values, np.nan).reshape(height // TILE, TILE, width // TILE, TILE)
    whole = np.isfinite(masked).all(axis=(1, 3))
    return masked.mean(axis=(1, 3))[whole]


def rms(values, region):
    return np.sqrt(np.mean(np.square(values[region])))


def judged(session, described):
    """Worst t of the error against those of samples alone, and worst z of the bias, over parts and regions.

    Where all pixels are sampled the former is Student's: another seed's error among those of `SEEDS`.
    """
    references = frames(session, described, False, MANY, 12345)
    sampled = [frames(session, described, False, SAMPLES, 1 + seed) for seed in range(SEEDS)]
    adaptive = frames(session, described, True, SAMPLES, 0)
    ts, zs = [], []
    for part, reference in enumerate(references):
        if not reference.any():
            continue
        new = adaptive[part] - reference
        for region in (np.ones_like(reference, dtype=bool), references[0] > 0.05 * references[0].max()):
            means = tiles(new, region)
            if len(means) < 8:
                continue
            rounding = ROUNDING * reference[region].mean()
            old = [rms(one[part] - reference, region) for one in sampled]
            spread = np.std(old, ddof=1) * np.sqrt(1 + 1 / SEEDS) + rounding
            ts.append((rms(new, region) - np.mean(old)) / spread)
            zs.append(max(abs(means.mean()) - rounding, 0) / (means.std(ddof=1) / np.sqrt(len(means)) + 1e-300))
    return max(ts), max(zs)


@pytest.mark.parametrize("name", SCENES)
def test_the_error_is_no_larger_than_that_of_samples_everywhere(name):
    surface, more = SCENES[name]
    t, z = judged(Session(scene(surface, **more)), SCENES[name])
    assert t < T_LIMIT
    assert z < Z_LIMIT


@pytest.mark.parametrize("name", ["plane, spot", "sphere"])
def test_centres_alone_err_more(name, monkeypatch):
    """Negative control: without the choice, edges show in the error."""
    monkeypatch.setattr(adaptive, "choose", lambda parts, *_: np.zeros(parts[0].shape, dtype=bool))
    monkeypatch.setattr(adaptive.MeshEdges, "marks", lambda self, camera, *_: np.zeros((72, 96), dtype=bool))
    surface, more = SCENES[name]
    t, _ = judged(Session(scene(surface, **more)), SCENES[name])
    assert t > T_LIMIT


def test_centres_without_their_curvature_are_biased(monkeypatch):
    """Negative control."""
    monkeypatch.setattr(adaptive, "mean_of_pixel", lambda centres: centres.copy())
    described = {"type": "plane"}, {"lights": [{}], "reflectance": {**GLOSSY, "exponent": 2000.0}}
    _, z = judged(Session(scene(described[0], **described[1])), described)
    assert z > Z_LIMIT


# What hides between centres ------------------------------------------------------------------------------------------


def grid(count, reach, depth):
    """A plane of triangles across the view, camera frame."""
    side = np.linspace(-reach, reach, count)
    x, y = np.meshgrid(side, side)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)
    corner = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + count, corner + count + 1
    return vertices, np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])


def wire(column_px, width_px, depth):
    """A flat strip along a border between columns of pixels, and facing the camera."""
    x = (column_px - CAMERA["width"] / 2) / CAMERA["fx"] * depth
    half = width_px / 2 / CAMERA["fx"] * depth
    vertices = np.array([[x - half, -3, depth], [x + half, -3, depth], [x - half, 3, depth], [x + half, 3, depth]])
    return vertices, np.array([[0, 2, 1], [1, 2, 3]])


def mesh_of(*pieces):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    faces = np.concatenate([faces + start for (_, faces), start in zip(pieces, starts[:-1], strict=True)])
    return vertices, faces


@pytest.fixture
def wired(monkeypatch):
    """A plane before which hangs a wire thinner than a pixel, where no ray through a centre meets it."""
    vertices, faces = mesh_of(grid(9, 14.0, 10.0), wire(48.0, 0.3, 7.0))

    def shape(self):
        pose = self.model_from_camera
        normals = np.tile(-pose[:3, 2], (len(vertices), 1))
        mesh = TriangleMesh(vertices @ pose[:3, :3].T + pose[:3, 3], faces, normals)
        return Shape("mesh", False, np.eye(4), mesh, "wired")

    monkeypatch.setattr(Quadric, "shape", shape)
    return {"type": "quadric", "k1_per_mm": 0.0, "k2_per_mm": 0.0}, {"camera": {"skew": 0.0}}


def test_a_wire_thinner_than_a_pixel_and_its_shadow_are_seen(wired):
    t, z = judged(Session(scene(wired[0], **wired[1])), wired)
    assert t < T_LIMIT
    assert z < Z_LIMIT


def test_without_the_meshs_edges_the_wire_is_missed(wired, monkeypatch):
    """Negative control."""
    monkeypatch.setattr(adaptive.MeshEdges, "marks", lambda self, camera, *_: np.zeros((72, 96), dtype=bool))
    t, _ = judged(Session(scene(wired[0], **wired[1])), wired)
    assert t > T_LIMIT
