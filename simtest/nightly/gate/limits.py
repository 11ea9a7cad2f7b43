"""The gate's level, and the differences that do no harm."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Level and equivalence margins of the gate; of a relative and an absolute margin the larger counts."""

    alpha: float = 0.01  # family-wise level: chance that a run without a regression is called one, at most
    relative: float = 0.02  # share of the baseline by which errors and the axis ratio's deviation may rise
    absolute_deg: float = 0.002  # deg by which errors may rise
    absolute_ratio: float = 0.002  # by which the mean deviation of the axis ratio from its law may rise
    rate: float = 0.02  # by which the share of unanswered highlights, and false detections a frame, may rise
    coverage: float = 0.02  # by which the share of normals inside their 95 % region may fall
    run_time: float = 0.5  # share by which the run time of a piece of work, over the reference kernel's, may rise
    memory: float = 0.25  # share by which peak memory may rise
    pooled_weight: float = 0.5  # share of alpha, in [0, 1), of all comparisons over many settings together
    medians_deg: float = 1e-3  # medians of errors that differ by no more are equal, on another processor too
