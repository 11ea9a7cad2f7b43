"""True highlights: glints and clouds of a relief, the spots that can be seen, and verdicts.

A signal over noise is the height over the noise at its level, and 10 of them make a detection. Verdicts are those of
the scene: another number of pixels, or a mirrored or turned picture, changes none.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial import cKDTree

from simtest.conventions import DEFAULT_SMOOTHING_PX, HIGHLIGHT_ISOVALUE
from simtest.geometry import smooth
from simtest.rendering import HighlightPoint, Session, highlights
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import Examined, describe, examine, find_spots, glints_of, verdicts
from simtest.spec import load_scene, scene_from_dict

CAMERA = {"width": 200, "height": 160, "fx": 200.0, "fy": 200.0, "cx": 100.0, "cy": 80.0}
SURFACES = {
    "plane": {"type": "plane", "distance_mm": 20, "tilt_deg": 10},
    "inside": {"type": "cylinder", "distance_mm": 20, "radius_mm": 40, "side": "inside"},
    "sphere": {"type": "sphere", "distance_mm": 20, "radius_mm": 30},
}
RELIEF = {"bands": [{"slope_deg": 5.0, "wavelength_mm": 1.5}], "seed": 3}


def scene(surface, relief=RELIEF, **more):
    rough = {} if relief is None else {"relief": relief}
    return scene_from_dict({"surface": {**SURFACES[surface], **rough}, "camera": CAMERA, **more})


@pytest.fixture(scope="module")
def sessions():
    return {name: Session(scene(name)) for name in SURFACES}


def glints_in(session):
    """Pixels of the glints of the only light."""
    return highlights.find_zeros(session, True)[0]


def off_zero(session, pixels, light):
    """Angle between fine normal and bisector, rad, from the points alone."""
    points = session.exact_points(pixels)
    to_camera = -points.position / np.linalg.norm(points.position, axis=1, keepdims=True)
    to_light = light - points.position
    to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
    bisector = to_camera + to_light
    bisector /= np.linalg.norm(bisector, axis=1, keepdims=True)
    return np.linalg.norm(points.normal - bisector, axis=1)


@pytest.mark.parametrize("surface", SURFACES)
def test_every_glint_is_a_zero(sessions, surface):
    session = sessions[surface]
    pixels = glints_in(session)
    assert len(pixels) >= 5
    assert off_zero(session, pixels, np.zeros(3)).max() < 1e-8
    assert off_zero(session, pixels + 0.5, np.zeros(3)).max() > 1e-3


@pytest.mark.parametrize(
    "surface", ["plane", pytest.param("inside", marks=pytest.mark.slow), pytest.param("sphere", marks=pytest.mark.slow)]
)
def test_search_finds_what_an_exhaustive_one_finds(sessions, surface):
    """Every sign change of the misfit on a grid of quarter pixels, followed by bisection of boxes, is a found glint."""
    session = sessions[surface]
    found = glints_in(session)
    missing = [zero for zero in boxed_zeros(session) if np.linalg.norm(found - zero, axis=1).min() > 0.3]
    assert missing == []


RIDGED = {"bands": [{"kind": "ridged", "slope_deg": 6.0, "wavelength_mm": 1.0}], "seed": 6}
PITS = {"bands": [{"kind": "ridged", "slope_deg": 5.5, "wavelength_mm": 2.0},
                  {"kind": "pits", "slope_deg": 4.0, "wavelength_mm": 0.7}], "seed": 4}  # fmt: skip


@pytest.mark.parametrize("relief", [RIDGED, pytest.param(PITS, marks=pytest.mark.ci)])
def test_creases_hide_no_glint_that_a_grid_twice_as_fine_finds(relief, monkeypatch):
    """The normal turns fastest at ridges and at the rims of pits; the glints there are the smallest."""
    session = Session(scene("inside", relief))
    found = glints_in(session)
    for name in ("GRID_WAVE", "MAX_DIVISION"):
        monkeypatch.setattr(highlights, name, 2 * getattr(highlights, name))
    finer = glints_in(session)
    assert len(finer) > 100
    assert cKDTree(found).query(finer)[0].max() < 0.05
    assert cKDTree(finer).query(found)[0].max() < 0.05


FINE = {"bands": [{"slope_deg": 5.0, "wavelength_mm": 0.4}], "seed": 3}
"""Its waves span four pixels: they are divided."""


@pytest.fixture(scope="module")
def divided():
    return Session(scene("plane", FINE))


def test_search_by_tiles_is_that_of_the_whole_divided_frame(divided, monkeypatch):
    found = glints_in(divided)
    tiles = highlights.tiles_near_zeros(divided.misfits().fine[0])
    assert len(found) > 50
    assert 0 < len(tiles) < 0.7 * (CAMERA["width"] / 4 + 1) * (CAMERA["height"] / 4 + 1)
    monkeypatch.setattr(highlights, "VARIES", np.inf)
    assert len(highlights.tiles_near_zeros(divided.misfits().fine[0])) == 51 * 41
    assert glints_in(divided).tobytes() == found.tobytes()
    # Too strict a choice loses some.
    monkeypatch.setattr(highlights, "VARIES", -0.4)
    assert len(glints_in(divided)) < len(found)


def test_tiles_hold_the_frames_own_misfits(divided):
    maps = divided.misfits()
    corners = np.array([[0, 0], [196, 156], [64, 32], [100, 8]])
    lights = np.zeros(4, dtype=int)
    tiles = divided.tile_misfits(lights, 1, corners, 4)
    for number, (column, row) in enumerate(corners + maps.margin - 1):
        expected = maps.fine[0][:, row : row + 6, column : column + 6]
        np.testing.assert_allclose(tiles[:, number], expected, rtol=0, atol=1e-6)
    # Of pixels cut in three, the middle cells have the pixels' own centres.
    middle = divided.tile_misfits(lights, 3, corners, 4)[:, :, 2:-1:3, 2:-1:3]
    np.testing.assert_allclose(middle, tiles[:, :, 1:-1, 1:-1], rtol=0, atol=2e-4)


def boxed_zeros(session, size=0.25):
    """Find the pixels near which both components of the misfit change sign round the border of a cell: winding 1."""
    y, x = np.mgrid[1 : CAMERA["height"] - 1 : size, 1 : CAMERA["width"] - 1 : size]
    corners = np.stack([x, y], axis=-1)
    points = session.exact_points(corners.reshape(-1, 2))
    to_camera = -points.position / np.linalg.norm(points.position, axis=1, keepdims=True)
    gap = (points.normal - to_camera)[:, :2].reshape(*x.shape, 2)
    angle = np.arctan2(gap[..., 1], gap[..., 0])
    ring = [angle[:-1, :-1], angle[:-1, 1:], angle[1:, 1:], angle[1:, :-1]]
    turns = sum(np.angle(np.exp(1j * (b - a))) for a, b in zip(ring, ring[1:] + ring[:1], strict=True))
    rows, columns = np.nonzero(np.abs(turns) > np.pi)
    return corners[rows, columns] + size / 2


def test_glints_know_their_base_normal_and_cloud(sessions):
    session = sessions["plane"]
    view = render_view(session, session.scene)
    assert len(view.clouds) == 1
    tilt = np.radians(10)
    for glint in view.highlights:
        assert glint.cloud == 0
        assert abs(np.arccos(-glint.normal_base[2]) - tilt) < 1e-9
    # The cloud's centre is the point whose base normal looks at the camera.
    sightline = session.camera.unproject(view.clouds[0].bp_px[None])[0]
    assert np.allclose(-sightline, view.clouds[0].normal, atol=1e-7)


def test_two_lights_have_two_clouds():
    rig = {"lights": [{"position_mm": [-6, 0, 0]}, {"position_mm": [6, 0, 0]}]}
    session = Session(scene("plane", rig=rig))
    view = render_view(session, session.scene)
    assert [centre.light for centre in view.clouds] in ([0, 1], [1, 0])
    for glint in view.highlights:
        assert view.clouds[glint.cloud].light == glint.light


def test_a_smooth_highlight_is_its_own_cloud():
    session = Session(scene("sphere", None))
    view = render_view(session, session.scene)
    (highlight,) = view.highlights
    assert highlight.cloud == 0
    assert view.clouds[0] is highlight
    (spot,) = view.visible_highlights
    assert spot.glints == (0,)
    assert spot.radius_px == pytest.approx(highlight.radius_px, rel=0.05)


def test_unresolved_relief_has_no_list_of_glints():
    relief = {"bands": [{"slope_deg": 3.0, "wavelength_mm": 0.05}]}
    session = Session(scene("plane", relief))
    assert len(glints_in(session)) == 0
    # It acts as roughness: the highlight is the base's, and its fine normal is anyone's.
    (point,) = session.highlights(session.radiance())
    sightline = session.camera.unproject(point.bp_px[None])[0]
    assert np.allclose(point.normal, -sightline, atol=1e-6)
    (centre,) = session.base_highlights(session.radiance())
    assert np.array_equal(centre.bp_px, point.bp_px)


def test_a_fine_band_without_slope_hides_no_glints():
    bands = [{"slope_deg": 4.0, "wavelength_mm": 2.0}, {"slope_deg": 0.1, "wavelength_mm": 0.1}]
    both, alone = (
        len(glints_in(Session(scene("plane", {"bands": bands[:n], "seed": 3})))) for n in (2, 1)
    )  # fmt: skip
    assert both >= alone > 5


@pytest.mark.slow
def test_glints_on_a_users_mesh():
    """Hits on triangles are single precision; the search must not depend on it."""
    path = Path(__file__).parents[3] / "shared" / "data" / "meshes" / "colon_edingca_00090.ply"
    if not path.exists():
        pytest.skip(f"no {path.name}: reference data is not part of the repository")
    surface = {"type": "anatomy", "path": str(path), "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 1.5}]}}
    session = Session(scene_from_dict({"surface": surface, "camera": CAMERA}))
    found = glints_in(session)
    assert len(found) >= 10
    assert off_zero(session, found, np.zeros(3)).max() < 1e-8
    zeros = boxed_zeros(session, 0.5)
    missing = [zero for zero in zeros if np.linalg.norm(found - zero, axis=1).min() > 0.5]
    # Creases of the mesh hold some.
    assert len(missing) <= 0.05 * len(zeros)


def bump(shape, row, column, width, height=1.0):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return height * np.exp(-((y - row) ** 2 + (x - column) ** 2) / (2 * width**2))


def test_spots_need_a_saddle_below_four_fifths():
    shape = (60, 120)
    # Two equal bumps 2 a apart, of deviation w, have the saddle 2 exp(-a^2/(2 w^2)) at the middle.
    apart = bump(shape, 30, 40, 5) + bump(shape, 30, 60, 5, 0.9)
    melted = bump(shape, 30, 44, 5) + bump(shape, 30, 55, 5, 0.95)
    assert len(find_spots(apart, apart).rows) == 2
    assert len(find_spots(melted, melted).rows) == 1


def test_spots_shine():
    shape = (60, 80)
    lobe = bump(shape, 30, 20, 3)
    matt = bump(shape, 30, 60, 8)
    spots = find_spots(0.2 + lobe + matt, lobe)
    assert [(int(r), int(c)) for r, c in zip(spots.rows, spots.columns, strict=True)] == [(30, 20)]
    assert spots.regions.max() == 1
    assert abs(np.sum(spots.regions == 1) - 2 * np.pi * np.log(2) * 9) < 6


def test_light_behind_a_dip_is_no_part_of_a_spot():
    """A dip below half of the peak, but no saddle: what lies behind it belongs to no spot, beside a dimmer one too."""
    light = np.full((11, 40), 0.1)
    light[5, 5:30] = np.interp(np.arange(25), [0, 4, 12, 14, 24], [0.6, 1.0, 0.49, 0.53, 0.2])
    light[5, 33:38] = 0.2, 0.3, 0.4, 0.3, 0.2
    spots = find_spots(light, light)
    assert (spots.rows.tolist(), spots.columns.tolist()) == ([5, 5], [9, 35])
    assert np.flatnonzero(spots.regions[5] == 1).max() == 16


def test_equal_spots_are_numbered_row_by_row():
    shape = (60, 120)
    lobe = bump(shape, 40, 20, 3) + bump(shape, 12, 90, 3) + bump(shape, 12, 30, 3)
    spots = find_spots(lobe, lobe)
    assert [(int(r), int(c)) for r, c in zip(spots.rows, spots.columns, strict=True)] == [(12, 30), (12, 90), (40, 20)]
    assert [int(spots.regions[r, c]) for r, c in zip(spots.rows, spots.columns, strict=True)] == [1, 2, 3]


def test_a_dark_frame_has_no_spots():
    assert len(find_spots(np.zeros((20, 20)), np.zeros((20, 20))).rows) == 0


def test_what_the_lens_spreads_beyond_the_view_mask_is_no_part_of_a_spot():
    y, x = np.mgrid[:40, :40]
    seen = x < 25
    lobe = smooth((np.exp(-((x - 27) ** 2 + (y - 20) ** 2) / 30) * seen).astype(np.float32), 3.0)
    assert not find_spots(lobe, lobe, seen).regions[~seen].any()


def test_spot_shape():
    y, x = np.mgrid[:80, :100]
    lobe = np.exp(-((x - 50.25) ** 2 / (2 * 8.0**2) + (y - 40.0) ** 2 / (2 * 4.0**2)))
    (shape,) = describe(find_spots(lobe, lobe), lobe, lobe, np.zeros(1), [])
    assert shape.area_px == pytest.approx(2 * np.pi * np.log(2) * 32, rel=0.03)
    assert shape.centroid_px == pytest.approx([50.75, 40.5], abs=0.05)
    assert shape.axis_ratio == pytest.approx(0.5, rel=0.02)
    assert shape.whole
    for turns in range(4):
        cut = np.rot90(lobe[:, 50:], turns)
        assert not describe(find_spots(cut, cut), cut, cut, np.zeros(1), [])[0].whole


@pytest.mark.parametrize(("sigma", "snr"), [(0.0, np.inf), (0.1, 10.0)])
def test_a_spot_on_clipped_light_stands_above_nothing(sigma, snr):
    """Its pixels and those around have the value at which the sensor's end, with noise or without."""
    lobe = bump((60, 80), 30, 40, 5)
    spots = find_spots(1 + lobe, lobe)
    for clip, expected in ((3.0, snr), (1.0, 0.0)):
        (spot,) = describe(spots, 1 + lobe, lobe, np.array([sigma]), [], clip=clip)
        assert spot.peak_snr == pytest.approx(expected)


def test_spots_hold_the_glints_in_them(sessions):
    session = sessions["inside"]
    view = render_view(session, session.scene)
    held = [number for spot in view.visible_highlights for number in spot.glints]
    assert len(held) == len(set(held))
    assert all(view.highlights[number].lit for number in held)
    # Glints are brighter where they are listed first.
    for spot in view.visible_highlights:
        values = [view.highlights[number].radiance for number in spot.glints]
        assert values == sorted(values, reverse=True)
    assert glints_of(find_spots(np.zeros((9, 9)), np.zeros((9, 9))), view.highlights) == []


FRONTAL = {
    "surface": {"type": "plane", "distance_mm": 20.0}, "camera": {"width": 96, "height": 96, "fx": 160.0, "fy": 160.0},
}  # fmt: skip
FILM = {"type": "tissue", "film": {"index": 1.36, "alpha": 0.05, "distribution": "beckmann"}, "diffuse": 0.0}


@pytest.mark.parametrize(
    ("lobe", "within"),
    [*(({"type": "phong", "exponent": n, "diffuse": 0.0}, 0.05) for n in (100.0, 10000.0)), (FILM, 0.05),
     # Its long tails are no Gaussian's.
     ({**FILM, "film": {"index": 1.36, "alpha": 0.03}}, 0.15)],
)  # fmt: skip
@pytest.mark.parametrize("radius_mm", [0.5, 1.5])
def test_a_source_of_finite_size_widens_the_radius(lobe, within, radius_mm):
    source = {"type": "disc", "radius_mm": radius_mm}
    seen = scene_from_dict({**FRONTAL, "reflectance": lobe, "rig": {"lights": [{"source": source}]}})
    view = render_view(Session(seen), seen)
    [highlight], [spot] = view.highlights, view.visible_highlights
    assert highlight.radius_px == pytest.approx(spot.radius_px, rel=within, abs=0.3)


def test_relief_that_is_not_resolved_widens_the_radius():
    surface = {**FRONTAL["surface"], "relief": {"bands": [{"slope_deg": 4.0, "wavelength_mm": 0.02}], "seed": 0}}
    more = {"reflectance": FILM, "surface": surface, "render": {"samples_per_pixel": 100}}
    seen = scene_from_dict({**FRONTAL, **more})
    view = render_view(Session(seen), seen)
    [highlight] = view.highlights
    # Waves leave some noise.
    lobe = ndimage.gaussian_filter(view.radiance.specular, 2.0)
    radius = np.sqrt(np.count_nonzero(lobe > 0.5 * lobe.max()) / np.pi)
    assert radius > 12
    assert highlight.radius_px == pytest.approx(radius, rel=0.1)


# Verdicts -------------------------------------------------------------------------------------------------------------


NORMAL = np.array([0.0, 0.0, -1.0])
POINT = HighlightPoint(
    light=0, bp_px=np.array([5.0, 5.0]), position=-10 * NORMAL, normal=NORMAL, direction_min=np.array([1.0, 0.0, 0.0]),
    distance=10.0, kd_min=0.0, kd_max=0.0, normal_base=NORMAL, kd_min_base=0.0, kd_max_base=0.0, pool=False, lit=True,
    radiance=1.0,
)  # fmt: skip

SMALL = {"camera.width": 160, "camera.height": 120, "camera.fx": 160.0, "camera.fy": 160.0}


def judged(height, sigma, level=2.0, **clip):
    examined = Examined(peak=(5, 5), level=level, height=height, why_not="")
    (found,) = verdicts([POINT], [examined], np.array([sigma]), **clip)
    return found


def test_the_snr_is_the_height_over_the_noise():
    assert judged(1.0, 0.02).peak_snr == pytest.approx(50, rel=1e-6)
    assert judged(0.0, 0.0).peak_snr == 0
    assert judged(1.0, 0.0).peak_snr == np.inf


@pytest.mark.parametrize(("sigmas", "isolated"), [(9.9, False), (10.1, True)])
def test_ten_sigma_make_a_detection(sigmas, isolated):
    found = judged(0.04 * sigmas, 0.04)
    assert (found.why_not == "") is isolated
    assert found.why_not in ("", "peak below 10 sigma")


def test_light_counts_up_to_the_clip():
    assert judged(1.0, 0.02, clip=1.5).peak_snr == pytest.approx(25, rel=1e-6)
    assert judged(1.0, 0.02, clip=0.5).peak_snr == 0
    assert judged(1.0, 0.0, clip=0.5).why_not == "peak below 10 sigma"


def test_on_a_relief_an_isolated_highlight_holds_one_lit_glint_alone():
    y, x = np.mgrid[:60, :80] + 0.5
    light = np.exp(-((x - 40) ** 2 + (y - 30) ** 2) / 72).astype(np.float32)
    pair = [replace(POINT, bp_px=np.array(at)) for at in ((40.2, 30.1), (43.0, 31.0))]

    def told(points, single):
        return [own.why_not for own in examine(points, light, single=single)]

    assert told(pair, True) == ["holds several glints", "part of a brighter one"]
    assert told(pair, False) == ["", "part of a brighter one"]
    assert told([pair[0], replace(pair[1], lit=False)], True) == ["", "in shadow"]


@pytest.mark.render
@pytest.mark.parametrize("gain", [1.0, 2.0, 3.0])
def test_a_highlight_on_tissue_whose_red_is_clipped_stands_as_high_as_its_channels_show(gain):
    red = {"type": "phong", "specular": 0.2, "diffuse": 0.8, "colour": [0.9, 0.1, 0.1]}
    sensor = {"saturation": True, "full_well": 2000, "exposure": {"gain": gain}}
    scene = load_scene("sphere", {**SMALL, "reflectance": red, "sensor": sensor})
    view = render_view(Session(scene), scene)
    (highlight,), spot = view.highlights, view.visible_highlights[0]
    column, row = spot.peak_px.astype(int)
    light, lobe = view.light[row, column] / view.full_scale, view.radiance.specular[row, column] / view.full_scale
    height = (np.minimum(light, 1) - np.minimum(light - lobe, 1)).mean()
    sigma = np.sqrt(min(light.mean(), 1) / 2000 / 3)
    for snr in (highlight.peak_snr, spot.peak_snr):
        assert snr == pytest.approx(height / sigma, rel=0.15)


@pytest.mark.render
def test_a_white_frame_shows_no_highlight():
    scene = load_scene("plane", {**SMALL, "reflectance.diffuse": 0.5, "sensor.saturation": True,
                                 "sensor.exposure.gain": 100.0})  # fmt: skip
    view = render_view(Session(scene), scene)
    assert (view.frame(0) > 0.9).all()
    assert [own.why_not for own in view.highlights] == ["peak below 10 sigma"]
    assert [spot.peak_snr for spot in view.visible_highlights] == pytest.approx([0.0])


def sloped(width):
    """A plane whose base, vignetting and emission move the frame's maximum by degrees from the lobe's."""
    cosine = {"type": "cosine", "power": 4.0}
    return scene_from_dict({
        "surface": {"type": "plane", "distance_mm": 12, "tilt_deg": 25.0, "azimuth_deg": 0.0},
        "camera": {"width": width, "height": 3 * width // 4, "fx": 0.8 * width, "fy": 0.8 * width},
        "reflectance": {"type": "phong", "exponent": 40.0, "diffuse": 0.5},
        "rig": {"lights": [{"position_mm": [4.0, 0.0, 0.0], "profile": cosine}]},
        "sensor": {"vignetting": cosine, "noise_sigma": 0.01},
    })  # fmt: skip


@pytest.mark.render
def test_verdict_and_snr_do_not_depend_on_the_number_of_pixels():
    found = []
    for width in (200, 400, 800):
        [highlight] = render_view(Session(sloped(width)), sloped(width)).highlights
        found.append((highlight.why_not, highlight.peak_snr))
    assert [why_not for why_not, _ in found] == ["", "", ""]
    assert [snr for _, snr in found] == pytest.approx([found[0][1]] * 3, rel=0.03)


place = st.tuples(st.floats(0.05, 0.95), st.floats(0.05, 0.95), st.floats(1.5, 9.0), st.floats(0.1, 1.0))


@given(lobes=st.lists(place, min_size=1, max_size=5), slope=st.floats(0, 0.01), single=st.booleans())
@settings(max_examples=50, deadline=None)
def test_verdicts_turn_with_the_picture(lobes, slope, single):
    height, width = 60, 90
    y, x = np.mgrid[:height, :width] + 0.5
    light = slope * (x + 0.7 * y)
    points = []
    for across, down, radius, peak in lobes:
        at = np.array([across * width, down * height])
        light = light + peak * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * radius**2))
        points.append(replace(POINT, bp_px=at))

    def judged_as(picture, moved):
        turned = [replace(point, bp_px=moved(*point.bp_px)) for point in points]
        return [(own.why_not, own.height) for own in examine(turned, picture.astype(np.float32), single=single)]

    # A pixel at half height to rounding is inside in one picture and outside in another.
    smoothed = smooth(light.astype(np.float32), DEFAULT_SMOOTHING_PX)
    for own in examine(points, light.astype(np.float32), single=single):
        assume(np.abs(smoothed / (HIGHLIGHT_ISOVALUE * own.level) - 1).min() > 1e-6)
    straight = judged_as(light, lambda x, y: np.array([x, y]))
    for other in (
        judged_as(light[:, ::-1], lambda x, y: np.array([width - x, y])),
        judged_as(np.rot90(light), lambda x, y: np.array([y, width - x])),
    ):
        assert [why_not for why_not, _ in other] == [why_not for why_not, _ in straight]
        for (_, one), (_, two) in zip(straight, other, strict=True):
            assert (one is None) == (two is None)
            assert one is None or two == pytest.approx(one, rel=1e-4, abs=1e-6)
