"""Print the table of docs/concepts/theory.md, section 3: `python -m studies.curvature_table reports/runs/curvature`."""

import sys
from pathlib import Path

import polars as pl


def main() -> None:
    """Print a row for each setting."""
    results = pl.read_parquet(Path(sys.argv[1]) / "results.parquet")
    for _, rows in results.group_by("setting", maintain_order=True):
        by = {
            name: rows.filter(pl.col("estimator") == name) for name in ("circle_pose", "brightest_point", "cone_axis")
        }
        low, high = float(rows["kd_min"].mean()), float(rows["kd_max"].mean())
        kd = f"{low:.2f}, {high:.2f}" if low * high < -1e-6 else f"{high if abs(high) >= abs(low) else low:.2f}"
        cells = [
            rows["label"][0],
            kd,
            _number(rows["axis_ratio_law"].mean(), 3),
            _answer(by["cone_axis"], "axis_ratio", 3),
            _number(by["circle_pose"]["error_law_deg"].mean(), 1),
            _answer(by["circle_pose"], "error_oracle_deg", 1),
            _answer(by["brightest_point"], "error_deg", 2),
            _answer(by["cone_axis"], "error_deg", 4),
        ]
        print("| " + " | ".join(cells) + " |")


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _answer(rows: pl.DataFrame, column: str, digits: int) -> str:
    """Return the mean of the rows that answered, or why none did."""
    mean = rows.filter(pl.col("status") == "ok")[column].mean()
    return f"{mean:.{digits}f}" if mean is not None else str(rows["status"][0])


if __name__ == "__main__":
    main()
