"""Measure what stated uncertainties are worth on the corpus `hard`.

    python -m studies.hard --out FOLDER [--split test] [--scenes 48] [--first 0]

The answers on each scene's frames are kept in a folder of this code below FOLDER (`studies.kept`), one file a scene: a
run that was ended goes on where it stopped. The table is of the scenes from `--first` on. Scenes of the split `train`
are for fitting: no figure is quoted on them.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import polars as pl

from simtest.errors import SimtestError
from simtest.estimators import Estimator, load_estimators
from simtest.estimators.dispatch import run
from simtest.runtime.files import make_folder, write_atomically
from studies.hard.cases import calibration_of
from studies.hard.measure import Frames, Record, record
from studies.hard.rows import GROUPS, ROWS
from studies.hard.scenes import SPLITS, kind_of
from studies.hard.table import lines, text
from studies.kept import of_this_code

MOST = 8
"""Highlights of one frame that are judged, the brightest: one frame must not outweigh the others."""

ESTIMATORS = ("brightest_point", "cone_axis", "curved", "photometric", "circle_pose", "bisector")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.hard", description="Measure stated uncertainties.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=list(SPLITS), default="test")
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args(arguments)
    out = of_this_code(given.out)
    make_folder(out)
    estimators = {name: each for name, each in load_estimators(ESTIMATORS).items() if isinstance(each, Estimator)}
    tables = []
    for number in range(given.first, given.first + given.scenes):
        file = out / f"{given.split}_{number:05d}.parquet"
        if not file.exists():
            made = pl.DataFrame(list(_answers(SPLITS[given.split] + number, estimators)), infer_schema_length=None)
            write_atomically(file, made.write_parquet)
        tables.append(pl.read_parquet(file))
    table = pl.concat(tables, how="diagonal_relaxed")
    if table.height:
        print(text(lines(table, [row.name for row in ROWS], GROUPS)))
    return 0


def _answers(number: int, estimators: Mapping[str, Estimator]) -> Iterator[Record]:
    """Yield what the estimators state of a scene's highlights; rows that it cannot show are left out and told."""
    started, frames, count = time.process_time(), Frames(number), 0
    for row in ROWS:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                cases = list(frames.cases(row))
        except SimtestError as error:
            print(f"scene {number}, {row.name}: {error}", file=sys.stderr)
            continue
        count += len(cases)
        matched = 0
        for case in cases:
            matched += case.normal is not None
            if matched > MOST:
                break
            calibration = calibration_of(number, row, case.span_mm)
            for name, estimator in estimators.items():
                result = run(estimator, case.patch, calibration.camera, calibration.priors)
                yield record(number, kind_of(number), case, name, result)
    print(f"scene {number}: {count} highlights, {time.process_time() - started:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
