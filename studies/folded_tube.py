"""Print what each estimator reaches in a straight folded tube, where curvature changes inside the highlights.

    python -m studies.folded_tube [FIRST] [COUNT] [FOLDER]

The surface is r(z) = r0 less a ring of Gaussian profile every `fold_spacing_mm`, exact, rendered with the light at the
camera. FOLDER keeps the frames of an earlier run, so that nothing is rendered twice.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from simtest.calibration import Calibration
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.description import best_of
from simtest.reconstruction.pipeline import DEFAULT_ESTIMATORS, reconstruct
from simtest.rendering import Session
from simtest.runtime.arrays import Array, Image
from simtest.simulation.rendered_view import render_view
from simtest.spec import load_scene
from simtest.validation.matching import match

SHOWN = tuple(dict.fromkeys((*DEFAULT_ESTIMATORS, "curved", "photometric")))
NOISE = 0.01
TUBE = {
    "surface.path": "colon",
    "surface.recipe.length_mm": 120.0,
    "surface.recipe.radius_mm": 20.0,
    "surface.recipe.bend_deg": 0.0,
    "surface.recipe.sway_deg": 0.0,
    "surface.recipe.taenia_mm": 0.0,
    # three folds make a ring
    "surface.recipe.fold_depth_mm": 1.6,
    "surface.recipe.fold_edge_mm": 9.0,
    "surface.recipe.fold_spacing_mm": 15.0,
    "surface.recipe.fold_concentration": 0.0,
    "surface.recipe.irregularity": 0.0,
    "reflectance.exponent": 50.0,
    "sensor.noise_sigma": NOISE,
}
"""Folds of 4.8 mm, 15 mm apart, on a tube of 40 mm."""

View = tuple[Image, Calibration, Array, Array]
"""A frame, its calibration, and pixels and normals of the true isolated highlights, shapes (N, 2) and (N, 3)."""


def views(first: int, count: int, folder: Path | None) -> Iterator[View]:
    """Yield the frames of some viewpoints, rendered or kept."""
    session = None
    for viewpoint in range(first, first + count):
        scene = load_scene("anatomy", {**TUBE, "surface.viewpoint": viewpoint, "sensor.seed": viewpoint})
        path = None if folder is None else folder / f"folded_tube_{viewpoint}.npz"
        if path is None or not path.exists():
            session = session or Session(scene)
            seen = render_view(session, scene)
            true = [h for h in seen.highlights if h.isolated]
            pixels = np.array([h.bp_px for h in true]).reshape(-1, 2)
            normals = np.array([h.normal for h in true]).reshape(-1, 3)
            frame = seen.frame(viewpoint)
            if path is not None:
                np.savez(path, frame=frame, pixels=pixels, normals=normals)
        else:
            with np.load(path) as kept:
                frame, pixels, normals = kept["frame"], kept["pixels"], kept["normals"]
        yield frame, scene.calibration(None), pixels, normals


def errors(first: int, count: int, folder: Path | None) -> dict[str, list[float | None]]:
    """Return each estimator's errors, deg, at the highlights that were found; None where it has no result."""
    made: dict[str, list[float | None]] = {name: [] for name in (*SHOWN, "best of the defaults")}
    for frame, calibration, pixels, normals in views(first, count, folder):
        found = reconstruct(frame, calibration, SHOWN)
        for i, j in match(found, list(pixels)).items():
            estimates = found[i].estimates
            best = best_of({name: estimates[name] for name in DEFAULT_ESTIMATORS})
            answers = {**estimates, "best of the defaults": None if best is None else estimates[best]}
            for name, of_name in made.items():
                answer = answers[name]
                of_name.append(float(angle_deg(answer.normal, normals[j])) if isinstance(answer, Estimate) else None)
    return made


def main() -> None:
    """Print a row for each estimator."""
    first, count = (int(v) for v in (*sys.argv[1:3], *("0", "60")[len(sys.argv[1:3]) :]))
    folder = Path(sys.argv[3]) if len(sys.argv) > 3 else None
    print(f"viewpoints {first} to {first + count - 1}; deg")
    print("| estimator | highlights | answered | median | RMS | p95 |\n| --- | --- | --- | --- | --- | --- |")
    for name, all_errors in errors(first, count, folder).items():
        own = np.array([e for e in all_errors if e is not None])
        figures = f"{np.median(own):.3f} | {np.sqrt(np.mean(own**2)):.3f} | {np.percentile(own, 95):.3f}"
        print(f"| {name} | {len(all_errors)} | {len(own)} | {figures} |")


if __name__ == "__main__":
    main()
