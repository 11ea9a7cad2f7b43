"""Signal over noise of true highlights: the height over the noise at its level, and 10 of them make a detection.

And verdicts are those of the scene: another number of pixels, or a mirrored or turned picture, changes none.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simtest.rendering import HighlightPoint, Session
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import Examined, examine, verdicts
from simtest.spec import load_scene, scene_from_dict

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

    straight = judged_as(light, lambda x, y: np.array([x, y]))
    for other in (
        judged_as(light[:, ::-1], lambda x, y: np.array([width - x, y])),
        judged_as(np.rot90(light), lambda x, y: np.array([y, width - x])),
    ):
        assert [why_not for why_not, _ in other] == [why_not for why_not, _ in straight]
        for (_, one), (_, two) in zip(straight, other, strict=True):
            assert (one is None) == (two is None)
            assert one is None or two == pytest.approx(one, rel=1e-4, abs=1e-6)
