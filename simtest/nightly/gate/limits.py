"""The gate's level, and the differences that do no harm."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Level and equivalence margins of the gate.

    Parameters
    ----------
    alpha : float
        Family-wise level: the chance that a run without a regression is called one, at most.
    relative : float
        Share of the baseline by which errors and the axis ratio's deviation may rise.
    absolute_deg : float
        deg by which errors may rise; the larger of the two margins counts.
    absolute_ratio : float
        By which the mean deviation of the axis ratio from its law may rise; the larger of the two counts.
    rate : float
        By which the share of unanswered highlights, and the number of false detections a frame, may rise.
    coverage : float
        By which the share of normals inside their 95 % region may fall.
    run_time : float
        Share by which the run time of a piece of work, over the reference kernel's, may rise.
    memory : float
        Share by which peak memory may rise.
    pooled_weight : float
        Share of alpha of the comparisons over many settings together, in [0, 1); the rest is for single settings.
    medians_deg : float
        Medians of errors that differ by no more are equal, on another processor too.
    """

    alpha: float = 0.01
    relative: float = 0.02
    absolute_deg: float = 0.002
    absolute_ratio: float = 0.002
    rate: float = 0.02
    coverage: float = 0.02
    run_time: float = 0.5
    memory: float = 0.25
    pooled_weight: float = 0.5
    medians_deg: float = 1e-3
