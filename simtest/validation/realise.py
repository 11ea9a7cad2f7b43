"""One realisation: render, expose, reconstruct, match, measure."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.estimators import Estimator
from simtest.reconstruction import Specularity, reconstruct
from simtest.rendering import Radiance, Session
from simtest.seeds import from_integer
from simtest.sensor import expose
from simtest.spec import Experiment, Scene
from simtest.validation.cases import Case
from simtest.validation.matching import match
from simtest.validation.metrics import RowContext, rows
from simtest.validation.truth import JudgedHighlight, judge


@dataclass(frozen=True)
class View:
    """A rendered scene with its judged truth: what all noise realisations of a fixed scene share.

    Parameters
    ----------
    scene : Scene
        What was rendered.
    radiance : Radiance
        Noise-free.
    truths : list of JudgedHighlight
        All true highlights, those included that do not count.
    full_scale : float
        Radiance that becomes 1: the brightest isolated highlight's, else the frame's maximum.
    """

    scene: Scene
    radiance: Radiance
    truths: list[JudgedHighlight]
    full_scale: float


@dataclass(frozen=True)
class Realisation:
    """The outcome of one realisation.

    Parameters
    ----------
    rows : list of dict
        Of the results' table.
    frame : ndarray of float32, shape (H, W) or (H, W, 3)
        What the sensor gave.
    specularities : list of Specularity
        Detections with estimates.
    truths : list of JudgedHighlight
        Those that count.
    matched : dict
        Index of the truth by index of the detection.
    """

    rows: list[dict[str, Any]]
    frame: npt.NDArray[np.float32]
    specularities: list[Specularity]
    truths: list[JudgedHighlight]
    matched: dict[int, int]


def view(session: Session, scene: Scene, radiance: Radiance | None = None) -> View:
    """Render a scene and judge its true highlights.

    Parameters
    ----------
    session : Session
        Is moved to the scene.
    scene : Scene
        The scene.
    radiance : Radiance, optional
        Of the scene, where it is rendered already.

    Returns
    -------
    View
    """
    session.update(scene)
    if radiance is None:
        radiance = session.radiance()
    total = radiance.intensity
    peak = float(total.max())
    highlights = session.highlights(radiance)
    # Exposure is set on the brightest isolated highlight, which is judged without noise first.
    isolated = [judged.highlight.radiance for judged in judge(highlights, total, 0.0, peak) if judged.isolated]
    full_scale = max(isolated, default=peak)
    # Noise is independent in each channel; estimators see the channels' mean.
    sigma = scene.sensor.noise_sigma / np.sqrt(radiance.channels)
    return View(scene, radiance, judge(highlights, total, float(sigma), full_scale), full_scale)


def realise(
    session: Session, experiment: Experiment, case: Case, number: int, seen: View, drawn: dict[str, Any],
    estimators: dict[str, Estimator],
) -> Realisation:  # fmt: skip
    """Make one realisation of a case.

    Parameters
    ----------
    session : Session
        At the view's scene.
    experiment : Experiment
        For name and seed.
    case : Case
        The case.
    number : int
        Of the realisation.
    seen : View
        The rendered scene.
    drawn : dict
        Values drawn for this realisation.
    estimators : dict
        Estimator by name.

    Returns
    -------
    Realisation
    """
    scene = seen.scene
    seed = case.noise_seed(experiment, number)
    frame = expose(seen.radiance.total, seen.full_scale, scene.sensor.noise_sigma, from_integer(seed))
    specularities = reconstruct(frame, session.camera, estimators, isolated=case.isolated)
    truths = [truth for truth in seen.truths if truth.isolated or not case.isolated]
    matched = match(specularities, truths)
    common = {
        "experiment": experiment.name,
        "label": case.label,
        "setting": case.setting,
        "realisation": number,
        "seed": seed,
        **case.swept,
        **drawn,
    }
    made = rows(RowContext(session, common), specularities, truths, matched, list(estimators))
    return Realisation(made, frame, specularities, truths, matched)
