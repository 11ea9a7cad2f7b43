"""Croissant metadata beside the dataset card: valid, true to the files, and read by mlcroissant."""

import hashlib
import json

import polars as pl
import pytest

from simtest.dataset import read
from simtest.dataset.croissant import CROISSANT
from simtest.dataset.shard_writer import write_dataset
from simtest.runtime.engines import make_engine
from simtest.spec import load_dataset


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("croissant") / "tiny"
    write_dataset(load_dataset("tiny", {"samples": 6, "estimators": ["brightest_point"]}), folder, make_engine())
    return folder


@pytest.mark.render
def test_every_file_is_listed_with_its_hash(made):
    content = json.loads((made / CROISSANT).read_text())
    files = {entry["contentUrl"]: entry for entry in content["distribution"] if entry["@type"] == "cr:FileObject"}
    assert set(files) == {path.name for path in made.iterdir() if path.suffix in (".tar", ".parquet")}
    for name, entry in files.items():
        data = (made / name).read_bytes()
        assert entry["sha256"] == hashlib.sha256(data).hexdigest()
        assert entry["contentSize"] == f"{len(data)} B"
    columns = {record["name"]: [field["name"] for field in record["field"]] for record in content["recordSet"]}
    for table in ("index", "highlights", "estimates"):
        assert columns[table] == pl.read_parquet(made / f"{table}.parquet").columns
    fields = set(next(read(made))) - {"meta"}
    assert fields - {"normal_base", "curvature_base", "pool", "instrument"} <= set(columns)
