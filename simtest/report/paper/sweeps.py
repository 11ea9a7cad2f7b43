"""The sweeps of the published protocol, gathered from a run's rows: what the article's error plots show."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
import polars as pl

from simtest.pages.style import degrees, estimator_order, number
from simtest.report.paper.parameters import DEFAULTS, PARAMETERS, PREFIX, Parameter
from simtest.report.run_folder import Run
from simtest.runtime.arrays import Array

Value = float | bool | None  # what a row holds of a parameter
_FEWEST = 2
_LEAST_LAW_DEG = 1e-3  # a smaller prediction is none


@dataclass(frozen=True)
class Sweep:
    """One estimator's errors over one parameter, all else fixed; the better candidate's error, deg."""

    parameter: Parameter  # what is swept
    estimator: str
    label: str  # of the group of settings
    fixed: Mapping[str, Value]  # the other parameters' values by name
    x: Array  # values of the parameter, ascending, as in the rows; shape (n,), as all that follow
    mean: Array  # over the answered realisations; NaN where there is none
    std: Array  # NaN where there is none or one
    least: Array
    largest: Array
    answered: Array  # realisations
    failed: Array
    reasons: tuple[str, ...]  # of the failures, with their counts
    bound: Array  # Cramer-Rao bound (RMS angle), deg; NaN where there is none
    law: Array  # predicted error without noise, deg; NaN where there is none

    @property
    def shown_x(self) -> Array:
        """Values of the parameter in the unit of the axis."""
        return self.x * self.parameter.factor

    @property
    def measured(self) -> str:
        """The measured numbers in words."""
        known, other = np.isfinite(self.mean), departures(self.fixed)
        text = f"{self.estimator}, {self.label}" + (f" ({other}): " if other else ": ")
        if known.any():
            low, high, largest = np.nanmin(self.mean), np.nanmax(self.mean), np.nanmax(self.largest)
            text += f"means from {degrees(float(low))} to {degrees(float(high))}, single errors up to "
            text += degrees(float(largest))
        else:
            text += "no answer"
        failing = [
            f"{self.parameter.text(float(x))}: {failed:.0f} of {failed + answered:.0f} ({reasons})"
            for x, failed, answered, reasons in zip(self.x, self.failed, self.answered, self.reasons, strict=True)
            if failed
        ]
        text += f"; failures at {', '.join(failing)}" if failing else "; no failures"
        wide = known & np.isfinite(self.law) & (self.law > _LEAST_LAW_DEG)
        if self.fixed.get("sigma") == 0 and wide.any():
            ratio = self.mean[wide] / self.law[wide]
            text += f"; measured over predicted bias {number(float(ratio.min()))} to {number(float(ratio.max()))}"
        return text + "."

    @property
    def standard_error(self) -> Array:
        """Standard error of each mean; NaN where a setting has fewer than two answers."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.std / np.sqrt(self.answered))


@dataclass(frozen=True)
class SweepFigure:
    """An error plot: all sweeps over one parameter."""

    parameter: Parameter
    sweeps: tuple[Sweep, ...]

    @property
    def key(self) -> str:
        """Name of the figure's files."""
        return f"error_vs_paper_{self.parameter.name}"

    @property
    def title(self) -> str:
        """Title of the figure."""
        return f"Error against {self.parameter.words} {self.parameter.symbol}"

    @property
    def bounds(self) -> list[Sweep]:
        """The sweeps whose Cramer-Rao bound is drawn: one a label, where it is not 0 everywhere."""
        seen: dict[str, Sweep] = {}
        for sweep in self.sweeps:
            if np.isfinite(sweep.bound).sum() > 1 and np.nanmax(sweep.bound) > 0:
                seen.setdefault(sweep.label, sweep)
        return list(seen.values())

    @property
    def laws(self) -> list[tuple[int, Sweep]]:
        """The sweeps whose law is drawn, with their indices: it is known at two settings, not 0 everywhere."""
        known = [(i, sweep) for i, sweep in enumerate(self.sweeps) if np.isfinite(sweep.law).sum() > 1]
        return [(i, sweep) for i, sweep in known if np.nanmax(sweep.law) > _LEAST_LAW_DEG]


def is_published(run: Run) -> bool:
    """Whether a run has rows of the published protocol."""
    return any(name.startswith(PREFIX) for name in run.results.columns)


def sweep_figures(run: Run) -> list[SweepFigure]:
    """Return the error plots of a run, one for each swept parameter, in the article's order.

    A run without rows of the published protocol has none.
    """
    found = list(_sweeps(run)) if is_published(run) else []
    figures = []
    for parameter in PARAMETERS.values():
        own = tuple(sweep for sweep in found if sweep.parameter == parameter)
        if own:
            figures.append(SweepFigure(parameter, own))
    return figures


def _sweeps(run: Run) -> Iterator[Sweep]:
    columns = [name for name in run.results.columns if name.startswith(PREFIX) and name[len(PREFIX) :] in PARAMETERS]
    rows = run.results.filter(pl.any_horizontal(pl.col(columns).is_not_null()))
    for (label,), part in rows.group_by("label", maintain_order=True):
        swept = [name for name in columns if part[name].drop_nulls().n_unique() >= _FEWEST]
        for name in swept:
            others = [other for other in swept if other != name]
            pieces = part.partition_by(others, maintain_order=True) if others else [part]
            kept = [piece for piece in pieces if piece[name].n_unique() >= _FEWEST]
            for piece in kept:
                held = {c[len(PREFIX) :]: piece[c].drop_nulls().first() for c in columns if c != name}
                fixed = cast(Mapping[str, Value], held)
                more = [PARAMETERS[other[len(PREFIX) :]].text(fixed[other[len(PREFIX) :]]) for other in others]
                for estimator in estimator_order(piece["estimator"].unique().to_list()):
                    own = piece.filter(pl.col("estimator") == estimator)
                    yield _sweep(own, name, estimator, ", ".join([str(label), *more]), fixed)


def _sweep(rows: pl.DataFrame, column: str, estimator: str, label: str, fixed: Mapping[str, Value]) -> Sweep:
    ok = (pl.col("status") == "ok") & pl.col("error_oracle_deg").is_not_null()
    error = pl.col("error_oracle_deg").filter(ok)
    bound = pl.col("bound_deg") if "bound_deg" in rows.columns else pl.lit(None, pl.Float64)
    table = (
        rows.filter(pl.col(column).is_not_null())
        .with_columns(bound=bound)
        .group_by(pl.col(column).cast(pl.Float64).alias("x"))
        .agg(
            mean=error.mean(), std=error.std(), least=error.min(), largest=error.max(), answered=error.len(),
            total=pl.len(), bound=pl.col("bound").first(), law=pl.col("error_law_deg").drop_nulls().first(),
            reasons=pl.col("status").filter(~ok.fill_null(False)).fill_null("unknown"),
        )
        .sort("x")
    )  # fmt: skip
    values = {
        name: table[name].cast(pl.Float64).to_numpy().astype(float)
        for name in ("x", "mean", "std", "least", "largest", "bound", "law")
    }
    # The mean of equal errors may lie a rounding outside of them.
    values["mean"] = np.clip(values["mean"], values["least"], values["largest"])
    answered = table["answered"].to_numpy().astype(float)
    reasons = tuple(_counted(list(entry)) for entry in table["reasons"].to_list())
    failed = table["total"].to_numpy().astype(float) - answered
    parameter = PARAMETERS[column[len(PREFIX) :]]
    return Sweep(parameter, estimator, label, fixed, answered=answered, failed=failed, reasons=reasons, **values)


def _counted(reasons: list[str]) -> str:
    return ", ".join(f"{name} {reasons.count(name)}" for name in sorted(set(reasons)))


def departures(fixed: Mapping[str, Value]) -> str:
    """Write the fixed parameters that are not the article's defaults; empty where all are."""
    return ", ".join(
        PARAMETERS[name].text(value)
        for name, value in fixed.items()
        if value is not None and value != DEFAULTS[name]
    )  # fmt: skip
