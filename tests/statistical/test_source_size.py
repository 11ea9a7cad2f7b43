"""Sources of finite size: highlight widths against numerical convolution, frames against Mitsuba's own area light."""

import numpy as np
import pytest
from scipy import stats

import simtest
from simtest.rendering import Session, plugins
from simtest.spec import scene_from_dict
from studies.source_size import Case, measure, scene

pytestmark = [pytest.mark.render, pytest.mark.slow]

BOUND = 0.03

CASES = [
    Case("phong", 200.0, 20.0, 1.5),
    Case("phong", 800.0, 10.0, 3.0),
    Case("ggx", 0.1, 10.0, 3.0),
    Case("ggx", 0.05, 20.0, 3.0),
]


@pytest.fixture(scope="module")
def session():
    return Session(scene(CASES[0], CASES[0].radius, 1, 0.5))


@pytest.mark.parametrize("case", CASES, ids=str)
def test_widths_are_those_of_numerical_convolution(session, case):
    """Within 3 %, from fixed points and from drawn ones; a point light's width is refuted."""
    row = measure(session, case)
    assert abs(row.fixed / row.expected - 1) < BOUND
    assert abs(row.drawn / row.expected - 1) < BOUND
    assert abs(row.point / row.expected - 1) > BOUND
    if case.lobe == "phong":
        # The disc adds (r / 4 d)^2 to the variance of the half-angle; the rest is the cut at the frame's rim.
        assert row.added == pytest.approx(1, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("lobe", ["phong", "rough plastic"])
def test_frames_are_those_of_mitsubas_area_light(session, tmp_path, lobe):
    """Blocks of 6 x 6 pixels by z-scores from independent seeds, and the same frames of a disc 10 % smaller refuted."""
    reflectances = {
        "phong": {"type": "phong", "exponent": 60.0, "diffuse": 0.3},
        "rough plastic": {"type": "rough_plastic", "alpha": 0.15},
    }
    seeds, block = 10, 6

    def described(radius, seed=0):
        light = {
            "position_mm": [1.5, -1.0, -0.8], "direction": [-0.15, 0.1, 1.0], "power": 2.0,
            "profile": {"type": "cosine", "power": 1.0}, "source": {"type": "disc", "radius_mm": radius},
        }  # fmt: skip
        return scene_from_dict(
            {
                "surface": {"type": "sphere", "radius_mm": 9.0, "tilt_deg": 10.0}, "reflectance": reflectances[lobe],
                "rig": {"lights": [light]}, "camera": {"width": 72, "height": 60, "fx": 60.0, "fy": 60.0},
                "render": {"samples_per_pixel": 64, "seed": seed},
            }
        )  # fmt: skip

    def blocks(image):
        image = image if image.ndim == 2 else image.mean(axis=-1)
        height, width = image.shape
        return image.astype(float).reshape(height // block, block, width // block, block).mean(axis=(1, 3)).ravel()

    def ours(radius):
        frames = []
        for seed in range(seeds):
            session.update(described(radius, seed))
            frames.append(blocks(session.radiance().total))
        return np.array(frames)

    def scores(frames):
        error = np.sqrt((frames.var(axis=0, ddof=1) + theirs.var(axis=0, ddof=1)) / seeds)
        lit = theirs.mean(axis=0) > 1e-3 * theirs.mean()
        return ((frames.mean(axis=0) - theirs.mean(axis=0))[lit]) / error[lit]

    plugins.register()
    file = simtest.export(described(3.0), tmp_path)[0]
    loaded = session.mi.load_file(str(file))
    theirs = np.array([blocks(np.array(session.mi.render(loaded, spp=512, seed=100 + seed))) for seed in range(seeds)])
    right, wrong = scores(ours(3.0)), scores(ours(2.7))
    # The largest of all blocks by Bonferroni, Student's t of both samples.
    limit = stats.t.ppf(1 - 0.005 / len(right), 2 * seeds - 2)
    assert len(right) > 50
    assert np.abs(right).max() < limit
    assert np.abs(right.mean()) < 4 / np.sqrt(len(right))
    assert np.abs(wrong).max() > limit
