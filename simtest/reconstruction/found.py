"""What a reconstruction found: specularities with their estimates, and the detection that they stand on."""

from dataclasses import dataclass

from simtest.detection import Region
from simtest.detection.detector import Detection
from simtest.errors import Failure
from simtest.estimators import Estimate
from simtest.geometry import Patch
from simtest.reconstruction.choices import Choices
from simtest.runtime.arrays import LONGEST, clipped, short_repr, vector


@dataclass(frozen=True)
class Specularity:
    """One region of interest and what each estimator made of it.

    Parameters
    ----------
    region : Region
        Where it is.
    patch : Patch or Failure
        The smoothed crop.
    estimates : dict
        `Estimate` or `Failure` by estimator name.

    Examples
    --------
    >>> import numpy as np, simtest
    >>> y, x = np.mgrid[:120, :160] + 0.5
    >>> frame = np.exp(-((x - 80) ** 2 + (y - 60) ** 2) / 200).astype(np.float32)
    >>> spot = simtest.reconstruct(frame, simtest.Camera.from_fov(60.0, 160, 120))[0]
    >>> spot.estimates["cone_axis"].normal.round(2) + 0.0
    array([ 0.,  0., -1.])
    """

    region: Region
    patch: Patch | Failure
    estimates: dict[str, Estimate | Failure]

    def __repr__(self) -> str:
        x, y, width, height = self.region.box
        answered = [name for name, each in self.estimates.items() if isinstance(each, Estimate)]
        failed = [f"{name} ({each.reason})" for name, each in self.estimates.items() if isinstance(each, Failure)]
        where = f"at ({x + width / 2:.1f}, {y + height / 2:.1f}) px"
        if not isinstance(self.patch, Failure):
            where = f"peak {vector(self.patch.peak_px)} px"
        text = f"{where}, normals: {' '.join(answered) or 'none'}" + f", failed: {', '.join(failed)}" * bool(failed)
        return f"Specularity({clipped(text, LONGEST - 13)})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the patch with isophotes and normals, and a row for each estimator."""
        from simtest.reconstruction.notebook import specularity_html

        return specularity_html(self)


@dataclass(frozen=True)
class Reconstruction:
    """The normals of a picture, and the detection that they stand on."""

    specularities: list[Specularity]
    detection: Detection

    __repr__ = short_repr


class Specularities(list[Specularity]):
    """The specularities found in a frame, the brightest first, with how the frame was taken.

    Attributes
    ----------
    detection : Detection
        What the detector found, with highlights of other kinds and the view where it judges them.
    choices : Choices
        Encoding, detector, smoothing, estimators and priors; `choices.inferred` names those that nobody gave.
    """

    def __init__(self, made: Reconstruction, choices: Choices) -> None:
        super().__init__(made.specularities)
        self.detection, self.choices = made.detection, choices

    def __repr__(self) -> str:
        answered = sum(any(isinstance(e, Estimate) for e in each.estimates.values()) for each in self)
        what = "specularity" if len(self) == 1 else "specularities"
        text = f"{len(self)} {what}, {answered} with a normal; {self.choices}"
        return f"<Specularities: {clipped(text, LONGEST - 18)}>"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the frame with the best normals, and the first rows."""
        from simtest.reconstruction.notebook import specularities_html

        return specularities_html(self)
