"""Checks of what is written: calibrations, and answers in datasets."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from simtest.calibration import Calibration
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.dataset import calibration_of
from simtest.errors import Failure
from simtest.reconstruction import Specularity, reconstruct
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec import load_calibration
from studies.corners import formulas
from studies.corners.case import STORED, Case, Faults
from studies.corners.scenes import EMISSION_POWER, VIGNETTING_POWER


def stored(case: Case) -> Faults:
    """Check that answers in a dataset are those of the stored picture with `calibration_of`.

    Either detector may have made them: that of pictures, or peaks.
    """
    sample = case.sample
    calibration = calibration_of(sample["meta"])
    options: list[dict[str, Any]] = [{}, {"detector": "peaks", "smoothing_px": DEFAULT_SMOOTHING_PX}]
    found = [reconstruct(sample["image"], calibration, list(STORED), **each) for each in options]
    return min((_other_answers(sample["meta"], each) for each in found), key=len)


def _other_answers(meta: Mapping[str, Any], found: Sequence[Specularity]) -> Faults:
    """Return how the answers that a sample's metadata keep differ from others."""
    kept = [entry for entry in meta["estimates"] if entry.get("status") == "ok" and "normal_x" in entry]
    made = [
        (name, result) for spot in found for name, result in spot.estimates.items() if not isinstance(result, Failure)
    ]
    faults = []
    if len(meta["detections"]) != len(found):
        faults.append(f"{len(meta['detections'])} detections stored, {len(found)} in the stored picture")
    if len(kept) != len(made):
        faults.append(f"{len(kept)} answers stored, {len(made)} from the stored picture")
    worst, spread = 0.0, 0.0
    for entry in kept:
        normal = np.array([entry[f"normal_{axis}"] for axis in "xyz"])
        look = np.array([entry["look_x_px"], entry["look_y_px"]])
        near = [r for name, r in made if name == entry["estimator"] and np.linalg.norm(r.look_px - look) < 2]
        if near:
            worst = max(worst, float(min(formulas.angle_deg(normal, r.normal) for r in near)))
            if near[0].covariance is not None and "cov_11" in entry:
                ratio = (entry["cov_11"] + entry["cov_22"]) / float(np.trace(near[0].covariance))
                spread = max(spread, abs(math.log(ratio)) / 2)
    if worst > 0.01:
        faults.append(f"a stored normal is {worst:.2g} deg from that of the stored picture")
    if spread > 0.02:
        faults.append(f"a stored +- is {math.exp(spread):.3g} times that of the stored picture, or its inverse")
    return faults


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
