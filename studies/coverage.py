"""Stated 95 % regions on highlights of the generated colon: how many hold the truth, and how large they are.

`python -m studies.coverage`: 2,000 different highlights with one realisation of the noise each. No viewpoint of these
was used to set what the estimators add to the noise. `python -m studies.coverage 300 surface.path=liver` takes another
number of highlights, and other settings of the scene.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from benchmarks.measuring import Figure, print_figures
from simtest.calibration import Calibration, exactly
from simtest.errors import Failure
from simtest.estimators.bisector import bisector
from simtest.estimators.cone_axis import cone_axis
from simtest.estimators.curved import curved
from simtest.estimators.photometric import photometric
from simtest.estimators.protocol import Estimate
from simtest.geometry import Patch
from simtest.geometry.vectors import angle_deg
from simtest.reconstruction.pipeline import reconstruct
from simtest.rendering import Session
from simtest.simulation.frame import render_view
from simtest.simulation.highlights import TrueHighlight
from simtest.spec import load_scene
from simtest.spec.toml_files import parse_settings
from simtest.validation.scoring import mahalanobis2, match

HIGHLIGHTS, ASIDE_HIGHLIGHTS = 2000, 400
FIRST_VIEWPOINT = 60000
ASIDE_MM = 2.0
"""How far beside the camera the light of `bisector` is."""

LOW, HIGH = 93.0, 97.0
"""Share of the regions that must hold the truth, %."""

LARGEST = 1.5
"""Most that the median semi-axis may be over what the RMS error implies: inflated regions are no way out."""

SAID_EVERY = 300
"""Estimates between two lines that say how the run stands."""

Judged = tuple[Estimate | Failure, TrueHighlight]


def figures(highlights: int = HIGHLIGHTS, settings: list[str] | None = None) -> list[Figure]:
    """Return coverage and size of each estimator's regions; ``KEY=VALUE`` sets the scene."""
    aside = highlights * ASIDE_HIGHLIGHTS // HIGHLIGHTS
    judged: dict[str, list[Judged]] = {name: [] for name in ("cone_axis", "curved", "photometric", "bisector")}
    for patch, calibration, truth in _highlights(highlights, (), settings or []):
        for name, estimator in (("cone_axis", cone_axis), ("curved", curved), ("photometric", photometric)):
            judged[name].append((estimator.estimate(patch, calibration.camera, calibration.priors), truth))
        _say_so_far(judged)
    light = {"offset_mm": ASIDE_MM, "azimuth_deg": 45.0}
    for patch, calibration, truth in _highlights(aside, (light,), settings or []):
        priors = replace(calibration.priors, distance_mm=exactly(truth.distance))
        judged["bisector"].append((bisector.estimate(patch, calibration.camera, priors), truth))
        _say_so_far(judged)
    return [figure for name, results in judged.items() for figure in _figures(name, results)]


def _say_so_far(judged: Mapping[str, Sequence[Judged]]) -> None:
    """Print from time to time what a run that is cut short would give."""
    if sum(map(len, judged.values())) % SAID_EVERY == 0:
        so_far = (_figures(name, results)[0] for name, results in judged.items() if results)
        print("; ".join(f"{figure.name}: {figure.about}" for figure in so_far), file=sys.stderr)


def _highlights(
    count: int, lights: Sequence[Mapping[str, float]], settings: list[str]
) -> Iterator[tuple[Patch, Calibration, TrueHighlight]]:
    """Return detected highlights that are matched to the truth, of as many viewpoints as it takes."""
    session, found, viewpoint = None, 0, FIRST_VIEWPOINT
    while found < count:
        values = {"surface.path": "colon", "surface.viewpoint": viewpoint, "sensor.seed": viewpoint}
        values |= parse_settings(settings)
        scene = load_scene("anatomy", values | ({"rig.lights": list(lights)} if lights else {}))
        session = session or Session(scene)
        seen = render_view(session, scene)
        specularities = reconstruct(seen.frame(viewpoint), seen.calibration, {})
        truths = [truth for truth in seen.highlights if truth.isolated]
        for i, j in match(specularities, [truth.bp_px for truth in truths]).items():
            patch = specularities[i].patch
            if isinstance(patch, Patch):
                found += 1
                yield patch, seen.calibration, truths[j]
        viewpoint += 1


def _figures(name: str, judged: Sequence[Judged]) -> list[Figure]:
    stated = [(e, t) for e, t in judged if isinstance(e, Estimate) and e.covariance is not None]
    distances = np.array([mahalanobis2(e, t.normal) for e, t in stated], dtype=float)
    errors = np.array([float(angle_deg(e.normal, t.normal)) for e, t in stated])
    longer = [np.linalg.eigvalsh(e.covariance)[-1] for e, _ in stated if e.covariance is not None]
    semi = float(np.degrees(np.sqrt(np.median(longer))))
    share = 100 * float(np.mean(distances <= chi2.ppf(0.95, 2)))
    # The RMS angle is that of two components; the median of a Rayleigh distribution is 1.18 of one.
    rms, median = float(np.sqrt(np.mean(errors**2))), float(np.median(errors))
    about = f"{share:.1f} % of {len(stated)}; {len(judged) - len(stated)} without a region"
    error = f"{semi:.4f} deg; error: median {median:.4f}, RMS {rms:.3f} deg"
    return [
        Figure(f"{name}: regions that hold the truth", share, LOW, at_least=True, unit="%", about=about),
        Figure(f"{name}: the same", share, HIGH, unit="%"),
        Figure(f"{name}: median semi-axis over that of the RMS error", semi * np.sqrt(2) / rms, LARGEST, about=error),
        Figure(f"{name}: median semi-axis over that of the median error", semi * np.sqrt(2 * np.log(2)) / median),
    ]


if __name__ == "__main__":
    count, *settings = sys.argv[1:] or [str(HIGHLIGHTS)]
    sys.exit(print_figures(figures(int(count), settings)))
