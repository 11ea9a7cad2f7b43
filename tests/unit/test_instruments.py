"""Instruments against plain NumPy: rays' closed forms, shadows, the metal's radiance, labels, hidden highlights."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import simtest
from simtest.errors import InputError
from simtest.rendering import Session
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec.scene import scene_from_dict
from simtest.spec.surfaces import Instrument
from simtest.surfaces.instrument import round_cones

F, WIDTH, HEIGHT, DISTANCE = 64.0, 80, 60, 60.0
SHAFT = {"tip": [0.55, 0.45], "depth_mm": 40.0, "azimuth_deg": 25.0, "tilt_deg": 15.0, "diameter_mm": 6.0}
LIGHT = (12.0, -9.0, 0.0)


def described(*instruments, light=LIGHT, **more):
    scene = {
        "surface": {"type": "plane", "distance_mm": DISTANCE},
        "reflectance": {"type": "phong", "exponent": 30.0, "specular": 1.0, "diffuse": 0.4},
        "rig": {"lights": [{"position_mm": light, "power": 1000.0}]},
        "camera": {"width": WIDTH, "height": HEIGHT, "fx": F, "fy": F},
        **more,
    }
    return scene_from_dict({**scene, "instruments": list(instruments)} if instruments else scene)


@pytest.fixture(scope="module")
def session():
    return Session(described(SHAFT), "llvm_ad_mono", labelled=True)


def sightlines():
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([x / F, y / F, np.ones_like(x)], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def axis_of(shaft):
    """Return the end of a shaft's axis next to its tip, its direction, and the radius, mm."""
    azimuth, tilt, radius = np.radians(shaft["azimuth_deg"]), np.radians(shaft["tilt_deg"]), shaft["diameter_mm"] / 2
    back = np.array([np.cos(tilt) * np.cos(azimuth), np.cos(tilt) * np.sin(azimuth), -np.sin(tilt)])
    pixel = (np.array(shaft["tip"]) - 0.5) * [WIDTH / F, HEIGHT / F]
    tip = shaft["depth_mm"] * np.array([*pixel, 1.0]) / np.linalg.norm([*pixel, 1.0])
    return tip + radius * back, back, radius


def capsule(shaft):
    """Return distance and normal of a shaft on the sightlines, by the quadratics of a cylinder and of a ball."""
    start, back, radius = axis_of(shaft)
    r = sightlines()
    distance = np.full(r.shape[:2], np.inf)
    with np.errstate(invalid="ignore"):
        # the cylinder: what is left of ray and start across the axis
        p, q = r - (r @ back)[..., None] * back, -start + (start @ back) * back
        a, b, c = (p * p).sum(-1), p @ q, q @ q - radius**2
        t = (-b - np.sqrt(b * b - a * c)) / a
        on = (t > 0) & ((t[..., None] * r - start) @ back > 0)
        distance = np.where(on, t, distance)
        # the ball at its end
        b, c = -(r @ start), start @ start - radius**2
        t = -b - np.sqrt(b * b - c)
        on = (t > 0) & ((t[..., None] * r - start) @ back <= 0)
        distance = np.where(on, np.minimum(t, distance), distance)
    place = np.where(np.isfinite(distance), distance, 0)[..., None] * r - start
    place -= np.maximum(place @ back, 0)[..., None] * back
    return distance, place / radius


def apart(start, back, reach, points, light):
    """Return how near the segments from points to a light come to an axis, by the closest points of two segments."""
    nearest = np.full(len(points), np.inf)
    # Convex in both: the best along the axis for each of many places on the way to the light.
    for share in np.linspace(0, 1, 601):
        place = points + share * (light - points) - start
        along = np.clip(place @ back, 0, reach)
        nearest = np.minimum(nearest, np.linalg.norm(place - along[:, None] * back, axis=1))
    return nearest


# Geometry ------------------------------------------------------------------------------------------------------------


def test_depth_normal_and_mask_of_a_shaft_are_those_of_cylinder_and_ball(session):
    session.update(described(SHAFT))
    expected, normal = capsule(SHAFT)
    hit = np.isfinite(expected)
    labels, truth = session.frame().labels, session.truth()
    assert 300 < hit.sum() < 3000
    for maps in (labels, truth):
        assert np.array_equal(maps.instrument, hit.astype(np.uint8))
        np.testing.assert_allclose(maps.depth[hit], expected[hit], rtol=1e-6)
        np.testing.assert_allclose(maps.normal[hit], normal[hit], atol=2e-6)
        assert np.array_equal(maps.normal_base, maps.normal, equal_nan=True)
        assert np.isnan(maps.k_max[hit]).all()
        assert np.isfinite(maps.k_max[~hit]).all()
        # Behind the instrument nothing changes.
        np.testing.assert_allclose(maps.depth[~hit], (DISTANCE / sightlines()[..., 2])[~hit], rtol=1e-6)
    np.testing.assert_allclose(truth.depth[hit], expected[hit], rtol=1e-12)
    np.testing.assert_allclose(truth.position[hit], (expected[..., None] * sightlines())[hit], rtol=1e-12, atol=1e-12)


def test_surface_hides_what_lies_behind_it(session):
    beyond = {**SHAFT, "tilt_deg": 0.0, "depth_mm": DISTANCE + 20}
    session.update(described(beyond))
    assert not session.frame().labels.instrument.any()
    assert not session.truth().instrument.any()


def test_same_scene_again_keeps_what_covers_the_frame(session):
    session.update(described(SHAFT))
    cover = session.cover()
    session.update(described(SHAFT))
    assert session.cover() is cover
    session.update(described({**SHAFT, "tip": [0.6, 0.6]}))
    assert not np.array_equal(session.cover().instrument, cover.instrument)


def test_depth_share_is_that_of_the_surface_at_the_tip(session):
    shaft = {"tip": [0.7, 0.3], "diameter_mm": 3.0}
    session.update(described({**shaft, "depth_share": 0.5}))
    depth = session.truth().depth
    along = float(np.linalg.norm([(0.7 - 0.5) * WIDTH / F, (0.3 - 0.5) * HEIGHT / F, 1]))
    session.update(described({**shaft, "depth_mm": 0.5 * DISTANCE * along}))
    np.testing.assert_allclose(depth, session.truth().depth, rtol=1e-6)


angles = st.floats(-180, 180)


@settings(max_examples=25, deadline=None)
@given(azimuth=angles, roll=angles, tilt=st.floats(-60, 60), opening=st.floats(0, 80), seed=st.integers(0, 2**31))
def test_rays_meet_a_grasper_first_on_its_surface(session, azimuth, roll, tilt, opening, seed):
    grasper = Instrument(kind="grasper", azimuth_deg=azimuth, roll_deg=roll, tilt_deg=tilt, opening_deg=opening)
    cones = round_cones({3: grasper}, {3: np.array([1.0, -2.0, 50.0])})
    from simtest.rendering.backend import mi
    from simtest.rendering.instruments import InstrumentKernel

    kernel = InstrumentKernel(cones, {3: grasper})
    rng = np.random.default_rng(seed)
    targets = cones.starts[rng.integers(len(cones.starts), size=64)] + rng.normal(0, 2, (64, 3))
    # From the camera, and along the cones' axes or nearly so, inside their radii and outside.
    axes = ((cones.ends - cones.starts) / cones.lengths[:, None]).repeat(8, axis=0)
    aside = rng.normal(0, cones.radii.max(axis=1).repeat(8))[:, None] * np.cross(axes, rng.normal(size=axes.shape))
    nearly = axes + 10.0 ** rng.uniform(-9, -2, (len(axes), 1)) * rng.normal(size=axes.shape)
    eyes = np.concatenate([np.zeros_like(targets), cones.starts.repeat(8, axis=0) + aside - 60 * axes])
    outside = cones.distances(eyes).min(axis=1) > 0
    eyes, rays = eyes[outside], np.concatenate([targets, nearly])[outside]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    distance, normal, owner = kernel.cast(eyes, rays)
    hit = np.isfinite(distance)
    assert set(owner[hit]) <= {3}
    assert (owner[~hit] == -1).all()
    # Outside all the way, and on the surface at its end.
    far = np.where(hit, distance, 100.0)
    way = eyes + np.linspace(0, 1, 200)[:-1, None, None] * (far[:, None] * rays)
    assert cones.distances(way.reshape(-1, 3)).min() > -1e-9
    place = eyes[hit] + distance[hit, None] * rays[hit]
    assert np.abs(cones.distances(place).min(axis=1)).max(initial=0) < 1e-9
    # Shadow rays, in single precision, but for those that only graze.
    deep = cones.distances(place + 0.1 * rays[hit]).min(axis=1) < -1e-3
    shadow = mi.Ray3f(*(mi.Vector3f(np.ascontiguousarray(part[hit][deep].T)) for part in (eyes, rays)))
    assert np.array(kernel.blocked(shadow, mi.Bool(True))).all()
    # The normal is the distance's gradient, but where two parts meet.
    h = 1e-5
    around = [cones.distances(place + sign * h * axis).min(axis=1) for axis in np.eye(3) for sign in (1, -1)]
    slope = np.stack([(up - down) / (2 * h) for up, down in zip(around[::2], around[1::2], strict=True)], axis=1)
    single = np.sort(cones.distances(place), axis=1)[:, 1] > 2 * h
    np.testing.assert_allclose(normal[hit][single], slope[single], atol=1e-6)


# Light ---------------------------------------------------------------------------------------------------------------


def test_shadow_on_a_plane_is_where_the_way_to_the_light_meets_the_axis(session):
    session.update(described(SHAFT))
    radiance = session.radiance()
    start, back, radius = axis_of(SHAFT)
    seen = np.isinf(capsule(SHAFT)[0])
    points = (DISTANCE / sightlines()[..., 2:] * sightlines())[seen]
    gap = apart(start, back, 300.0, points, np.array(LIGHT)) - radius
    dark = radiance.total[seen] == 0
    # Between places on the way the distance is known to its step squared.
    assert dark[gap < -1e-2].all()
    assert not dark[gap > 1e-2].any()
    assert 200 < dark.sum() < len(dark) / 2
    # Without the shaft nothing is dark.
    session.update(described({**SHAFT, "present": False}))
    assert (session.radiance().total > 0).all()


def test_radiance_of_the_metal_is_ggx_with_schlick_over_the_squared_distance(session):
    shaft = {**SHAFT, "alpha": 0.3, "diffuse": 0.25, "metal": [0.6, 0.6, 0.6], "colour": [0.5, 0.5, 0.5]}
    session.update(described(shaft))
    radiance = session.radiance()
    distance, n = capsule(shaft)
    hit = np.isfinite(distance)
    v, n = -sightlines()[hit], n[hit]
    towards = np.array(LIGHT) + distance[hit, None] * v
    squared = (towards**2).sum(-1)
    light = towards / np.sqrt(squared)[:, None]
    cos_i, cos_o = (v * n).sum(-1), (light * n).sum(-1)
    half = (v + light) / np.linalg.norm(v + light, axis=1, keepdims=True)
    cos_h, facing = (half * n).sum(-1), (half * v).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        tangent2 = 1 / cos_h**2 - 1
        density = 1 / (np.pi * 0.3**2 * cos_h**4 * (1 + tangent2 / 0.3**2) ** 2)
        shadowed = [2 / (1 + np.sqrt(1 + 0.3**2 * (1 / c**2 - 1))) for c in (cos_i, cos_o)]
        fresnel = 0.6 + 0.4 * (1 - facing) ** 5
        lobe = 0.75 * density * fresnel * shadowed[0] * shadowed[1] / (4 * cos_i)
    lit = cos_o > 0.02
    np.testing.assert_allclose(radiance.specular[hit][lit], (1000 / squared * lobe)[lit], rtol=2e-4)
    np.testing.assert_allclose(
        radiance.diffuse[hit][lit], (1000 / squared * 0.25 * 0.5 / np.pi * cos_o)[lit], rtol=2e-5
    )
    assert (radiance.total[hit][cos_o < -0.02] == 0).all()


def test_samples_cover_the_share_of_a_pixel(session):
    # Far less light off the metal: the share of the surface's radiance that is left is that of the pixel.
    black = {**SHAFT, "metal": [0.0, 0.0, 0.0], "diffuse": 1.0, "colour": [0.0, 0.0, 0.0]}
    at_camera = {"rig": {"lights": [{"power": 1000.0}]}, "render": {"samples_per_pixel": 64}}
    session.update(described(black, **at_camera))
    covered = session.radiance().diffuse
    session.update(described(**at_camera))
    share = covered / session.radiance().diffuse
    expected = np.isinf(capsule(SHAFT)[0])
    assert abs(share.mean() - expected.mean()) < 2e-3
    edge = (share > 0.05) & (share < 0.95)
    assert 60 < edge.sum() < 400


# Highlights ----------------------------------------------------------------------------------------------------------


def over(point_px, **more):
    """Return a shaft whose tip is seen at a pixel."""
    return {**SHAFT, "tip": [point_px[0] / WIDTH, point_px[1] / HEIGHT], "tilt_deg": 0.0, **more}


def test_hidden_highlight_is_listed_and_not_lit(session):
    session.update(described())
    (free,) = session.highlights(session.radiance())
    assert (free.lit, free.hidden) == (True, False)
    session.update(described(over(free.bp_px - np.array([4, 2]))))
    (behind,) = session.highlights(session.radiance())
    np.testing.assert_allclose(behind.bp_px, free.bp_px, atol=1e-6)
    assert (behind.lit, behind.hidden) == (False, True)
    # Beside it: seen again, and lit.
    session.update(described(over(free.bp_px + np.array([20, 0]))))
    (beside,) = session.highlights(session.radiance())
    assert (beside.lit, beside.hidden) == (True, False)


def between(point, light, **more):
    """Return a shaft midway between a surface point and a light, off the sightline."""
    middle = (point.position + np.array(light)) / 2
    pixel, azimuth = middle[:2] / middle[2] * F + [WIDTH / 2, HEIGHT / 2], np.degrees(np.arctan2(light[1], light[0]))
    depth = float(np.linalg.norm(middle))
    return over(pixel, depth_mm=depth, diameter_mm=2.0, azimuth_deg=float(azimuth), **more)


def test_shaded_highlight_is_seen_and_not_lit(session):
    session.update(described())
    (free,) = session.highlights()
    session.update(described(between(free, LIGHT)))
    (shaded,) = session.highlights()
    assert (shaded.lit, shaded.hidden) == (False, False)
    # A light at the camera reaches all that is seen.
    at_camera = {"rig": {"lights": [{"power": 1000.0}]}}
    session.update(described(**at_camera))
    (free,) = session.highlights()
    session.update(described(over(free.bp_px + np.array([20, 0])), **at_camera))
    assert [(point.lit, point.hidden) for point in session.highlights()] == [(True, False)]


def test_lobe_at_a_highlight_is_without_the_lights_that_an_instrument_keeps_away(session):
    """As in the frame: of two lights whose lobes overlap the other one is shaded at the first one's highlight."""
    other = np.array([-2.0, 6.0, 0.0])
    lights = [{"position_mm": place, "power": 1000.0} for place in (LIGHT, tuple(other))]
    session.update(described(rig={"lights": lights}))
    first = next(point for point in session.highlights() if point.light == 0)
    session.update(described(between(first, other), rig={"lights": lights}))
    radiance = session.radiance()
    lit = [point for point in session.highlights(radiance) if point.lit and point.light == 0]
    assert len(lit) == 1
    column, row = lit[0].bp_px.astype(int)
    np.testing.assert_allclose(session.lobe_at(lit), radiance.specular[row, column], rtol=0.01)


def test_frame_names_why_a_hidden_highlight_does_not_count_and_whose_a_spot_is(session):
    session.update(described())
    (free,) = session.highlights()
    frame = make_frame(described(over(free.bp_px - np.array([4, 2]))))
    assert [own.why_not for own in frame.highlights] == ["hidden by an instrument"]
    # The lobe still shines on both sides of the shaft, and the shaft shines itself.
    assert {spot.instrument for spot in frame.visible_highlights} == {0, None}
    for spot in frame.visible_highlights:
        column, row = spot.peak_px.astype(int)
        assert frame.truth.instrument[row, column] == (0 if spot.instrument is None else 1)
        assert spot.to_json().get("instrument") == spot.instrument
        assert spot.glints == ()
    # Without instruments nothing says anything of them.
    plain = make_frame(described())
    assert [spot.instrument for spot in plain.visible_highlights] == [None]
    assert "instrument" not in plain.visible_highlights[0].to_json()


def test_files_hold_the_map_and_the_pose_and_none_of_it_without_instruments(tmp_path):
    write_frame(make_frame(described(SHAFT)), tmp_path / "with")
    write_frame(make_frame(described()), tmp_path / "without")
    arrays = [np.load(tmp_path / name / "truth.npz") for name in ("with", "without")]
    assert set(arrays[0]) - set(arrays[1]) == {"instrument"}
    assert arrays[0]["instrument"].any()
    assert arrays[0]["mask"][arrays[0]["instrument"] > 0].all()
    told = [json.loads((tmp_path / name / "frame.json").read_text(encoding="utf-8")) for name in ("with", "without")]
    assert "instrument" in told[0]["fields"]
    assert "instrument" not in json.dumps(told[1])
    # The plane z = 0 of the world is what the camera sees.
    pose = np.array(told[1]["world_from_camera"])
    points = arrays[1]["position_mm"].reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    assert np.abs(points[:, 2]).max() < 1e-4


# Sessions ------------------------------------------------------------------------------------------------------------


def test_absent_instruments_change_no_byte(session):
    session.update(described())
    plain, maps = session.frame(), session.truth()
    session.update(described({**SHAFT, "present": False}))
    absent = session.frame()
    assert absent.radiance.total.tobytes() == plain.radiance.total.tobytes()
    assert absent.labels.depth.tobytes() == plain.labels.depth.tobytes()
    assert session.truth().depth.tobytes() == maps.depth.tobytes()
    assert not session.truth().instrument.any()


BAD = {
    "over_camera": ({**SHAFT, "depth_mm": 1.0}, "instruments.0: lies .* mm over the camera"),
    "over_light": (
        {"tip": [0.9, 0.1], "depth_mm": 20.0, "azimuth_deg": -36.87, "tilt_deg": 80.0, "diameter_mm": 12.0},
        "over rig.lights.0",
    ),
    "ends_in_view": ({**SHAFT, "length_mm": 20.0}, "instruments.0.length_mm = 20: its end is seen"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_place_is_one_line_and_the_session_stays_at_its_scene(session, name):
    instrument, words = BAD[name]
    session.update(described(SHAFT))
    before = session.radiance().total.tobytes()
    with pytest.raises(InputError, match=words) as caught:
        session.update(described(instrument))
    assert "\n" not in str(caught.value)
    assert session.radiance().total.tobytes() == before


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("jaw_mm", 9.0, "belongs to a grasper"),
        ("depth_share", 0.5, "depth_mm and depth_share exclude each other"),
        ("length_mm", 11.0, "must be at least 12"),
    ],
)
def test_bad_instrument_is_one_line_with_its_key(key, value, words):
    with pytest.raises(InputError, match=words) as caught:
        described({**SHAFT, key: value})
    assert "\n" not in str(caught.value)
    assert "instruments.0" in str(caught.value)


def test_export_and_bounces_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"instruments\.0\.present = True: cannot be exported; .* must be false"):
        simtest.export(described(SHAFT), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match=r"render.path_depth = 3: .* must be 2 where instruments are present"):
        described(SHAFT, render={"path_depth": 3})
    assert described({**SHAFT, "present": False}, render={"path_depth": 3}).instruments


@pytest.mark.parametrize(("azimuth", "tilt", "roll"), [(30.0, 20.0, 40.0), (200.0, -10.0, 90.0), (75.0, 45.0, -60.0)])
def test_a_grasper_rolls_right_handed_about_its_shaft(azimuth, tilt, roll):
    held = {"kind": "grasper", "azimuth_deg": azimuth, "tilt_deg": tilt}
    level, turned = (Instrument(**held, roll_deg=each) for each in (0.0, roll))
    expected = Rotation.from_rotvec(np.radians(roll) * level.back).apply(level.side)
    np.testing.assert_allclose(turned.side, expected, atol=1e-12)
