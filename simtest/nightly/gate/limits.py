"""The gate's level, and the differences that do no harm."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limits:
    """Level and equivalence margins of the gate; of a relative and an absolute margin the larger counts."""

    alpha: float = 0.01  # family-wise level: chance that a run without a change is called one, at most
    relative: float = 0.02  # share of the baseline by which errors, axis ratios, regions and levels may change
    absolute_deg: float = 0.002  # deg by which errors, laws and regions may change
    absolute_ratio: float = 0.002  # by which axis ratios, and the deviations of ratios and gains, may change
    absolute_eps: float = 1e-4  # by which the light's distance over the surface's may change
    absolute_snr: float = 0.1  # by which a peak over its noise may change
    rate: float = 0.02  # by which shares of highlights, and false detections a frame, may change
    coverage: float = 0.02  # by which coverage, and the truth's mean place in the regions, may change
    pooled_weight: float = 0.5  # share of alpha, in [0, 1), of all comparisons over many settings together
    medians_deg: float = 1e-3  # medians of errors that differ by no more are equal, on another processor too
