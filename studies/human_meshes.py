"""Human meshes through a colonoscope's camera chain: what is found, what is false, and what regions hold the truth.

    python -m studies.human_meshes [VIEWPOINTS] [FIRST]

The meshes are those of ../shared/data/meshes. They are smooth, in tissue's colours, lit at the camera, and seen through
the sensor preset colonoscope_hd; reconstruction is told light, lens and response, and finds highlights by colour, as it
does in pictures. Truth is that of the mesh's interpolated normals (docs/meshes.md).
"""

import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.detection.colour import ColourDetector
from simtest.errors import Failure, SimtestError
from simtest.estimators import Estimate
from simtest.geometry import chi_squared
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import SMOOTHING_BY_COLOUR_PX, run_pipeline
from simtest.rendering import Session
from simtest.simulation.rendered_view import RenderedView, render_view
from simtest.spec import load_scene
from simtest.validation.matching import match
from simtest.validation.metrics import mahalanobis2

MESHES = Path(__file__).resolve().parents[2] / "shared" / "data" / "meshes"
ESTIMATORS = ("cone_axis", "curved", "brightest_point", "photometric")
COLOUR = "llvm_ad_rgb"
KEPT = ("isolated", "clipped", "small")
"""Kinds of detections that may carry one normal."""


@dataclass(frozen=True)
class FrameScore:
    """What a frame shows and what was made of it.

    Parameters
    ----------
    isolated, found : int
        True isolated highlights, and those that a detection matches.
    detections, false : int
        Detections that may carry one normal, and those that match no lit highlight point.
    answers : dict
        By estimator: error in deg, squared Mahalanobis distance and semi-axis in deg of each answer at an isolated one.
    """

    isolated: int
    found: int
    detections: int
    false: int
    answers: dict[str, list[tuple[float, float, float]]]


def main(arguments: list[str]) -> int:
    """Print the table."""
    count, first = (int(arguments[i]) if len(arguments) > i else default for i, default in ((0, 20), (1, 300)))
    rows = [["mesh", "frames", "highlights", "found, %", "false, % of detections", *ESTIMATORS]]
    for path in sorted(MESHES.glob("*.ply")):
        rows.append(_row(path, list(_frames(path, range(first, first + count)))))
        print(rows[-1], file=sys.stderr)
    print_markdown(rows)
    return 0


def _frames(
    path: Path, viewpoints: range
) -> Iterator[tuple[int, int, int, dict[str, list[tuple[float, float, float]]]]]:
    """Yield of each frame: true isolated highlights, those found, false detections, and the answers."""
    session = None
    for viewpoint in viewpoints:
        values = {
            "surface.path": str(path), "surface.viewpoint": viewpoint, "sensor": {"preset": "colonoscope_hd"},
            "reflectance.exponent": 300.0,
        }  # fmt: skip
        try:
            scene = load_scene("anatomy", values)
            session = session or Session(scene, COLOUR)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                view = render_view(session, scene)
        except SimtestError as error:
            print(f"{path.name}, viewpoint {viewpoint}: {error}", file=sys.stderr)
            continue
        yield _judged(view, viewpoint)


def _judged(view: RenderedView, seed: int) -> FrameScore:
    made = run_pipeline(
        view.frame(seed), view.calibration, ColourDetector(True), list(ESTIMATORS), None, SMOOTHING_BY_COLOUR_PX
    )
    judged = zip(made.specularities, made.detection.highlights, strict=True)
    found = [specularity for specularity, highlight in judged if str(highlight.kind) in KEPT]
    lit = [h for h in view.highlights if h.lit]
    matched = match(found, [h.bp_px for h in lit])
    isolated = {i for i, h in enumerate(lit) if h.isolated}
    answers: dict[str, list[tuple[float, float, float]]] = {name: [] for name in ESTIMATORS}
    for i, j in matched.items():
        for name, result in found[i].estimates.items():
            if isinstance(result, Failure) or j not in isolated or not isinstance(result, Estimate):
                continue
            distance = mahalanobis2(result, lit[j].normal)
            if distance is not None and result.covariance is not None:
                semi = float(np.degrees(np.sqrt(np.trace(result.covariance) / 2)))
                answers[name].append((float(angle_deg(result.normal, lit[j].normal)), distance, semi))
    held = len(isolated & set(matched.values()))
    return FrameScore(len(isolated), held, len(found), len(found) - len(matched), answers)


def _row(path: Path, frames: list[FrameScore]) -> list[str]:
    true, found, detections, false = (
        sum(getattr(frame, name) for frame in frames) for name in ("isolated", "found", "detections", "false")
    )
    row = [path.stem, str(len(frames)), str(true), _share(found, true), _share(false, detections)]
    for name in ESTIMATORS:
        own = np.array([answer for frame in frames for answer in frame.answers[name]]).reshape(-1, 3)
        held = int(np.count_nonzero(own[:, 1] <= chi_squared.quantile(0.95, 2)))
        rms = float(np.sqrt(np.mean(own[:, 0] ** 2) / 2)) if len(own) else np.nan
        size = float(np.median(own[:, 2])) / rms if len(own) else np.nan
        row.append(f"{_share(held, len(own))}, median error {np.median(own[:, 0]):.3f}°, semi-axis {size:.2f} RMS")
    return row


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} % of {whole}" if whole else "none"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
