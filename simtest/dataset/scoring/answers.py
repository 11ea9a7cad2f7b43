"""Answers to one frame, looked up as an estimator gives them."""

from collections.abc import Sequence
from dataclasses import dataclass

from simtest.calibration import Frame
from simtest.errors import Failure, Reason
from simtest.estimators import Estimate
from simtest.estimators.dispatch import assign
from simtest.geometry import Array, Patch

_TAKEN = Failure(Reason.NO_ESTIMATE, "a row names this detection")


@dataclass(frozen=True)
class Answer:
    """One row of a table of answers.

    Parameters
    ----------
    result : Estimate or Failure
        The normal, or why there is none.
    point_px : ndarray, shape (2,)
        Pixel that is answered for.
    specularity : int, optional
        Number of the detection in highlights.csv; without it the pixel decides.
    """

    result: Estimate | Failure
    point_px: Array
    specularity: int | None = None


@dataclass(frozen=True)
class TableEstimator:
    """Answers made elsewhere, of one frame. It sees nothing of the frame: what it returns was in the table."""

    answers: Sequence[Answer]

    def estimate_regions(
        self, _frame: Frame, patches: Sequence[Patch | Failure], /
    ) -> tuple[Sequence[Estimate | Failure | None], Sequence[Estimate]]:
        """Return the answer for each patch, None where the table has no row, and normals that belong to no patch."""
        # Rows that name a detection.
        of_patches: list[Estimate | Failure | None] = [None] * len(patches)
        located = []
        for answer in self.answers:
            if answer.specularity is None:
                located.append(answer)
            else:
                of_patches[answer.specularity] = answer.result
        # The others by their pixel, to patches that none has named.
        free = [patch if own is None else _TAKEN for patch, own in zip(patches, of_patches, strict=True)]
        taken = assign([answer.point_px for answer in located], free)
        for patch, index in taken.items():
            of_patches[patch] = located[index].result
        used = set(taken.values())
        rest = [answer.result for index, answer in enumerate(located) if index not in used]
        return of_patches, [result for result in rest if not isinstance(result, Failure)]
