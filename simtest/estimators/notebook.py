"""What a notebook shows of an estimate."""

import numpy as np

from simtest.estimators.budget import deviations
from simtest.estimators.protocol import Estimate
from simtest.geometry import chi_squared
from simtest.geometry.vectors import covariance_across, tilt_deg
from simtest.pages.notebook import normal_html, note_html, table_html


def estimate_html(estimate: Estimate) -> str:
    """Return the normal in the view, with its 95 % ellipse, and the budget of its uncertainty."""
    x, y, z = estimate.normal
    lines = [
        f"normal ({x:.4f}, {y:.4f}, {z:.4f}), camera frame; {tilt_deg(estimate.normal):.2f} deg from the optical axis"
    ]
    if estimate.deviation_deg is not None:
        lines.append(f"standard deviation {estimate.deviation_deg:.3g} deg; the ellipse holds 95 % of the errors")
    if len(estimate.candidates) > 1:
        lines.append(f"{len(estimate.candidates)} candidates; the proposed one is shown")
    if estimate.flags:
        lines.append("flags: " + ", ".join(estimate.flags))
    parts = sorted(deviations(estimate.budget or {}).items(), key=lambda part: -part[1])
    table = table_html(("part", "standard deviation (deg)"), [(n, f"{np.degrees(v):.3g}") for n, v in parts])
    region = None
    if estimate.covariance is not None:
        region = chi_squared.quantile(0.95, 2) * covariance_across(estimate.normal, estimate.covariance)
    return normal_html(estimate.normal[:2], region) + "".join(map(note_html, lines)) + (table if parts else "")
