"""How many true highlights were found, how many detections are false, and how well each highlight meets its law."""

from typing import NamedTuple

import polars as pl

from simtest.conventions import ON_INSTRUMENT
from simtest.pages.style import estimator_order
from simtest.report.run_folder import Run
from simtest.report.series import LEAST_LAW, TOLERANCE_DEG, TOLERANCE_SHARE
from simtest.validation.statistics import counts

VIEWPOINT = "surface.viewpoint"
PATH_SHARE = "surface.path_share"
_MEASURES = (("error", "error_oracle_deg", "error_law_deg", "°", TOLERANCE_DEG),
             ("axis ratio", "axis_ratio", "axis_ratio_law", "", 0.0))  # fmt: skip
"""Name, columns of measurement and law, unit and the least tolerance."""


class Coverage(NamedTuple):
    """Two tables of a run over views of anatomies, a row for each setting and for each measure of it with a law."""

    found: pl.DataFrame  # setting, found (true highlights), detections, `row_kinds.counts`, coverage, false_share
    laws: pl.DataFrame  # setting, estimator, measure, unit, n, met (within tolerance), median, median_law, median_gap


def is_anatomical(run: Run) -> bool:
    """Whether a run is one over views of anatomies."""
    return bool({VIEWPOINT, PATH_SHARE} & set(run.results.columns))


def coverage(run: Run) -> Coverage | None:
    """Compute the tables; None for a run that is not over views of anatomies, or has no rows."""
    if not is_anatomical(run) or run.results.is_empty():
        return None
    # Detections are the same for all estimators of single highlights; one of clouds has fewer.
    answers = run.results.group_by("setting", "estimator", maintain_order=True).agg(n=pl.col("specularity").count())
    most = answers.filter(pl.col("n") == pl.col("n").max().over("setting")).unique("setting", keep="first")
    own = run.results.join(most, on=["setting", "estimator"], how="semi", maintain_order="left")
    # Without a detection, a highlight is not found whatever its status: in the dark it is no missed one.
    detected = pl.col("specularity").is_not_null()
    found = own.group_by("setting", maintain_order=True).agg(
        found=(detected & pl.col("true_id").is_not_null()).sum(), detections=detected.sum(), **counts(own)
    )
    # What shines on an instrument is no detection of tissue. Shares of nothing are null.
    detections = pl.col("detections") - pl.col(ON_INSTRUMENT)
    found = found.with_columns(
        coverage=pl.when(pl.col("true") > 0).then(pl.col("found") / pl.col("true")),
        false_share=pl.when(detections > 0).then(pl.col("false") / detections),
    )
    return Coverage(found, _laws(run.results))


def _laws(results: pl.DataFrame) -> pl.DataFrame:
    """Compare each highlight's measurement with the law at its own exact curvature and light."""
    ordered = results.with_row_index("order").with_columns(pl.col("order").min().over("setting"))
    ok = ordered.filter((pl.col("status") == "ok") & pl.col("true_id").is_not_null())
    ranks = {name: rank for rank, name in enumerate(estimator_order(ok["estimator"].to_list()))}
    tables = []
    for measure, value, law, unit, floor in _MEASURES:
        gap = (pl.col(value) - pl.col(law)).abs()
        allowed = pl.max_horizontal(pl.lit(floor), TOLERANCE_SHARE * pl.col(law))
        tables.append(
            ok.filter(pl.col(value).is_not_null() & (pl.col(law) > LEAST_LAW))
            .group_by("setting", "estimator")
            .agg(
                pl.col("order").first(), measure=pl.lit(measure), unit=pl.lit(unit), n=pl.len(),
                met=(gap <= allowed).sum(), median=pl.col(value).median(), median_law=pl.col(law).median(),
                median_gap=gap.median(),
            )
        )  # fmt: skip
    # Settings in their order, in each the estimators in the report's, of each the error first.
    rank = pl.col("estimator").replace_strict(ranks, default=0, return_dtype=pl.Int64)
    return pl.concat(tables).sort("order", rank, maintain_order=True)
