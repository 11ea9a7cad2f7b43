"""Checks of the calibrations that are written."""

import numpy as np

from simtest.calibration import Calibration
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec import load_calibration
from studies.corners import formulas
from studies.corners.case import Case, Faults
from studies.corners.scenes import EMISSION_POWER, VIGNETTING_POWER


def calibration(case: Case) -> Faults:
    """Check that the calibration file beside a rendered picture, read back, says what the scene says."""
    write_frame(make_frame(case.scene), case.folder / "frame")
    read, given = load_calibration(case.folder / "frame" / "calibration.toml"), case.seen.calibration
    faults, sensor = [], case.tables["sensor"]
    camera, tables = read.camera, case.camera
    pixels = formulas.pixel_centres(tables)[::7, ::7].reshape(-1, 2)
    rays = formulas.sightlines(tables, pixels)
    gaps = np.abs(camera.unproject(pixels) - rays).max(), 1e-3 * np.abs(camera.project(rays) - pixels).max()
    if not max(gaps) < 1e-9:
        faults.append("camera: its sightlines are not those of the scene")
    if (camera.width, camera.height) != (tables["width"], tables["height"]):
        faults.append("camera: another size")
    # Response and bits are those of the picture that is written.
    encodes = "bits" in sensor or "response" in sensor
    kind = "srgb" if "response" in sensor or not encodes else "linear"
    if (read.response is None or read.response.kind) != kind:
        faults.append(f"response: {read.response}, written as {kind}")
    if read.noise.bits != (sensor.get("bits") if encodes else 8):
        faults.append(f"sensor.bits: {read.noise.bits}")
    if (read.noise.full_well, read.noise.read_noise) != (sensor.get("full_well"), sensor.get("read_noise", 0.0)):
        faults.append(f"sensor: {read.noise}")
    clips = sensor["saturation"] or encodes or "mosaic" in sensor
    if read.saturation_level != 1.0 and (clips or not encodes):
        faults.append(f"sensor.saturation_level: {read.saturation_level}")
    return faults + _priors(case, read, given)


def _priors(case: Case, read: Calibration, given: Calibration) -> Faults:
    """Compare falloff, lights and lobe of a calibration read back with the scene's."""
    faults, row = [], case.row
    angles = np.radians(np.linspace(0, 60, 13))
    for name, power in (
        ("vignetting", VIGNETTING_POWER if row["vignetting"] == "known" else 0.0),
        ("emission", EMISSION_POWER if row["emission"] == "known" and row["light"] in ("at_camera", "disc") else 0.0),
    ):
        profile = getattr(read, name).at(np.cos(angles), np.sin(angles))
        if not np.abs(profile - np.cos(angles) ** power).max() < 1e-9:
            faults.append(f"{name}: not cos^{power:g} of the angle")
    lights = np.array(read.priors.lights_mm).reshape(-1, 3)
    expected = formulas.lights_mm(case.tables["rig"]) if row["light"] != "beside_not_given" else np.zeros((0, 3))
    if lights.shape != expected.shape or (lights.size and not np.abs(lights - expected).max() < 1e-9):
        faults.append(f"rig.lights_mm: {lights.tolist()}, rendered {expected.tolist()}")
    lobe = read.priors.lobe_curvature
    if (None if lobe is None else lobe.mean) != (600.0 if row["reflectance"] == "phong" else None):
        faults.append(f"surface: lobe curvature {lobe}")
    # A falloff that is in the frame and not given stays a prior.
    left = row["vignetting"] == "not_known" or row["emission"] == "not_known"
    left |= row["emission"] == "known" and row["light"] not in ("at_camera", "disc")
    for name, priors in (("given", given.priors), ("read back", read.priors)):
        if left and priors.falloff_power is None:
            faults.append(f"falloff: one that is in the frame is not given, and {name} it has no prior")
    if read.priors != given.priors:
        faults.append(f"priors: {read.priors} read back, {given.priors} given")
    return faults
