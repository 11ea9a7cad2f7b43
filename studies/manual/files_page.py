"""The page of files and columns, from the tables in the code that writes them."""

import inspect
import re
from collections.abc import Iterable, Mapping

from docstring_parser import parse

from simtest.dataset.fields import FIELDS as SAMPLE_FIELDS
from simtest.dataset.index import HIGHLIGHT_COLUMNS, SAMPLE_COLUMNS
from simtest.reconstruction.outputs import COLUMNS
from simtest.simulation.frame_files import FIELDS, FILES, INSTRUMENT_FIELDS
from simtest.validation.columns import COLUMNS as RESULTS
from simtest.validation.columns import Column
from simtest.validation.runner import RunRecord
from simtest.validation.statistics import Figures
from studies.manual.markdown import code, table
from studies.manual.tables import CONSTRAINTS, ESTIMATE, NORMALS, SPECULARITY

PAGE = """# Files and columns

What the commands write, and what each column and key means. Lengths are in mm, pixels have their centres at
integer + 0.5, and the camera frame has x to the right, y down and z forward. [Keys of the files](keys.md) lists what
the commands read.

## A rendered frame

`simtest render` writes @FILES.
Names without a file below are arrays of truth.npz; frame.json holds the same list under its key `fields`. `instrument`
and `visible_highlights.instrument` exist where the scene lists instruments.

@FRAME

## Normals of a picture

`simtest reconstruct` writes these files; [Pictures](../howto/pictures.md) explains how to read them.

### normals.json

@NORMALS

### normals.json: a specularity

@SPECULARITY

### normals.json: an estimate

@ESTIMATE

### normals.csv

A row for each specularity, estimator and candidate, with the columns @CSV.

### constraints.npz

@CONSTRAINTS

## A run of an experiment

`simtest validate` writes these files; [Experiments](../howto/experiments.md) explains them.

### results.parquet

A row for each estimator at each detected or missed highlight. The swept parameters follow these columns under their own
names. BP is the highlight's brightest point; sections are those of [theory](../concepts/theory.md).

@RESULTS

Runs with instruments have `on_instrument`: the index of the instrument that a detection shows. Runs with further
views have rows of the estimator `motion`, with the status `ok` where both signs are decided, else `undecided`:
`motion_over_d` (motion over distance), and for each estimated principal direction `motion_sign_1`, `motion_sign_2`
(decided sign of 1 + d k; 0: undecided), `motion_gain_1`, `motion_gain_2` (true 1 + d k) and `motion_margin_1`,
`motion_margin_2` (twice the log of the likelihood ratio of both signs); `motion_distance2` (squared Mahalanobis
distance of the best curvature) and `motion_fits` (1: it explains the views). Runs of the published protocol have a
column for each key `paper.*` and `bound_deg`, the Cramer-Rao bound.

### summary.json

`run` tells how the run was made; `experiments.NAME.settings.SETTING.ESTIMATOR` holds the figures.

#### run

@RUN

The environment (versions, machine) stands beside them.

#### Figures

@FIGURES

#### Beside the settings

`experiments.NAME` also has `title`, `description`, `realism` (which kind of realism the scenes stand for), `frames`
(their number), `faults` (errors inside estimators and cores: `estimator`, `reason`, `text`, `count`), `estimators`
(a sentence each) and `conditions`: by setting `told` (what estimators know of the lights), `relief`, `sensor`,
`render`, `camera`, `half_width_rad` (of the lobe; null where the reflectance has none) and `focal_px`.

### guide.json

The table of situations. `rows` has an object for each: `surface`, `circumstances`, `settings`, `target` (`fine` or
`base`), `best`, `ties` (methods that cannot be distinguished from it), `unranked` (why the order is open, or
empty), `error`, `answered`, `unanswered`, `breaks`, `is_broken` (the best method's figures in words), `methods` and
`best_by_setting` with the figures `n`, `answered`, `missed`, `refused`, `failed`, `median_deg`, `mean_deg`,
`interval_deg` (95 % of the median; null below 5 frames), `mean_penalised_deg` and `breaks`. `practice` has, for
`overview`, what pictures from practice give (`title`, `about`, `rows`), else null. `methods`, `shared`,
`seen`, `left_out`, `rules` and `words` explain the table.

## A dataset

`simtest dataset` writes shards, tables, manifest.json and README.md; [Datasets](../howto/datasets.md)
explains them. highlights.parquet and estimates.parquet are folders of a file a shard.

### Images of a sample

@IMAGES

### index.parquet

@SAMPLES

### highlights.parquet

@HIGHLIGHTS

### estimates.parquet

`index`, `split`, and the columns of [results.parquet](#results-parquet).
"""


def files_page() -> str:
    """Return the page as Markdown."""
    meaning, of_columns = ("key", "meaning"), ("column", "type", "meaning")
    images = (
        (code(own.name), code(own.suffix), f"{own.shape} {own.dtype}, {own.unit}", own.meaning, own.codec.text)
        for own in SAMPLE_FIELDS
    )
    *most, last = FILES
    made = {
        "FILES": f"{', '.join(most)} and {last}",
        "FRAME": table(("file, array or key", "meaning"), _coded({**FIELDS, **INSTRUMENT_FIELDS})),
        "NORMALS": table(meaning, _coded(NORMALS)),
        "SPECULARITY": table(meaning, _coded(SPECULARITY)),
        "ESTIMATE": table(meaning, _coded(ESTIMATE)),
        "CSV": ", ".join(code(name) for name in COLUMNS),
        "CONSTRAINTS": table(("array", "shape", "meaning"), ((code(name), *row) for name, row in CONSTRAINTS.items())),
        "RESULTS": table(of_columns, _columns(RESULTS)),
        "RUN": _parameters(RunRecord),
        "FIGURES": _parameters(Figures),
        "IMAGES": table(("field", "member", "decoded", "meaning", "encoding"), images),
        "SAMPLES": table(of_columns, _columns(SAMPLE_COLUMNS)),
        "HIGHLIGHTS": table(of_columns, _columns(HIGHLIGHT_COLUMNS)),
    }
    return re.sub(r"@([A-Z]+)\b", lambda match: made[match[1]], PAGE)


def _columns(columns: Mapping[str, Column]) -> Iterable[tuple[str, str, str]]:
    """Return the columns of a table, those of one meaning, such as a vector's, in a row."""
    rows: list[tuple[list[str], str, str]] = []
    for name, column in columns.items():
        kind = str(column.dtype).lower()
        if column.meaning:
            rows.append(([name], kind, column.meaning))
        else:
            rows[-1][0].append(name)
            if kind not in rows[-1][1].split(", "):
                rows[-1] = (rows[-1][0], f"{rows[-1][1]}, {kind}", rows[-1][2])
    return [(code(", ".join(names)), kind, line) for names, kind, line in rows]


def _coded(lines: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    return ((code(names), line) for names, line in lines.items())


def _parameters(record: type) -> str:
    """Return the table of a record's fields from its docstring, which a test compares with the fields."""
    rows = [(code(own.arg_name), own.description or "") for own in parse(inspect.getdoc(record) or "").params]
    return table(("key", "meaning"), rows)
