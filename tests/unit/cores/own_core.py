"""An estimator of simtest as a core: `own_core.py NAME`, of this checkout; with --files over files."""

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from simtest.calibration import Priors
from simtest.calibration.priors import CameraPrior, LogUniform, Uniform, exactly
from simtest.calibration.priors import Normal as NormalPrior
from simtest.errors import Failure
from simtest.estimators import load_estimators
from simtest.geometry import Camera, Patch, ViewMask
from simtest.geometry.lenses import BrownConrady, KannalaBrandt

FILES = "--files" in sys.argv
LENSES = {"brown_conrady": BrownConrady, "kannala_brandt": KannalaBrandt}
ARRAYS = ["values", "raw", "noise", "saturated", "seen"]


def receive():
    line = sys.stdin.buffer.readline()
    if not line:
        return None
    header, arrays = json.loads(line), {}
    if "folder" in header:
        folder = Path(header["folder"])
        header = {**json.loads((folder / "request.json").read_text()), "folder": header["folder"]}
        return header, {entry["name"]: np.load(folder / entry["file"]) for entry in header["arrays"]}
    for entry in header.get("arrays", []):
        dtype = np.dtype(entry["dtype"])
        content = sys.stdin.buffer.read(dtype.itemsize * int(np.prod(entry["shape"], dtype=int)))
        arrays[entry["name"]] = np.frombuffer(content, dtype).reshape(entry["shape"])
    return header, arrays


def send(header):
    sys.stdout.buffer.write(json.dumps(header).encode() + b"\n")
    sys.stdout.buffer.flush()


def camera_of(told):
    lens, mask = told["distortion"], told["view_mask"]
    K = np.array(told["K"])
    return Camera(
        told["width"], told["height"], K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1],
        lens and LENSES[lens.pop("model")](**lens), mask and ViewMask(**mask),
    )  # fmt: skip


def prior_of(told):
    if told is None:
        return None
    values = told["parameters"]
    kinds = {"uniform": Uniform, "log_uniform": LogUniform, "normal": NormalPrior}
    return exactly(values["value"]) if told["distribution"] == "exact" else kinds[told["distribution"]](**values)


def priors_of(told):
    names = ("lobe_curvature", "light_offset_mm", "falloff_power", "relief_slope")
    distance = prior_of(told["distance_mm"]) if told["distance_mm"]["told"] else None
    return Priors(
        lights_mm=tuple(map(tuple, told["lights_mm"])), distance_mm=distance, camera=CameraPrior(**told["camera"]),
        plane=told["plane"], **{name: prior_of(told[name]) for name in names},
    )  # fmt: skip


def patch_of(told, arrays):
    noise = told["noise"] if told["noise"] is not None else arrays.get("noise")
    seen = None if arrays["seen"].all() else arrays["seen"]
    return Patch(
        arrays["values"], tuple(told["origin_px"]), np.array(told["peak_px"]), told["peak_value"],
        tuple(told["peak_pixel"]), arrays.get("saturated"), seen, arrays.get("raw"), noise, told["smoothing_px"],
        tuple(map(tuple, told["others_px"])), tuple(told["others_value"]),
        diffuse=told["diffuse"], clipped_share=told["clipped_share"], score=told["score"],
    )  # fmt: skip


def message(result):
    if isinstance(result, Failure):
        return {"type": "failure", "reason": result.reason, "detail": result.detail}
    return {
        "type": "estimate", "normal": result.normal.tolist(), "candidates": result.candidates.tolist(),
        "look_px": result.look_px.tolist(), "axis_ratio": result.axis_ratio, "choice_margin": result.choice_margin,
        "budget": result.budget and {name: part.tolist() for name, part in result.budget.items()},
        "flags": list(result.flags), "target": result.target,
        "isophotes": [
            {"isovalue": i.isovalue, "cone": i.cone.tolist(), "sightline": i.sightline.tolist()}
            for i in result.isophotes
        ],
    }  # fmt: skip


def main():
    estimator = load_estimators(sys.argv[1:2])[sys.argv[1]]
    receive()
    transport = "files" if FILES else "stream"
    send({
        "type": "hello", "protocol": 1, "name": sys.argv[1], "version": "1", "kind": "patch", "arrays": ARRAYS,
        "transport": transport,
    })  # fmt: skip
    while (asked := receive()) is not None:
        header, arrays = asked
        patch = patch_of(header["patch"], arrays)
        result = estimator.estimate(patch, camera_of(header["camera"]), priors_of(header["priors"]))
        answer = {**message(result), "id": header["id"]}
        if FILES:
            (Path(header["folder"]) / "answer.json").write_text(json.dumps(answer))
            answer = {"type": "done", "id": header["id"]}
        send(answer)


main()
