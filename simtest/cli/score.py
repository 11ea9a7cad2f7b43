"""`simtest score`."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from simtest.cli.dense_score import (
    MapDepth,
    MapEncoding,
    MapFrame,
    MapUnit,
    is_dense,
    refuse_dense_options,
    score_dense,
)
from simtest.cli.options import Address, AsJson, EngineName, Workers, named_path

DEFAULT_OUT = Path("reports/scores")


def score(
    answers: Annotated[Path, Parameter(converter=named_path)],
    /,
    *,
    on: Annotated[
        Path,
        Parameter(help="Run or dataset whose frames were exported; it holds export.json.", converter=named_path),
    ],
    out: Annotated[
        Path | None, Parameter(help="Folder of the scored run; default reports/scores/NAME.", converter=named_path)
    ] = None,
    name: Annotated[str | None, Parameter(help="Name of the method in the results; default that of the file.")] = None,
    engine: EngineName = "local",
    workers: Workers = 1,
    address: Address = None,
    encoding: MapEncoding = None,
    frame: MapFrame = None,
    depth: MapDepth = None,
    unit_mm: MapUnit = None,
    as_json: AsJson = False,
) -> None:
    """Score normals that were estimated elsewhere on exported frames, as our own estimators are scored.

    Parameters
    ----------
    answers : Path
        Table of normals, CSV or Parquet: frame, x_px, y_px, normal_x, normal_y, normal_z (docs/howto/score.md). Or a
        folder of maps of normals or depths, or the word shading, for a score of every pixel (docs/howto/dense.md).
    """
    if is_dense(answers):
        score_dense(answers, on, out, name, encoding, frame, depth, unit_mm, as_json)
        return
    refuse_dense_options(encoding=encoding, frame=frame, depth=depth, unit_mm=unit_mm)
    from simtest.cli.guide_table import print_guide
    from simtest.cli.printing import print_run
    from simtest.cli.progress import progress_bar
    from simtest.dataset.scoring.run import score_table
    from simtest.report import write_report
    from simtest.runtime.processes import make_engine

    command = shlex.join(["simtest", *sys.argv[1:]])
    folder = out or DEFAULT_OUT / (name or answers.stem)
    with progress_bar() as progress:
        chosen = make_engine(engine, workers, address)
        run = score_table(answers, on, folder, name, command, chosen, progress)
        page = write_report(run.folder, progress)
    if as_json:
        print_run(folder)
        return
    print_guide(folder)
    print(page)
