"""Labelled frames and frames of several samples: against the exact truth and closed forms."""

import numpy as np
import pytest
from surface_helpers import angle

from simtest.rendering import Session
from simtest.rendering.rays import TILE, untile
from simtest.spec import scene_from_dict
from tests.marked import marked

pytestmark = pytest.mark.render

CAMERA = {"width": 90, "height": 70, "fx": 80.0, "fy": 76.0, "cx": 44.0, "cy": 37.0, "skew": 1.5}
ASIDE = {"position_mm": [2.0, -1.5, 1.0], "power": 3.0}


def scene(surface=None, lights=({},), reflectance=None, camera=None, **render):
    tables = {"surface": surface or {"type": "plane"}, "camera": {**CAMERA, **(camera or {})}}
    tables |= {"rig": {"lights": list(lights)}, "render": render}
    return scene_from_dict(tables | {"reflectance": {"type": "phong", **(reflectance or {})}})


@pytest.fixture(scope="module")
def session():
    return Session(scene())


def parts(radiance):
    return radiance.specular, radiance.diffuse, radiance.indirect


# Labels --------------------------------------------------------------------------------------------------------------

# Surface; limits at 99 of 100 pixels: angle of the normals, depth mm, curvature 1/mm. Those of the fine surface are
# looser on a mesh: its triangles shift the point, where the relief has another normal.
LABELLED = {
    "plane": ({"type": "plane", "tilt_deg": 30.0, "azimuth_deg": 50.0}, 1e-5, 1e-4, 1e-7),
    "sphere": ({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 10.0}, 1e-4, 1e-4, 1e-5),
    "sphere inside": ({"type": "sphere", "radius_mm": 14.0, "side": "inside"}, 1e-4, 1e-4, 1e-5),
    "cylinder": ({"type": "cylinder", "radius_mm": 5.0, "spin_deg": 25.0}, 1e-4, 1e-4, 1e-5),
    "cylinder inside": ({"type": "cylinder", "radius_mm": 11.0, "side": "inside"}, 1e-4, 1e-4, 1e-5),
    "saddle": ({"type": "quadric", "k1_per_mm": 0.06, "k2_per_mm": -0.04, "tilt_deg": 15.0}, 1e-4, 1e-3, 1e-4),
    "colon": ({"type": "anatomy", "path": "colon"}, 4e-3, 0.03, 0.02),
}
ROUGH = {
    "plane": (2e-5, 1e-4), "sphere": (1e-4, 1e-3), "cylinder inside": (1e-4, 1e-3), "saddle": (3e-3, 3e-3),
    "colon": (6e-3, 0.03),
}  # fmt: skip
RELIEF = {"bands": [{"slope_deg": 4.0, "wavelength_mm": 2.0}, {"slope_deg": 2.0, "wavelength_mm": 1.0}], "seed": 3}
CASES = [(name, None, 1) for name in LABELLED] + [(name, "relief", 1) for name in ROUGH]
CASES += [(name, relief, 3) for name in ("plane", "sphere", "colon") for relief in (None, "relief")]


@pytest.mark.parametrize(
    ("name", "relief", "samples"), marked(CASES, ci=[case for case in CASES if case[0] in ("colon", "saddle")])
)
def test_labels_are_the_exact_truth_to_the_meshs_fineness(session, name, relief, samples):
    surface, turned, shifted, bent = LABELLED[name]
    fine_turned, fine_bent = ROUGH[name] if relief else (turned, bent)
    described = surface | ({"relief": RELIEF} if relief else {})
    session.update(scene(described, (ASIDE,), samples_per_pixel=samples))
    labels, truth = session.frame().labels, session.truth()
    both = labels.mask & truth.mask
    assert both.sum() > 1000
    assert np.count_nonzero(labels.mask != truth.mask) <= 0.002 * both.size

    def near(error, limit):
        assert np.percentile(error[both], 99) < limit, (np.percentile(error[both], 99), limit)

    near(angle(labels.normal.astype(float), truth.normal), fine_turned)
    near(angle(labels.normal_base.astype(float), truth.normal_base), max(turned, fine_turned))
    flat = {"colon": 0.1, "saddle": 3e-3}.get(name, max(turned, fine_turned))
    near(angle(labels.geometric_normal.astype(float), truth.normal_base), flat)
    near(np.abs(labels.depth - truth.depth), shifted)
    near(np.linalg.norm(labels.position - truth.position, axis=-1), shifted)
    for curvature in ("k_min", "k_max", "k_min_base", "k_max_base"):
        limit = max(bent, fine_bent) if "base" in curvature else fine_bent
        near(np.abs(getattr(labels, curvature) - getattr(truth, curvature)), limit)
    for label in (labels.depth, labels.k_min, labels.k_max_base, labels.position[..., 2], labels.normal[..., 0]):
        assert label.dtype == np.float32
        assert np.isnan(label[~labels.mask]).all()
        assert np.isfinite(label[labels.mask]).all()
    assert set(np.unique(labels.instance)) <= {-1, 0}
    np.testing.assert_array_equal(labels.face >= 0, labels.mask)
    assert not labels.pool.any()
    assert not truth.pool.any()
    if relief:
        # The light off the lobe sees the fine normal, and the truth says so.
        near(angle(truth.shading_normal, labels.normal.astype(float)), 1e-6)
        # The two truths differ by the relief's slope, and the fine one is far more curved.
        slope = np.degrees(np.mean(angle(labels.normal, labels.normal_base)[both]))
        assert 0.7 * 4.47 * np.sqrt(np.pi / 2) < slope < 1.3 * 4.47 * np.sqrt(np.pi / 2)
        assert np.median((truth.k_max - truth.k_max_base)[both]) > 0.1


# Several samples -----------------------------------------------------------------------------------------------------


GLOSSY = {"exponent": 400.0, "diffuse": 0.5}


def supersampled(cells):
    """Mean over each pixel of the radiance of a plane at depth 10, light at the camera."""
    share = (np.arange(cells) + 0.5) / cells
    u = (np.arange(90)[:, None] + share).ravel()
    v = (np.arange(70)[:, None] + share).ravel()
    y = (v[:, None] - 37.0) / 76.0
    x = (u[None, :] - 44.0 - 1.5 * y) / 80.0
    cosine2 = 1 / (1 + x**2 + y**2)
    lobe = np.maximum(2 * cosine2 - 1, 0) ** 400.0
    value = (lobe + 0.5 / np.pi * np.sqrt(cosine2)) * cosine2 / 100.0
    return value.reshape(70, cells, 90, cells).mean(axis=(1, 3))


def test_several_samples_average_over_each_pixel(session):
    """Pooled over pixels and seeds: no bias beyond three standard errors; the centre's value alone is told apart."""
    expected = supersampled(32)
    gaps = []
    for seed in range(40):
        session.update(scene(reflectance=GLOSSY, samples_per_pixel=4, seed=seed, adaptive=False))
        total = session.radiance().total.astype(float)
        gaps.append(total / expected - 1)
    gaps = np.array(gaps)
    pooled = gaps.mean(axis=(1, 2))
    error = pooled.std(ddof=1) / np.sqrt(len(pooled))
    assert abs(pooled.mean()) < 3 * error + 1e-6
    # By pixel: z-scores of unit variance.
    z = gaps.mean(axis=0) / (gaps.std(axis=0, ddof=1) / np.sqrt(len(gaps)))
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert 0.9 < z.std() < 1.15
    session.update(scene(reflectance=GLOSSY))
    centre = session.radiance().total / expected - 1
    assert abs(centre.mean()) > 3 * error + 1e-6


def test_samples_spread_evenly_beat_independent_ones(session):
    """From 4 to 64 samples, independent ones would lower the error to a quarter."""
    spread, expected = [], supersampled(32)
    for samples in (4, 64):
        session.update(scene(reflectance=GLOSSY, samples_per_pixel=samples, adaptive=False))
        spread.append(float((session.radiance().total / expected - 1).std()))
    assert spread[1] < spread[0] / 5


def test_frames_of_any_size(session):
    for width, height in ((1, 1), (5, 3), (4, 8), (13, 2)):
        camera = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
        frames = []
        for samples in (1, 4):
            session.update(scene(reflectance={"diffuse": 0.3}, camera=camera, samples_per_pixel=samples))
            frame = session.frame()
            assert frame.radiance.total.shape == frame.labels.depth.shape == (height, width)
            frames.append(frame.radiance.total)
        np.testing.assert_allclose(frames[0], frames[1], rtol=0.05)


def test_untile_puts_tiles_in_rows():
    height, width = 2 * TILE, 3 * TILE
    index = np.arange(height * width)
    tile, cell = np.divmod(index, TILE * TILE)
    row, column = tile // 3 * TILE + cell // TILE, tile % 3 * TILE + cell % TILE
    np.testing.assert_array_equal(untile((row * width + column)[None], (height, width))[0].ravel(), index)
