"""A canary: a figure whose value is known beforehand."""

from dataclasses import dataclass

import polars as pl

from simtest.nightly.gate.records import FIGURES


@dataclass(frozen=True)
class Canary:
    """A measured figure beside what it may be.

    Parameters
    ----------
    name : str
        What is watched.
    quantity : str
        What of it was measured.
    unit : str
        Of the value.
    value : float
        NaN, where there was nothing to measure, does not pass.
    high : float
        What it may be at most.
    low : float
        What it must be at least.
    n : int
        How many numbers the value was made of.
    about : str
        What is right, and why the tolerance is what it is.
    """

    name: str
    quantity: str
    unit: str
    value: float
    high: float
    low: float = 0.0
    n: int = 1
    about: str = ""

    @property
    def passed(self) -> bool:
        """Whether the value is what it may be."""
        return bool(self.low <= self.value <= self.high)


def as_figures(canaries: list[Canary]) -> pl.DataFrame:
    """Give canaries as a night's figures: columns `FIGURES`, kind "canary"."""
    blank = dict.fromkeys(("label", "surface", "setting", "estimator"), "")
    return pl.DataFrame(
        [
            {
                "kind": "canary", "experiment": canary.name, **blank, "quantity": canary.quantity, "unit": canary.unit,
                "value": canary.value, "low": canary.low, "high": canary.high, "n": canary.n, "passed": canary.passed,
                "about": canary.about,
            }
            for canary in canaries
        ],
        schema=FIGURES,
    ).with_columns(pl.col("value").fill_nan(None))  # fmt: skip
