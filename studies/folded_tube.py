"""Print what each estimator reaches in a straight folded tube, where curvature changes inside the highlights.

    python -m studies.folded_tube [FIRST] [COUNT] [FOLDER]

The surface is that of a generated colon whose centreline is straight, exact, rendered with the light at the camera.
FOLDER keeps the frames of an earlier run, so that nothing is rendered twice.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.calibration import Calibration
from simtest.estimators.protocol import Estimate
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.options import DEFAULT_ESTIMATORS
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import best_of
from simtest.rendering import Session
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array, Image
from simtest.simulation.frame import render_view
from simtest.spec import load_scene
from simtest.validation.scoring import mahalanobis2, match

SHOWN = tuple(dict.fromkeys((*DEFAULT_ESTIMATORS, "curved", "photometric")))
NOISE = 0.01
TUBE = {
    "surface.path": "colon",
    "surface.recipe.length_mm": 120.0,
    "surface.recipe.radius_mm": 20.0,
    "surface.recipe.bend_deg": 0.0,
    "surface.recipe.sway_deg": 0.0,
    "surface.recipe.taenia_mm": 0.0,
    "surface.recipe.fold_depth_mm": 6.0,
    "surface.recipe.fold_edge_mm": 3.0,
    "surface.recipe.fold_spacing_mm": 15.0,
    "sensor.noise_sigma": NOISE,
}
"""Folds 6 mm high with edges of 3 mm, 15 mm apart, in a straight tube of 40 mm."""

EXPONENTS = (50.0, 20.0)
"""Of the Phong lobe: the wider a highlight is, the more the curvature changes inside it."""

BEST = "best of the defaults"

Measured = tuple[float, float | None]
"""Error, deg, and squared Mahalanobis distance of the truth, where an uncertainty is stated."""

View = tuple[Image, Calibration, Array, Array]
"""A frame, its calibration, and pixels and normals of the true isolated highlights, shapes (N, 2) and (N, 3)."""


def views(exponent: float, first: int, count: int, folder: Path | None) -> Iterator[View]:
    """Yield the frames of some viewpoints, rendered or kept."""
    session = None
    for viewpoint in range(first, first + count):
        own = {"reflectance.exponent": exponent, "surface.viewpoint": viewpoint, "sensor.seed": viewpoint}
        scene = load_scene("anatomy", {**TUBE, **own})
        path = None if folder is None else folder / f"folded_tube_{exponent:g}_{viewpoint}.npz"
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


def errors(exponent: float, first: int, count: int, folder: Path | None) -> dict[str, list[Measured | None]]:
    """Return each estimator's errors at the highlights that were found; None where it has no result."""
    made: dict[str, list[Measured | None]] = {name: [] for name in (*SHOWN, BEST)}
    for frame, calibration, pixels, normals in views(exponent, first, count, folder):
        found = reconstruct(frame, calibration, SHOWN)
        for i, j in match(found, list(pixels)).items():
            estimates = found[i].estimates
            best, _ = best_of({name: estimates[name] for name in DEFAULT_ESTIMATORS})
            answers = {**estimates, BEST: None if best is None else estimates[best]}
            for name, of_name in made.items():
                answer = answers[name]
                if not isinstance(answer, Estimate):
                    of_name.append(None)
                    continue
                of_name.append((float(angle_deg(answer.normal, normals[j])), mahalanobis2(answer, normals[j])))
    return made


def main() -> None:
    """Print a row for each estimator and exponent."""
    first, count = (int(v) for v in (*sys.argv[1:3], *("1000", "60")[len(sys.argv[1:3]) :]))
    folder = Path(sys.argv[3]) if len(sys.argv) > 3 else None
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    print(f"viewpoints {first} to {first + count - 1}; deg")
    rows = [("exponent", "estimator", "highlights", "answered", "median", "RMS", "p95", "in the 95 % region, %")]
    for exponent in EXPONENTS:
        for name, measured in errors(exponent, first, count, folder).items():
            answered = [each for each in measured if each is not None]
            own = np.array([error for error, _ in answered])
            stated = np.array([squared for _, squared in answered if squared is not None])
            median, rms, p95 = np.median(own), np.sqrt(np.mean(own**2)), np.percentile(own, 95)
            covered = f"{100 * np.mean(stated <= chi_squared.quantile(0.95, 2)):.0f}" if len(stated) else ""
            figures = (f"{median:.3f}", f"{rms:.3f}", f"{p95:.3f}", covered)
            rows.append((f"{exponent:g}", name, str(len(measured)), str(len(own)), *figures))
    print_markdown(rows)


if __name__ == "__main__":
    main()
