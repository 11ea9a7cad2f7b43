"""Plants lights, takes pictures of a ball, measures the lights, and prints how far and how surely they are found."""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from simtest.calibration import Calibration, Response
from simtest.calibration.lights.result import LightCalibration
from simtest.errors import InputError
from simtest.reconstruction.light_calibration.run import Ball, Calibrated, calibrate_lights
from simtest.runtime import chi_squared
from studies.light_calibration.plantings import Planting, plant, write_pictures

WITHIN_MM = 0.2
LIMIT = chi_squared.quantile(0.95, 3)


def measured(planting: Planting, told_radius: float | None = None, lights: Any = None) -> Calibrated:
    """Return what the pictures of a planting say, the response told."""
    calibration = Calibration(planting.camera, Response("gamma", planting.look.gamma))
    radius = planting.radius_mm if told_radius is None else told_radius
    return calibrate_lights(planting.pictures(lights), calibration, Ball(radius))


def row(planting: Planting) -> dict[str, Any]:
    """Return one planting as a row of the table."""
    told: dict[str, Any] = {
        "seed": planting.seed, "lens": planting.lens, "kind": planting.kind, "planted": len(planting.lights),
        "radius_mm": planting.radius_mm,
    }  # fmt: skip
    try:
        result = measured(planting).result
    except InputError as error:
        return told | {"status": str(error), "lights": []}
    status = "doubtful" if result.problems else "ok"
    fit = {name: getattr(result, name) for name in ("chi2", "freedom", "inflation", "rms_px")}
    own = {"found": len(result.own), "lights": compared(result, planting), "problems": list(result.problems)}
    return told | {"status": status, **own, **fit}


def compared(result: LightCalibration, planting: Planting) -> list[dict[str, Any]]:
    """Return the errors of the lights that are found, each against a planted one, with what is stated of them."""
    found = result.own
    places = np.array([light.position_mm for light in found]).reshape(-1, 3)
    gaps = np.linalg.norm(places[:, None] - planting.lights[None], axis=2)
    rows = []
    for i, j in zip(*linear_sum_assignment(gaps), strict=True):
        error = places[i] - planting.lights[j]
        rows.append({
            "error_mm": error.tolist(), "half_mm": found[i].half_widths_mm.tolist(),
            "mahalanobis2": float(error @ np.linalg.solve(found[i].covariance_mm2, error)),
        })  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> list[str]:
    """Return the table's lines."""
    sure = [each for each in rows if each["status"] == "ok"]
    right = [each for each in sure if each["found"] == each["planted"]]
    lines = [
        f"{len(rows)} rigs, {sum(each['planted'] for each in rows)} planted lights: {len(right)} rigs with the right "
        f"number of lights, {len(sure) - len(right)} with another, {sum(e['status'] == 'doubtful' for e in rows)} told "
        f"as doubtful, {len(rows) - len(sure) - sum(e['status'] == 'doubtful' for e in rows)} refused"
    ]
    groups = [("right number", right), ("every answer", sure)]
    for count in sorted({each["planted"] for each in rows}):
        drawn = [each for each in rows if each["planted"] == count]
        groups.append((f"{count} planted, {len(drawn)} rigs", [each for each in sure if each["planted"] == count]))
    for name, group in groups:
        lights = [light for each in group for light in each["lights"]]
        if not lights:
            continue
        errors = np.array([light["error_mm"] for light in lights])
        halves = np.array([light["half_mm"] for light in lights])
        length, inside = np.linalg.norm(errors, axis=1), np.abs(errors) <= halves
        squares = np.array([light["mahalanobis2"] for light in lights])
        share = float((squares <= LIMIT).mean())
        good = ((np.abs(errors) <= np.maximum(halves, WITHIN_MM)).all(axis=1)).mean()
        lines.append(
            f"{name}: {len(group)} answered, {len(lights)} lights, error median {np.median(length):.3f}, "
            f"95 % {np.quantile(length, 0.95):.3f}, largest {length.max():.3f} mm; "
            f"within 0.2 mm {np.mean(length <= WITHIN_MM):.1%}; within 0.2 mm or the interval {good:.1%}; "
            f"intervals cover {inside.mean():.1%} of {inside.size} coordinates, 95 % regions {share:.1%}"
        )
    lines += [_outside(e) for e in sure if any(light["mahalanobis2"] > LIMIT for light in e["lights"])]
    return [
        *lines,
        *(f"rig {e['seed']}, {e['kind']}, {e['planted']} planted: {_why(e)}" for e in rows if e not in sure),
    ]


def _outside(row: dict[str, Any]) -> str:
    """Return a line about a rig whose lights lie outside their 95 % region."""
    lengths = ", ".join(f"{np.linalg.norm(light['error_mm']):.2f}" for light in row["lights"])
    return f"rig {row['seed']}, {row['kind']}, {row['planted']} planted: outside a region; off by {lengths} mm"


def _why(row: dict[str, Any]) -> str:
    """Return why a rig has no answer."""
    return "; ".join(row.get("problems") or [row["status"]])


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rigs", type=int, default=90)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first rig")
    parser.add_argument("--out", type=Path, default=Path("out/light_calibration.jsonl"))
    parser.add_argument("--resume", action="store_true", help="keep the rigs that --out holds, and add the others")
    parser.add_argument("--write", type=Path, help="folder for the pictures of the rig --first; nothing is measured")
    told = parser.parse_args()
    if told.write is not None:
        planting = plant(told.first)
        write_pictures(planting, told.write)
        print(f"ball of {planting.radius_mm:.3f} mm; lights at {np.round(planting.lights, 3).tolist()} mm")
        return
    told.out.parent.mkdir(parents=True, exist_ok=True)
    rows = [json.loads(line) for line in told.out.read_text("utf-8").splitlines()] if told.resume else []
    kept = {each["seed"] for each in rows}
    with told.out.open("a" if told.resume else "w", encoding="utf-8") as file:
        for seed in range(told.first, told.first + told.rigs):
            if seed in kept:
                continue
            rows.append(row(plant(seed)))
            file.write(json.dumps(rows[-1]) + "\n")
            file.flush()
    print("\n".join(summary(rows)))


if __name__ == "__main__":
    main()
