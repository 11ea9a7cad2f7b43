"""What the frames of a track tell of a highlight's curvature: an entry of a sequence's files."""

from dataclasses import dataclass

from simtest.runtime.files import JsonObject

COLUMNS = ("motion", "motion_frames", "bend_1", "bend_2", "sign_1", "sign_2", "margin_1", "margin_2")
"""Columns of timeline.csv of a sequence with poses."""


@dataclass(frozen=True)
class MotionRecord:
    """What motion tells of a highlight.

    Parameters
    ----------
    status : str
        "ok" where both signs are told, else the `Reason`; `detail` says more.
    frames : tuple of int
        Frames that judged it.
    signs : tuple of int
        Of 1 + d k along both principal directions of the estimate `curved`; 0 where it is not told.
    margins : tuple of float
        Twice the log of the likelihood ratio of each sign and the other one.
    gains : tuple of float
        1 + d k of the hypothesis that explains the frames best, told or not.
    bends : tuple of str
        "convex", "concave" or "undecided" along both directions.
    distance2, freedom : float, int
        Squared Mahalanobis distance of that hypothesis, and its degrees of freedom; `fits` says whether it is one that
        chance explains.
    motions : tuple of float, optional
        Shortest and longest motion to another frame of its track, as shares of the distance; None where there is none.
    """

    status: str
    detail: str = ""
    frames: tuple[int, ...] = ()
    signs: tuple[int, int] = (0, 0)
    margins: tuple[float, ...] = (0.0, 0.0)
    gains: tuple[float, ...] = ()
    bends: tuple[str, str] = ("undecided", "undecided")
    distance2: float | None = None
    freedom: int = 0
    fits: bool = False
    motions: tuple[float, float] | None = None

    @property
    def shape(self) -> str:
        """The bends in a word: convex, concave, saddle, or both one by one."""
        first, second = self.bends
        if first == second:
            return first
        return "saddle" if "undecided" not in self.bends else f"{first} and {second}"

    def row(self) -> tuple[object, ...]:
        """Return the values of `COLUMNS`."""
        return (self.status, len(self.frames), *self.bends, *self.signs, *self.margins)

    def to_json(self) -> JsonObject:
        """Return the entry ``motion`` of a specularity."""
        return {**vars(self), "shape": self.shape}
