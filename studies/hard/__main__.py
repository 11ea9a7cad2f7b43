"""Measure what stated uncertainties are worth on the corpus `hard`.

    python -m studies.hard --out FOLDER [--split test] [--scenes 48] [--first 0] [--row NAME]...
        [--judged-from 0] [--estimator NAME]...

The highlights of each scene's frames are kept in a folder of this code below FOLDER (`studies.kept`), one file a scene:
a run that was ended goes on where it stopped, and another one judges estimators without rendering. The table is printed
at the end, of all scenes that are there. With `--row` those rows alone are rendered and judged; a later run adds other
rows to the files. Scenes of the split `train` are for fitting: no figure is quoted on them.
"""

import argparse
import sys
import time
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import polars as pl

from simtest.errors import SimtestError
from simtest.estimators import Estimator, load_estimators
from simtest.estimators.dispatch import run
from simtest.runtime.files import make_folder
from studies.hard.cases import Case, calibration_of, load, rows_in, save
from studies.hard.measure import Frames, Record, record
from studies.hard.rows import GROUPS, ROWS, Row
from studies.hard.scenes import SPLITS, kind_of
from studies.hard.table import lines, text
from studies.kept import of_this_code

MOST = 8
"""Highlights of one frame that are judged."""

ESTIMATORS = ("brightest_point", "cone_axis", "curved", "photometric", "circle_pose", "bisector")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(prog="python -m studies.hard", description="Measure stated uncertainties.")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=list(SPLITS), default="test")
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--judged-from", type=int, default=0, help="scenes before this one are not judged")
    parser.add_argument("--row", action="append", dest="rows")
    parser.add_argument("--estimator", action="append", dest="estimators")
    given = parser.parse_args(arguments)
    rows = [row for row in ROWS if not given.rows or row.name in given.rows]
    out = of_this_code(given.out)
    make_folder(out)
    for number in range(given.first, given.first + given.scenes):
        _render(SPLITS[given.split] + number, out / f"{given.split}_{number:05d}.npz", rows)
    loaded = load_estimators(list(given.estimators or ESTIMATORS))
    # Those of whole frames are measured by studies of their own.
    estimators = {name: each for name, each in loaded.items() if isinstance(each, Estimator)}
    records: list[Record] = []
    for file in sorted(out.glob(f"{given.split}_*.npz")):
        number = int(file.stem.rpartition("_")[2])
        if number >= given.judged_from:
            kept = _first_of_each_row(load(file))
            of_scene = SPLITS[given.split] + number
            records += [answer for case in kept for answer in _answers(of_scene, case, rows, estimators)]
    if records:
        table = pl.DataFrame(records, infer_schema_length=None)
        table.write_parquet(out / f"{given.split}.parquet")
        print(text(lines(table, [row.name for row in rows], GROUPS)))
    return 0


def _render(number: int, file: Path, rows: Sequence[Row]) -> None:
    """Keep the highlights of rows of a scene that its file lacks; rows that it cannot show are left out and told."""
    done = rows_in(file)
    missing = [row for row in rows if row.name not in done]
    if not missing:
        return
    started, frames, cases = time.process_time(), Frames(number), list(load(file)) if done else []
    for row in missing:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                cases += list(frames.cases(row))
        except SimtestError as error:
            print(f"scene {number}, {row.name}: {error}", file=sys.stderr)
    save(file, cases, done | {row.name for row in missing})
    print(f"scene {number}: {len(cases)} highlights, {time.process_time() - started:.0f} s", file=sys.stderr)


def _first_of_each_row(cases: Iterable[Case]) -> Iterator[Case]:
    """Leave out highlights beyond the first of a row, the brightest: one frame must not outweigh the others."""
    count: Counter[str] = Counter()
    for case in cases:
        count[case.row] += case.normal is not None
        if count[case.row] <= MOST:
            yield case


def _answers(number: int, case: Case, rows: Sequence[Row], estimators: Mapping[str, Estimator]) -> list[Record]:
    """Return what the estimators state of one highlight."""
    row = next((row for row in rows if row.name == case.row), None)
    if row is None:
        return []
    calibration = calibration_of(number, row, case.span_mm)
    camera, priors = calibration.camera, calibration.priors
    results = ((name, run(estimator, case.patch, camera, priors)) for name, estimator in estimators.items())
    return [record(number, kind_of(number), case, name, result) for name, result in results]


if __name__ == "__main__":
    sys.exit(main())
