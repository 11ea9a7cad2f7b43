"""EndoMapper's photometric calibration: its own model, written out here, against a frame rendered with that light."""

from dataclasses import replace

import numpy as np
import pytest
from camera_texts import vicalib

from simtest import load_calibration, save_calibration
from simtest.calibration import NO_PRIORS
from simtest.calibration.photometry import AngularProfile
from simtest.calibration.priors import UNTOLD_FALLOFF_POWER
from simtest.rendering import Session
from simtest.simulation.sensor import capture, collect
from simtest.spec import camera_table, scene_from_dict

GAMMA, POWER, MU = 2.2, 2.5, 2.767302
P_M = np.array([-6.1e-05, -0.001135, -0.003612])
D = np.array([0.11, -0.04, 0.0])
D[2] = np.sqrt(1 - D @ D)

GEOMETRY = vicalib(
    "calibu_fu_fv_u0_v0_kb4",
    "143.5; 143.6; 146.9; 110.4; -0.1396589; -0.0003139987; 0.001505504; -0.0001316715",
    288,
    216,
)
PHOTOMETRY = f"""<rig>
    <camera>
        <camera_model index="0" name="" serialno="0" type="gamma" version="1.0">
            <!-- Camera response model -->
            <gamma> [ {GAMMA} ] </gamma>
            <vignetting> [ {POWER} ] </vignetting>
        </camera_model>
    </camera>
    <light>
        <light_model index="0" name="" serialno="0" type="sls" version="1.0">
            <sigma> 1.000000 </sigma>
            <mu> {MU} </mu>
            <P> [ {"; ".join(map(str, P_M))} ] </P>
            <D> [ {"; ".join(map(repr, D.tolist()))} ] </D>
        </light_model>
    </light>
</rig>
"""


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    folder = tmp_path_factory.mktemp("endomapper")
    (folder / "Endoscope_01_geometrical.xml").write_text(GEOMETRY)
    (folder / "Endoscope_01_photometrical.xml").write_text(PHOTOMETRY)
    made = load_calibration(
        folder / "Endoscope_01_geometrical.xml", folder / "Endoscope_01_photometrical.xml", view_radius_px=144.0
    )
    # Written as simtest's own file it is the same.
    save_calibration(made, folder / "scope.toml")
    again = load_calibration(folder / "scope.toml")
    assert (again.camera, again.response, again.vignetting) == (made.camera, made.response, made.vignetting)
    assert (again.emission_axis, again.priors) == (made.emission_axis, made.priors)
    np.testing.assert_allclose(again.falloff, made.falloff, rtol=1e-12)
    return made


def test_what_the_files_state(calibration):
    assert calibration.priors.lights_mm == (tuple((1000 * P_M).tolist()),)
    assert (calibration.response.kind, calibration.response.gamma) == ("gamma", GAMMA)
    assert calibration.vignetting.power == POWER
    np.testing.assert_allclose(calibration.emission_axis, D, atol=1e-15)
    angle = np.linspace(0, np.pi, 500)
    spread = np.exp(-MU * (1 - np.cos(angle)))
    np.testing.assert_allclose(calibration.emission.at(np.cos(angle), np.sin(angle)), spread, rtol=1e-4)
    # The light stands 1 mm beside the lens and 4 mm behind it: its falloff is not that of a light at the camera.
    assert calibration.priors.falloff_power == UNTOLD_FALLOFF_POWER


@pytest.mark.render
def test_radiance_is_recovered_from_a_frame_with_that_light(calibration):
    """Response and vignetting undone to 0.5 % where the vignetting is above 0.2; the light is EndoMapper's to 0.5 %."""
    camera = calibration.camera
    spread = {"type": "table", "angle_deg": np.degrees(calibration.emission.angles).tolist()}
    light = {
        "position_mm": (1000 * P_M).tolist(), "direction": D.tolist(),
        "profile": spread | {"value": calibration.emission.values},
    }  # fmt: skip
    tilt, distance = np.radians(20.0), 25.0
    scene = scene_from_dict(
        {
            "surface": {"type": "plane", "distance_mm": distance, "tilt_deg": 20.0, "azimuth_deg": 60.0},
            "camera": dict(camera_table(camera)),
            "reflectance": {"type": "phong", "specular": 0.0, "diffuse": 0.6},
            "rig": {"lights": [light]},
            "sensor": {
                "vignetting": {"type": "cosine", "power": POWER},
                "response": {"type": "gamma", "gamma": GAMMA},
                "bits": 16,
            },
        }
    )
    session = Session(scene)
    radiance = session.radiance().total
    truth = session.truth()
    # EndoMapper's model at each pixel: sigma e^(-mu (1 - D.L)) / d^2 cos(theta) albedo / pi
    normal = np.array([np.sin(tilt) * np.cos(np.pi / 3), np.sin(tilt) * np.sin(np.pi / 3), -np.cos(tilt)])
    rays = camera.unproject(camera.pixel_centres())
    points = rays * (distance * normal[2] / (rays @ normal))[..., None]
    away = points - 1000 * P_M
    d = np.linalg.norm(away, axis=-1)
    L = away / d[..., None]
    model = np.exp(-MU * (1 - L @ D)) / d**2 * -(L @ normal) * 0.6 / np.pi
    vignetting = np.where(np.isfinite(rays[..., 2]), rays[..., 2], 0.0).clip(0) ** POWER
    judged = truth.mask & (vignetting > 0.2)
    assert judged.mean() > 0.3
    np.testing.assert_allclose((radiance / model)[judged], 1.0, atol=0.005)
    # From the encoded frame back to radiance, whose scale the exposure sets.
    full_scale = float(radiance[judged].max()) * 1.05
    frame = capture(collect(radiance, scene.sensor, camera), full_scale, scene.sensor, None)
    emitted = np.exp(-MU * (1 - rays @ D))

    def off(light, spread=1.0, where=judged):
        """Return the largest relative error of light that is taken for radiance, once a spread is put back."""
        return float(np.abs((light * spread * full_scale)[where] / radiance[where] - 1).max())

    # The lens and the response alone: radiance, wherever the lens passes a fifth of the light.
    lens = replace(calibration, emission=AngularProfile())
    assert off(lens.correct(frame).intensity) < 0.005
    # The spread of a light at the camera too: as well, but for marked pixels, which less than 5 % of the light reaches.
    recovered = replace(calibration, priors=NO_PRIORS).correct(frame)
    inside = judged & ~recovered.limited
    assert inside.sum() > 0.9 * judged.sum()
    assert off(recovered.intensity, emitted, inside) < 0.005
    # Negative controls: without the vignetting, the response or the light's direction it is missed by far.
    assert off(frame**GAMMA) > 0.5
    with np.errstate(divide="ignore", invalid="ignore"):
        assert off(frame / vignetting) > 0.5
    assert off(recovered.intensity, np.exp(-MU * (1 - rays[..., 2])), inside) > 0.05
