"""How many true highlights were found, how many detections are false, and how well each highlight meets its law."""

from dataclasses import dataclass
from typing import Any

import polars as pl

from simtest.pages.style import estimator_order
from simtest.report.run_folder import Run
from simtest.report.series import LEAST_LAW, TOLERANCE_DEG, TOLERANCE_SHARE

VIEWPOINT = "surface.viewpoint"
PATH_SHARE = "surface.path_share"


@dataclass(frozen=True)
class Coverage:
    """Two tables of a run over views of anatomies.

    Parameters
    ----------
    found : tuple of dict
        For each setting: true isolated highlights, found, missed, false, and their shares.
    laws : tuple of dict
        For each setting and measure with a law: highlights, those within tolerance, median departure.
    """

    found: tuple[dict[str, Any], ...]
    laws: tuple[dict[str, Any], ...]


def is_anatomical(run: Run) -> bool:
    """Tell whether a run is one over views of anatomies."""
    return bool({VIEWPOINT, PATH_SHARE} & set(run.results.columns))


def coverage(run: Run) -> Coverage | None:
    """Compute the tables; None for a run that is not over views of anatomies, or has no rows.

    Parameters
    ----------
    run : Run
        A run directory.

    Returns
    -------
    Coverage or None
    """
    if not is_anatomical(run) or run.results.is_empty():
        return None
    found, laws = [], []
    for (setting,), rows in run.results.group_by("setting", maintain_order=True):
        # Detections are the same for all estimators.
        own = rows.filter(pl.col("estimator") == rows["estimator"][0])
        true = own.filter(pl.col("true_id").is_not_null())
        missed = true.filter(pl.col("status") == "missed").height
        false = own.height - true.height
        hits = true.height - missed
        found.append(
            {"setting": setting, "true": true.height, "found": hits, "missed": missed, "false": false,
             "coverage": _share(hits, true.height), "false_share": _share(false, hits + false)}
        )  # fmt: skip
        laws += _laws(str(setting), rows)
    return Coverage(tuple(found), tuple(laws))


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _laws(setting: str, rows: pl.DataFrame) -> list[dict[str, Any]]:
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
            table.append(
                {"setting": setting, "estimator": name, "measure": measure, "unit": unit, "n": both.height,
                 "met": int((gap <= allowed).sum()), "median_gap": gap.median(),
                 "median_law": both[law].median(), "median": both[value].median()}
            )  # fmt: skip
    return table
