"""Human meshes through a colonoscope's camera chain: what is found, what is false, and what regions hold the truth.

    python -m studies.human_meshes [VIEWPOINTS] [FIRST]

The meshes are those of ../shared/data/meshes. They are smooth, in tissue's colours, lit at the camera, and seen through
the sensor preset colonoscope_hd; reconstruction is told light, lens and response, and finds highlights by colour, as it
does in pictures. Truth is that of the mesh's interpolated normals (docs/howto/scenes.md).
"""

import sys
import warnings
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.measuring import print_markdown
from simtest.detection.colour import ColourDetector
from simtest.errors import Failure, SimtestError
from simtest.estimators import Estimate
from simtest.geometry.patch import encloses
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.reconstruction.records import Specularity
from simtest.rendering import Session
from simtest.runtime import chi_squared
from simtest.runtime.arrays import Array
from simtest.simulation.frame import RenderedView, render_view
from simtest.spec import load_scene
from simtest.validation.scoring import mahalanobis2, match, peak_px
from studies.hard.measure import semi_axis_deg

MESHES = Path(__file__).resolve().parents[2] / "shared" / "data" / "meshes"
ESTIMATORS = ("cone_axis", "curved", "brightest_point", "photometric")
COLOUR = "llvm_ad_rgb"
TISSUE = [0.85, 0.45, 0.40]
NEAR_PX = 1.5
"""A detection shows the visible highlight whose peak its isophote encloses, or lies so near to its own peak."""

Answer = tuple[float, float, float]
"""Error in deg, squared Mahalanobis distance, and semi-axis in deg, of an answer."""


@dataclass
class Score:
    """What frames show and what was made of it.

    Parameters
    ----------
    frames, isolated : int
        Frames, and true isolated highlights (theory.md section 6).
    found, refused : int
        Those that a detection matches which may carry one normal; of the others those inside the outline of a highlight
        of another kind, which no estimator answers for: mostly clusters.
    detections, near, false : int
        Detections that may carry one normal; those that show a visible highlight without any lit highlight point, where
        the normal only comes near the bisector (theory.md 7.1b); and those that show no visible highlight.
    answers, near_answers : dict
        By estimator, the answers at isolated highlights, against the normal there; and at near misses, against the
        normal of the surface point that the estimate looks at.
    near_flagged, flagged : int
        Near misses, and found isolated highlights, that are flagged as dim.
    """

    frames: int = 0
    isolated: int = 0
    found: int = 0
    refused: int = 0
    detections: int = 0
    near: int = 0
    false: int = 0
    near_flagged: int = 0
    flagged: int = 0
    answers: dict[str, list[Answer]] = field(default_factory=lambda: {name: [] for name in ESTIMATORS})
    near_answers: dict[str, list[Answer]] = field(default_factory=lambda: {name: [] for name in ESTIMATORS})


def main(arguments: list[str]) -> int:
    """Print the two tables."""
    count, first = (int(arguments[i]) if len(arguments) > i else default for i, default in ((0, 20), (1, 300)))
    rows = [[
        "mesh", "frames", "highlights", "found", "refused", "false, of detections", "near misses", *ESTIMATORS,
    ]]  # fmt: skip
    misses = [["mesh", "near misses", "flagged dim (of found)", *ESTIMATORS]]
    for path in sorted(MESHES.glob("*.ply")):
        score = _scored(path, range(first, first + count))
        rows.append(_row(path, score))
        dim = f"{_share(score.near_flagged, score.near)} ({_share(score.flagged, score.found)})"
        misses.append([path.stem, str(score.near), dim, *(_looked(score.near_answers[name]) for name in ESTIMATORS)])
        print(rows[-1], misses[-1], file=sys.stderr)
    print_markdown(rows)
    print()
    print_markdown(misses)
    return 0


def _scored(path: Path, viewpoints: range) -> Score:
    session, score = None, Score()
    for viewpoint in viewpoints:
        values = {
            "surface.path": str(path), "surface.viewpoint": viewpoint, "sensor": {"preset": "colonoscope_hd"},
            "reflectance.exponent": 300.0, "reflectance.diffuse": 0.3, "reflectance.colour": TISSUE,
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
        _judge(score, session, view, viewpoint)
    return score


def _judge(score: Score, session: Session, view: RenderedView, seed: int) -> None:
    """Add a frame's counts and answers."""
    made = reconstruct(view.frame(seed), view.calibration, list(ESTIMATORS), detector=ColourDetector(True))
    detection = made.detection
    judged = list(zip(made, detection.highlights, strict=True))
    kept = [pair for pair in judged if pair[1].is_isolated]
    found = [specularity for specularity, _ in kept]
    lit = [h for h in view.highlights if h.lit]
    matched = match(found, [h.bp_px for h in lit])
    isolated = {i for i, h in enumerate(lit) if h.isolated}
    held = isolated & set(matched.values())
    # highlights that are told, but not answered for
    others = [highlight for _, highlight in judged if not highlight.is_isolated] + list(detection.others)
    refused = sum(any(encloses(other.outline, lit[j].bp_px) for other in others) for j in isolated - held)
    # detections without a highlight point: near misses, or nothing that can be seen
    bare = [i for i in range(len(found)) if i not in matched]
    near = [i for i in bare if _shows_any(found[i], [visible.peak_px for visible in view.visible_highlights])]
    score.frames, score.isolated = score.frames + 1, score.isolated + len(isolated)
    score.found, score.refused = score.found + len(held), score.refused + refused
    score.detections, score.near = score.detections + len(found), score.near + len(near)
    score.false += len(bare) - len(near)
    score.near_flagged += sum(kept[i][1].dim for i in near)
    score.flagged += sum(kept[i][1].dim for i, j in matched.items() if j in isolated)
    for i, j in matched.items():
        for name, result in found[i].estimates.items() if j in isolated else ():
            _add(score.answers[name], result, lit[j].normal)
    for i in near:
        for name, result in found[i].estimates.items():
            if isinstance(result, Failure) or not np.isfinite(result.look_px).all():
                continue
            point = session.exact_points(result.look_px[None])
            if point.valid[0]:
                _add(score.near_answers[name], result, point.normal[0])


def _shows_any(specularity: Specularity, peaks_px: list[Array]) -> bool:
    """Return whether a detection shows one of the visible highlights with these peaks, px."""
    apart = np.array([*peaks_px]).reshape(-1, 2) - peak_px(specularity)
    return bool(match([specularity], peaks_px)) or bool((np.hypot(*apart.T) <= NEAR_PX).any())


def _add(answers: list[Answer], result: Estimate | Failure, normal: Array) -> None:
    """Add an answer's error against a normal, unless it states no region."""
    if isinstance(result, Failure) or result.covariance is None:
        return
    distance = mahalanobis2(result, normal)
    if distance is not None:
        semi = semi_axis_deg(result.covariance)
        answers.append((float(angle_deg(result.normal, normal)), distance, semi))


def _row(path: Path, score: Score) -> list[str]:
    row = [path.stem, str(score.frames), str(score.isolated), _share(score.found, score.isolated),
           _share(score.refused, score.isolated), _share(score.false, score.detections),
           _share(score.near, score.detections)]  # fmt: skip
    for name in ESTIMATORS:
        own, held = _inside(score.answers[name])
        rms = float(np.sqrt(np.mean(own[:, 0] ** 2) / 2)) if len(own) else np.nan
        size = float(np.median(own[:, 2])) / rms if len(own) else np.nan
        row.append(f"{held}, median error {np.median(own[:, 0]):.3f}°, semi-axis {size:.2f} RMS")
    return row


def _looked(answers: list[Answer]) -> str:
    own, held = _inside(answers)
    if not len(own):
        return "none"
    median, most, semi = np.median(own[:, 0]), np.percentile(own[:, 0], 90), np.median(own[:, 2])
    return f"{held}, median {median:.2f}°, 90 % below {most:.2f}°, semi-axis {semi:.2f}°"


def _inside(answers: list[Answer]) -> tuple[Array, str]:
    """Return answers as an array, shape (N, 3), and the share whose 95 % region holds the normal."""
    own = np.array(answers).reshape(-1, 3)
    return own, _share(int(np.count_nonzero(own[:, 1] <= chi_squared.quantile(0.95, 2))), len(own))


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} % of {whole}" if whole else "none"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
