"""The page of files and columns, from the tables in the code that writes them."""

import inspect
import re
from collections.abc import Iterable, Mapping, Sequence

from docstring_parser import parse

from simtest.dataset.fields import FIELDS as SAMPLE_FIELDS
from simtest.dataset.index import HighlightRow, SampleRow
from simtest.reconstruction.output_files import COLUMNS
from simtest.simulation.frame_files import FIELDS, INSTRUMENT_FIELDS
from simtest.validation.column_meanings import MEANINGS
from simtest.validation.results_table import SCHEMA
from simtest.validation.runner import RunRecord
from simtest.validation.statistics import Figures
from studies.manual.tables import CONSTRAINTS, ESTIMATE, NORMALS, SPECULARITY

PAGE = """# Files and columns

What the commands write, and what each column and key means. Lengths are in mm, pixels have their centres at
integer + 0.5, and the camera frame has x to the right, y down and z forward. [Keys of the files](keys.md) lists what
the commands read.

```{toctree}
:hidden:

keys
```

## A rendered frame

`simtest render` writes frame.png, radiance.exr, truth.npz, frame.json, camera.toml and calibration.toml. Names without
a file below are arrays of truth.npz; frame.json holds the same list under its key `fields`. `instrument` and
`visible_highlights.instrument` exist where the scene lists instruments.

@FRAME

## Normals of a picture

`simtest reconstruct` writes these files; [Reconstructing a picture](../howto/reconstruct.md) explains how to read them.

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

`simtest validate` writes these files; [Experiments and their results](experiments.md) explains them.

### results.parquet

A row for each estimator at each detected or missed highlight. The swept parameters follow these columns under their own
names. BP is the highlight's brightest point; sections are those of [theory](../concepts/theory.md).

@RESULTS

### summary.json

`run` tells how the run was made; `experiments.NAME.settings.SETTING.ESTIMATOR` holds the figures.

#### run

@RUN

The environment (versions, machine) stands beside them.

#### Figures

@FIGURES

## A dataset

`simtest dataset` writes shards, tables, manifest.json and README.md; [Datasets for learning](../howto/datasets.md)
explains them.

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
    meaning = ("key", "meaning")
    images = (
        (_code(own.name), _code(own.suffix), f"{own.shape} {own.dtype}, {own.unit}", own.meaning, own.encoding)
        for own in SAMPLE_FIELDS
    )
    made = {
        "FRAME": _table(("file, array or key", "meaning"), _coded({**FIELDS, **INSTRUMENT_FIELDS})),
        "NORMALS": _table(meaning, _coded(NORMALS)),
        "SPECULARITY": _table(meaning, _coded(SPECULARITY)),
        "ESTIMATE": _table(meaning, _coded(ESTIMATE)),
        "CSV": ", ".join(_code(name) for name in COLUMNS),
        "CONSTRAINTS": _table(
            ("array", "shape", "meaning"), ((_code(name), *row) for name, row in CONSTRAINTS.items())
        ),
        "RESULTS": _table(("column", "type", "meaning"), _columns()),
        "RUN": _parameters(RunRecord),
        "FIGURES": _parameters(Figures),
        "IMAGES": _table(("field", "member", "decoded", "meaning", "encoding"), images),
        "SAMPLES": _parameters(SampleRow),
        "HIGHLIGHTS": _parameters(HighlightRow),
    }
    return re.sub(r"@([A-Z]+)\b", lambda match: made[match[1]], PAGE)


def _columns() -> Iterable[tuple[str, str, str]]:
    """Return the columns of results, those of one vector or matrix in a row."""
    rows: list[tuple[list[str], str, str]] = []
    for name, kind in SCHEMA.items():
        if not MEANINGS[name]:
            rows[-1][0].append(name)
        else:
            rows.append(([name], str(kind).lower(), MEANINGS[name]))
    return [(_code(", ".join(names)), kind, line) for names, kind, line in rows]


def _coded(table: Mapping[str, str]) -> Iterable[tuple[str, str]]:
    return ((_code(names), line) for names, line in table.items())


def _parameters(record: type) -> str:
    """Return the table of a record's fields from its docstring, which a test compares with the fields."""
    rows = [(_code(own.arg_name), own.description or "") for own in parse(inspect.getdoc(record) or "").params]
    return _table(("key", "meaning"), rows)


def _code(names: str) -> str:
    return ", ".join(f"`{name}`" for name in names.split(", "))


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *([_cell(cell) for cell in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    """Return a cell on one line, its signs taken as they are where they are no code."""
    parts = " ".join(text.split()).split("`")
    parts[::2] = [re.sub(r"([|*$<])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)
