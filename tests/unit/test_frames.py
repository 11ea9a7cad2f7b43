"""Labelled frames and frames of several samples: against the exact truth, closed forms, and themselves."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest

from simtest.geometry.camera import Camera
from simtest.rendering import Session, trace
from simtest.rendering.rays import TILE, is_pinhole, untile
from simtest.spec import scene_from_dict
from simtest.spec.camera import CameraSpec
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


def angle(a, b):
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def parts(radiance):
    return radiance.specular, radiance.diffuse, radiance.indirect


def bytes_of(radiance):
    return [part.tobytes() for part in parts(radiance)]


# Labels --------------------------------------------------------------------------------------------------------------

# Limits at 99 of 100 pixels: angle of the normals, depth mm, curvature 1/mm.
LABELLED = {
    "plane": ({"type": "plane", "tilt_deg": 30.0, "azimuth_deg": 50.0}, 1e-5, 1e-4, 1e-7),
    "sphere": ({"type": "sphere", "radius_mm": 6.0, "tilt_deg": 10.0}, 1e-4, 1e-4, 1e-5),
    "sphere inside": ({"type": "sphere", "radius_mm": 14.0, "side": "inside"}, 1e-4, 1e-4, 1e-5),
    "cylinder": ({"type": "cylinder", "radius_mm": 5.0, "spin_deg": 25.0}, 1e-4, 1e-4, 1e-5),
    "cylinder inside": ({"type": "cylinder", "radius_mm": 11.0, "side": "inside"}, 1e-4, 1e-4, 1e-5),
    "saddle": ({"type": "quadric", "k1_per_mm": 0.06, "k2_per_mm": -0.04, "tilt_deg": 15.0}, 1e-4, 1e-3, 1e-4),
    "colon": ({"type": "anatomy", "path": "colon"}, 4e-3, 0.03, 0.02),
}


@pytest.mark.parametrize("samples", [1, 3])
@pytest.mark.parametrize("name", marked(LABELLED, ci=["colon"]))
def test_labels_are_the_exact_truth_to_the_meshs_fineness(session, name, samples):
    surface, turned, shifted, bent = LABELLED[name]
    session.update(scene(surface, (ASIDE,), samples_per_pixel=samples))
    labels, truth = session.frame().labels, session.truth()
    both = labels.mask & truth.mask
    assert both.sum() > 1000
    assert np.count_nonzero(labels.mask != truth.mask) <= 0.002 * both.size

    def near(error, limit):
        assert np.percentile(error[both], 99) < limit

    near(angle(labels.normal.astype(float), truth.normal), turned)
    near(angle(labels.geometric_normal.astype(float), truth.normal), {"colon": 0.1, "saddle": 3e-3}.get(name, turned))
    near(np.abs(labels.depth - truth.depth), shifted)
    near(np.linalg.norm(labels.position - truth.position, axis=-1), shifted)
    near(np.abs(labels.k_min - truth.k_min), bent)
    near(np.abs(labels.k_max - truth.k_max), bent)
    for label in (labels.depth, labels.k_min, labels.position[..., 2], labels.normal[..., 0]):
        assert label.dtype == np.float32
        assert np.isnan(label[~labels.mask]).all()
        assert np.isfinite(label[labels.mask]).all()
    assert set(np.unique(labels.instance)) <= {-1, 0}
    np.testing.assert_array_equal(labels.face >= 0, labels.mask)


@pytest.mark.parametrize("name", marked(["sphere", "saddle", "colon"], ci=["saddle", "colon"]))
def test_truth_is_the_same_with_and_without_labels_first(session, name):
    """The labels' hits are a start for the exact solution: it must not show."""
    surface = LABELLED[name][0]
    session.update(scene())
    session.update(scene(surface))
    alone = session.truth()
    session.update(scene())
    session.update(scene(surface))
    session.frame()
    after = session.truth()
    for field in dataclasses.fields(alone):
        first, second = (getattr(truth, field.name) for truth in (alone, after))
        assert first is second is None or first.tobytes() == second.tobytes(), field.name


def test_labels_and_radiance_of_one_pass_are_those_of_two(session):
    session.update(scene(LABELLED["sphere"][0], (ASIDE,), {"diffuse": 0.3}))
    np.testing.assert_allclose(session.frame().radiance.total, session.radiance().total, rtol=1e-6)


_TWO_VARIANTS = """
import numpy as np
from simtest.rendering import Session
from simtest.spec import scene_from_dict
def scene(tilt):
    return scene_from_dict({"surface": {"type": "plane", "tilt_deg": tilt},
        "reflectance": {"type": "phong", "diffuse": 0.3}, "camera": {"width": 32, "height": 24, "fx": 30, "fy": 30}})
def all_of(session):
    frame = session.frame()
    found = session.highlights(frame.radiance)
    points = session.exact_points(np.array([[16.0, 12.0]]))
    arrays = [session.radiance().total, frame.radiance.total, frame.labels.depth, session.truth().normal,
              found[0].bp_px, points.position]
    return [array.tobytes() for array in arrays]
mono = Session(scene(5.0), "llvm_ad_mono")
alone = all_of(mono)
colour = Session(scene(5.0), "llvm_ad_rgb")
for session, channels in ((mono, ()), (colour, (3,)), (mono, ())):
    assert session.radiance().total.shape == (24, 32, *channels)
for step in ("radiance", "frame", "highlights", "truth", "update"):
    colour.radiance()
    if step == "highlights":
        mono.highlights(radiance)
    elif step == "update":
        mono.update(scene(9.0))
        mono.update(scene(5.0))
    else:
        made = getattr(mono, step)()
        radiance = made if step == "radiance" else radiance
colour.frame()
assert all_of(mono) == alone
"""


@pytest.mark.slow
def test_sessions_of_two_variants_do_not_disturb_each_other():
    done = subprocess.run([sys.executable, "-c", _TWO_VARIANTS], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


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


@pytest.mark.parametrize("depth", [2, 3])
def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(session, depth):
    surface = {"type": "sphere", "radius_mm": 14.0, "side": "inside"}

    def made(seed):
        return scene(surface, (ASIDE,), {"diffuse": 0.4}, samples_per_pixel=5, path_depth=depth, seed=seed)

    session.update(made(3))
    first = bytes_of(session.radiance())
    session.update(scene())
    session.radiance()
    session.update(made(3))
    assert bytes_of(session.radiance()) == first
    assert bytes_of(session.frame().radiance) == first
    assert bytes_of(Session(made(3)).radiance()) == first
    session.update(made(4))
    assert bytes_of(session.radiance())[0] != first[0]


@pytest.mark.parametrize("samples", [1, 7])
def test_the_launches_size_changes_nothing_of_direct_light(session, monkeypatch, samples):
    session.update(scene(LABELLED["sphere"][0], (ASIDE,), {"diffuse": 0.3}, samples_per_pixel=samples))
    whole = session.frame()
    told = []
    monkeypatch.setattr(trace, "LANES", 1000)
    monkeypatch.setattr(trace, "RAYS", 3000)
    cut = session.frame(lambda done, total, what: told.append((done, total)))
    for a, b in zip(parts(whole.radiance), parts(cut.radiance), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(whole.labels.depth, cut.labels.depth)
    assert [done for done, _ in told] == sorted({done for done, _ in told})
    assert {total for _, total in told} == {told[-1][0]}
    assert len(told) > 6


def test_a_stopped_frame_leaves_the_session_whole(session, monkeypatch):
    session.update(scene(LABELLED["sphere"][0], samples_per_pixel=4))
    whole = bytes_of(session.radiance())
    monkeypatch.setattr(trace, "RAYS", 1)

    def stop(done, total, what):
        if done > total / 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.radiance(stop)
    monkeypatch.undo()
    assert bytes_of(session.radiance()) == whole


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (4, 8), (13, 2)])
def test_frames_of_any_size(session, size):
    width, height = size
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


# Other cameras -------------------------------------------------------------------------------------------------------


class Lens(Camera):
    """A lens that turns its outer sightlines inwards, and has none beyond a radius."""

    strength, reach = 0.0, np.inf

    def unproject(self, points_px):
        rays = super().unproject(points_px)
        rays = rays / rays[..., 2:]
        squared = (rays[..., :2] ** 2).sum(axis=-1, keepdims=True)
        rays[..., :2] *= 1 - self.strength * squared
        rays[np.sqrt(squared[..., 0]) > self.reach] = np.nan
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def test_only_a_pinhole_has_its_rays_made_in_the_kernel():
    plain = Camera(90, 70, 80.0, 76.0, 44.0, 37.0, 1.5)
    assert is_pinhole(plain)
    lens = Lens(90, 70, 80.0, 76.0, 44.0, 37.0, 1.5)
    assert is_pinhole(lens)
    for name, value in (("strength", 1e-4), ("reach", 0.5)):
        other = type("Other", (Lens,), {name: value})
        assert not is_pinhole(other(90, 70, 80.0, 76.0, 44.0, 37.0, 1.5))


def lens_session(monkeypatch, described, **settings):
    """A session whose camera is a lens."""
    model = CameraSpec.model
    lens = type("Other", (Lens,), settings)

    def made(self):
        camera = model(self)
        return lens(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.skew)

    monkeypatch.setattr(CameraSpec, "model", made)
    return Session(described)


@pytest.mark.parametrize("samples", [1, 3])
def test_rays_that_are_given_trace_as_those_made_in_the_kernel(session, monkeypatch, samples):
    described = scene(LABELLED["sphere"][0], (ASIDE,), {"diffuse": 0.3}, samples_per_pixel=samples, seed=2)
    session.update(described)
    expected = session.frame()
    lens = lens_session(monkeypatch, described, strength=0.0)
    lens.sightlines.in_kernel = False
    frame = lens.frame()
    scale = expected.radiance.total.max()
    inside = (angle(expected.labels.normal.astype(float), -expected.labels.position.astype(float)) < 1.2) & (
        expected.labels.mask
    )
    for a, b in zip(parts(frame.radiance), parts(expected.radiance), strict=True):
        assert np.percentile(np.abs(a - b)[inside], 99) < 1e-5 * scale
    np.testing.assert_allclose(frame.labels.depth[inside], expected.labels.depth[inside], rtol=1e-4)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_lens_bends_the_picture_and_what_it_does_not_see_is_dark(monkeypatch, samples):
    """Positions of the plane follow the lens; no NaN reaches the renderer."""
    described = scene(reflectance={"diffuse": 0.3}, samples_per_pixel=samples)
    lens = lens_session(monkeypatch, described, strength=0.2, reach=0.4)
    assert not lens.sightlines.in_kernel
    frame, truth = lens.frame(), lens.truth()
    sightlines = lens.camera.unproject(lens.camera.pixel_centres())
    seen = np.isfinite(sightlines).all(axis=-1)
    assert 0 < seen.sum() < seen.size
    np.testing.assert_array_equal(frame.labels.mask, seen)
    np.testing.assert_array_equal(truth.mask, seen)
    expected = sightlines[seen] / sightlines[seen][:, 2:] * 10.0
    np.testing.assert_allclose(frame.labels.position[seen], expected, rtol=1e-5, atol=1e-5)
    for part in parts(frame.radiance):
        assert np.isfinite(part).all()
    inner = np.hypot(*(lens.camera.pixel_centres() - [44.0, 37.0]).transpose(2, 0, 1)) > 0.5 * 80
    assert (frame.radiance.total[inner] == 0).all()
    assert (frame.radiance.total[37, 40:48] > 0).all()


@pytest.mark.parametrize("lens", [None, {"type": "brown_conrady", "k1": -0.1}])
@pytest.mark.parametrize("samples", [1, 4])
def test_a_round_field_of_view_darkens_the_pixels_outside(session, samples, lens):
    """Whole pixels, by their centres, whatever the samples."""
    camera = {"distortion": lens, "view_mask": {"cx": 44.5, "cy": 36.5, "radius": 30.0}}
    session.update(scene(reflectance={"diffuse": 0.3}, samples_per_pixel=samples, camera=camera))
    assert session.sightlines.in_kernel == (lens is None)
    frame, truth = session.frame(), session.truth()
    x, y = session.camera.pixel_centres().transpose(2, 0, 1)
    inside = np.hypot(x - 44.5, y - 36.5) <= 30.0
    np.testing.assert_array_equal(session.camera.seen, inside)
    np.testing.assert_array_equal(frame.radiance.total > 0, inside)
    np.testing.assert_array_equal(frame.labels.mask, inside)
    np.testing.assert_array_equal(truth.mask, inside)
    for maps, name in ((frame.labels, "depth"), (frame.labels, "normal"), (truth, "position"), (truth, "k_min")):
        assert np.isnan(getattr(maps, name)[~inside]).all(), name
        assert np.isfinite(getattr(maps, name)[inside]).all(), name


# Updates -------------------------------------------------------------------------------------------------------------

SWEPT = {
    "phong": [{"type": "phong", "exponent": 30.0 + i, "diffuse": 0.1 * i, "specular": 1.0 + i} for i in range(4)],
    "rough plastic": [{"type": "rough_plastic", "alpha": 0.1 + 0.05 * i, "diffuse": 0.2 * i} for i in range(4)],
    "principled": [{"type": "principled", "roughness": 0.2 + 0.1 * i, "diffuse": 0.2 * i} for i in range(4)],
    "rough conductor": [{"type": "rough_conductor", "alpha": 0.1 + 0.1 * i, "diffuse": 0.2 * i} for i in range(4)],
    "tissue": [
        {"type": "tissue", "diffuse": 0.2 * i, "film": {"index": 1.33 + 0.02 * i, "alpha": 0.03 + 0.02 * i}}
        for i in range(4)
    ],
}


@pytest.mark.parametrize("name", SWEPT)
def test_a_sweep_builds_once_compiles_once_and_gives_what_fresh_sessions_give(name):
    def step(i):
        profile = {"type": "cosine", "power": 1.0 + 0.5 * i}
        light = {"offset_mm": 1.0 + i, "power": 1.0 + i, "profile": profile, "direction": [0.1 * i, 0.0, 1.0]}
        surface = {"type": "sphere", "radius_mm": 6.0 + i, "tilt_deg": 3.0 * i}
        tinted = {**SWEPT[name][i], "colour": [1.0, 0.9 - 0.1 * i, 0.5]}
        return scene(surface, (light, {"power": 0.5}), tinted, {"fx": 80.0 + i}, samples_per_pixel=3, seed=i)

    session = Session(step(0))
    session.frame()
    import drjit as dr  # after the backend has chosen its libLLVM

    swept = []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for i in (1, 2, 3):
            session.update(step(i))
            swept.append(session.frame())
        launched = dr.kernel_history((dr.KernelType.JIT,))
    assert session.rebuilds == 1
    assert len(launched) >= 6
    assert all(kernel["cache_hit"] for kernel in launched)
    fresh = Session(step(3)).frame()
    assert fresh.radiance.total.tobytes() != swept[0].radiance.total.tobytes()
    for a, b in zip(parts(swept[-1].radiance), parts(fresh.radiance), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_memory_does_not_grow_over_a_thousand_frames():
    """The last 950 of 1000 labelled frames of a moving light add less than 2 % to the resident memory."""
    from pathlib import Path

    surface = {"type": "anatomy", "path": "colon"}
    session = Session(scene(surface), labelled=True)

    def resident():
        return int(Path("/proc/self/statm").read_text().split()[1])

    if not Path("/proc/self/statm").exists():
        pytest.skip("the system does not tell the resident memory")
    sizes = []
    for i in range(1000):
        lights = ({"offset_mm": 1.0 + 1e-3 * i, "power": 1.0 + i},)
        session.update(scene(surface, lights, {"exponent": 50.0 + 0.1 * i}, samples_per_pixel=1 + i % 2))
        session.frame()
        sizes.append(resident())
    assert np.median(sizes[-50:]) < 1.02 * np.median(sizes[50:100])
