"""One realisation: render, expose, reconstruct, match, measure."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.errors import Reason
from simtest.estimators import AnyEstimator
from simtest.reconstruction.pipeline import Specularity, reconstruct
from simtest.rendering import Session
from simtest.simulation.rendered_view import View
from simtest.simulation.true_highlights import JudgedHighlight
from simtest.spec import Experiment
from simtest.validation.cases import Case
from simtest.validation.matching import match
from simtest.validation.metrics import MISSED, RowContext, rows

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Realisation:
    """The outcome of one realisation.

    Parameters
    ----------
    rows : list of dict
        Of the results' table.
    frame : ndarray of float32, shape (H, W) or (H, W, 3)
        What the sensor gave, as encoded.
    specularities : list of Specularity
        Detections with estimates.
    truths : list of JudgedHighlight
        Those that count.
    matched : dict
        Index of the truth by index of the detection.
    """

    rows: list[dict[str, Any]]
    frame: Image
    specularities: list[Specularity]
    truths: list[JudgedHighlight]
    matched: dict[int, int]


def realise(
    session: Session, experiment: Experiment, case: Case, number: int, seen: View, drawn: dict[str, Any],
    estimators: dict[str, AnyEstimator],
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
    seed = case.noise_seed(experiment, number)
    frame = seen.frame(seed)
    dark = seen.full_scale <= 0
    # Without light whatever is found is noise; no highlight counts as isolated, and all count as failures.
    specularities = [] if dark else reconstruct(frame, seen.calibration, estimators, isolated=case.isolated)
    truths = [truth for truth in seen.truths if truth.isolated or not case.isolated or dark]
    matched = match(specularities, truths)
    common = {
        "experiment": experiment.name,
        "label": case.label,
        "setting": case.setting,
        "realisation": number,
        "seed": seed,
        "laws": ",".join(case.laws) or None,
        **case.swept,
        **drawn,
    }
    unfound = str(Reason.NO_LIGHT) if dark else MISSED
    made = rows(RowContext(session, common), specularities, truths, matched, list(estimators), unfound)
    return Realisation(made, frame, specularities, truths, matched)
