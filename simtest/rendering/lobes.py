"""Powers of a cosine in single precision, for narrow lobes."""

from typing import Any


def log_cosine(first: Any, second: Any) -> tuple[Any, Any]:
    """Give log cos(beta), and whether beta is below 90 deg.

    With t = tan(beta/2) = |a - b|/|a + b|, log cos(beta) = -2 artanh(t^2). The cosine itself, by a dot product, has
    lost the digits that count next to 1: its k-th power's relative error would be k eps, while this form's is
    sqrt(k) eps within the lobe.

    Parameters
    ----------
    first, second : mitsuba.Vector3f
        Unit vectors a and b, beta apart.

    Returns
    -------
    log_cosine : mitsuba.Float
        0 where beta is 90 deg or more.
    ahead : mitsuba.Bool
    """
    import drjit as dr

    squared = dr.squared_norm(first - second) / dr.squared_norm(first + second)
    ahead = squared < 1
    return -2 * dr.atanh(dr.select(ahead, squared, 0)), ahead
