"""Whether two processors agree on the benchmark: medians, statuses and bits of two folders of `simtest bench run`.

``python -m studies.bench_processors FIRST SECOND`` compares what ``simtest bench run --core CORE --out FIRST`` wrote on
one processor with what the same command wrote on another. A processor can be emulated, at 15 times the cost::

    export NPY_DISABLE_CPU_FEATURES=X86_V3
    qemu-x86_64 -cpu Haswell .venv/bin/python -m simtest bench run --core CORE --part smooth --out SECOND

LLVM, OpenBLAS and NumPy then use the instructions of that processor. (The variable keeps NumPy from AVX2, whose gather
crashes in version 7.2 of the emulator.)
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from simtest.bench.scores import HASHED, results_hash

TOLERANCE_DEG = 1e-3
"""By how much medians may differ between processors."""


def compare(first: Path, second: Path) -> Iterator[tuple[bool, str]]:
    """Yield for each part and estimator whether two runs agree, and a line that says by how much they differ."""
    parts = [{path.parent.name for path in folder.glob("*/results.parquet")} for folder in (first, second)]
    for part in sorted(set.intersection(*parts)):
        tables = [pl.read_parquet(folder / part / "results.parquet") for folder in (first, second)]
        for estimator in tables[0]["estimator"].unique(maintain_order=True):
            yield _line(part, estimator, *(table.filter(pl.col("estimator") == estimator) for table in tables))


def _line(part: str, estimator: str, one: pl.DataFrame, other: pl.DataFrame) -> tuple[bool, str]:
    medians = [table.filter(pl.col("true_id").is_not_null())["error_deg"].median() for table in (one, other)]
    apart = 0.0 if medians == [None, None] else abs(float(medians[0]) - float(medians[1]))  # type: ignore[arg-type]
    keys = ["setting", "realisation", "specularity", "true_id"]
    paired = one.join(other, on=keys, how="full", nulls_equal=True, suffix="_other")
    changed = paired.filter(pl.col("status").ne_missing(pl.col("status_other"))).height
    gap = (paired["error_deg"] - paired["error_deg_other"]).abs().max()
    single = "no single error" if gap is None else f"single errors by at most {gap:.2g}"
    bits = "equal bits" if results_hash(one.select(HASHED)) == results_hash(other.select(HASHED)) else "other bits"
    counts = f"{paired.height:5} rows, {changed} of another status"
    told = f"{part:10} {estimator:16} {counts}, medians differ by {apart:.2g} deg, {single}, {bits}"
    return apart <= TOLERANCE_DEG, told


def main() -> int:
    """Compare two folders; return 1 if any median differs by more than `TOLERANCE_DEG`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path)
    given = parser.parse_args()
    found = list(compare(given.first, given.second))
    for _, text in found:
        print(text)
    return 0 if found and all(agrees for agrees, _ in found) else 1


if __name__ == "__main__":
    sys.exit(main())
