"""Signal over noise of true highlights: the height over the noise at its level, and 10 of them make a detection."""

import numpy as np
import pytest

from simtest.calibration import NoiseModel
from simtest.rendering import HighlightPoint
from simtest.simulation.true_highlights import Examined, verdicts

NORMAL = np.array([0.0, 0.0, -1.0])
POINT = HighlightPoint(
    light=0, bp_px=np.array([5.0, 5.0]), position=-10 * NORMAL, normal=NORMAL, direction_min=np.array([1.0, 0.0, 0.0]),
    distance=10.0, kd_min=0.0, kd_max=0.0, normal_base=NORMAL, kd_min_base=0.0, kd_max_base=0.0, pool=False, lit=True,
    radiance=1.0,
)  # fmt: skip


def judged(height, noise, level=2.0, full_scale=4.0, channels=1):
    (found,) = verdicts([POINT], [Examined(level=level, height=height, why_not="")], noise, full_scale, channels)
    return found


@pytest.mark.parametrize("channels", [1, 3])
def test_the_snr_is_the_height_over_the_noise_at_its_level(channels):
    # Half of full scale: white noise and that of 250 electrons of 500.
    sigma = 4.0 * np.sqrt((0.01**2 + 0.5 / 500) / channels)
    assert judged(1.0, NoiseModel(0.01, 500.0), channels=channels).peak_snr == pytest.approx(1 / sigma, rel=1e-6)
    assert judged(0.0, NoiseModel()).peak_snr == 0
    assert judged(1.0, NoiseModel()).peak_snr == np.inf


@pytest.mark.parametrize(("sigmas", "isolated"), [(9.9, False), (10.1, True)])
def test_ten_sigma_make_a_detection(sigmas, isolated):
    found = judged(4.0 * 0.01 * sigmas, NoiseModel(0.01))
    assert (found.why_not == "") is isolated
    assert found.why_not in ("", "peak below 10 sigma")
