"""Powers of a cosine in single precision, for narrow lobes, and the mean of a spectrum."""

from typing import Any


def log_cosine(first: Any, second: Any) -> tuple[Any, Any]:
    """Compute log cos(beta), and whether beta is below 90 deg.

    With t = tan(beta/2) = |a - b|/|a + b|, log cos(beta) = -2 artanh(t^2). A dot product loses the digits that matter
    next to 1: the relative error of its k-th power would be k eps, that of this form is sqrt(k) eps within the lobe.

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


def channel_mean(spectrum: Any) -> Any:
    """Return the mean of a spectrum's channels.

    `drjit.mean` multiplies by the length of the launch and divides by it again, and keeps both in the kernel, so that
    each other length compiles another kernel.
    """
    return sum(spectrum) / len(spectrum)
