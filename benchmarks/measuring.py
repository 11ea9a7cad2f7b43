"""What the benchmarks share: a measured figure with its limit."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A measured figure beside what the project promises.

    Parameters
    ----------
    name : str
        What was measured.
    value : float
        The figure.
    limit : float or None
        What it must keep to; None where it is shown alone.
    at_least : bool
        Whether the limit is a lower one.
    unit : str
        "x" for a ratio.
    about : str
        The times behind it.
    """

    name: str
    value: float
    limit: float | None = None
    at_least: bool = False
    unit: str = "x"
    about: str = ""

    @property
    def met(self) -> bool:
        """Whether the figure keeps to its limit."""
        if self.limit is None:
            return True
        return self.value >= self.limit if self.at_least else self.value <= self.limit
