"""How many true highlights were found, how many detections are false, and how well each highlight meets its law."""

from dataclasses import dataclass

import polars as pl

from simtest.pages.style import estimator_order
from simtest.report.run_folder import Run
from simtest.report.series import LEAST_LAW, TOLERANCE_DEG, TOLERANCE_SHARE

VIEWPOINT = "surface.viewpoint"
PATH_SHARE = "surface.path_share"


@dataclass(frozen=True)
class FoundRow:
    """Counts of one setting: true isolated highlights, those missed, and false detections."""

    setting: str
    true: int
    missed: int
    false: int

    @property
    def found(self) -> int:
        """True highlights that were found."""
        return self.true - self.missed

    @property
    def coverage(self) -> float | None:
        """Share of the true highlights that were found."""
        return self.found / self.true if self.true else None

    @property
    def false_share(self) -> float | None:
        """Share of the detections that are false."""
        return self.false / (self.found + self.false) if self.found + self.false else None


@dataclass(frozen=True)
class LawRow:
    """One measure with a law in one setting: highlights, those within tolerance, and medians in `unit`."""

    setting: str
    estimator: str
    measure: str
    unit: str
    n: int
    met: int
    median: float
    median_law: float
    median_gap: float


@dataclass(frozen=True)
class Coverage:
    """Two tables of a run over views of anatomies."""

    found: tuple[FoundRow, ...]
    laws: tuple[LawRow, ...]


def is_anatomical(run: Run) -> bool:
    """Whether a run is one over views of anatomies."""
    return bool({VIEWPOINT, PATH_SHARE} & set(run.results.columns))


def coverage(run: Run) -> Coverage | None:
    """Compute the tables; None for a run that is not over views of anatomies, or has no rows."""
    if not is_anatomical(run) or run.results.is_empty():
        return None
    found, laws = [], []
    for (setting,), rows in run.results.group_by("setting", maintain_order=True):
        # Detections are the same for all estimators.
        own = rows.filter(pl.col("estimator") == rows["estimator"][0])
        true = own.filter(pl.col("true_id").is_not_null())
        missed = true.filter(pl.col("status") == "missed").height
        found.append(FoundRow(str(setting), true.height, missed, own.height - true.height))
        laws += _laws(str(setting), rows)
    return Coverage(tuple(found), tuple(laws))


def _laws(setting: str, rows: pl.DataFrame) -> list[LawRow]:
    """Compare each highlight's measurement with the law at its own exact curvature and light."""
    ok = rows.filter((pl.col("status") == "ok") & pl.col("true_id").is_not_null())
    table = []
    for name in estimator_order(ok["estimator"].to_list()):
        own = ok.filter(pl.col("estimator") == name)
        for measure, value, law, unit, floor in (
            ("error", "error_oracle_deg", "error_law_deg", "°", TOLERANCE_DEG),
            ("axis ratio", "axis_ratio", "axis_ratio_law", "", 0.0),
        ):
            both = own.filter(pl.col(value).is_not_null() & (pl.col(law) > LEAST_LAW))
            if both.is_empty():
                continue
            gap = (both[value] - both[law]).abs()
            allowed = both.select(pl.max_horizontal(pl.lit(floor), TOLERANCE_SHARE * pl.col(law))).to_series()
            medians = (float(part.median()) for part in (both[value], both[law], gap))  # type: ignore[arg-type]
            table.append(LawRow(setting, name, measure, unit, both.height, int((gap <= allowed).sum()), *medians))
    return table
