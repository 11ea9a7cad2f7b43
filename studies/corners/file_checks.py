"""Checks of what is written: calibrations, datasets, and the counts of files that tell the same."""

import csv
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import polars as pl

from simtest.api import reconstruct_picture, sample_views, validate
from simtest.calibration import Calibration
from simtest.conventions import DEFAULT_SMOOTHING_PX
from simtest.dataset import calibration_of
from simtest.errors import Failure
from simtest.reconstruction import Specularity, reconstruct
from simtest.reconstruction.options import Options
from simtest.simulation.flow import HIDDEN, OUT, SEEN
from simtest.simulation.frame import make_frame
from simtest.simulation.frame_files import write_frame
from simtest.spec import load_calibration
from simtest.spec.recipes import Experiment, Group
from studies.corners import formulas
from studies.corners.case import STORED, Case, Faults, NotAskedError
from studies.corners.scenes import EMISSION_POWER, VIGNETTING_POWER

RUNS_EVERY = 6
"""Scenes of which one is run as an experiment, which takes longest."""


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


def counts(case: Case) -> Faults:
    """Check that highlights and answers are as many in JSON, CSV, NPZ, the page, and a dataset's tables."""
    faults, folder = [], case.folder / "frame"
    if not (folder / "frame.png").is_file():
        calibration(case)
    record, _ = reconstruct_picture(folder / "frame.png", case.folder / "normals", Options(folder / "calibration.toml"))
    found = json.loads((case.folder / "normals" / "normals.json").read_text())["specularities"]
    with (case.folder / "normals" / "normals.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    page = (case.folder / "normals" / "index.html").read_text()
    shown = json.loads(page.split('<script id="data" type="application/json">')[1].split("</script>")[0])["spots"]
    arrays = np.load(case.folder / "normals" / "constraints.npz")
    answers = {(s["id"], name) for s in found for name, e in s["estimates"].items() if e["status"] == "ok"}
    others = {
        "Python": {(s.id, name) for s in record for name in s.normals},
        "normals.csv": {(int(r["specularity"]), r["estimator"]) for r in lines if r["status"] == "ok"},
        "the page": {(s["id"], r["name"]) for s in shown for r in s["rows"] if r["status"] == "ok"},
    }
    faults += [f"answers: {len(answers)} in normals.json, {len(o)} in {n}" for n, o in others.items() if o != answers]
    for entry in lines:
        if entry["status"] == "ok" and entry["candidate"] == "0":
            kept = found[int(entry["specularity"])]["estimates"][entry["estimator"]]["normal"]
            if [float(entry[f"normal_{axis}"]) for axis in "xyz"] != kept:
                faults.append(f"normals.csv: another normal of {entry['specularity']} {entry['estimator']}")
    best = [s for s in found if s["best"] is not None and s["sightline"] is not None]
    if arrays["id"].tolist() != [s["id"] for s in best]:
        faults.append(f"constraints.npz: {len(arrays['id'])} for {len(best)} best normals")
    described = json.loads((folder / "frame.json").read_text())
    if len(described["highlights"]) != len(case.seen.highlights):
        faults.append(f"frame.json: {len(described['highlights'])} of {len(case.seen.highlights)} highlights")
    if len(described["visible_highlights"]) != len(case.seen.visible_highlights):
        faults.append("frame.json: another number of visible highlights")
    return faults + _tables(case)


def _tables(case: Case) -> Faults:
    """Compare the tables of a dataset with its sample's metadata."""
    faults = []
    meta = case.sample["meta"]
    index, highlights, estimates = (
        pl.read_parquet(case.dataset / f"{name}.parquet") for name in ("index", "highlights", "estimates")
    )
    isolated = [h["isolated"] for h in meta["highlights"]]
    stated = (len(isolated), sum(isolated), len(meta["detections"]))
    tabled = tuple(index.row(0, named=True)[f"n_{name}"] for name in ("highlights", "isolated", "detections"))
    if tabled != stated:
        faults.append(f"index.parquet: {tabled} for {stated} highlights, isolated ones, detections")
    if highlights["isolated"].to_list() != isolated:
        faults.append("highlights.parquet: not the sample's highlights")
    if len(estimates) != len(meta["estimates"]) or estimates["status"].to_list() != [
        e["status"] for e in meta["estimates"]
    ]:
        faults.append("estimates.parquet: not the sample's estimates")
    # Each detection is answered, false or on metal; each isolated highlight is found or missed.
    one = estimates.filter(pl.col("estimator") == STORED[0]) if len(estimates) else estimates
    missed = sum(e["status"] == "missed" and e["estimator"] == STORED[0] for e in meta["estimates"])
    matched = one.filter(pl.col("true_id").is_not_null() & pl.col("specularity").is_not_null())["true_id"].n_unique()
    detected = one["specularity"].drop_nulls().n_unique() if len(one) else 0
    if detected != len(meta["detections"]):
        faults.append(f"estimates: of {detected} specularities, {len(meta['detections'])} detected")
    if matched + missed != sum(isolated):
        faults.append(f"estimates: {matched} found and {missed} missed of {sum(isolated)} isolated highlights")
    return faults


def experiment(case: Case) -> Faults:
    """Check that a run's rows, its summary and its page count the same highlights, each isolated one."""
    if case.number % RUNS_EVERY:
        raise NotAskedError(f"one scene of {RUNS_EVERY} is run as an experiment")
    group = Group(scene=str(case.written()))
    described = Experiment(name="corners", realisations=2, estimators=STORED, groups=(group,))
    page = validate(described, case.folder / "run").page.read_text()
    rows = pl.read_parquet(case.folder / "run" / "results.parquet")
    entry = json.loads((case.folder / "run" / "summary.json").read_text())["experiments"]["corners"]
    faults = []
    if entry["frames"] != 2:
        faults.append(f"summary.json: {entry['frames']} frames of 2")
    (figures,) = entry["settings"].values() if entry["settings"] else [{}]
    for name in STORED:
        own = rows.filter((pl.col("estimator") == name) & pl.col("true_id").is_not_null())
        counted = {"n": len(own), "n_ok": len(own.filter(pl.col("status") == "ok")),
                   "n_missed": len(own.filter(pl.col("status") == "missed"))}  # fmt: skip
        stated = {key: figures.get(name, {}).get(key, 0) for key in counted}
        if stated != counted:
            faults.append(f"summary.json: {name}: {stated}, in results.parquet {counted}")
        if case.row["relief"] == "none":
            # The scene's geometry is that of the case: each realisation shows its isolated highlights.
            isolated = sum(h.isolated for h in case.seen.highlights)
            if len(own) != 2 * isolated:
                faults.append(f"results.parquet: {name}: {len(own)} rows of {2 * isolated} isolated highlights")
    text = " ".join(re.sub(r"<[^>]+>", " ", page).split())
    if shown := re.search(r"Of (\d+) rows, (\d+) gave no normal.*?, (\d+) missed a true highlight", text):
        missed = int((rows["status"] == "missed").sum())
        expected = (len(rows), len(rows) - missed - int((rows["status"] == "ok").sum()), missed)
        if tuple(map(int, shown.groups())) != expected:
            faults.append(f"page: {shown[0]!r}, in results.parquet {expected}")
    elif len(rows):
        faults.append("page: does not say of how many rows it is")
    return faults


def views(case: Case) -> Faults:
    """Check that flow and co-visibility, and the poses, of a sequence of views are those of one another."""
    if case.row["surface"] not in ("colon", "mesh"):
        raise NotAskedError("a sequence follows the path of a lumen")
    folder, count = case.folder / "views", 3
    sample_views(case.scene, folder, count, {"surface.view": "wall"}, along=(0.45, 0.48), labels=True)
    listed = json.loads((folder / "views.json").read_text())["accepted"]
    shares = np.load(folder / "covisibility.npy")
    faults = [] if len(listed) == count and shares.shape == (count, count) else [f"{len(listed)} views of {count}"]
    for first in range(count - 1):
        with np.load(folder / f"flow_{first:04d}.npz") as arrays:
            states = {(first, first + 1): arrays["forward_state"], (first + 1, first): arrays["backward_state"]}
        for (one, other), state in states.items():
            # Co-visibility is that of points on every 16th pixel.
            sparse = state[8::16, 8::16]
            points = int(np.count_nonzero((sparse == SEEN) | (sparse == OUT) | (sparse == HIDDEN)))
            share = int(np.count_nonzero(sparse == SEEN)) / max(points, 1)
            if points and not abs(share - shares[one, other]) < 1.5 / points:
                faults.append(
                    f"covisibility[{one}, {other}]: {shares[one, other]:.3f}, by the flow's states {share:.3f}"
                )
    poses = [np.array(view["world_from_camera"]) for view in listed]
    lines = [line.split() for line in (folder / "trajectory.txt").read_text().splitlines() if line[:1] != "#"]
    for pose, line in zip(poses, lines, strict=True):
        # Time, position in m, quaternion with its real part last.
        values = np.array(line, dtype=float)
        place, turn = 1000 * values[1:4], formulas.rotation_of_quaternion(values[4:])
        if not max(np.abs(place - pose[:3, 3]).max(), np.abs(turn - pose[:3, :3]).max()) < 1e-5:
            faults.append("trajectory.txt: another pose than views.json")
    return faults
