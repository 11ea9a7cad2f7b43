"""Figure 2 of the article: the pipeline in pictures, from one realisation that the run kept."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from simtest.geometry.vectors import angle_deg
from simtest.report.gallery import estimated_normals, vector
from simtest.report.paper.parameters import DEFAULTS, PARAMETERS
from simtest.report.run_folder import GalleryItem, Run

Array = npt.NDArray[np.float64]

PICTURES = ("texture", "clean", "smoothed")


@dataclass(frozen=True)
class Stages:
    """The stages of one realisation; pictures are shares of the noise-free peak.

    Parameters
    ----------
    setting : str
        Name of the setting, with the drawn values.
    theta_deg : float
        Slant.
    texture : ndarray, shape (m, m)
        Over the window of `side` texture units.
    side : float
        Side of the texture's window.
    clean, noisy, smoothed : ndarray, shape (h, w)
        The part of the camera's picture that is used; `smoothed` normalised to its peak.
    extent : tuple of float
        x0, x1, y1, y0 of that part, px.
    isovalue : float
        t.
    isophote, ellipse : ndarray, shape (k, 2), or None
        px; None where the realisation failed.
    truth : ndarray, shape (3,)
        True normal.
    candidates : tuple of ndarray
        The proposed one first.
    errors_deg : tuple of float
        Of the candidates.
    status : str
        "ok" or the failure's reason.
    is_default : bool
        Whether the setting is the article's.
    """

    setting: str
    theta_deg: float
    texture: npt.NDArray[np.float32]
    side: float
    clean: npt.NDArray[np.float32]
    noisy: npt.NDArray[np.float32]
    smoothed: npt.NDArray[np.float32]
    extent: tuple[float, float, float, float]
    isovalue: float
    isophote: Array | None
    ellipse: Array | None
    truth: Array
    candidates: tuple[Array, ...]
    errors_deg: tuple[float, ...]
    status: str
    is_default: bool

    @property
    def better(self) -> int:
        """Index of the better candidate."""
        return int(np.argmin(self.errors_deg))


def stages(run: Run) -> Stages | None:
    """Choose the kept realisation at the article's defaults, else one that answered, and read its stages.

    Parameters
    ----------
    run : Run
        A run directory.

    Returns
    -------
    Stages or None
        None where the run kept no realisation of the published protocol.
    """
    kept = [item for item in run.gallery if item.meta.get("paper") and all(p in item.pictures for p in PICTURES)]
    if not kept:
        return None
    return _read(max(kept, key=lambda item: (item.meta["paper"] == DEFAULTS, _pose(item).get("status") == "ok")))


def _pose(item: GalleryItem) -> Mapping[str, Any]:
    """Give circle pose's estimate, else the first one."""
    estimates = item.estimates
    return next((e for e in estimates if e.get("estimator") == "circle_pose"), estimates[0] if estimates else {})


def _read(item: GalleryItem) -> Stages:
    setting, estimate = item.meta["paper"], _pose(item)
    x, y, width, height = (int(v) for v in item.meta["outer"])
    peak = item.meta.get("peak_value") or float(np.max(item.pictures["smoothed"])) or 1.0
    truth = np.asarray(vector(item.truth[0]["normal"], 3))
    candidates = tuple(estimated_normals(estimate))
    contours, curves = estimate.get("isophotes") or [], estimate.get("curves") or []
    is_default = setting == DEFAULTS
    values = ", ".join(PARAMETERS[k].text(setting[k]) for k in ("sigma", "theta_deg", "exponent", "isovalue", "eps"))
    return Stages(
        setting=f"{values}, smoothing {PARAMETERS['smoothing_px'].text(setting['smoothing_px'])}",
        theta_deg=float(setting["theta_deg"]),
        texture=item.pictures["texture"],
        side=float(setting["size"]),
        clean=item.pictures["clean"],
        noisy=item.frame[y : y + height, x : x + width],
        smoothed=item.pictures["smoothed"] / np.float32(peak),
        extent=(x, x + width, y + height, y),
        isovalue=float(setting["isovalue"]),
        isophote=np.asarray(contours[0]["points"], dtype=float) if contours else None,
        ellipse=np.asarray(curves[0], dtype=float) if curves else None,
        truth=truth,
        candidates=candidates,
        errors_deg=tuple(float(angle_deg(candidate, truth)) for candidate in candidates),
        status=str(estimate.get("status")),
        is_default=is_default,
    )
