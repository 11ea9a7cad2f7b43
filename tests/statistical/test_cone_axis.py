"""Statistics over noise: `cone_axis` and `circle_pose` at sigma 5 %, and the noise itself; levels are stated."""

from hashlib import sha256

import numpy as np
import pytest
from scipy import ndimage, stats

from simtest.detection import estimate_noise
from simtest.geometry import Camera
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.runtime.seeds import Stage, generator
from simtest.simulation.sensor import expose
from simtest.spec import scene_from_dict
from simtest.validation import laws
from tests.marked import marked

ALPHA = 0.01
"""Level of each test: with the seeds fixed, how surprising a pass or a rejection has to be."""

LIMIT_DEG = 0.02
REALISATIONS = 20
SIGMA = 0.05
D = 10.0


def surface(kind, ratio=1.0):
    tilt = {"tilt_deg": 10.0 if kind == "plane" else 0.5, "azimuth_deg": 30.0, "distance_mm": D}
    return {"type": kind, **tilt, **({} if kind == "plane" else {"radius_mm": ratio * D})}


class Bench:
    """Renders through one session and reconstructs noisy frames."""

    def __init__(self):
        self.session = Session(scene_from_dict({"surface": surface("plane")}))

    def render(self, shape, light=None):
        self.session.update(scene_from_dict({"surface": shape, "rig": {"lights": [light or {}]}}))
        radiance = self.session.radiance()
        (highlight,) = self.session.highlights(radiance)
        return radiance.total, highlight

    def errors(self, shape, light=None, camera=None):
        """Return the errors, deg, of each estimator over the realisations."""
        radiance, highlight = self.render(shape, light)
        camera = camera or self.session.camera
        found = {"cone_axis": [], "circle_pose": [], "brightest_point": []}
        for number in range(REALISATIONS):
            rng = generator(7, "statistics", str(shape), number, Stage.SENSOR)
            frame = expose(radiance, float(radiance.max()), SIGMA, rng)
            (specularity,) = reconstruct(frame, camera)
            for name, errors in found.items():
                errors.append(float(angle_deg(specularity.estimates[name].normal, highlight.normal)))
        return {name: np.array(errors) for name, errors in found.items()}, highlight


@pytest.fixture(scope="module")
def bench():
    return Bench()


def accepts(errors):
    """One-sided t test: the mean is below the limit at level ALPHA."""
    return stats.ttest_1samp(errors, LIMIT_DEG, alternative="less").pvalue < ALPHA


def rejects(errors):
    """The same test turned round: the mean is above the limit at level ALPHA."""
    return stats.ttest_1samp(errors, LIMIT_DEG, alternative="greater").pvalue < ALPHA


@pytest.mark.render
@pytest.mark.parametrize("kind", marked(["plane", "cylinder", "sphere"], ci=["cylinder", "sphere"]))
def test_cone_axis_stays_below_two_hundredths_of_a_degree(bench, kind):
    errors, _ = bench.errors(surface(kind))
    assert accepts(errors["cone_axis"])
    # The brightest pixel is worse by far: the test could not pass by chance.
    assert errors["brightest_point"].mean() > 5 * errors["cone_axis"].mean()


@pytest.mark.render
@pytest.mark.parametrize("kind", ["plane", pytest.param("cylinder", marks=pytest.mark.ci)])
@pytest.mark.parametrize("shift", [(0.5, 0.0), (0.0, -0.5)])
def test_half_a_pixel_is_noticed(bench, kind, shift):
    """Negative control: 0.5 px at f = 406 px is 0.07 deg."""
    K = Camera(406, 406, 406.0, 406.0, 203.0 + shift[0], 203.0 + shift[1])
    errors, _ = bench.errors(surface(kind), camera=K)
    assert not accepts(errors["cone_axis"])
    assert rejects(errors["cone_axis"])


@pytest.mark.render
def test_a_light_beside_the_camera_is_noticed(bench):
    """Negative control: 1 mm at 10 mm; the law says 2.9 deg."""
    errors, highlight = bench.errors(surface("cylinder"), light={"offset_mm": 1.0, "azimuth_deg": 45.0})
    assert rejects(errors["cone_axis"])
    light = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    law = float(np.degrees(laws.bisector_angle(highlight.position, light)))
    assert law == pytest.approx(2.86, abs=0.05)
    assert errors["cone_axis"].mean() == pytest.approx(law, rel=0.03)


@pytest.mark.render
@pytest.mark.parametrize("ratio", [pytest.param(10.0, marks=pytest.mark.ci), 1.0])
def test_circle_pose_follows_its_law(bench, ratio):
    errors, highlight = bench.errors(surface("cylinder", ratio))
    half_axes = laws.isophote_half_axes(0.5, 4 * 50.0, highlight.kd_min, highlight.kd_max)
    law = float(np.degrees(laws.circle_pose_error(*half_axes)))
    pose = errors["circle_pose"]
    # Equivalence: above law - 1 and below law + 1, each at level ALPHA.
    assert stats.ttest_1samp(pose, law - 1, alternative="greater").pvalue < ALPHA
    assert stats.ttest_1samp(pose, law + 1, alternative="less").pvalue < ALPHA


# Noise ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.1])
def test_noise_has_the_stated_mean_and_variance(sigma):
    signal = np.full((400, 400), 0.5, np.float32)
    noise = expose(signal * 3, 3.0, sigma, generator(0, "noise", "flat", 0, Stage.SENSOR)).astype(float) - 0.5
    count = noise.size
    assert abs(noise.mean()) < stats.norm.ppf(1 - ALPHA / 2) * sigma / np.sqrt(count)
    low, high = stats.chi2.ppf([ALPHA / 2, 1 - ALPHA / 2], count - 1) / (count - 1)
    assert low < noise.var(ddof=1) / sigma**2 < high
    # White and normal: no correlation of neighbours, no excess of the fourth moment.
    for shifted in (noise[1:] * noise[:-1], noise[:, 1:] * noise[:, :-1]):
        assert abs(shifted.mean()) < 3 * sigma**2 / np.sqrt(count)
    assert abs(stats.kurtosis(noise.ravel())) < 3 * np.sqrt(24 / count)


def test_no_noise_leaves_the_frame_as_it_is():
    signal = np.random.default_rng(0).random((30, 40), dtype=np.float32)
    np.testing.assert_array_equal(expose(signal, 1.0, 0.0, None), signal)
    np.testing.assert_array_equal(expose(signal, 0.0, 0.0, None), 0)


@pytest.mark.render
@pytest.mark.parametrize("kind", ["plane", "sphere"])
@pytest.mark.parametrize("sigma", [0.01, 0.05, 0.1])
def test_noise_is_estimated_from_a_frame_with_a_highlight(bench, kind, sigma):
    radiance, _ = bench.render(surface(kind, 0.5))
    for number in range(3):
        rng = generator(3, "noise", kind, number, Stage.SENSOR)
        assert estimate_noise(expose(radiance, float(radiance.max()), sigma, rng)) == pytest.approx(sigma, rel=0.03)


def test_estimated_noise_is_blind_to_what_is_smooth():
    x, y = np.meshgrid(np.linspace(-1, 1, 90), np.linspace(-1, 1, 70))
    assert estimate_noise(3 + 2 * x - y + x * y + 0.5 * x**2) < 1e-6
    noisy = np.random.default_rng(0).normal(0, 0.2, (90, 90))
    assert estimate_noise(5 * noisy) == pytest.approx(5 * estimate_noise(noisy), rel=1e-5)
    # Smoothed noise is not white: the estimate is meant for the frame before smoothing.
    assert estimate_noise(ndimage.gaussian_filter(noisy, 2)) < 0.1 * estimate_noise(noisy)
    assert estimate_noise(np.ones((2, 5))) == 0


def test_realisations_are_independent():
    signal = np.zeros((64, 64), np.float32)

    def noise(seed=0, experiment="e", case="c", realisation=0):
        return expose(signal, 1.0, 0.05, generator(seed, experiment, case, realisation, Stage.SENSOR))

    frames = [noise(realisation=i) for i in range(40)]
    frames += [noise(seed=1), noise(experiment="f"), noise(case="d"), noise(case="c | part 1")]
    assert len({sha256(frame.tobytes()).hexdigest() for frame in frames}) == len(frames)
    np.testing.assert_array_equal(noise(realisation=5), frames[5])
    correlations = np.corrcoef([frame.ravel() for frame in frames])
    off_diagonal = np.abs(correlations[np.triu_indices(len(frames), 1)])
    # 946 pairs: Bonferroni at level ALPHA.
    assert off_diagonal.max() < stats.norm.ppf(1 - ALPHA / 2 / len(off_diagonal)) / 64
