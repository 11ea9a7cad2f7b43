"""Compare the published scripts' circle pose with ours: `python -m studies.authors_core SCRIPT`.

SCRIPT is one of the scripts of github.com/k16makki/EndoMapper_UCA_Specularity that define `Zisserman_method`, in a
clone of yours. It runs as a core (examples/cores/authors/core.py). It and our `circle_pose` get the same isophotes, at
half of the peak, of rendered highlights on planes, cylinders and spheres at random attitudes, under a light beside the
camera. Compared are the two normals that each method allows, whichever of them it proposes.
"""

import argparse
import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

import simtest
from simtest.estimators.names import load_estimators
from simtest.geometry import Array
from simtest.geometry.vectors import angle_deg

CORE = Path(__file__).resolve().parents[1] / "examples" / "cores" / "authors" / "core.py"
BRANCHES = ("pose", "eigenvector")
SCENES = ("plane", "cylinder", "sphere")
DRAWS = 40
"""Of each scene."""

SEED = 911
RIGHT_ANGLE_DEG = 89.0


@dataclass
class Agreement:
    """How a branch of the scripts agrees with our circle pose, a number a highlight.

    Parameters
    ----------
    gaps_deg : list of float
        Angle from each of our two normals to the nearest of theirs; the larger of the two.
    proposed_deg : list of float
        Angle between the proposed normals.
    from_axis_deg : list of float
        Angle between the proposed normal and the reverse of the cone's axis, which halves that between our two.
    single : int
        Highlights at which both of the script's normals are the same vector.
    unanswered : int
        Highlights at which one of the two methods states no normal.
    """

    gaps_deg: list[float] = field(default_factory=list)
    proposed_deg: list[float] = field(default_factory=list)
    from_axis_deg: list[float] = field(default_factory=list)
    single: int = 0
    unanswered: int = 0

    def add(self, ours: simtest.Estimate | simtest.Failure, theirs: simtest.Estimate | simtest.Failure) -> None:
        """Take the two methods' results at one highlight."""
        if isinstance(ours, simtest.Failure) or isinstance(theirs, simtest.Failure):
            self.unanswered += 1
            return
        gaps = angle_deg(ours.candidates[:, None], theirs.candidates[None])
        axis: Array = ours.candidates.sum(axis=0)
        self.gaps_deg.append(float(gaps.min(axis=1).max()))
        self.proposed_deg.append(float(angle_deg(ours.normal, theirs.normal)))
        self.from_axis_deg.append(float(angle_deg(axis / np.linalg.norm(axis), theirs.normal)))
        self.single += "one_normal" in theirs.flags

    def lines(self) -> list[str]:
        """Return the figures as lines."""
        answered = len(self.gaps_deg)
        axis = np.array(self.from_axis_deg)
        return [
            f"highlights where both answer: {answered}; where one does not: {self.unanswered}",
            f"one vector for both normals: {self.single} of {answered}",
            f"difference of the two normals, deg: {spread(self.gaps_deg)}",
            f"difference of the proposed normals, deg: {spread(self.proposed_deg)}",
            f"proposed normal along the cone's axis: {int((axis < 1 - RIGHT_ANGLE_DEG / 90).sum())}, "
            f"across it: {int((axis > RIGHT_ANGLE_DEG).sum())}",
        ]


def spread(values: list[float]) -> str:
    """Return median, 95th percentile and largest of some numbers."""
    if not values:
        return "none"
    return "median {:.2g}, 95 % below {:.2g}, largest {:.2g}".format(*np.percentile(values, [50, 95, 100]))


def settings(scene: str, rng: np.random.Generator) -> dict[str, object]:
    """Return random settings of a scene: attitude, curvature, lobe, light and noise."""
    drawn: dict[str, object] = {
        "surface.tilt_deg": float(rng.uniform(0.0, 15.0 if scene == "plane" else 3.0)),
        "surface.azimuth_deg": float(rng.uniform(0.0, 360.0)),
        "reflectance.exponent": float(np.exp(rng.uniform(np.log(50.0), np.log(300.0)))),
        "rig.lights.0.offset_mm": float(rng.uniform(0.0, 2.0)),
        "rig.lights.0.azimuth_deg": float(rng.uniform(0.0, 360.0)),
        "sensor.noise_sigma": 0.02,
        "sensor.seed": int(rng.integers(1 << 31)),
    }
    return drawn if scene == "plane" else drawn | {"surface.radius_mm": float(rng.uniform(4.0, 20.0))}


def compare(script: Path, draws: int, seed: int) -> dict[str, Agreement]:
    """Run our circle pose and both branches of a script on the same highlights."""
    rng = np.random.default_rng(seed)
    command = f"command: {shlex.join([sys.executable, str(CORE), str(script.resolve())])} --branch"
    names = {branch: f"{command} {branch}" for branch in BRANCHES}
    cores = {branch: load_estimators([name]).popitem()[1] for branch, name in names.items()}
    estimators = {"ours": load_estimators(["circle_pose"])["circle_pose"], **cores}
    found = {branch: Agreement() for branch in BRANCHES}
    for scene in SCENES:
        for _ in range(draws):
            frame = simtest.render(scene, settings(scene, rng))
            for spot in simtest.reconstruct(frame.image, frame.calibration, estimators=estimators):
                for branch in BRANCHES:
                    found[branch].add(spot.estimates["ours"], spot.estimates[branch])
    return found


def main() -> None:
    """Print the agreement of both branches."""
    parser = argparse.ArgumentParser(description="Compare the published scripts' circle pose with ours.")
    parser.add_argument("script", type=Path)
    parser.add_argument("--draws", type=int, default=DRAWS)
    parser.add_argument("--seed", type=int, default=SEED)
    given = parser.parse_args()
    for branch, agreement in compare(given.script, given.draws, given.seed).items():
        print(f"branch {branch}")
        for line in agreement.lines():
            print(f"  {line}")


if __name__ == "__main__":
    main()
