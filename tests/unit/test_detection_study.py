from pathlib import Path

import numpy as np
import pytest

from simtest.calibration import srgb_encode
from simtest.detection.detector import Kind
from simtest.reconstruction import reconstruct
from simtest.rendering import Session
from simtest.spec import load_scene
from studies.detection.frames import SPLITS, study_frames
from studies.detection.truth import specular_truth

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.render
def test_detection_keeps_its_promise(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    from studies.detection.__main__ import figures

    shown = {figure.name: figure for figure in figures(frames=18)}
    assert all(figure.met for figure in shown.values()), shown
    assert shown["F1, simtest, all"].limit == 0.90
    assert shown["Dice, simtest, all"].limit == 0.85


@pytest.mark.slow
@pytest.mark.render
def test_study_frames_are_the_same_again_and_their_anatomies_disjoint(tmp_path):
    first = [next(study_frames("tuning", 6, tmp_path / f"{k}")) for k in range(2)]
    np.testing.assert_array_equal(first[0].picture, first[1].picture)
    frame = first[0]
    assert frame.name == f"colon_{SPLITS['tuning']}-0"
    assert abs(SPLITS["figures"] - SPLITS["tuning"]) > 100
    truth = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen)
    wider = specular_truth(frame.specular, frame.other, frame.noise, frame.camera.seen, peak_share=0.05)
    assert truth.count > 0
    # Less of the peak is asked for: the mask can only grow, by highlights too that were too small before.
    assert not (truth.mask & ~(wider.mask | wider.unclear)).any()


@pytest.mark.render
@pytest.mark.parametrize("radius", [4.0, 30.0])
def test_normals_through_a_clipped_8_bit_picture_of_a_tilted_sphere(radius):
    settings = {"surface.radius_mm": radius, "surface.tilt_deg": 15.0, "surface.azimuth_deg": 40.0,
                "reflectance.diffuse": 0.5}  # fmt: skip
    scene = load_scene("sphere", settings)
    session = Session(scene)
    radiance = session.radiance()
    (truth,) = [h for h in session.highlights(radiance) if h.lit]
    tissue = radiance.diffuse[:, :, None] * np.array([1.0, 0.5, 0.4], dtype=np.float32)
    linear = tissue / (2.5 * tissue.max()) + radiance.specular[:, :, None] / (0.7 * radiance.specular.max())
    linear += np.random.default_rng(0).normal(0, 0.004, linear.shape)
    picture = (np.rint(255 * srgb_encode(np.clip(linear, 0, 1))) / 255).astype(np.float32)
    made = reconstruct(picture, session.camera, detector="colour", encoding="srgb")
    (spot,) = made
    assert made.detection.highlights[0].kind is Kind.ISOLATED
    for name, most in (("cone_axis", 0.1), ("brightest_point", 0.5)):
        estimate = spot.estimates[name]
        assert np.degrees(np.arccos(min(1.0, estimate.normal @ truth.normal))) < most
